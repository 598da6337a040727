"""The ground seen from straight above, put together from located pictures: an orthophoto on a given ground
surface.

For each ground pixel the nearest camera is taken; seams are hidden by two-band blending (Burt and Adelson, "A
Multiresolution Spline with Application to Image Mosaics", 1983): brightness changes over metres, structure
over a few pixels, so that nothing is seen twice. Work goes tile by tile, with the pictures that win there,
so memory does not grow with the map.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from affine import Affine
from rasterio.enums import ColorInterp

from overfly.errors import OutputError
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray
from overfly.products.elevation import ElevationGrid
from overfly.products.exposure import Exposure, even_exposure, thumbnail_of
from overfly.products.georeference import GeoReference, cloud_optimised_geotiff, transform_points
from overfly.products.views import MappedImage, View, look_up, spread_out, view_of
from overfly.products.visibility import is_hidden
from overfly.types import BoolArray, Float32Array, UInt8Array

TILE_PX = 512
PAD_PX = 48  # tiles are computed this much larger, so that blending knows what lies beyond their edge
NODE_PX = 8  # exact projections are this far apart, bilinear between; where relief is finer, closer
WIDE_SIGMA_PX, FINE_SIGMA_PX = 14.0, 1.5  # of the blend: brightness, structure
CACHE_BYTES = 256 * 2**20
MOST_PIXELS = 1_000_000_000  # a wild pose must not ask for a raster of the whole country
HIDDEN = 1e4  # times as dear is ground that is hidden behind other ground
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


@dataclass(slots=True)
class _Pictures:
    """Pictures at the resolution of the mosaic, the latest used kept in memory."""

    views: list[View]
    gsd_m: float
    kept: OrderedDict[int, UInt8Array] = field(default_factory=OrderedDict)

    def camera(self, index: int) -> Camera:
        camera, factor = self.views[index].image.camera, self._factor(index)
        return camera.scaled(max(1, camera.width // factor), max(1, camera.height // factor))

    def get(self, index: int) -> UInt8Array:
        """Gray or RGB; averaged down by a whole factor when its pixels are finer than the mosaic's."""
        if index in self.kept:
            self.kept.move_to_end(index)
            return self.kept[index]
        picture, camera = self.views[index].image.load(), self.camera(index)
        if picture.shape[:2] != (camera.height, camera.width):
            size = (camera.width, camera.height)
            picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        self.kept[index] = picture
        while len(self.kept) > 1 and sum(kept.nbytes for kept in self.kept.values()) > CACHE_BYTES:
            self.kept.popitem(last=False)
        return picture

    def _factor(self, index: int) -> int:
        return max(1, int(1.15 * self.gsd_m / self.views[index].gsd_m))


@dataclass(frozen=True, slots=True, eq=False)
class _Plan:
    """Everything the tiles share.

    world_from_pixel: of the plane, pixel corners; step_px between exact projections; highest_m: of the
    ground.
    """

    views: list[View]
    pictures: _Pictures
    exposure: Exposure
    ground: ElevationGrid
    world_from_pixel: Affine
    step_px: int
    lows: FloatArray
    highs: FloatArray
    highest_m: float


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
    views = _covering(views, ground)
    crs_from_world = reference.crs_from_world()
    gsd = reference.scale * (gsd_m or float(np.median([view.gsd_m for view in views])))
    gsd, crs_from_pixel, width, height = _raster_frame(views, crs_from_world, gsd)
    plan = _plan(views, ground, ~crs_from_world @ crs_from_pixel, gsd / reference.scale)
    profile = {"width": width, "height": height, "count": 4, "dtype": "uint8", "transform": crs_from_pixel}
    tiles = [(x, y) for y in range(0, height, TILE_PX) for x in range(0, width, TILE_PX)]
    seen = 0
    with cloud_optimised_geotiff(path, reference.crs, **profile) as checked:
        checked.raster.colorinterp = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
        for done, (x, y) in enumerate(tiles, start=1):
            tile = _tile(plan, x, y)
            if tile is not None:
                tile = tile[: height - y, : width - x]
                checked.write(tile.transpose(2, 0, 1), x, y)
                seen += int(np.count_nonzero(tile[..., 3]))
            progress(done, len(tiles))
    return Mosaic(Path(path), gsd, width, height, crs_from_pixel, len(views), seen / (width * height))


def _covering(views: list[View], ground: ElevationGrid) -> list[View]:
    """Enough of the views: well spread ones, and those that see ground which these do not."""
    chosen = spread_out(views, MOST_OVERLAP)
    points = _ground_points(views, ground)
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
    """(n, 3) points of the ground all over the map, some twenty across a picture, 200,000 at most."""
    low = np.min([view.low for view in views], axis=0)
    high = np.max([view.high for view in views], axis=0)
    step = float(np.median([np.sqrt(np.prod(view.high - view.low)) for view in views])) / 20.0
    step = max(step, float(np.sqrt(np.prod(high - low) / 200_000.0)))
    x, y = np.meshgrid(np.arange(low[0], high[0], step), np.arange(low[1], high[1], step))
    return np.stack([x.ravel(), y.ravel(), ground.height_at(x.ravel(), y.ravel())], axis=1)


def _raster_frame(views: list[View], crs_from_world: Affine, gsd: float) -> tuple[float, Affine, int, int]:
    """GSD, crs_from_pixel, width and height of the north-up raster around all views."""
    outline = transform_points(crs_from_world, np.concatenate([view.outline for view in views]))
    low, high = outline.min(axis=0), outline.max(axis=0)
    gsd = max(gsd, math.sqrt(float(np.prod(high - low)) / MOST_PIXELS))
    left, top = math.floor(low[0] / gsd) * gsd, math.ceil(high[1] / gsd) * gsd
    width, height = math.ceil((high[0] - left) / gsd), math.ceil((top - low[1]) / gsd)
    return gsd, Affine(gsd, 0.0, left, 0.0, -gsd, top), max(width, 1), max(height, 1)


def _plan(views: list[View], ground: ElevationGrid, world_from_pixel: Affine, gsd_m: float) -> _Plan:
    thumbnails = [thumbnail_of(view.image.load()) for view in views]
    exposure = even_exposure(views, thumbnails, _ground_points(views, ground))
    step = NODE_PX if ground.heights.size == 1 else int(np.clip(ground.cell_m / gsd_m, 1, NODE_PX))
    step = 1 << int(math.log2(step))  # a divisor of the tile and its padding, so that tiles agree
    return _Plan(
        views,
        _Pictures(views, gsd_m),
        exposure,
        ground,
        world_from_pixel,
        step,
        np.array([view.low for view in views]),
        np.array([view.high for view in views]),
        ground.height_range_m()[1],
    )


@dataclass(frozen=True, slots=True)
class _Area:
    """A rectangle of mosaic pixels, in multiples of NODE_PX."""

    left: int
    top: int
    width: int
    height: int


@dataclass(frozen=True, slots=True, eq=False)
class _Layer:
    """One picture over part of a padded tile: colour (h, w, channels); log cost (h, w), inf if not seen."""

    rows: slice
    columns: slice
    colour: Float32Array
    cost: Float32Array


def _tile(plan: _Plan, x: int, y: int) -> UInt8Array | None:
    """(TILE_PX, TILE_PX, 4) RGBA whose top-left pixel is (x, y); None where nothing was seen."""
    whole = _Area(x - PAD_PX, y - PAD_PX, TILE_PX + 2 * PAD_PX, TILE_PX + 2 * PAD_PX)
    layers = [_layer(plan, index, part, whole) for index, part in _winners(plan, whole)]
    if not layers:
        return None
    colour, alpha = _blend(layers, whole)
    inner = slice(PAD_PX, PAD_PX + TILE_PX)
    alpha = alpha[inner, inner]
    if not alpha.any():
        return None
    tile = np.zeros((TILE_PX, TILE_PX, 4), np.uint8)
    tile[..., :3] = np.clip(colour[inner, inner] + 0.5, 0, 255)
    tile[..., 3] = 255
    tile[~alpha] = 0
    return tile


def _winners(plan: _Plan, whole: _Area) -> list[tuple[int, _Area]]:
    """The pictures that are the best somewhere, each with the part of the area its blending may reach."""
    points = _node_points(plan, whole, NODE_PX)
    flat = points.reshape(-1, 3)
    low, high = flat[:, :2].min(axis=0), flat[:, :2].max(axis=0)
    near = np.flatnonzero(((plan.highs >= low) & (plan.lows <= high)).all(axis=1))
    if len(near) == 0:
        return []
    cameras = [plan.pictures.camera(int(index)) for index in near]
    costs = [look_up(plan.views[index], camera, flat)[1] for index, camera in zip(near, cameras, strict=True)]
    for place, index in enumerate(near):
        costs[place] = _with_hidden(plan, int(index), flat, costs[place])
    cost = np.stack(costs).reshape(len(near), *points.shape[:2])
    best = np.where(np.isfinite(cost.min(axis=0)), np.argmin(cost, axis=0), -1)
    found = []
    for place in np.unique(best[best >= 0]):
        rows, columns = np.nonzero(best == place)
        left = max(0, NODE_PX * (int(columns.min()) - 2) - PAD_PX)
        top = max(0, NODE_PX * (int(rows.min()) - 2) - PAD_PX)
        right = min(whole.width, NODE_PX * (int(columns.max()) + 1) + PAD_PX)
        bottom = min(whole.height, NODE_PX * (int(rows.max()) + 1) + PAD_PX)
        if right > left and bottom > top:
            part = _Area(whole.left + left, whole.top + top, right - left, bottom - top)
            found.append((int(near[place]), part))
    return found


def _with_hidden(plan: _Plan, index: int, points: FloatArray, cost: FloatArray) -> FloatArray:
    """The cost (n,) of taking points (n, 3) from a picture, dear where higher ground hides them there.

    Not impossible: ground that no picture sees is better painted than left out.
    """
    seen = np.flatnonzero(np.isfinite(cost))
    centre = plan.views[index].image.world_from_cam.translation
    hidden = seen[is_hidden(plan.ground, points[seen], centre, plan.highest_m)]
    dear = cost.copy()
    dear[hidden] *= HIDDEN
    return dear


def _node_points(plan: _Plan, area: _Area, step_px: int) -> FloatArray:
    """(rows, columns, 3) ground points in the middle of blocks of step_px, with one block around the area."""
    x = area.left + step_px * (
        np.arange(area.width // step_px + 2) - 0.5
    )  # pixel corners, as the transform has them
    y = area.top + step_px * (np.arange(area.height // step_px + 2) - 0.5)
    world = transform_points(plan.world_from_pixel, np.stack(np.meshgrid(x, y), axis=-1))
    height = plan.ground.height_at(world[..., 0], world[..., 1])
    return np.concatenate([world, height[..., None]], axis=-1)


def _layer(plan: _Plan, index: int, part: _Area, whole: _Area) -> _Layer:
    """The picture laid on the ground, at the pixels of ``part``, its brightness evened."""
    picture, camera, step = plan.pictures.get(index), plan.pictures.camera(index), plan.step_px
    points = _node_points(plan, part, step)
    px, cost = look_up(plan.views[index], camera, points.reshape(-1, 3))
    cost = _with_hidden(plan, index, points.reshape(-1, 3), cost)
    brightness = plan.exposure.log_brightness(index, camera, px)
    nodes = np.stack([px[:, 0], px[:, 1], np.log(np.minimum(cost, 1e12)), brightness], axis=1)
    nodes = nodes.astype(np.float32).reshape(*points.shape[:2], 4)
    dense = cv2.resize(nodes, (part.width + 2 * step, part.height + 2 * step), interpolation=cv2.INTER_LINEAR)
    column, row, log_cost, log_brightness = cv2.split(dense[step:-step, step:-step])
    warped = cv2.remap(picture, column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    colour = warped.astype(np.float32).reshape(part.height, part.width, -1)
    colour *= cv2.exp(-log_brightness)[..., None]
    seen = (column >= 1.0) & (column <= camera.width - 2.0) & (row >= 1.0) & (row <= camera.height - 2.0)
    left, top = part.left - whole.left, part.top - whole.top
    return _Layer(
        slice(top, top + part.height),
        slice(left, left + part.width),
        colour,
        np.where(seen, log_cost, np.float32(np.inf)),
    )


def _blend(layers: list[_Layer], whole: _Area) -> tuple[Float32Array, BoolArray]:
    """Colour (h, w, 1 or 3) and where anything was seen (h, w)."""
    lowest = np.full((whole.height, whole.width), np.inf, np.float32)
    best = np.full(lowest.shape, -1)
    for place, layer in enumerate(layers):
        cost, label = lowest[layer.rows, layer.columns], best[layer.rows, layer.columns]
        better = layer.cost < cost
        cost[better], label[better] = layer.cost[better], place
    channels = max(layer.colour.shape[2] for layer in layers)
    wide = np.zeros((*lowest.shape, channels), np.float32)
    fine = np.zeros((*lowest.shape, channels), np.float32)
    wide_sum, fine_sum = np.full((2, *lowest.shape, 1), 1e-12, np.float32)
    for place, layer in enumerate(layers):
        part = (layer.rows, layer.columns)
        mine = (best[part] == place).astype(np.float32)
        seen = np.isfinite(layer.cost).astype(np.float32)
        smooth = _smoothed(layer.colour, seen)
        # The least weight keeps a lonely pixel, which the blur would wash out, its own.
        wide_weight = (_wide_blur(mine) * seen + 1e-6 * mine)[..., None]
        fine_weight = (cv2.GaussianBlur(mine, (0, 0), FINE_SIGMA_PX) * seen + 1e-6 * mine)[..., None]
        wide[part] += wide_weight * smooth
        fine[part] += fine_weight * (layer.colour - smooth)
        wide_sum[part] += wide_weight
        fine_sum[part] += fine_weight
    return np.asarray(wide / wide_sum + fine / fine_sum, np.float32), np.asarray(best >= 0)


def _smoothed(colour: Float32Array, seen: Float32Array) -> Float32Array:
    """Wide-blurred colour of what was seen, (s, s, channels), without the dark of what was not."""
    weight = np.maximum(_wide_blur(seen), 1e-6)[..., None]
    blurred = _wide_blur(colour * seen[..., None]).reshape(colour.shape)
    return np.asarray(blurred / weight, dtype=np.float32)


def _wide_blur(image: Float32Array) -> Float32Array:
    """Gaussian of WIDE_SIGMA_PX, at a quarter of the resolution."""
    size = (image.shape[1], image.shape[0])
    quarter = cv2.resize(image, (size[0] // 4, size[1] // 4), interpolation=cv2.INTER_AREA)
    quarter = cv2.GaussianBlur(quarter, (0, 0), WIDE_SIGMA_PX / 4.0)
    return np.asarray(cv2.resize(quarter, size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)
