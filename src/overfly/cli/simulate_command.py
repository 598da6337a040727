"""overfly simulate: write a simulated flight with exact truth."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from overfly.errors import UsageError


def command(
    scenario: Annotated[str, typer.Argument(help="Name of a scenario; 'list' shows them all.")],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="New folder for the flight.")] = None,
    seed: Annotated[int, typer.Option(help="Another seed is another ground, path and noise.")] = 0,
    frames: Annotated[int | None, typer.Option(min=1, help="Only the first N frames.")] = None,
    size: Annotated[
        str | None, typer.Option(help="Picture size, such as 640x480; same field of view.")
    ] = None,
    camera: Annotated[
        Path | None, typer.Option(help="Fly this camera: a Kalibr, OpenCV, ROS, COLMAP or EuRoC calibration.")
    ] = None,
    ortho: Annotated[Path | None, typer.Option(help="Fly over this GeoTIFF orthophoto instead.")] = None,
    dsm: Annotated[Path | None, typer.Option(help="Heights for --ortho: a GeoTIFF surface model.")] = None,
    height_m: Annotated[
        float | None, typer.Option(min=0.2, help="Height of a survey above the ground, metres.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")] = False,
) -> None:
    """Simulate a flight: pictures and sensors in EuRoC layout under mav0/, the truth under truth/."""
    from overfly.sensors.calibration_files import read_camera_file
    from overfly.simulation import simulate, with_camera, write_flight
    from overfly.simulation.orthophoto import over_orthophoto
    from overfly.simulation.scenario import SCENARIOS, declared

    if scenario == "list":
        declared("demo")
        for name, entry in sorted(SCENARIOS.items()):
            print(f"{name:18} {entry.title}")
        return
    if out is None:
        raise UsageError("say where the flight shall go: -o FOLDER")
    if ortho is None and (dsm is not None or height_m is not None):
        raise UsageError("--dsm and --height-m belong to --ortho: give the orthophoto, too")
    built = declared(scenario).build(seed)
    if ortho is not None:
        built = over_orthophoto(built, ortho, dsm, height_m, seed)
    if camera is not None:
        built = with_camera(built, read_camera_file(camera)[0].camera)
    flight = simulate(built, seed, frames, _size(size))
    count = write_flight(flight, out, _progress)
    if as_json:
        print(json.dumps({"scenario": scenario, "seed": seed, "frames": count, "out": str(out)}))
    else:
        print(f"{count} frames of '{scenario}' are in {out}; the truth is in {out / 'truth'}")


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) >= 16 for part in parts):
        raise UsageError(f"--size {text}: write it as WIDTHxHEIGHT in pixels, such as 640x480")
    return int(parts[0]), int(parts[1])


def _progress(done: int, total: int) -> None:
    """A line that counts on a terminal; elsewhere a plain line now and then."""
    if sys.stderr.isatty():
        print(f"\rframe {done}/{total}", end="" if done < total else "\n", file=sys.stderr, flush=True)
    elif done % 200 == 0 or done == total:
        print(f"frame {done}/{total}", file=sys.stderr)
