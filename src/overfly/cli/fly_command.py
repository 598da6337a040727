"""overfly fly: keep a place, or go to places, by the map alone."""

from __future__ import annotations

import json
import shlex
import sys
from contextlib import closing, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from overfly.cli.console import FrameProgress, announce_page, exit_interrupted
from overfly.errors import SourceError, UsageError

if TYPE_CHECKING:
    from overfly.pipeline.autopilot import AutopilotRequest
    from overfly.pipeline.flying import FlyRequest


def command(
    map_file: Annotated[
        Path, typer.Argument(metavar="[MAP]", help="A map of the place; begun if there is none.")
    ] = Path("map.overfly"),
    sim: Annotated[
        str | None,
        typer.Option("--sim", help="Fly in this simulated world: blimp, multirotor, helicopter, hold, ..."),
    ] = None,
    mavlink: Annotated[
        str | None,
        typer.Option("--mavlink", help="Tell this autopilot where it is: udpin:0.0.0.0:14550, /dev/ttyAMA0."),
    ] = None,
    camera: Annotated[str, typer.Option(help="With --mavlink: camera:0 or rtsp://...")] = "camera:0",
    calibration: Annotated[
        Path | None, typer.Option(help="With --mavlink: of the camera; that of the map if left away.")
    ] = None,
    camera_delay_ms: Annotated[
        float, typer.Option("--camera-delay-ms", help="With --mavlink: from exposure to arrival.")
    ] = 0.0,
    goto: Annotated[str | None, typer.Option(help="Go to this place of the map and end there: X,Y.")] = None,
    hold: Annotated[bool, typer.Option("--hold", help="Keep the place where the mission begins.")] = False,
    waypoints: Annotated[
        Path | None, typer.Option(help="Places to visit: a text file with x,y in each line.")
    ] = None,
    minutes: Annotated[float | None, typer.Option(min=0.05, help="Length of the mission.")] = None,
    wind: Annotated[float, typer.Option(min=0.0, help="Mean wind, m/s, with gusts.")] = 0.0,
    pushes: Annotated[int, typer.Option(min=0, help="How often a hand leads the vehicle away.")] = 0,
    drop_outs: Annotated[
        bool, typer.Option("--drop-outs", help="Pictures go black or missing, ranges too.")
    ] = False,
    survey: Annotated[
        str | None, typer.Option(help="Map so much ground first, metres: 6x4; 0x0 for none.")
    ] = None,
    geofence_m: Annotated[
        float | None, typer.Option("--geofence-m", min=0.1, help="Margin of the geofence about the map.")
    ] = None,
    floor_m: Annotated[
        float | None, typer.Option("--floor-m", min=0.05, help="Never lower above the ground.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the simulated world.")] = 0,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")] = Path(
        "overfly-flight"
    ),
    viewer: Annotated[
        bool, typer.Option("--viewer", help="Ground station in the browser: see it, click where to go.")
    ] = False,
    viewer_host: Annotated[
        str, typer.Option(help="Address to serve it on, 0.0.0.0 for other machines; those need a token.")
    ] = "127.0.0.1",
    json_output: Annotated[
        bool, typer.Option("--json", help="Print the numbers as one JSON object.")
    ] = False,
) -> int:
    """Fly by the map alone: hold a place in wind and pushes, or go to places; the map grows meanwhile."""
    if (sim is None) == (mavlink is None):
        raise UsageError("say what to fly: --sim blimp, for example, or --mavlink udpin:0.0.0.0:14550")
    if sum((goto is not None, hold, waypoints is not None)) > 1:
        raise UsageError("--goto, --hold and --waypoints: choose one")
    if viewer and mavlink is not None:
        raise UsageError("--viewer is for --sim: a real vehicle takes no orders from a page yet")
    from overfly.pipeline.flying import FlyRequest, run
    from overfly.pipeline.operating import Operator

    places = (place_of(goto),) if goto else read_places(waypoints) if waypoints else ()
    typed = shlex.join(["overfly", *sys.argv[1:]])
    if mavlink is not None:
        from overfly.pipeline.autopilot import AutopilotRequest

        return fly_vehicle(
            AutopilotRequest(
                map_file, mavlink, camera, out, calibration, places, hold, minutes,
                geofence_m, floor_m, 1e-3 * camera_delay_ms, typed,
            ),
            json_output,
        )  # fmt: skip
    assert sim is not None
    request = FlyRequest(
        map_file, sim, out, places, minutes, wind, pushes, drop_outs, seed,
        size_of(survey), geofence_m, floor_m, endless=viewer and not places and minutes is None,
        command=typed,
    )  # fmt: skip
    operator = Operator(announce_page, map_file, viewer_host) if viewer else None
    count = 0
    with FrameProgress() as progress, closing(operator) if operator else nullcontext():

        def watch(frame: Any, result: Any, situation: Any) -> None:
            nonlocal count
            count += 1
            progress(count, result)
            if operator:
                operator.watch(frame, result, situation)

        controls = (operator.orders, operator.begin) if operator else ()
        outcome = run(request, watch, *controls)
    print(json.dumps(outcome.numbers) if json_output else summary(outcome.numbers, request))
    return exit_interrupted() if outcome.interrupted else 0


def fly_vehicle(request: AutopilotRequest, json_output: bool) -> int:
    """A real vehicle, until somebody interrupts or what was asked for is done."""
    from overfly.pipeline.autopilot import run

    count = 0
    with FrameProgress() as progress:

        def watch(_frame: object, result: Any) -> None:
            nonlocal count
            count += 1
            progress(count, result)

        outcome = run(request, watch)
    numbers = outcome.numbers
    words = (
        f"{numbers['located']} of {numbers['images']} pictures located, {numbers['fixes_sent']} fixes sent "
        f"to {numbers['autopilot']}, {1e3 * numbers['latency_s']:.0f} ms after the picture; "
        f"results in {request.out}"
    )
    print(json.dumps(numbers) if json_output else words)
    return exit_interrupted() if outcome.interrupted else 0


def place_of(text: str) -> tuple[float, float]:
    """'X,Y' in metres."""
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"--goto {text}: write a place as X,Y in metres of the map's world") from None
    return x, y


def read_places(path: Path) -> tuple[tuple[float, float], ...]:
    """Places from a text file, one in each line. Raises SourceError."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: cannot be read: {error}") from error
    places = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            x, y = (float(part) for part in line.split(",")[:2])
        except ValueError:
            raise SourceError(f"{path}:{number}: write a place as x,y in metres") from None
        places.append((x, y))
    if not places:
        raise SourceError(f"{path}: no place in it: write one as x,y in metres in each line")
    return tuple(places)


def size_of(text: str | None) -> tuple[float, float] | None:
    """'WIDTHxDEPTH' in metres."""
    if text is None:
        return None
    try:
        width, depth = (float(part) for part in text.lower().split("x"))
    except ValueError:
        raise UsageError(f"--survey {text}: write it as WIDTHxDEPTH in metres, such as 6x4") from None
    if min(width, depth) < 0.0:
        raise UsageError(f"--survey {text}: sizes are not negative")
    return width, depth


def summary(numbers: dict[str, Any], request: FlyRequest) -> str:
    """A few lines for a person."""
    lines = []
    if numbers.get("images"):
        lines.append(
            f"{numbers['images']} pictures in {numbers['simulated_s'] / 60.0:.1f} minutes of flight, "
            f"{numbers['realtime_factor']:.1f} times real time; longest without a fix: "
            f"{numbers['longest_lost_s']:.1f} s"
        )
        if numbers["rms_error_m"] is not None:
            lines.append(f"RMS distance to its place when settled: {100.0 * numbers['rms_error_m']:.1f} cm")
        if numbers["pushes"]:
            lines.append(
                f"pushed {numbers['pushes']} times, up to {numbers['max_error_m']:.1f} m away; "
                f"came back {numbers['returned']} times, in {numbers['longest_return_s'] or 0.0:.0f} s at "
                "most"
            )
        if request.places:
            lines.append(
                f"arrived at {numbers['arrived']} of {len(request.places)} places, "
                f"the last one {100.0 * numbers['final_error_m']:.1f} cm away"
            )
    lines.append(f"results in {request.out}: open {request.out / 'report.html'}")
    return "\n".join(lines)
