"""The map's points as PLY (world coordinates) and LAS (coordinates of the map's CRS)."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
from pyproj import CRS

from overfly.errors import OutputError
from overfly.files import atomic_path
from overfly.products.exports.content import GroundPoints
from overfly.products.georeference import GeoReference, transform_points

LAS_STEP_M = 0.001  # LAS keeps whole multiples of this
PLAIN_RGB = 160  # of points whose colour is not known


def write_ply(path: Path, points: GroundPoints) -> None:
    """Binary PLY: x y z in metres, red green blue, and ``sigma``, the standard deviation of the depth.

    Raises OutputError.
    """
    row = [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    table = np.zeros(len(points), np.dtype([*row, ("sigma", "<f4")]))
    for axis, name in enumerate("xyz"):
        table[name] = points.positions[:, axis]
    for band, name in enumerate(("red", "green", "blue")):
        table[name] = PLAIN_RGB if points.rgb is None else points.rgb[:, band]
    table["sigma"] = points.sigma_m
    words = {"<f8": "double", "<f4": "float", "u1": "uchar"}
    properties = "".join(f"property {words[kind]} {name}\n" for name, kind in [*row, ("sigma", "<f4")])
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
    with atomic_path(path) as temporary:
        temporary.write_bytes(header.encode("ascii") + table.tobytes())


def write_las(path: Path, points: GroundPoints, reference: GeoReference | None) -> None:
    """LAS 1.4 with colours, ``sigma`` as an extra dimension, and the CRS where there is one.

    Raises OutputError, also for a map so large that LAS cannot count its millimetres.
    """
    placed = reference or GeoReference.local()
    x, y = transform_points(placed.crs_from_world(), points.positions[:, :2]).T
    places = np.column_stack([x, y, placed.height_in_crs(points.positions[:, 2])])
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales = np.full(3, LAS_STEP_M)
    header.offsets = np.floor(places.mean(axis=0)) if len(places) else np.zeros(3)
    header.add_extra_dim(laspy.ExtraBytesParams("sigma", np.float32, "depth, m (std. deviation)"))
    if reference is not None:
        header.add_crs(CRS.from_user_input(reference.crs))
    cloud = laspy.LasData(header)
    try:
        cloud.x, cloud.y, cloud.z = places.T
    except OverflowError as error:
        raise OutputError(f"cannot write {path}: points lie further apart than LAS can hold") from error
    rgb = np.full((len(points), 3), PLAIN_RGB, np.uint8) if points.rgb is None else points.rgb
    cloud.red, cloud.green, cloud.blue = rgb.T.astype(np.uint16) * 257
    cloud.sigma = (placed.scale * points.sigma_m).astype(np.float32)
    with atomic_path(path) as temporary:
        cloud.write(temporary)
