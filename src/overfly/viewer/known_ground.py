"""The ground of a map that exists: its mosaic on its elevation where they lie beside it, else its points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import viser

from overfly.geometry.poses import FloatArray
from overfly.mapstore import Map
from overfly.products.georeference import GeoReference
from overfly.types import UInt8Array
from overfly.viewer.rasters import Terrain, mosaic_meshes

MOST_POINTS = 200_000
POINT_SHARE = 0.01  # of the flying height: size of a point


def terrain_of(known: Map, folder: Path | None) -> Terrain:
    """From elevation.tif in the folder, else level. Raises SourceError when the file cannot be read."""
    reference = known.georeference or GeoReference.local()
    path = None if folder is None else folder / "elevation.tif"
    if path is not None and path.exists():
        return Terrain.read(path, reference)
    points, _ = known.visual.all_points()
    return Terrain.level(float(np.median(points[:, 2])) if len(points) else 0.0, reference)


def draw_ground(
    server: viser.ViserServer, known: Map, folder: Path | None, terrain: Terrain, unit_m: float
) -> None:
    """Below /ground in the scene. unit_m: the flying height. Raises SourceError for a mosaic that cannot be
    read."""
    mosaic = None if folder is None else folder / "mosaic.tif"
    if mosaic is not None and mosaic.exists():
        for count, mesh in enumerate(mosaic_meshes(mosaic, terrain)):
            server.scene.add_glb(f"/ground/mosaic/{count}", mesh, cast_shadow=False, receive_shadow=False)
        return
    points, _ = known.visual.all_points()
    points = points[:: max(1, len(points) // MOST_POINTS)]
    server.scene.add_point_cloud(
        "/ground/points", points.astype(np.float32), _height_colours(points[:, 2]), precision="float32",
        point_size=POINT_SHARE * unit_m, point_shape="circle", point_shading="flat",
    )  # fmt: skip


def _height_colours(z_m: FloatArray) -> UInt8Array:
    """(n, 3) from brown in the valleys to white on the heights."""
    low, high = np.percentile(z_m, [2, 98]) if len(z_m) else (0.0, 1.0)
    share = np.clip((z_m - low) / max(high - low, 1e-9), 0.0, 1.0)[:, None]
    return np.asarray((1.0 - share) * [150, 110, 70] + share * [245, 245, 235]).astype(np.uint8)
