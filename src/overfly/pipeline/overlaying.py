"""overfly export --overlay: the map over another one. run() is the list of what happens."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS, Transformer

from overfly.errors import SourceError, UsageError
from overfly.geometry.poses import FloatArray
from overfly.mapstore import Map
from overfly.pipeline.exporting import open_map
from overfly.products.georeference import GeoReference, transform_points
from overfly.products.overlay import OtherMap, fit_plane, read_other_map, write_overlay
from overfly.products.pictures import map_picture

LONGEST_PX = 8000  # of the mosaic, as it is drawn
COLUMNS = "name (of a landmark) or map_x_m,map_y_m; and x,y (coordinates of the other map) or column,row"


@dataclass(frozen=True, slots=True)
class OverlayRequest:
    """Which map over which other one; points: a CSV file of places known in both, None where both have a
    CRS."""

    source: Path
    other: Path
    out: Path
    points: Path | None = None
    opacity: float = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class PointPairs:
    """Places (n, 2) in the world, metres, and in the other map; and their names."""

    names: list[str]
    world: FloatArray
    xy: FloatArray


def run(request: OverlayRequest) -> dict[str, Any]:
    """Draw the map over the other one; returns residuals and numbers. Raises OverflyError in one line."""
    known = open_map(request.source)
    assert known.path is not None
    mosaic = known.path.with_name("mosaic.tif")
    if not mosaic.exists():
        raise UsageError(f"there is no {mosaic}: give the folder that overfly map left")
    picture = map_picture(mosaic, known.georeference, LONGEST_PX)
    other = read_other_map(request.other)
    numbers: dict[str, Any] = {"output": str(request.out), "other": str(request.other)}
    world_from_xy: Callable[[FloatArray], FloatArray]
    if request.points is not None:
        pairs = read_pairs(request.points, other, landmarks_beside(known.path))
        fit = fit_plane(pairs.world, pairs.xy)
        numbers |= {
            "aligned_by": "points",
            "units_per_metre": float(np.sqrt(fit.xy_from_world.determinant)),
            "rotation_deg": float(np.degrees(np.arctan2(fit.xy_from_world.d, fit.xy_from_world.a))),
            "rms": fit.rms,
            "residuals": dict(zip(pairs.names, fit.residuals.tolist(), strict=True)),
        }
        inverse = ~fit.xy_from_world

        def world_from_xy(xy: FloatArray) -> FloatArray:
            return transform_points(inverse, xy)
    else:
        world_from_xy = _by_crs(known, other)
        numbers["aligned_by"] = "coordinate reference systems"
    width, height = write_overlay(request.out, picture, other, world_from_xy, request.opacity)
    return numbers | {"width": width, "height": height}


def _by_crs(known: Map, other: OtherMap) -> Callable[[FloatArray], FloatArray]:
    if known.georeference is None or not other.crs:
        which = "the map" if known.georeference is None else str(other.path)
        raise UsageError(f"{which} does not know where it lies on Earth: give --points, CSV with {COLUMNS}")
    reference: GeoReference = known.georeference
    transformer = Transformer.from_crs(
        CRS.from_user_input(other.crs), CRS.from_user_input(reference.crs), always_xy=True
    )
    world_from_crs = ~reference.crs_from_world()

    def world_from_xy(xy: FloatArray) -> FloatArray:
        x, y = transformer.transform(xy[..., 0], xy[..., 1])
        return transform_points(world_from_crs, np.stack([x, y], axis=-1))

    return world_from_xy


def landmarks_beside(map_path: Path) -> dict[str, tuple[float, float]]:
    """x, y of the named landmarks that the map located; empty where it has none."""
    path = map_path.with_name("landmarks.json")
    if not path.exists():
        return {}
    tree = json.loads(path.read_text(encoding="utf-8"))
    return {name: (float(entry["x_m"]), float(entry["y_m"])) for name, entry in tree.items()}


def read_pairs(path: Path, other: OtherMap, landmarks: dict[str, tuple[float, float]]) -> PointPairs:
    """Places known in both maps. Raises SourceError with file and row."""
    names, world, xy = [], [], []
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file, skipinitialspace=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SourceError(f"cannot read the points {path}: {error}") from error
    for number, row in enumerate(rows, start=2):
        where = f"{path}, row {number}"
        try:
            if row.get("map_x_m"):
                world.append((float(row["map_x_m"]), float(row["map_y_m"])))
            elif row["name"] in landmarks:
                world.append(landmarks[row["name"]])
            else:
                known = ", ".join(landmarks) or "none"
                raise SourceError(f"{where}: landmark {row['name']} is not in the map; known are {known}")
            if row.get("column"):
                corner = np.array([float(row["column"]) + 0.5, float(row["row"]) + 0.5])
                xy.append(tuple(transform_points(other.xy_from_pixel, corner)))
            else:
                xy.append((float(row["x"]), float(row["y"])))
        except (KeyError, TypeError, ValueError) as error:
            raise SourceError(f"{where}: needs the columns {COLUMNS}") from error
        names.append(row.get("name") or f"row {number}")
    if len(names) < 2:
        raise SourceError(f"{path}: {len(names)} points; two or more are needed, with the columns {COLUMNS}")
    return PointPairs(names, np.array(world), np.array(xy))
