"""overfly locate: find frames in a map that exists."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from overfly.cli.console import FrameProgress, announce_page, exit_interrupted
from overfly.cli.map_command import settings_of
from overfly.cli.options import (
    Assignments,
    AttitudeUse,
    CameraFile,
    Every,
    Out,
    Source,
    StartS,
    Stereo,
    StopS,
    TimeOffset,
    Topic,
    Watched,
)


def command(
    map_file: Annotated[Path, typer.Argument(metavar="MAP", help="A map file: map.overfly.")],
    source: Source,
    out: Out,
    config: Annotated[
        Path | None, typer.Option("--config", help="Settings that replace the map's, YAML.")
    ] = None,
    assignments: Assignments = None,
    camera: CameraFile = None,
    stereo: Stereo = None,
    attitude: AttitudeUse = None,
    start_s: StartS = None,
    stop_s: StopS = None,
    every: Every = 1,
    time_offset_s: TimeOffset = None,
    topic: Topic = None,
    viewer: Watched = False,
    json_output: Annotated[
        bool, typer.Option("--json", help="Print the numbers as one JSON object.")
    ] = False,
) -> int:
    """Find the frames of a flight in a map: where each was taken, or why that is not known."""
    given = settings_of(config, assignments, attitude, None).model_dump(mode="json", exclude_unset=True)
    from overfly.frame_result import FrameResult
    from overfly.pipeline.locating import LocateRequest, run
    from overfly.sensors import ReadOptions

    reading = ReadOptions(camera, stereo, start_s, stop_s, every, time_offset_s=time_offset_s, topic=topic)
    with FrameProgress() as progress:
        numbers, interrupted = run(
            LocateRequest(map_file, source, out, given, reading, announce_page if viewer else None),
            lambda count, fix: progress(count, FrameResult(fix.t_ns, fix.pose)),
        )
    print(json.dumps(numbers) if json_output else summary(numbers, out))
    return exit_interrupted() if interrupted else 0


def summary(numbers: dict[str, Any], out: Path) -> str:
    """A few lines for a person."""
    lines = [f"{numbers['located']} of {numbers['frames']} frames located"]
    if numbers["latency_ms"]:
        lines[0] += (
            f", {numbers['latency_ms']['p50']:.0f} ms a frame (95 %: {numbers['latency_ms']['p95']:.0f} ms)"
        )
    lines += [f"lost: {reason} ({count} frames)" for reason, count in numbers["lost_by_reason"].items()]
    lines.append(f"results in {out}: fixes.jsonl, fixes.tum")
    return "\n".join(lines)
