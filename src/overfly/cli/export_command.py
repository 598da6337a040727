"""overfly export: a finished map for other programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

FORMATS = "tum, kitti, euroc, g2o, colmap, geojson, kml, gpx, ply, las, occupancy"


def command(
    source: Annotated[Path, typer.Argument(metavar="MAP", help="map.overfly, or the folder that map left.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write; for colmap a folder.")],
    to: Annotated[str | None, typer.Option("--to", help=f"One of {FORMATS}.")] = None,
    overlay: Annotated[
        Path | None,
        typer.Option(help="Draw the map over this one: GeoTIFF, picture with world file, or ROS map YAML."),
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option(help="overlay: CSV of places in both: name or map_x_m,map_y_m; x,y or column,row."),
    ] = None,
    opacity: Annotated[float, typer.Option(help="overlay: of the map.", min=0.0, max=1.0)] = 0.8,
    flight: Annotated[
        int | None, typer.Option(help="Number of one flight, in a map of several; all by default.")
    ] = None,
    obstacle_m: Annotated[
        float,
        typer.Option("--obstacle-m", help="occupancy: what stands out so far is in the way.", min=1e-3),
    ] = 0.3,
    json_output: Annotated[bool, typer.Option("--json", help="Print what was written as JSON.")] = False,
) -> None:
    """Write a map in the format of another program, or draw it over another map."""
    from overfly.errors import UsageError

    if (to is None) == (overlay is None):
        raise UsageError(f"give either --to FORMAT, one of {FORMATS}, or --overlay FILE")
    if overlay is not None:
        from overfly.pipeline import overlaying

        drawn = overlaying.run(overlaying.OverlayRequest(source, overlay, out, points, opacity))
        print(json.dumps(drawn) if json_output else overlay_summary(drawn))
        return
    from overfly.pipeline.exporting import ExportRequest, Format, run

    if to not in set(Format):
        raise UsageError(f"--to {to}: choose one of {', '.join(Format)}")
    done = run(ExportRequest(source, Format(to), out, flight, obstacle_m))
    if json_output:
        print(json.dumps(done))
    else:
        numbers = ", ".join(f"{value} {name}" for name, value in done.items() if isinstance(value, int))
        print(f"{done['output']}: {numbers}")


def overlay_summary(drawn: dict[str, Any]) -> str:
    """A few lines for a person."""
    lines = [f"{drawn['output']}: {drawn['width']} x {drawn['height']} px, aligned by {drawn['aligned_by']}"]
    if "residuals" in drawn:
        lines.append(f"RMS of the residuals {drawn['rms']:.3g} units of {drawn['other']}:")
        lines += [f"  {name}: {residual:.3g}" for name, residual in drawn["residuals"].items()]
    return "\n".join(lines)
