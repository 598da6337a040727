"""overfly demo: a first map without any data."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from overfly.cli.console import FrameProgress, announce_compiling, say


def command(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the flight and its map.")] = Path(
        "overfly-demo"
    ),
    seed: Annotated[int, typer.Option(help="Another seed is another garden.")] = 0,
    show: Annotated[
        bool | None, typer.Option("--show/--no-show", help="Open the report in a browser.")
    ] = None,
    json_output: Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")] = False,
) -> None:
    """Simulate a short flight over a garden, map it, and compare the map with the truth."""
    from overfly.pipeline.demo import run_demo

    say("Simulating a flight and mapping it ...")
    announce_compiling()
    with FrameProgress() as progress:
        result = run_demo(out, seed, progress)
    if json_output:
        print(json.dumps(result.metrics | {"ate_m": result.evaluation.ate_m.rmse}))
        return
    error_mm = 1e3 * result.evaluation.ate_m.rmse
    print(
        f"{result.metrics['located']} of {result.metrics['frames']} frames located; "
        f"{error_mm:.0f} mm from the truth (RMS) on a path of {result.evaluation.path_m:.0f} m.\n"
        f"The flight is in {out / 'flight'}, its map in {out / 'map'}: open {out / 'map' / 'report.html'}\n"
        f"Next: overfly map YOUR_FLIGHT -o OUT"
    )
    if show or (show is None and sys.stdout.isatty()):
        typer.launch(str((out / "map" / "report.html").resolve()))
