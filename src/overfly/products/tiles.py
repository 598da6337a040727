"""One tile of the mosaic at a time: which picture wins where, and how the seams between them are hidden.

Which pictures matter is found out on nodes 8 pixels apart, and so is their common brightness, which changes
over tens of pixels. Only what is left, the structure, is drawn at full resolution: each picture just where it
wins, and a few pixels beyond.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np
from affine import Affine
from numba import njit

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray
from overfly.products.cog import TILE_PX
from overfly.products.elevation import ElevationGrid
from overfly.products.exposure import Exposure
from overfly.products.georeference import transform_points
from overfly.products.views import View, look_up
from overfly.products.visibility import is_hidden
from overfly.types import BoolArray, Float32Array, UInt8Array

NODE_PX = 8
PAD_NODES = 6  # around a tile, whose pictures its brightness depends on
EDGE_NODES = 1  # around a tile, in which labels are found, so that blending knows what lies beyond its edge
WIDE_SIGMA_PX, FINE_SIGMA_PX = 14.0, 1.5  # of the blend: brightness, structure
STRIP_PX = 32  # of rows that are drawn at once
CACHE_BYTES = 256 * 2**20
HIDDEN = 1e4  # times as dear is ground that is hidden behind other ground

Span = tuple[slice, slice]  # rows and columns


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """pixels: (h, w) or (h, w, 3), at full size; small: all of it with one pixel per NODE_PX."""

    pixels: UInt8Array
    small: Float32Array

    @property
    def n_bytes(self) -> int:
        return self.small.nbytes + self.pixels.nbytes


@dataclass(slots=True)
class Pictures:
    """Pictures at the resolution of the mosaic, the latest used kept in memory. Threads may share them."""

    views: list[View]
    gsd_m: float
    _kept: OrderedDict[int, Picture] = field(default_factory=OrderedDict)
    _n_bytes: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def camera(self, index: int) -> Camera:
        camera, factor = self.views[index].image.camera, self._factor(index)
        return camera.scaled(max(1, camera.width // factor), max(1, camera.height // factor))

    def get(self, index: int) -> Picture:
        """Averaged down by a whole factor when its pixels are finer than the mosaic's."""
        with self._lock:
            if index in self._kept:
                self._kept.move_to_end(index)
                return self._kept[index]
            self._kept[index] = read = self._read(index)
            self._n_bytes += read.n_bytes
            while len(self._kept) > 1 and self._n_bytes > CACHE_BYTES:
                self._n_bytes -= self._kept.popitem(last=False)[1].n_bytes
            return read

    def _read(self, index: int) -> Picture:
        picture, camera = self.views[index].image.load(), self.camera(index)
        picture = _reduced(picture, camera.width, camera.height)
        small = _reduced(picture, -(-camera.width // NODE_PX), -(-camera.height // NODE_PX))
        return Picture(picture, small.astype(np.float32))

    def _factor(self, index: int) -> int:
        return max(1, int(1.15 * self.gsd_m / self.views[index].gsd_m))


@dataclass(frozen=True, slots=True, eq=False)
class Canvas:
    """Everything the tiles share.

    world_from_pixel: of the plane, pixel corners; step_px between exact projections, where relief is fine;
    boxes (n, 4): left, top, right, bottom of what each view may see, pixels; highest_m: of the ground.
    """

    views: list[View]
    pictures: Pictures
    exposure: Exposure
    ground: ElevationGrid
    world_from_pixel: Affine
    step_px: int
    boxes: FloatArray
    highest_m: float


def canvas(
    views: list[View], exposure: Exposure, ground: ElevationGrid, world_from_pixel: Affine, gsd_m: float
) -> Canvas:
    """gsd_m: length of a pixel on the ground. The ground has no unknown cells."""
    step = NODE_PX if ground.heights.size == 1 else float(np.clip(ground.cell_m / gsd_m, 1.0, NODE_PX))
    outlines = [transform_points(~world_from_pixel, view.outline) for view in views]
    boxes = np.array([[*outline.min(axis=0), *outline.max(axis=0)] for outline in outlines])
    return Canvas(
        views,
        Pictures(views, gsd_m),
        exposure,
        ground,
        world_from_pixel,
        1 << round(np.log2(step)),  # a divisor of the tile and its padding, so that tiles agree
        boxes,
        ground.height_range_m()[1],
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A view over the nodes of a tile that it may see. nodes: which; px (h, w, 2); cost (h, w), inf if not
    seen; mine (h, w): where it wins."""

    index: int
    nodes: Span
    px: FloatArray
    cost: FloatArray
    mine: BoolArray


def draw_tile(plan: Canvas, corner: tuple[int, int]) -> UInt8Array | None:
    """(TILE_PX, TILE_PX, 4) RGBA whose top-left pixel is at (x, y) = corner; None where nothing was seen."""
    x, y = corner
    candidates = _winners(plan, x, y)
    if not candidates:
        return None
    shades = _shades(plan, candidates)
    size = TILE_PX + 2 * EDGE_NODES * NODE_PX
    lowest = np.full((size, size), np.inf, np.float32)
    label = np.full((size, size), -1, np.int16)
    layers = [layer for one in candidates if (layer := _layer(plan, one, x, y)) is not None]
    for layer in layers:
        _compete(lowest[layer.part], label[layer.part], layer.log_cost, layer.column, layer.row,
                 *layer.size, layer.candidate.index)  # fmt: skip
    channels = max((shades[layer.candidate.index].shape[2] - 1 for layer in layers), default=1)
    colour = np.zeros((size, size, channels), np.float32)
    weights = np.zeros((size, size), np.float32)
    for layer in layers:
        _draw(
            plan,
            layer,
            shades[layer.candidate.index],
            label[layer.part],
            colour[layer.part],
            weights[layer.part],
        )
    edge = EDGE_NODES * NODE_PX
    inner = slice(edge, edge + TILE_PX)
    if not (label[inner, inner] >= 0).any():
        return None
    tile = np.zeros((TILE_PX, TILE_PX, 4), np.uint8)
    _finish(tile, colour[inner, inner], weights[inner, inner], label[inner, inner])
    return tile


# --- on the nodes ------------------------------------------------------------------------------------


def _winners(plan: Canvas, x: int, y: int) -> list[_Candidate]:
    """The pictures that are the best somewhere in or around the tile.

    Node k stands in the middle of the pixels from NODE_PX * (k - PAD_NODES - 1) of the tile on.
    """
    count = TILE_PX // NODE_PX + 2 * PAD_NODES + 2
    left, top = x - NODE_PX * (PAD_NODES + 1), y - NODE_PX * (PAD_NODES + 1)
    points, origin = _ground_points(plan, left, top, NODE_PX, count, count), np.array([left, top])
    best, lowest = np.full((count, count), -1), np.full((count, count), np.inf)
    scouted = []
    first = np.floor((plan.boxes[:, :2] - origin) / NODE_PX).astype(np.int64) - 1
    last = np.ceil((plan.boxes[:, 2:] - origin) / NODE_PX).astype(np.int64) + 1
    for index in np.flatnonzero(((first < count) & (last > 0)).all(axis=1)):
        (west, north), (east, south) = np.maximum(first[index], 0), np.minimum(last[index], count)
        nodes = slice(int(north), int(south)), slice(int(west), int(east))
        px, cost = _seen_from(plan, int(index), points[nodes])
        better = cost < lowest[nodes]
        if better.any():
            lowest[nodes][better], best[nodes][better] = cost[better], index
            scouted.append((int(index), nodes, px, cost))
    found = [_Candidate(*one, best[one[1]] == one[0]) for one in scouted]
    return [candidate for candidate in found if candidate.mine.any()]


def _ground_points(
    plan: Canvas, left: float, top: float, step_px: int, rows: int, columns: int
) -> FloatArray:
    """(rows, columns, 3) ground points in the middle of blocks of step_px."""
    x = left + step_px * (np.arange(columns) + 0.5)  # pixel corners, as the transform has them
    y = top + step_px * (np.arange(rows) + 0.5)
    world = transform_points(plan.world_from_pixel, np.stack(np.meshgrid(x, y), axis=-1))
    height = plan.ground.height_at(world[..., 0], world[..., 1])
    return np.concatenate([world, height[..., None]], axis=-1)


def _seen_from(plan: Canvas, index: int, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (h, w, 2) of points (h, w, 3) in a picture and the cost (h, w) of taking them from there, dear
    where higher ground hides them.

    Not impossible: ground that no picture sees is better painted than left out.
    """
    view, shape = plan.views[index], points.shape[:2]
    points = points.reshape(-1, 3)
    px, cost = look_up(view, plan.pictures.camera(index), points)
    seen = np.flatnonzero(np.isfinite(cost))
    hidden = is_hidden(plan.ground, points[seen], view.image.world_from_cam.translation, plan.highest_m)
    cost[seen[hidden]] *= HIDDEN
    return px.reshape(*shape, 2), cost.reshape(shape)


def _shades(plan: Canvas, candidates: list[_Candidate]) -> dict[int, Float32Array]:
    """For each view, on its nodes, (h, w, 1 + channels): by what its colours are to be multiplied, and what
    is then to be added so that brightness goes over into that of its neighbours."""
    smooth, gains = {}, {}
    for one in candidates:
        camera, small = plan.pictures.camera(one.index), plan.pictures.get(one.index).small
        log_brightness = plan.exposure.log_brightness(one.index, camera, one.px.reshape(-1, 2))
        gains[one.index] = np.exp(-log_brightness).reshape(*one.mine.shape, 1).astype(np.float32)
        share = np.array([small.shape[1] / camera.width, small.shape[0] / camera.height])
        column, row = np.moveaxis(((one.px + 0.5) * share - 0.5).astype(np.float32), 2, 0)
        colour = cv2.remap(small, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        colour = colour.reshape(*one.mine.shape, -1) * gains[one.index]
        smooth[one.index] = _smoothed(np.asarray(colour, np.float32), np.isfinite(one.cost))
    channels = max(one.shape[2] for one in smooth.values())
    count = TILE_PX // NODE_PX + 2 * PAD_NODES + 2
    mixed, total = (
        np.zeros((count, count, channels), np.float32),
        np.full((count, count, 1), 1e-12, np.float32),
    )
    for one in candidates:
        weight = _wide_blur(one.mine.astype(np.float32))[..., None]
        mixed[one.nodes] += weight * smooth[one.index]
        total[one.nodes] += weight
    mixed /= total
    return {
        one.index: np.concatenate([gains[one.index], mixed[one.nodes] - smooth[one.index]], axis=2)
        for one in candidates
    }


def _smoothed(colour: Float32Array, seen: BoolArray) -> Float32Array:
    """Wide-blurred colour of what was seen, (h, w, channels), without the dark of what was not."""
    mask = seen.astype(np.float32)
    weight = np.maximum(_wide_blur(mask), 1e-6)[..., None]
    return np.asarray(_wide_blur(colour * mask[..., None]).reshape(colour.shape) / weight, dtype=np.float32)


def _wide_blur(nodes: Float32Array) -> Float32Array:
    return np.asarray(cv2.GaussianBlur(nodes, (0, 0), WIDE_SIGMA_PX / NODE_PX), np.float32)


# --- at full resolution ------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Layer:
    """A view at the pixels of part of a tile: where they lie in its picture of this size, (width, height),
    and what they cost; nodes: the part's own and one around, of those of the view."""

    candidate: _Candidate
    part: Span
    nodes: Span
    column: Float32Array
    row: Float32Array
    log_cost: Float32Array
    size: tuple[int, int]


def _layer(plan: Canvas, one: _Candidate, x: int, y: int) -> _Layer | None:
    """None when the view wins nowhere near the tile itself."""
    first, reach = PAD_NODES + 1 - EDGE_NODES, TILE_PX // NODE_PX + 2 * EDGE_NODES  # blocks that are drawn
    spans, inner = [], []
    for axis in (0, 1):
        start = one.nodes[axis].start
        taken = np.flatnonzero(one.mine.any(axis=1 - axis)) + start
        # beyond the nodes that it wins its pixels may win, too; a node more for the interpolation
        low = max(int(taken[0]) - 2, first, start + 1)
        high = min(int(taken[-1]) + 3, first + reach, one.nodes[axis].stop - 1)
        if high <= low:
            return None
        spans.append(slice(NODE_PX * (low - first), NODE_PX * (high - first)))
        inner.append(slice(low - start - 1, high - start + 1))
    part, nodes = (spans[0], spans[1]), (inner[0], inner[1])
    px, cost, step = one.px[nodes], one.cost[nodes], plan.step_px
    rows, columns = (span.stop - span.start for span in part)
    if step < NODE_PX:
        edge = EDGE_NODES * NODE_PX
        left, top = x - edge + part[1].start - step, y - edge + part[0].start - step
        points = _ground_points(plan, left, top, step, rows // step + 2, columns // step + 2)
        px, cost = _seen_from(plan, one.index, points)
    values = px[..., 0], px[..., 1], np.log(np.minimum(cost, 1e12))
    # one by one: together they would have to be taken apart again
    column, row, log_cost = (_dense(value.astype(np.float32), step, rows, columns) for value in values)
    camera = plan.pictures.camera(one.index)
    return _Layer(one, part, nodes, column, row, log_cost, (camera.width, camera.height))


def _dense(nodes: Float32Array, step: int, rows: int, columns: int) -> Float32Array:
    """(rows, columns) or (rows, columns, k) from nodes that stand step apart, one more on each side."""
    edge = NODE_PX if step == NODE_PX else step
    size = (columns + 2 * edge, rows + 2 * edge)
    return np.asarray(
        cv2.resize(nodes, size, interpolation=cv2.INTER_LINEAR)[edge:-edge, edge:-edge], np.float32
    )


def _draw(
    plan: Canvas,
    layer: _Layer,
    shade: Float32Array,
    label: np.ndarray,
    colour: Float32Array,
    weights: Float32Array,
) -> None:
    """Add the view's colours to those of the tile, where it wins and a few pixels beyond, in place."""
    mine = (label == layer.candidate.index).astype(np.float32)
    if not mine.any():
        return
    weight = cv2.GaussianBlur(mine, (0, 0), FINE_SIGMA_PX)
    shades = shade[layer.nodes]
    pixels = plan.pictures.get(layer.candidate.index).pixels
    for strip in _strips(weight):
        column, row = layer.column[strip], layer.row[strip]
        warped = cv2.remap(pixels, column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        warped = np.asarray(warped, np.uint8).reshape(*column.shape, -1)
        seen = np.isfinite(layer.log_cost[strip])
        first, count = strip[0].start // NODE_PX, len(column) // NODE_PX
        bright = _dense(shades[first : first + count + 2], NODE_PX, len(column), mine.shape[1])[:, strip[1]]
        _add(colour[strip], weights[strip], warped, bright, weight[strip], mine[strip], seen)


def _strips(weight: Float32Array) -> Iterator[Span]:
    """Where there is weight (h, w), strip by strip: hardly any picture wins a whole rectangle."""
    for top in range(0, len(weight), STRIP_PX):
        rows = slice(top, top + STRIP_PX)
        columns = np.flatnonzero(weight[rows].any(axis=0))
        if len(columns):
            yield rows, slice(int(columns[0]), int(columns[-1]) + 1)


@njit(cache=True, nogil=True)
def _compete(lowest, label, log_cost, column, row, width, height, index):  # type: ignore[no-untyped-def]
    """Label the pixels where the view costs least; where it does not see, its cost becomes infinite."""
    for r in range(lowest.shape[0]):
        for c in range(lowest.shape[1]):
            u, v = column[r, c], row[r, c]
            if not (1.0 <= u <= width - 2.0 and 1.0 <= v <= height - 2.0):
                log_cost[r, c] = np.inf
            elif log_cost[r, c] < lowest[r, c]:
                lowest[r, c], label[r, c] = log_cost[r, c], index


@njit(cache=True, nogil=True)
def _add(colour, weights, warped, shades, weight, mine, seen):  # type: ignore[no-untyped-def]
    for r in range(weights.shape[0]):
        for c in range(weights.shape[1]):
            # the least weight keeps a lonely pixel, which the blur would wash out, its own
            share = (weight[r, c] if seen[r, c] else np.float32(0.0)) + np.float32(1e-6) * mine[r, c]
            if share <= 0.0:
                continue
            weights[r, c] += share
            for k in range(colour.shape[2]):
                value = np.float32(warped[r, c, min(k, warped.shape[2] - 1)])
                shift = shades[r, c, 1 + min(k, shades.shape[2] - 2)]
                colour[r, c, k] += share * (value * shades[r, c, 0] + shift)


@njit(cache=True, nogil=True)
def _finish(tile, colour, weights, label):  # type: ignore[no-untyped-def]
    last = colour.shape[2] - 1
    for r in range(tile.shape[0]):
        for c in range(tile.shape[1]):
            if label[r, c] < 0:
                continue
            for k in range(3):
                value = colour[r, c, min(k, last)] / weights[r, c] + np.float32(0.5)
                tile[r, c, k] = np.uint8(min(max(value, np.float32(0.0)), np.float32(255.0)))
            tile[r, c, 3] = 255


def _reduced(picture: UInt8Array, width: int, height: int) -> UInt8Array:
    if picture.shape[:2] == (height, width):
        return picture
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
