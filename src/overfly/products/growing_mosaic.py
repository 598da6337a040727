"""The mosaic while the flight goes on: drawn tile by tile from the poses at hand, and drawn again where new
pictures came or where the ground moved by more than half a pixel.

Each picture is laid at a pose, at which all tiles draw it; it is laid anew only when the ground that it shows
has moved by more than half a pixel. So a tile is drawn again exactly when one of its pictures is laid anew,
and tiles that were drawn at different times agree.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from affine import Affine

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.products.cog import TILE_PX
from overfly.products.elevation import ElevationGrid, elevation_from_points
from overfly.products.exposure import Exposure, even_exposure, gray_of, thumbnail_of, within_white
from overfly.products.growing_raster import GrowingRaster, Place
from overfly.products.mosaic import MOST_OVERLAP, MOST_PIXELS
from overfly.products.picture_spool import PictureSpool
from overfly.products.tile_labels import NODE_PX
from overfly.products.tiles import PAD_NODES, canvas, draw_tile
from overfly.products.views import STEEPEST_TAN, MappedImage, View, border_rays, look_up
from overfly.types import BoolArray, IntArray, UInt8Array

MOVED_PX = 0.5  # of the ground, by which a picture is laid anew
MOST_BYTES = 160 * 2**20  # of drawn tiles; beyond, pixels become twice as long
COARSER = 2.0  # pixels of the pictures by those of the mosaic, from which on these become twice as long
CELL = 0.25  # of the ground's heights, in heights above it
MOST_CELLS = 100_000
SAMPLES = 20  # ground points across a picture, of which some must be new if it shows what others show
LEAST_NEW = 2
EVEN_EVERY = 7  # of these points tell of brightness: more find the same gains
MOST_DUE = 24  # tiles of new ground that may wait; beyond, pixels become twice as long
FALL_OFF_VIEWS = 12  # pictures that tell together how the lens darkens the corners
POINTS = 24  # of each node, that tell of its ground
LEAST_DOWN = 0.1  # cosine of the camera's tilt
RANGE_PERCENT = 95  # of a picture's points are no deeper: how far it looks
SPIKE = 0.1  # in heights above it, that the ground may differ from that around it


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Where the nodes of a map stand at one moment, n of them, in metres of the map's beginning.

    positions (n, 3), rotations (n, 3, 3): world_from_cam; is_placed (n,): False where it is reckoned only;
    points (m, POINTS, 4): what the nodes from first_node on know of their ground, metres in the camera's
    frame, and the standard deviation of the depth; NaN where that is less.
    """

    positions: FloatArray
    rotations: FloatArray
    is_placed: BoolArray
    first_node: int
    points: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class NodePicture:
    """What a node saw: pixels (h, w) or (h, w, 3) RGB, of the mosaic's camera."""

    node: int
    pixels: UInt8Array


@dataclass(slots=True, eq=False)
class _Laid:
    """The pictures that are drawn, n of them, with the poses at which they are.

    nodes (n,); positions (n, 3); rotations (n, 3, 3); heights (n, 2): of the camera above the middle and the
    lowest of its ground; outlines (n, m, 2): where the border meets that; boxes (n, 2, 2): their low and high
    corners; is_laid (n,); log_gains (n,).
    """

    nodes: IntArray
    positions: FloatArray
    rotations: FloatArray
    heights: FloatArray
    outlines: FloatArray
    boxes: FloatArray
    is_laid: BoolArray
    log_gains: FloatArray
    thumbnails: list[UInt8Array] = field(default_factory=list)

    @staticmethod
    def none(n_border: int) -> _Laid:
        return _Laid(
            np.zeros(0, np.int64),
            np.zeros((0, 3)),
            np.zeros((0, 3, 3)),
            np.zeros((0, 2)),
            np.zeros((0, n_border, 2)),
            np.zeros((0, 2, 2)),
            np.zeros(0, np.bool_),
            np.zeros(0),
        )

    def add(self, node: int, pose: Pose, heights: FloatArray, outline: FloatArray, small: UInt8Array) -> None:
        self.nodes = np.append(self.nodes, node)
        self.positions = np.concatenate([self.positions, pose.translation[None]])
        self.rotations = np.concatenate([self.rotations, pose.rotation[None]])
        self.heights = np.concatenate([self.heights, heights[None]])
        self.outlines = np.concatenate([self.outlines, outline[None]])
        self.boxes = np.concatenate([self.boxes, _box(outline)[None]])
        self.is_laid = np.append(self.is_laid, False)
        self.log_gains = np.append(self.log_gains, 0.0)
        self.thumbnails.append(small)

    def meeting(self, box: FloatArray) -> IntArray:
        """Which laid pictures' boxes meet this one."""
        meets = (self.boxes[:, 0] < box[1]).all(axis=1) & (self.boxes[:, 1] > box[0]).all(axis=1)
        return np.flatnonzero(self.is_laid & meets)


class GrowingMosaic:
    """Give it the map as it stands, let it draw, save it; all in one thread."""

    def __init__(self, camera: Camera, spool: PictureSpool) -> None:
        """camera: of the pictures; spool: where they are set aside."""
        self._camera, self._spool = camera, spool
        self._border = border_rays(camera)
        self._ray_limit = float(np.linalg.norm(self._border, axis=1).max())
        self._laid = _Laid.none(len(self._border))
        self._points = np.zeros((0, POINTS, 4))
        self._ground = ElevationGrid.flat(0.0)
        self._raster: GrowingRaster | None = None
        self._due_new: dict[Place, None] = {}  # where pictures came, in the order in which they did
        self._due_moved: dict[Place, None] = {}
        self._fall_off: FloatArray | None = None
        self.has_changed = False  # since it was saved

    @property
    def due(self) -> set[Place]:
        """Tiles that wait to be drawn."""
        return self._due_new.keys() | self._due_moved.keys()

    @property
    def px_m(self) -> float | None:
        """Length of a pixel in metres of the map's beginning; None before there is one."""
        return None if self._raster is None else self._raster.px_m

    # -- the map moved or grew

    def lay(self, placement: Placement, pictures: Iterable[NodePicture]) -> None:
        """Lay down new pictures, and anew those whose ground has moved. Raises OutputError."""
        self._points = np.concatenate([self._points[: placement.first_node], placement.points])
        self._ground = _ground_of(placement, self._points)
        self._move(placement)
        before = len(self._laid.nodes)
        for picture in pictures:
            self._choose(placement, picture)
        new = before + np.flatnonzero(self._laid.is_laid[before:])
        self._even(new)
        self._touch(new, self._due_new)
        self._keep_size()

    def _move(self, placement: Placement) -> None:
        """Known pictures: those whose ground moved are laid anew, those that came to hang by nothing taken
        away."""
        laid = self._laid
        if len(laid.nodes) == 0 or self._raster is None:
            return
        positions, rotations = placement.positions[laid.nodes], placement.rotations[laid.nodes]
        is_placed = placement.is_placed[laid.nodes] & (rotations[:, 2, 2] < -LEAST_DOWN)
        shift = _ground_shift(laid, positions, rotations)
        is_moved = (shift > MOVED_PX * self._raster.px_m) | ~laid.is_laid
        gone, anew = np.flatnonzero(laid.is_laid & ~is_placed), np.flatnonzero(is_moved & is_placed)
        old = np.concatenate([gone, anew[laid.is_laid[anew]]])
        self._touch(old, self._due_moved)
        laid.is_laid[old] = False
        laid.positions[anew], laid.rotations[anew] = positions[anew], rotations[anew]
        for index in anew.tolist():
            pose = Pose(rotations[index], positions[index])
            laid.heights[index] = self._heights(int(laid.nodes[index]), pose)
            laid.outlines[index] = self._outline(pose, float(laid.heights[index, 1]))
            laid.boxes[index] = _box(laid.outlines[index])
        laid.is_laid[anew] = True
        self._touch(anew, self._due_moved)

    def _choose(self, placement: Placement, picture: NodePicture) -> None:
        """Take a picture, unless others show its ground: every seam is a chance for an error to show."""
        pose = Pose(placement.rotations[picture.node], placement.positions[picture.node])
        heights = self._heights(picture.node, pose)
        if pose.rotation[2, 2] >= -LEAST_DOWN or heights[0] <= 0.0:
            return
        outline = self._outline(pose, float(heights[1]))
        if placement.is_placed[picture.node] and self._is_seen_already(pose, heights, outline):
            return
        self._spool.add(picture.node, picture.pixels)
        self._laid.add(picture.node, pose, heights, outline, gray_of(thumbnail_of(picture.pixels)))
        if self._raster is None:
            self._raster = GrowingRaster(float(heights[0]) / self._camera.focal_px)
        # counted as laid at once, so that the next picture is compared with it
        self._laid.is_laid[-1] = placement.is_placed[picture.node]

    def _is_seen_already(self, pose: Pose, heights: FloatArray, outline: FloatArray) -> bool:
        box = _box(outline)
        others = self._laid.meeting(box)
        if len(others) == 0:
            return False
        away = np.linalg.norm(self._laid.outlines[others].mean(axis=1) - outline.mean(axis=0), axis=1)
        if away.min() >= (1.0 - MOST_OVERLAP) * math.sqrt(float(np.prod(box[1] - box[0]))):
            return False
        view = self._view(-1, pose, float(heights[0]), outline)
        points = self._sampled(view)
        for other in others[np.argsort(away)].tolist():
            if len(points) < LEAST_NEW:
                return True
            points = points[np.isinf(look_up(self._view_of(other), self._camera, points)[1])]
        return len(points) < LEAST_NEW

    def _touch(self, indices: IntArray, due: dict[Place, None]) -> None:
        """All tiles that these pictures reach become due."""
        if self._raster is None or len(indices) == 0:
            return
        tile_m, pad = TILE_PX * self._raster.px_m, NODE_PX * (PAD_NODES + 1) / TILE_PX
        west, south = (self._laid.boxes[indices, 0] / tile_m - pad).T
        east, north = (self._laid.boxes[indices, 1] / tile_m + pad).T
        spans = np.floor(np.stack([-north, -south, west, east], axis=1)).astype(np.int64)
        for top, bottom, left, right in np.unique(spans, axis=0).tolist():
            for row in range(top, bottom + 1):
                due |= dict.fromkeys((row, column) for column in range(left, right + 1))

    def _keep_size(self) -> None:
        """Coarser pixels where the camera has climbed, the memory is full, the ground is vast, or it comes
        faster than it can be drawn: all of it coarse is more to look at than a fine piece."""
        raster, laid = self._raster, self._laid
        if raster is None or not laid.is_laid.any():
            return
        px_m = float(np.median(laid.heights[laid.is_laid, 0])) / self._camera.focal_px
        size = np.ptp(laid.outlines[laid.is_laid].reshape(-1, 2), axis=0)
        while (
            px_m > COARSER * raster.px_m
            or raster.n_bytes > MOST_BYTES
            or float(np.prod(size)) / raster.px_m**2 > MOST_PIXELS
        ):
            self._coarsen(raster)
        if len(self._due_new) > MOST_DUE:
            self._coarsen(raster)

    def _coarsen(self, raster: GrowingRaster) -> None:
        raster.coarsen()
        self._due_new, self._due_moved = _merged(self._due_new), _merged(self._due_moved)

    # -- pictures and ground

    def _heights(self, node: int, pose: Pose) -> FloatArray:
        """(2,) of a camera above the middle and the lowest of its ground."""
        points = self._points[node]
        points = points[np.isfinite(points[:, 2]), :3]
        if len(points) == 0:
            ground = float(self._ground.height_at(pose.translation[0], pose.translation[1]))
            return np.full(2, float(pose.translation[2]) - ground)
        below = -(points @ pose.rotation[2])
        return np.asarray(np.percentile(below, [50, RANGE_PERCENT]))

    def _outline(self, pose: Pose, height_m: float) -> FloatArray:
        return pose.translation[:2] + height_m * _reach(self._border, pose.rotation[None])[0, :, :2]

    def _view_of(self, index: int) -> View:
        laid = self._laid
        pose = Pose(laid.rotations[index], laid.positions[index])
        return self._view(int(laid.nodes[index]), pose, float(laid.heights[index, 0]), laid.outlines[index])

    def _view(self, node: int, pose: Pose, height_m: float, outline: FloatArray) -> View:
        image = MappedImage(str(node), partial(self._spool.get, node), self._camera, pose)
        return View(image, self._ray_limit, outline, height_m / self._camera.focal_px)

    def _sampled(self, view: View) -> FloatArray:
        """(n, 3) points of the ground that a view sees, spread evenly."""
        x, y = (np.linspace(view.low[k], view.high[k], SAMPLES) for k in (0, 1))
        xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        points = np.column_stack([xy, self._ground.height_at(xy[:, 0], xy[:, 1])])
        return points[np.isfinite(look_up(view, self._camera, points)[1])]

    def _even(self, new: IntArray) -> None:
        """Gains of new pictures by what they have in common with those about them, whose own stay as they
        are, so that tiles that are drawn already keep their brightness."""
        if len(new) == 0:
            return
        laid = self._laid
        about = [laid.meeting(laid.boxes[index]) for index in new]
        group = np.unique(np.concatenate([*about, new]))
        views = [self._view_of(index) for index in group.tolist()]
        n_old = len(group) - len(new)  # these come first
        points = np.concatenate([self._sampled(view)[::EVEN_EVERY] for view in views[n_old:]])
        small = [laid.thumbnails[index] for index in group]
        found = even_exposure(views, small, points)
        known = laid.log_gains[group[:n_old]]
        level = float(np.median(known - found.log_gain[:n_old])) if n_old else 0.0
        alike = Exposure(found.log_gain[n_old:] + level, found.fall_off)
        # where that would cut off what is bright in the new ones, they stay darker
        laid.log_gains[new] = within_white(alike, views[n_old:], small[n_old:]).log_gain
        if self._fall_off is None and len(group) >= FALL_OFF_VIEWS and self._raster is not None:
            self._fall_off = found.fall_off
            self._due_moved |= dict.fromkeys(self._raster.places())

    # -- drawing

    def draw_next(self) -> bool:
        """Draw the tile that has waited longest, new ground before what moved; False when none is due.

        Raises OutputError.
        """
        place = next(iter(self._due_new or self._due_moved), None)
        if place is None or self._raster is None:
            return False
        self._raster.put(place, self._drawn(self._raster.px_m, place))
        for due in (self._due_new, self._due_moved):
            due.pop(place, None)
        self.has_changed = True
        return True

    def _drawn(self, px_m: float, place: Place) -> UInt8Array | None:
        row, column = place
        corner, pad = np.array([column, row]) * TILE_PX, NODE_PX * (PAD_NODES + 1)
        (west, north), (east, south) = px_m * (corner - pad), px_m * (corner + TILE_PX + pad)
        chosen = self._laid.meeting(np.array([[west, -south], [east, -north]]))
        if len(chosen) == 0:
            return None
        exposure = Exposure.even(self._laid.log_gains[chosen])
        if self._fall_off is not None:
            exposure = replace(exposure, fall_off=self._fall_off)
        views = [self._view_of(index) for index in chosen.tolist()]
        plan = canvas(views, exposure, self._ground, Affine(px_m, 0.0, 0.0, 0.0, -px_m, 0.0), px_m)
        return draw_tile(plan, (int(corner[0]), int(corner[1])))

    def save(self, path: str | Path, scale: float = 1.0) -> None:
        """All that is drawn, as a GeoTIFF; no file where that is nothing. scale: the map's metre by that of
        its beginning. Raises OutputError."""
        if self._raster is not None and self._raster.places():
            self._raster.save(path, scale)
        self.has_changed = False


def _merged(due: dict[Place, None]) -> dict[Place, None]:
    """The same tiles of a raster of half the size."""
    return dict.fromkeys((row // 2, column // 2) for row, column in due)


def _box(outline: FloatArray) -> FloatArray:
    return np.stack([outline.min(axis=0), outline.max(axis=0)])


def _reach(border: FloatArray, rotations: FloatArray) -> FloatArray:
    """(n, m, 3) of border rays (m, 2): where each meets the ground, from the camera, in heights above it."""
    rays = np.column_stack([border, np.ones(len(border))])
    directions = np.einsum("nij,mj->nmi", rotations, rays)
    flat = np.linalg.norm(directions[..., :2], axis=2)
    down = np.maximum(-directions[..., 2], flat / STEEPEST_TAN)
    return np.asarray(directions / down[..., None])


def _ground_shift(laid: _Laid, positions: FloatArray, rotations: FloatArray) -> FloatArray:
    """(n,) metres, by how much the ground on the border of each picture moves with its camera."""
    ground = np.concatenate([laid.outlines, laid.outlines.mean(axis=1, keepdims=True)], axis=1)
    old = np.concatenate([
        ground - laid.positions[:, None, :2],
        np.broadcast_to(-laid.heights[:, None, 1:], (*ground.shape[:2], 1)),
    ], axis=2)  # fmt: skip
    turns = np.einsum("nij,nkj->nik", rotations, laid.rotations)
    new = np.einsum("nij,nmj->nmi", turns, old)
    shift = (new - old)[..., :2] + (positions - laid.positions)[:, None, :2]
    return np.asarray(np.linalg.norm(shift, axis=2).max(axis=1))


def _ground_of(placement: Placement, points: FloatArray) -> ElevationGrid:
    """The ground's heights from points (n, POINTS, 4) of the nodes, on coarse cells, without spikes: a steep
    slope in a wrong place smears what is drawn on it."""
    arms = np.einsum("nij,nkj->nki", placement.rotations, points[..., :3])
    below = -arms[..., 2].ravel()
    in_world = (arms + placement.positions[:, None]).reshape(-1, 3)
    good = np.isfinite(below) & (below > 0.0) & np.repeat(placement.is_placed, POINTS)
    if not good.any():
        return ElevationGrid.flat(0.0)
    in_world, height_m = in_world[good], float(np.median(below[good]))
    area = float(np.prod(np.ptp(in_world[:, :2], axis=0)))
    cell_m = max(CELL * height_m, math.sqrt(area / MOST_CELLS))
    grid = elevation_from_points(in_world, points[..., 3].ravel()[good], cell_m)
    around = cv2.medianBlur(grid.extended().heights, 5)
    level = np.where(np.abs(grid.heights - around) < SPIKE * height_m, grid.heights, np.float32(np.nan))
    smooth = replace(grid, heights=level).extended()
    return replace(smooth, heights=np.asarray(cv2.medianBlur(smooth.heights, 5), np.float32))
