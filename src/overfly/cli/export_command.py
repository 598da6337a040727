"""overfly export: a finished map for other programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

FORMATS = "tum, kitti, euroc, g2o, colmap, geojson, kml, gpx, ply, las, occupancy"


def command(
    source: Annotated[Path, typer.Argument(metavar="MAP", help="map.overfly, or the folder that map left.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write; for colmap a folder.")],
    to: Annotated[str, typer.Option("--to", help=f"One of {FORMATS}.")],
    flight: Annotated[
        int | None, typer.Option(help="Number of one flight, in a map of several; all by default.")
    ] = None,
    obstacle_m: Annotated[
        float,
        typer.Option("--obstacle-m", help="occupancy: what stands out so far is in the way.", min=1e-3),
    ] = 0.3,
    json_output: Annotated[bool, typer.Option("--json", help="Print what was written as JSON.")] = False,
) -> None:
    """Write a map in the format of another program."""
    from overfly.errors import UsageError
    from overfly.pipeline.exporting import ExportRequest, Format, run

    if to not in set(Format):
        raise UsageError(f"--to {to}: choose one of {', '.join(Format)}")
    done = run(ExportRequest(source, Format(to), out, flight, obstacle_m))
    if json_output:
        print(json.dumps(done))
    else:
        numbers = ", ".join(f"{value} {name}" for name, value in done.items() if isinstance(value, int))
        print(f"{done['output']}: {numbers}")
