"""overfly info: what a recorded flight or a map holds, and what it lacks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from overfly.cli.options import TimeOffset, Topic

if TYPE_CHECKING:
    from overfly.sensors import Flight

PROBLEMS_SHOWN = 20


def command(
    source: Annotated[Path, typer.Argument(help="Any source of a flight, or a map file.")],
    camera: Annotated[Path | None, typer.Option(help="Calibration file to use instead.")] = None,
    stereo: Annotated[bool | None, typer.Option("--stereo/--mono", help="As found, if left away.")] = None,
    time_offset_s: TimeOffset = None,
    topic: Topic = None,
    quick: Annotated[bool, typer.Option("--quick", help="Do not decode every picture.")] = False,
    json_output: Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")] = False,
) -> None:
    """Say what a flight or map is, what sensors it has, which scale source it uses, and what is missing."""
    from overfly.cli.map_info import is_map_file

    if is_map_file(source):
        print(_map_info(source, json_output))
        return
    from overfly.sensors import ReadOptions, open_flight

    flight = open_flight(
        source, ReadOptions(camera_file=camera, stereo=stereo, time_offset_s=time_offset_s, topic=topic)
    )
    readable = None if quick else sum(1 for _ in flight)
    if json_output:
        import json

        print(json.dumps(as_dictionary(flight, readable)))
    else:
        print(as_text(flight, readable))


def _map_info(path: Path, json_output: bool) -> str:
    import json

    from overfly.cli import map_info
    from overfly.mapstore import Map

    known = Map.open(path)
    return json.dumps(map_info.as_dictionary(known)) if json_output else map_info.as_text(known)


def as_dictionary(flight: Flight, readable: int | None) -> dict[str, Any]:
    """What the flight holds, in JSON's types; readable: frames that could be decoded, None when not tried."""
    from overfly.sensors import choose_scale_source

    duration_s = float(flight.t_ns[-1] - flight.t_ns[0]) * 1e-9
    return {
        "source": str(flight.path),
        "kind": str(flight.kind),
        "frames": len(flight),
        "frames_readable": readable,
        "start_ns": int(flight.t_ns[0]),
        "duration_s": duration_s,
        "rate_hz": (len(flight) - 1) / duration_s if duration_s > 0 else None,
        "cameras": [
            {
                "name": mounted.name,
                "width": mounted.camera.width,
                "height": mounted.camera.height,
                "fx": mounted.camera.fx,
                "fy": mounted.camera.fy,
                "cx": mounted.camera.cx,
                "cy": mounted.camera.cy,
                "distortion": str(mounted.camera.distortion),
                "coefficients": list(mounted.camera.coefficients),
            }
            for mounted in flight.rig.cameras
        ],
        "calibration_source": flight.rig.calibration_source,
        "stereo_baseline_m": _baseline_m(flight),
        "sensors": [
            {
                "name": sensor.name,
                "quantity": str(sensor.quantity),
                "samples": sensor.samples,
                "rate_hz": sensor.rate_hz,
                "sigma": sensor.sigma,
                "frames": sensor.frames,
            }
            for sensor in flight.sensors
        ],
        "scale_landmark": None if flight.scale_landmark is None else flight.scale_landmark.name,
        "named_landmarks": sorted({click.name for click in flight.landmark_clicks}),
        "scale_source": str(choose_scale_source(flight)),
        "missing": missing(flight),
        "problems": [{"where": problem.where, "what": problem.what} for problem in flight.problems],
    }


def missing(flight: Flight) -> list[str]:
    """What the flight lacks and what follows from it, one line each."""
    from overfly.sensors import Quantity, ScaleSource, choose_scale_source

    frames = {sensor.quantity: sensor.frames for sensor in flight.sensors}
    lines = []
    if choose_scale_source(flight) is ScaleSource.NONE:
        lines.append("scale: nothing tells how long a metre is; give --height-m or --landmark")
    if Quantity.ATTITUDE not in frames:
        lines.append("attitude: the camera is taken to be level, within what its images allow")
    if Quantity.POSITION not in frames:
        lines.append("GPS: the map gets local coordinates")
    if flight.rig.calibration_source == "default":
        lines.append("calibration: nothing states the focal length, a guess is used; give --camera")
    lines += [
        f"{sensor.name}: no value for {len(flight) - sensor.frames} of {len(flight)} frames"
        for sensor in flight.sensors
        if sensor.frames < len(flight)
    ]
    return lines


def as_text(flight: Flight, readable: int | None) -> str:
    """The same for a terminal."""
    facts = as_dictionary(flight, readable)
    decoded = "" if readable is None or readable == len(flight) else f" ({readable} readable)"
    rate = f", {facts['rate_hz']:.2f} Hz" if facts["rate_hz"] else ""
    lines = [
        f"{flight.path}: {flight.kind}",
        f"  frames           {len(flight)}{decoded}, {facts['duration_s']:.1f} s{rate}",
    ]
    for mounted in flight.rig.cameras:
        camera = mounted.camera
        size = f"{camera.width}x{camera.height}"
        lines.append(
            f"  {mounted.name:<16} {size}, focal length {camera.focal_px:.1f} px, {camera.distortion}"
            f" (calibration: {flight.rig.calibration_source})"
        )
    if facts["stereo_baseline_m"] is not None:
        lines.append(f"  stereo           baseline {facts['stereo_baseline_m']:.4f} m")
    lines += [
        f"  {sensor.name:<16} {sensor.quantity}, {sensor.samples} at {sensor.rate_hz:.4g} Hz, {sensor.sigma}"
        for sensor in flight.sensors
    ]
    if facts["named_landmarks"]:
        lines.append(f"  landmarks        {', '.join(facts['named_landmarks'])}")
    if flight.scale_landmark is not None:
        lines.append(f"  known size       {flight.scale_landmark.name}")
    lines.append(f"  scale from       {facts['scale_source']}")
    lines += [f"  missing          {line}" for line in facts["missing"]]
    lines += [
        f"  problem          {problem.where}: {problem.what}" for problem in flight.problems[:PROBLEMS_SHOWN]
    ]
    if len(flight.problems) > PROBLEMS_SHOWN:
        lines.append(f"  problem          and {len(flight.problems) - PROBLEMS_SHOWN} more; --json names all")
    return "\n".join(lines)


def _baseline_m(flight: Flight) -> float | None:
    if not flight.rig.is_stereo:
        return None
    offset = flight.rig.cam1_from_cam0.translation
    return float((offset @ offset) ** 0.5)
