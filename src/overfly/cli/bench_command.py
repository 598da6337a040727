"""overfly bench: how fast Overfly is on this machine, beside what else is installed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer


def command(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for bench.json and bench.html.")] = Path(
        "overfly-bench"
    ),
    frames: Annotated[int, typer.Option(min=10, help="Frames of each flight.")] = 240,
    long_frames: Annotated[
        int, typer.Option("--long", min=0, help="Frames of the long flight; 0 leaves it out.")
    ] = 2000,
    source: Annotated[Path | None, typer.Option(help="A recorded flight instead of simulated ones.")] = None,
    stereo: Annotated[
        bool | None, typer.Option("--stereo/--mono", help="Cameras of the recorded flight.")
    ] = None,
    json_output: Annotated[
        bool, typer.Option("--json", help="Print the figures as one JSON object.")
    ] = False,
) -> None:
    """Measure frames per second and stages by resolution, cameras and feature type, beside alternatives."""
    from overfly.cli.console import announce_compiling, say
    from overfly.pipeline.bench import run_bench
    from overfly.sensors import ReadOptions
    from overfly.threads import one_opencv_thread

    announce_compiling()
    with one_opencv_thread():
        report = run_bench(out, frames, long_frames, source, ReadOptions(stereo=stereo), say)
    if json_output:
        print(json.dumps(report))
        return
    for case in report["cases"]:
        cameras = "stereo" if case["stereo"] else "mono"
        print(
            f"{case['name']:20} {cameras:6} {case['features']:16} {case['frames_per_second']:6.0f} frames/s"
        )
    for row in report["alternatives"]:
        print(f"{row['flight']:20} {row['name']:32} {row['times_ours']:.2f} times our time")
    print(f"results in {out}: open {out / 'bench.html'}")
