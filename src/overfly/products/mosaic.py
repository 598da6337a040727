"""The ground seen from straight above, put together from located pictures: an orthophoto on a given ground
surface.

For each ground pixel the nearest camera is taken; seams are hidden by two-band blending (Burt and Adelson, "A
Multiresolution Spline with Application to Image Mosaics", 1983): brightness changes over metres, structure
over a few pixels, so that nothing is seen twice. Work goes tile by tile, with the pictures that win there,
so memory does not grow with the map.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from affine import Affine

from overfly.errors import OutputError
from overfly.geometry.poses import FloatArray
from overfly.products.cog import PackedTile, RasterFrame, cloud_optimised_geotiff, pack_tile
from overfly.products.elevation import ElevationGrid
from overfly.products.exposure import even_exposure, thumbnail_of
from overfly.products.georeference import GeoReference, transform_points
from overfly.products.tiles import Canvas, canvas, draw_tile
from overfly.products.views import MappedImage, View, look_up, spread_out, view_of
from overfly.threads import in_order
from overfly.types import BoolArray

MOST_PIXELS = 1_000_000_000  # a wild pose must not ask for a raster of the whole country
MOST_OVERLAP = 0.85  # pictures that overlap more add seams, not ground

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Mosaic:
    """What was written.

    crs_from_pixel: of the plane, pixel corners; n_images: pictures that went in; fraction_seen of area.
    """

    path: Path
    gsd_m: float
    width: int
    height: int
    crs_from_pixel: Affine
    n_images: int
    fraction_seen: float


def write_mosaic(
    path: str | Path,
    images: Sequence[MappedImage],
    ground: ElevationGrid,
    gsd_m: float | None = None,
    reference: GeoReference | None = None,
    progress: Progress = lambda _done, _total: None,
) -> Mosaic:
    """mosaic.tif: RGBA, Cloud Optimised GeoTIFF, transparent where nothing was seen.

    ground: ``ElevationGrid.flat(0.0)`` where its shape is not known. gsd_m: ground length of a pixel, the
    median of the images by default. reference: where the world lies on Earth; None leaves it in a local
    CRS. progress(done, total) after each tile. Raises OutputError when no image looks at the ground or the
    file cannot be written; what ``load`` raises.
    """
    reference = reference or GeoReference.local()
    ground = ground.extended()
    height_range_m = ground.height_range_m()
    looking = (view_of(image, ground, height_range_m) for image in images)
    views = [view for view in looking if view is not None]
    if not views:
        raise OutputError(f"no located picture looks down on the ground, so there is no mosaic for {path}")
    points = _ground_points(views, ground)
    views = _covering(views, points)
    crs_from_world = reference.crs_from_world()
    gsd = reference.scale * (gsd_m or float(np.median([view.gsd_m for view in views])))
    gsd, crs_from_pixel, width, height = _raster_frame(views, crs_from_world, gsd)
    pictures = (view.image.load() for view in views)
    exposure = even_exposure(views, list(in_order(thumbnail_of, pictures)), points)
    plan = canvas(views, exposure, ground, ~crs_from_world @ crs_from_pixel, gsd / reference.scale)
    frame = RasterFrame(reference.crs, crs_from_pixel, width, height)
    corners = frame.corners()
    seen = 0
    with cloud_optimised_geotiff(path, frame) as raster:
        drawn = in_order(partial(_drawn, plan, (width, height)), corners)
        for done, (tile, seen_here) in enumerate(drawn, start=1):
            raster.add(tile)
            seen += seen_here
            progress(done, len(corners))
    return Mosaic(Path(path), gsd, width, height, crs_from_pixel, len(views), seen / (width * height))


def _drawn(plan: Canvas, size: tuple[int, int], corner: tuple[int, int]) -> tuple[PackedTile | None, int]:
    """A tile as it goes into the file of this size, width and height, and how many of its pixels are seen."""
    tile = draw_tile(plan, corner, plan.scratch().tile)
    if tile is None:
        return None, 0
    tile[max(size[1] - corner[1], 0) :] = 0
    tile[:, max(size[0] - corner[0], 0) :] = 0
    return pack_tile(tile), int(np.count_nonzero(tile[..., 3]))


def _covering(views: list[View], points: FloatArray) -> list[View]:
    """Enough of the views: well spread ones, and those that see ground points (n, 3) which these do not."""
    chosen = spread_out(views, MOST_OVERLAP)
    unseen = np.ones(len(points), dtype=bool)
    for view in chosen:
        unseen &= ~_sees(view, points)
    taken = {id(view) for view in chosen}
    for view in views:
        if id(view) in taken or not unseen.any():
            continue
        new = unseen & _sees(view, points)
        if np.count_nonzero(new) >= 2:
            taken.add(id(view))
            unseen &= ~new
    return [view for view in views if id(view) in taken]


def _sees(view: View, points: FloatArray) -> BoolArray:
    """(n,) which ground points the view sees."""
    found = view.may_see(points)
    near = np.flatnonzero(found)
    found[near] = np.isfinite(look_up(view, view.image.camera, points[near])[1])
    return found


def _ground_points(views: list[View], ground: ElevationGrid) -> FloatArray:
    """(n, 3) points of the ground that may be seen, some twenty across a picture; 200,000 at most."""
    lows, highs = np.array([view.low for view in views]), np.array([view.high for view in views])
    low, high = lows.min(axis=0), highs.max(axis=0)
    step = float(np.median(np.sqrt(np.prod(highs - lows, axis=1)))) / 20.0
    step = max(step, float(np.sqrt(np.prod(high - low) / 200_000.0)))
    first = np.ceil((lows - low) / step).astype(np.int64)
    last = np.floor((highs - low) / step).astype(np.int64)
    inside = np.zeros(last.max(axis=0)[::-1] + 1, dtype=bool)
    for (left, bottom), (right, top) in zip(first, last, strict=True):
        inside[bottom : top + 1, left : right + 1] = True
    row, column = np.nonzero(inside)
    x, y = low[0] + step * column, low[1] + step * row
    return np.stack([x, y, ground.height_at(x, y)], axis=1)


def _raster_frame(views: list[View], crs_from_world: Affine, gsd: float) -> tuple[float, Affine, int, int]:
    """GSD, crs_from_pixel, width and height of the north-up raster around all views."""
    outline = transform_points(crs_from_world, np.concatenate([view.outline for view in views]))
    low, high = outline.min(axis=0), outline.max(axis=0)
    gsd = max(gsd, math.sqrt(float(np.prod(high - low)) / MOST_PIXELS))
    left, top = math.floor(low[0] / gsd) * gsd, math.ceil(high[1] / gsd) * gsd
    width, height = math.ceil((high[0] - left) / gsd), math.ceil((top - low[1]) / gsd)
    return gsd, Affine(gsd, 0.0, left, 0.0, -gsd, top), max(width, 1), max(height, 1)
