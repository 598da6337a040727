"""One tile of the mosaic at a time: which picture wins where, and how the seams between them are hidden.

Which pictures matter is found out on nodes 8 pixels apart, and so is their common brightness, which changes
over tens of pixels. What is left, the structure, is drawn at full resolution, block by block of 8 x 8 pixels:
where one picture wins all around it is copied, and only along seams are pixels compared and blended
(overfly.products.tile_kernels).
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field

import cv2
import numpy as np
from affine import Affine

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray
from overfly.products.cog import TILE_PX
from overfly.products.elevation import ElevationGrid
from overfly.products.exposure import Exposure
from overfly.products.georeference import transform_points
from overfly.products.tile_kernels import (
    BLUR_RADIUS,
    blocks_of,
    finish_seams,
    mix,
    number_seams,
    paint_blocks,
    place_blocks,
    shade,
    shade_source,
)
from overfly.products.tile_labels import NODE_PX, ground_points, label_blocks, look, scout
from overfly.products.tile_pictures import Pictures
from overfly.products.views import View
from overfly.types import BoolArray, Float32Array, IntArray, UInt8Array

PAD_NODES = 6  # around a tile, whose pictures its brightness depends on
EDGE_NODES = 1  # around a tile, in which labels are found, so that blending knows what lies beyond its edge
WIDE_SIGMA_PX, FINE_SIGMA_PX = 14.0, 1.5  # of the blend: brightness, structure
WIDE_NODES = 7  # reach of the wide blur
BLOCKS_AT_ONCE = 512  # that are warped in one call: their places and colours stay in the processor's cache
TAPS = cv2.getGaussianKernel(2 * BLUR_RADIUS + 1, FINE_SIGMA_PX, cv2.CV_32F).ravel()

Span = tuple[slice, slice]  # rows and columns


class _Scratch:
    """Arrays that a thread uses again for each tile: fresh memory costs more than what is done in it."""

    def __init__(self) -> None:
        edge = 2 * EDGE_NODES
        side = TILE_PX // NODE_PX
        self.label = np.empty((TILE_PX + edge * NODE_PX,) * 2, np.int16)
        self.winners = np.empty((side + edge,) * 2, np.int16)
        self.present = np.empty((side + edge,) * 2, np.uint64)
        self.seams = np.full((side + edge,) * 2, -1, np.int32)
        self.blocks = np.empty((side * side, 2), np.int32)
        self.column = np.empty((NODE_PX, NODE_PX * BLOCKS_AT_ONCE), np.float32)
        self.row = np.empty_like(self.column)
        self.tile = np.empty((TILE_PX, TILE_PX, 4), np.uint8)
        self._of_channels: dict[int, tuple[UInt8Array, Float32Array]] = {}

    def blended(self, channels: int) -> Float32Array:
        """(blocks, NODE_PX, NODE_PX, channels + 1)"""
        return self._colours(channels)[1]

    def warped(self, channels: int) -> UInt8Array:
        """(NODE_PX, pixels, channels)"""
        return self._colours(channels)[0]

    def _colours(self, channels: int) -> tuple[UInt8Array, Float32Array]:
        if channels not in self._of_channels:
            self._of_channels[channels] = (
                np.empty((*self.column.shape, channels), np.uint8),
                np.empty((len(self.blocks), NODE_PX, NODE_PX, channels + 1), np.float32),
            )
        return self._of_channels[channels]


@dataclass(frozen=True, slots=True, eq=False)
class Canvas:
    """Everything the tiles share.

    world_from_pixel: of the plane, pixel corners; step_px between exact projections, where relief is fine;
    boxes (n, 4): left, top, right, bottom of what each view may see, pixels; sights (n, 25): see _sight;
    heights, frame: of the ground, and its x0, y0, cell; highest_m: of it.
    """

    views: list[View]
    pictures: Pictures
    exposure: Exposure
    world_from_pixel: Affine
    step_px: int
    boxes: FloatArray
    sights: FloatArray
    heights: Float32Array
    frame: tuple[float, float, float]
    highest_m: float
    of_thread: threading.local = field(default_factory=threading.local)

    def scratch(self) -> _Scratch:
        """Of the calling thread."""
        if not hasattr(self.of_thread, "scratch"):
            self.of_thread.scratch = _Scratch()
        found: _Scratch = self.of_thread.scratch
        return found


def canvas(
    views: list[View], exposure: Exposure, ground: ElevationGrid, world_from_pixel: Affine, gsd_m: float
) -> Canvas:
    """gsd_m: length of a pixel on the ground. The ground has no unknown cells."""
    step = NODE_PX if ground.heights.size == 1 else float(np.clip(ground.cell_m / gsd_m, 1.0, NODE_PX))
    outlines = [transform_points(~world_from_pixel, view.outline) for view in views]
    boxes = np.array([[*outline.min(axis=0), *outline.max(axis=0)] for outline in outlines])
    pictures = Pictures(views, gsd_m)
    return Canvas(
        views,
        pictures,
        exposure,
        world_from_pixel,
        1 << round(np.log2(step)),  # a divisor of the tile and its padding, so that tiles agree
        boxes,
        np.array([_sight(view, pictures.camera(index)) for index, view in enumerate(views)]),
        np.ascontiguousarray(ground.heights, np.float32),
        (ground.x0_m, ground.y0_m, ground.cell_m),
        ground.height_range_m()[1],
    )


def _sight(view: View, camera: Camera) -> FloatArray:
    """(25,) what kernels need to know of a view: rotation (9) and centre (3) of world_from_cam, ray limit,
    fx, fy, cx, cy, distortion (5), whether it is a fisheye's, width and height."""
    intrinsics, coefficients, equidistant = camera._kernel_arguments()
    pose = view.image.world_from_cam
    return np.concatenate(
        [
            pose.rotation.ravel(),
            pose.translation,
            [view.ray_limit],
            intrinsics,
            coefficients,
            [float(equidistant), camera.width, camera.height],
        ]
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A view over nodes of a tile: which; mine (h, w): where it wins; seen (3, h, w): columns, rows and log
    costs there and around."""

    index: int
    nodes: Span
    mine: BoolArray
    seen: Float32Array


def draw_tile(plan: Canvas, corner: tuple[int, int], out: UInt8Array | None = None) -> UInt8Array | None:
    """(TILE_PX, TILE_PX, 4) RGBA whose top-left pixel is at (x, y) = corner; None where nothing was seen.

    out: an array for it, to be overwritten.
    """
    x, y = corner
    candidates = _winners(plan, x, y)
    layers = _layers(plan, candidates, x, y)
    if layers is None:
        return None
    scratch = plan.scratch()
    label_blocks(layers.table, layers.sizes, layers.nodes, plan.step_px,
                 scratch.label, scratch.winners, scratch.present)  # fmt: skip
    edge = EDGE_NODES * NODE_PX
    if not (scratch.label[edge:-edge, edge:-edge] >= 0).any():
        return None
    shades = _shades(plan, candidates)
    blended = scratch.blended(shades[0].shape[2] - 1)
    blended[: number_seams(scratch.winners, EDGE_NODES, scratch.seams)] = 0.0
    tile = np.empty((TILE_PX, TILE_PX, 4), np.uint8) if out is None else out
    tile.fill(0)
    for number, place in enumerate(layers.candidates):
        _paint(plan, scratch, layers, number, candidates[place], shades[place], tile)
    finish_seams(scratch.seams, EDGE_NODES, blended, scratch.label, tile)
    return tile


# --- on the nodes ------------------------------------------------------------------------------------


def _winners(plan: Canvas, x: int, y: int) -> list[_Candidate]:
    """The pictures that are the best somewhere in or around the tile.

    Node k stands in the middle of the pixels from NODE_PX * (k - PAD_NODES - 1) of the tile on.
    """
    count = TILE_PX // NODE_PX + 2 * PAD_NODES + 2
    left, top = x - NODE_PX * (PAD_NODES + 1), y - NODE_PX * (PAD_NODES + 1)
    origin = np.array([left, top])
    first = np.floor((plan.boxes[:, :2] - origin) / NODE_PX).astype(np.int64) - 1
    last = np.ceil((plan.boxes[:, 2:] - origin) / NODE_PX).astype(np.int64) + 1
    near = np.flatnonzero(((first < count) & (last > 0)).all(axis=1))
    if len(near) == 0:
        return []
    points = _ground_points(plan, left, top, NODE_PX, count)
    middle = points[count // 2, count // 2]
    away = np.linalg.norm(plan.sights[near, 9:12] - middle, axis=1)
    best, lowest = np.full((count, count), -1, np.int32), np.full((count, count), np.inf)
    for index in near[np.argsort(away)].tolist():  # the nearest first, which saves looking at others
        (west, north), (east, south) = np.maximum(first[index], 0), np.minimum(last[index], count)
        nodes = (int(north), int(south), int(west), int(east))
        scout(
            points, nodes, plan.sights[index], plan.heights, plan.frame, plan.highest_m, index, best, lowest
        )
    found = np.flatnonzero(np.bincount(best[best >= 0])).tolist()
    return [_candidate(plan, points, best == index, index) for index in found]


def _candidate(plan: Canvas, points: FloatArray, mine: BoolArray, index: int) -> _Candidate:
    """points (n, n, 3), mine (n, n): of all nodes of a tile."""
    spans = []
    for axis in (0, 1):
        taken = np.flatnonzero(mine.any(axis=1 - axis))
        low, high = int(taken[0]) - 2 * WIDE_NODES, int(taken[-1]) + 1 + 2 * WIDE_NODES
        spans.append(slice(max(low, 0), min(high, len(mine))))  # as far as its brightness is blurred
    nodes = (spans[0], spans[1])
    return _Candidate(index, nodes, mine[nodes], _seen_from(plan, index, points, nodes))


def _ground_points(plan: Canvas, left: float, top: float, step_px: int, count: int) -> FloatArray:
    """(count, count, 3) ground points in the middle of blocks of step_px."""
    points = np.empty((count, count, 3))
    ground_points(
        points, tuple(plan.world_from_pixel)[:6], float(left), float(top), step_px, plan.heights, plan.frame
    )
    return points


def _seen_from(plan: Canvas, index: int, points: FloatArray, nodes: Span) -> Float32Array:
    """(3, h, w) columns and rows of those of the points (n, n, 3) in a picture, and the logarithm of the
    cost of taking them from there, dear where higher ground hides them.

    Not impossible: ground that no picture sees is better painted than left out.
    """
    rows, columns = nodes
    seen = np.empty((3, rows.stop - rows.start, columns.stop - columns.start), np.float32)
    look(points, *_first(nodes), plan.sights[index], plan.heights, plan.frame, plan.highest_m, *seen)
    return seen


def _shades(plan: Canvas, candidates: list[_Candidate]) -> list[Float32Array]:
    """For each view, on its nodes, (h, w, 1 + channels): by what its colours are to be multiplied, and what
    is then to be added so that brightness goes over into that of its neighbours."""
    smalls = [plan.pictures.get(one.index).small for one in candidates]
    channels = max(small.shape[2] for small in smalls)
    count = TILE_PX // NODE_PX + 2 * PAD_NODES + 2
    mixed = np.zeros((count, count, channels + 1), np.float32)
    smooth, gains, tints = [], [], []
    for one, small in zip(candidates, smalls, strict=True):
        gain = np.empty(one.mine.shape, np.float32)
        source = np.empty((*one.mine.shape, channels + 1), np.float32)
        tint = np.ones((*one.mine.shape, channels), np.float32)
        exposure = float(plan.exposure.log_gain[one.index]), plan.exposure.fall_off, plan.exposure.tint
        column, row, log_cost = one.seen
        size = tuple(plan.sights[one.index, 23:25])
        shade_source(column, row, log_cost, small, size, *exposure, gain, tint, source)
        gains.append(gain)
        tints.append(tint)
        smooth.append(_wide_blur(source))
        mix(smooth[-1], _wide_blur(one.mine.astype(np.float32)), mixed, *_first(one.nodes))
    shades = []
    for one, gain, tint, colour in zip(candidates, gains, tints, smooth, strict=True):
        shades.append(np.empty((*one.mine.shape, 1 + channels), np.float32))
        shade(gain, tint, colour, mixed, *_first(one.nodes), shades[-1])
    return shades


def _first(nodes: Span) -> tuple[int, int]:
    return nodes[0].start, nodes[1].start


def _wide_blur(nodes: Float32Array) -> Float32Array:
    """Reaches WIDE_NODES far."""
    size = 2 * WIDE_NODES + 1
    return np.asarray(cv2.GaussianBlur(nodes, (size, size), WIDE_SIGMA_PX / NODE_PX), np.float32)


# --- at full resolution ------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Layers:
    """The views that win near a tile, on nodes step_px apart over blocks of it, one node more on each side.

    candidates: which each layer is of; table (n, 6): where its nodes begin in ``nodes`` and how many stand in
    a row, its first block (row, column), number of blocks (rows, columns); nodes (3, m): column, row, log
    cost; sizes (n, 2): of its picture.
    """

    candidates: list[int]
    table: IntArray
    nodes: Float32Array
    sizes: FloatArray


def _layers(plan: Canvas, candidates: list[_Candidate], x: int, y: int) -> _Layers | None:
    """None when no view wins near the tile itself."""
    parts = [(place, part) for place, one in enumerate(candidates) if (part := _part(one)) is not None]
    if not parts:
        return None
    step, edge = plan.step_px, EDGE_NODES * NODE_PX
    per, points = NODE_PX // step, np.zeros((0, 0, 3))
    if per > 1:
        count = per * (TILE_PX // NODE_PX + 2 * EDGE_NODES) + 2
        points = _ground_points(plan, x - edge - step, y - edge - step, step, count)
    table, nodes, begins = [], [], 0
    for place, part in parts:
        one = candidates[place]
        if per > 1:
            seen = _seen_from(plan, one.index, points, _nodes_around(part, per, (0, 0)))
        else:
            before = PAD_NODES - EDGE_NODES  # the node before block 0
            shift = (before - one.nodes[0].start, before - one.nodes[1].start)
            seen = one.seen[:, *_nodes_around(part, 1, shift)]
        sides = [span.stop - span.start for span in part]
        table.append([begins, seen.shape[2], *_first(part), *sides])
        nodes.append(seen.reshape(3, -1))
        begins += nodes[-1].shape[1]
    places = [place for place, _ in parts]
    sizes = plan.sights[[candidates[place].index for place in places], 23:25]
    return _Layers(places, np.array(table), np.concatenate(nodes, axis=1), sizes)


def _nodes_around(part: Span, per: int, shift: tuple[int, int]) -> Span:
    """Nodes, per to a block, of a part of the blocks, and one more on each side."""
    rows, columns = (
        slice(per * span.start + away, per * span.stop + 2 + away)
        for span, away in zip(part, shift, strict=True)
    )
    return rows, columns


def _part(one: _Candidate) -> Span | None:
    """The blocks (rows, columns) on which a view may win pixels; None where none is near the tile itself."""
    first, reach = PAD_NODES + 1 - EDGE_NODES, TILE_PX // NODE_PX + 2 * EDGE_NODES
    spans = []
    for axis in (0, 1):
        start = one.nodes[axis].start
        taken = np.flatnonzero(one.mine.any(axis=1 - axis)) + start
        # beyond the nodes that it wins its pixels may win, too; a node more for the interpolation
        low = max(int(taken[0]) - 2, first, start + 1)
        high = min(int(taken[-1]) + 3, first + reach, one.nodes[axis].stop - 1)
        if high <= low:
            return None
        spans.append(slice(low - first, high - first))
    return spans[0], spans[1]


def _paint(
    plan: Canvas,
    scratch: _Scratch,
    layers: _Layers,
    number: int,
    candidate: _Candidate,
    shades: Float32Array,
    tile: UInt8Array,
) -> None:
    """Paint a layer into the tile and what is blended, in place."""
    layer, size = layers.table[number], (layers.sizes[number, 0], layers.sizes[number, 1])
    count = blocks_of(
        layer, number, scratch.winners, scratch.present, scratch.seams, EDGE_NODES, scratch.blocks
    )
    if count == 0:
        return
    pixels = plan.pictures.get(candidate.index).pixels
    warped = scratch.warped(1 if pixels.ndim == 2 else pixels.shape[2])
    blended = scratch.blended(shades.shape[2] - 1)
    first = tuple(PAD_NODES + 1 - EDGE_NODES - start for start in _first(candidate.nodes))
    column, row = scratch.column, scratch.row
    for begin in range(0, count, BLOCKS_AT_ONCE):
        blocks = scratch.blocks[begin : min(begin + BLOCKS_AT_ONCE, count)]
        place_blocks(layer, layers.nodes, plan.step_px, blocks, column, row)
        used = np.s_[:, : NODE_PX * len(blocks)]
        cv2.remap(pixels, column[used], row[used], cv2.INTER_CUBIC, dst=warped[used],
                  borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
        paint_blocks(number, blocks, EDGE_NODES, warped, column, row, size, shades, first,
                     scratch.label, scratch.seams, TAPS, tile, blended)  # fmt: skip
