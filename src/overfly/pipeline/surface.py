"""The ground's shape from the pictures of the nodes: each is matched densely with its partner, and what all
views say is fused.

The partner is the second camera's picture where there is one, else that of a node from a little further on
or back.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import cv2
import numpy as np
from numba import njit
from scipy import ndimage
from scipy.spatial import KDTree

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.products.elevation import (
    ElevationGrid,
    elevation_from_points,
    with_small_holes_filled,
    without_noise,
)
from overfly.threads import in_order
from overfly.types import Rig, UInt8Array
from overfly.vision.dense import DepthRange, PairGeometry, dense_points, pair_geometry
from overfly.vision.observation import working_image, working_rig

WIDTH_PX = 320  # of the pictures that are matched: finer ones cost much and show little more of the ground
CELL_PX = 4.0  # of those, side of a cell of the elevation: smaller ones would only repeat their neighbours
LEAST_PX = 3  # of those, that a view must have in a cell
MOST_CELLS = 40_000_000
LARGEST_HOLE = 6.0  # in cells, that is filled from around
BASELINES = (0.08, 0.6)  # in heights above the ground, between a node and its partner
BEST_BASELINE = 0.3
SPECK_CELLS = 100  # smaller pieces of ground that hang together with nothing are wrong matches
QUARREL, QUARREL_SIGMAS = 0.03, 4.0  # heights above the ground, and of usual sigmas, that views may disagree
JURY = 5  # points of the map, next to a cell, most of which have to bear it out
SPIKE = 0.2  # in heights above the ground: single cells so far from all around them are, too
KEPT_PICTURES = 6


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceView:
    """A node as dense matching needs it.

    load: gives the pictures of the rig's cameras, as recorded; depths_m: of the ground in it; pose_sigma_m:
    deviation of the ground's height in all of the picture, by the pose, in the map's own shape; points (n, 3)
    of the map in it, in the camera, and their deviations (n,), metres: what bears the matching out.
    """

    world_from_cam: Pose
    depths_m: DepthRange
    load: Callable[[], tuple[UInt8Array, ...]]
    pose_sigma_m: float = 0.0
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    points_sigma_m: FloatArray = field(default_factory=lambda: np.zeros(0))


def dense_elevation(views: Sequence[SurfaceView], rig: Rig) -> ElevationGrid | None:
    """Heights and their standard deviations from all views; None when no two pictures tell any."""
    small = working_rig(rig, WIDTH_PX)
    if not views:
        return None
    cell_m = _cell_size(views, small)
    parts = [part for part in in_order(partial(_by_cell, cell_m), _pairs(views, small)) if len(part)]
    if not parts:
        return None
    table = np.concatenate(parts)
    grid = elevation_from_points(table[:, :3], table[:, 3], cell_m)
    typical = float(np.median([view.depths_m.ground_m for view in views]))
    grid = _without_specks(_without_quarrels(_with_view_errors(grid, parts), typical), SPIKE * typical)
    grid = with_small_holes_filled(without_noise(grid), LARGEST_HOLE * cell_m)
    return _with_pose_errors(grid, table)


def _cell_size(views: Sequence[SurfaceView], small: Rig) -> float:
    """A round number of metres, some pixels large, and larger where the map is vast."""
    height = float(np.median([view.depths_m.ground_m for view in views]))
    places = np.array([view.world_from_cam.translation[:2] for view in views])
    area = float(np.prod(np.ptp(places, axis=0) + 2.0 * height))
    wanted = max(CELL_PX * height / small.cam0.camera.focal_px, math.sqrt(area / MOST_CELLS))
    return float(f"{wanted:.1g}")


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """A view's picture and its partner's, gray; geometry: as far as it is known already."""

    view: SurfaceView
    left: UInt8Array
    right: UInt8Array
    cameras: tuple[Camera, Camera]
    right_from_left: Pose
    geometry: PairGeometry | None = None


def _pairs(views: Sequence[SurfaceView], small: Rig) -> Iterator[_Pair]:
    """Each view that has a partner, with it."""
    pictures = _Pictures(views, small)
    if small.is_stereo:
        left, right = (mounted.camera for mounted in small.cameras[:2])
        geometry: PairGeometry | None = None
        for index, view in enumerate(views):
            if geometry is None or not geometry.suits(view.depths_m):
                geometry = pair_geometry(left, right, small.cam1_from_cam0, view.depths_m)
            shown = pictures.get(index, 0), pictures.get(index, 1)
            yield _Pair(view, *shown, (left, right), small.cam1_from_cam0, geometry)
        return
    camera = small.cam0.camera
    for index, partner in _partners(views):
        step = views[partner].world_from_cam.inverse() @ views[index].world_from_cam
        yield _Pair(views[index], pictures.get(index, 0), pictures.get(partner, 0), (camera, camera), step)


def _partners(views: Sequence[SurfaceView]) -> Iterator[tuple[int, int]]:
    """For each view an earlier one that stands a good way off, the nearest in time first."""
    for index, view in enumerate(views):
        best, partner = math.inf, -1
        for other in range(max(0, index - 4), index):
            step = float(
                np.linalg.norm(views[other].world_from_cam.translation - view.world_from_cam.translation)
            )
            share = step / view.depths_m.ground_m
            if BASELINES[0] <= share <= BASELINES[1] and abs(math.log(share / BEST_BASELINE)) < best:
                best, partner = abs(math.log(share / BEST_BASELINE)), other
        if partner >= 0:
            yield index, partner


def _by_cell(cell_m: float, pair: _Pair) -> FloatArray:
    """(k, 5) x, y, z, sigma in metres, world: the mean of the view's points in each cell of the grid; and the
    sigma of the pose."""
    depths_m, pose = pair.view.depths_m, pair.view.world_from_cam
    geometry = pair.geometry or pair_geometry(*pair.cameras, pair.right_from_left, depths_m)
    points = None if geometry is None else dense_points(geometry, pair.left, pair.right)
    if points is None or len(points.in_cam) == 0:
        return np.zeros((0, 5))
    cells = _mean_by_cell(points.in_cam, points.sigma_m, pose.rotation, pose.translation, cell_m, LEAST_PX)
    cells = _borne_out(cells, pair.view, cell_m)
    return np.column_stack([cells, np.full(len(cells), pair.view.pose_sigma_m)])


def _borne_out(cells: FloatArray, view: SurfaceView, cell_m: float) -> FloatArray:
    """Those of the cells (k, 4), x, y, z, sigma, that the points of the map next to them do not contradict.

    Ground that repeats itself, such as tiles, is matched a period off, a whole piece alike; the map's points
    are found in several views. All are kept where there are too few points to tell.
    """
    if len(cells) == 0 or len(view.points) == 0:
        return cells
    places = view.world_from_cam.transform(view.points)
    away, at = KDTree(cells[:, :2]).query(places[:, :2])
    inside = away < cell_m
    if np.count_nonzero(inside) < JURY:
        return cells
    places, matched = places[inside], cells[np.asarray(at)[inside]]
    sigma = np.hypot(view.points_sigma_m[inside], matched[:, 3])
    most = np.maximum(QUARREL * view.depths_m.ground_m, QUARREL_SIGMAS * sigma)
    contradicts = np.abs(matched[:, 2] - places[:, 2]) > most
    if not contradicts.any():
        return cells
    _, jury = KDTree(places[:, :2]).query(cells[:, :2], k=JURY)
    return np.asarray(cells[2 * np.count_nonzero(contradicts[jury], axis=1) < JURY])


@njit(cache=True, nogil=True)
def _mean_by_cell(points, sigmas, rotation, translation, cell_m, least):  # type: ignore[no-untyped-def]
    count = len(points)
    heights = np.empty(count)
    places = np.empty((count, 2), np.int64)
    low, high = np.full(2, 1 << 62), np.full(2, -(1 << 62))
    for n in range(count):
        for k in range(3):
            value = translation[k]
            for m in range(3):
                value += rotation[k, m] * points[n, m]
            if k == 2:
                heights[n] = value
            else:
                place = math.floor(value / cell_m)
                places[n, k] = place
                low[k], high[k] = min(low[k], place), max(high[k], place)
    sums = np.zeros((high[1] - low[1] + 1, high[0] - low[0] + 1, 3))  # of ones, heights, sigmas
    for n in range(count):
        cell = sums[places[n, 1] - low[1], places[n, 0] - low[0]]
        cell[0] += 1.0
        cell[1] += heights[n]
        cell[2] += sigmas[n]
    table = np.empty((np.count_nonzero(sums[..., 0] >= least), 4))
    filled = 0
    for row in range(sums.shape[0]):
        for column in range(sums.shape[1]):
            ones = sums[row, column, 0]
            if ones < least:
                continue
            table[filled, 0] = cell_m * (low[0] + column + 0.5)
            table[filled, 1] = cell_m * (low[1] + row + 0.5)
            table[filled, 2] = sums[row, column, 1] / ones
            # matching makes neighbours agree: their errors do not average out
            table[filled, 3] = sums[row, column, 2] / ones
            filled += 1
    return table


def _with_view_errors(grid: ElevationGrid, parts: Sequence[FloatArray]) -> ElevationGrid:
    """The same with what whole views are off from the others, by their poses, added to the sigmas."""
    offsets = [
        float(np.nanmedian(part[:, 2] - grid.height_at(part[:, 0], part[:, 1])))
        for part in parts
        if np.isfinite(grid.height_at(part[:, 0], part[:, 1])).any()
    ]
    common = 1.4826 * float(np.median(np.abs(offsets))) if offsets else 0.0
    return replace(grid, sigma=np.sqrt(grid.sigma**2 + common**2).astype(np.float32))


def _with_pose_errors(grid: ElevationGrid, table: FloatArray) -> ElevationGrid:
    """The same with the sigmas of the poses added. table (k, 5): what each view says of each cell.

    They do not average out: poses of views of the same ground err together.
    """
    rows, columns = grid.heights.shape
    row = np.clip(((grid.y0_m - table[:, 1]) / grid.cell_m).astype(np.int64), 0, rows - 1)
    column = np.clip(((table[:, 0] - grid.x0_m) / grid.cell_m).astype(np.int64), 0, columns - 1)
    cell = row * columns + column
    count = np.bincount(cell, minlength=rows * columns)
    total = np.bincount(cell, table[:, 4], minlength=rows * columns)
    mean = np.divide(total, count, out=np.full(len(count), np.nan), where=count > 0)
    seen = replace(grid, heights=mean.reshape(rows, columns).astype(np.float32))
    sigma = np.hypot(grid.sigma, seen.extended().heights)  # a filled hole is as sure as what is around it
    return replace(grid, sigma=sigma.astype(np.float32))


def _without_quarrels(grid: ElevationGrid, height_m: float) -> ElevationGrid:
    """The same without cells on which views disagree far more than they usually do."""
    if not np.isfinite(grid.sigma).any():
        return grid
    most = max(QUARREL * height_m, QUARREL_SIGMAS * float(np.nanmedian(grid.sigma)))
    agreed = grid.sigma < most
    heights, sigma = (np.where(agreed, band, np.float32(np.nan)) for band in (grid.heights, grid.sigma))
    return replace(grid, heights=heights, sigma=sigma)


def _without_specks(grid: ElevationGrid, spike_m: float) -> ElevationGrid:
    """The same without what hangs together with nothing: spikes, and small pieces apart from all others."""
    around = cv2.medianBlur(grid.extended().heights, 5)
    known = np.abs(grid.heights - around) < spike_m
    pieces, _ = ndimage.label(known)
    sizes = np.bincount(pieces.ravel())
    # a map that is small as a whole keeps its largest piece
    enough = min(SPECK_CELLS, int(sizes[1:].max(initial=0)))
    known &= sizes[pieces] >= enough
    heights, sigma = (np.where(known, band, np.float32(np.nan)) for band in (grid.heights, grid.sigma))
    return replace(grid, heights=heights, sigma=sigma)


@dataclass(slots=True, eq=False)
class _Pictures:
    """Gray pictures of matching size, the last few kept."""

    views: Sequence[SurfaceView]
    rig: Rig
    kept: OrderedDict[int, list[UInt8Array]] = field(default_factory=OrderedDict)

    def get(self, index: int, camera: int) -> UInt8Array:
        if index not in self.kept:
            pictures = zip(self.views[index].load(), self.rig.cameras, strict=False)
            self.kept[index] = [working_image(picture, mounted.camera) for picture, mounted in pictures]
            if len(self.kept) > KEPT_PICTURES:
                self.kept.popitem(last=False)
        return self.kept[index][camera]
