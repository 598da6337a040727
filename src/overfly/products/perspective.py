"""The elevation with the mosaic on it, seen from the side (paper, Fig. 5): every pixel's ray is followed to
the ground."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray
from overfly.products.elevation import ElevationGrid
from overfly.products.georeference import transform_points
from overfly.products.pictures import MapPicture
from overfly.types import BoolArray, UInt8Array

DOWN_DEG = 38.0  # how steeply the view looks down
DISTANCE = 1.9  # of the eye from the middle, in half lengths of the map
TALLEST_SHARE = 0.06  # of the map's length that its relief is raised to, so that it can be seen
MOST_RAISED = 5.0
RELIEF_SIGMAS = 10.0  # that the ground must span to have a relief worth raising
SMOOTH_CELLS = 1.2
MARGIN_PX = 8
STEP_CELLS = 0.5
EDGE_CELLS = 2.0
PALE, PALE_SHARE = 205.0, 0.4  # gray that is mixed into ground whose height is not known


@dataclass(frozen=True, slots=True, eq=False)
class PerspectiveView:
    """rgba (h, w, 4), transparent beside the map; raised: by how much heights are exaggerated; has_pale:
    whether it shows ground whose height is not known."""

    rgba: UInt8Array
    raised: float
    has_pale: bool = False


def perspective_view(
    picture: MapPicture, grid: ElevationGrid, width_px: int = 1000
) -> PerspectiveView | None:
    """The ground of the grid, looked at across its shorter side; None where hardly any height is known.

    What the picture shows within the grid without a height is drawn as high as what is nearest, and paler.
    """
    is_known = np.isfinite(grid.heights)
    if np.count_nonzero(is_known) < 10:
        return None
    is_drawn = is_known | _is_shown(picture, grid)
    places = _middles(grid)[is_drawn]
    middle, right, half = _frame(places)
    low, high = (float(value) for value in np.nanpercentile(grid.heights, [0.5, 99.5]))
    raised = 1.0
    if high - low > RELIEF_SIGMAS * float(np.nanmedian(grid.sigma)):  # noise is not raised
        raised = float(np.clip(TALLEST_SHARE * 2.0 * half / max(high - low, 1e-9), 1.0, MOST_RAISED))
    smooth = cv2.GaussianBlur(grid.extended().heights, (0, 0), SMOOTH_CELLS)
    smooth = np.where(is_known, smooth, np.minimum(smooth, np.float32(high)))  # nothing to make a peak of
    heights = np.where(is_drawn, (smooth - low) * raised, np.float32(np.nan))
    down = math.radians(DOWN_DEG)
    ahead = np.array([-right[1], right[0]])
    look = np.array([*(math.cos(down) * ahead), -math.sin(down)])
    axes = np.stack([np.array([*right, 0.0]), np.cross(look, np.array([*right, 0.0])), look])
    eye = np.array([*middle, 0.0]) - DISTANCE * half * look
    top = np.array([[*place, raised * (high - low)] for place in places[:: max(1, len(places) // 5000)]])
    ends = (np.concatenate([top, top * [1.0, 1.0, 0.0]]) - eye) @ axes.T
    flat = ends[:, :2] / ends[:, 2:]
    first, last = flat.min(axis=0), flat.max(axis=0)
    focal = (width_px - 2 * MARGIN_PX) / (last[0] - first[0])
    height_px = math.ceil(focal * (last[1] - first[1])) + 2 * MARGIN_PX
    offset = MARGIN_PX - focal * first
    world_from_picture = picture.world_from_pixel
    corner, along, across = transform_points(~world_from_picture, np.array([[0.0, 0], [1, 0], [0, 1]]))
    picture_from_world = np.column_stack([along - corner, across - corner, corner])
    place = np.array([grid.x0_m, grid.y0_m, grid.cell_m])
    lens = np.array([focal, *offset])
    rgba = _render(
        heights.astype(np.float32), is_known, place, raised * (high - low) * 1.3, picture.rgba,
        picture_from_world, eye, axes, lens, width_px, height_px,
    )  # fmt: skip
    return PerspectiveView(np.asarray(rgba, np.uint8), raised, bool((is_drawn & ~is_known).any()))


def _middles(grid: ElevationGrid) -> FloatArray:
    """(rows, columns, 2) of the cells, metres, world."""
    rows, columns = grid.heights.shape
    x, y = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    return np.stack([grid.x0_m + x * grid.cell_m, grid.y0_m - y * grid.cell_m], axis=-1)


def _is_shown(picture: MapPicture, grid: ElevationGrid) -> BoolArray:
    """(rows, columns) whether the picture shows the middle of a cell."""
    rows, columns = picture.rgba.shape[:2]
    x, y = np.floor(picture.pixels_from_world(_middles(grid))).astype(np.int64).transpose(2, 0, 1)
    inside = (x >= 0) & (y >= 0) & (x < columns) & (y < rows)
    return np.asarray(inside & (picture.rgba[y * inside, x * inside, 3] > 0))


def _frame(places: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Middle (2,) of places (n, 2), direction (2,) of their longer side, and half its length."""
    middle = 0.5 * (places.min(axis=0) + places.max(axis=0))
    _, directions = np.linalg.eigh(np.cov((places - places.mean(axis=0)).T))
    right = directions[:, 1]
    right = right if right[0] >= 0 else -right
    along = (places - middle) @ right
    return middle, np.asarray(right), float(max(np.abs(along).max(), 1e-6))


@njit(cache=True, nogil=True)
def _height(heights, c, r):  # type: ignore[no-untyped-def]
    """Bilinear; NaN beside unknown cells and beyond the grid."""
    rows, columns = heights.shape
    c0, r0 = math.floor(c), math.floor(r)
    if c0 < 0 or r0 < 0 or c0 >= columns - 1 or r0 >= rows - 1:
        return math.nan
    fc, fr = c - c0, r - r0
    above = (1.0 - fc) * heights[r0, c0] + fc * heights[r0, c0 + 1]
    below = (1.0 - fc) * heights[r0 + 1, c0] + fc * heights[r0 + 1, c0 + 1]
    return (1.0 - fr) * above + fr * below


@njit(cache=True, nogil=True)
def _paint(pixel, rgba, picture_from_world, x, y, slope):  # type: ignore[no-untyped-def]
    """The mosaic's colour at a place, in light from the left: what faces it is brighter."""
    m = picture_from_world
    j = math.floor(m[0, 0] * x + m[0, 1] * y + m[0, 2])
    i = math.floor(m[1, 0] * x + m[1, 1] * y + m[1, 2])
    if not (0 <= i < rgba.shape[0] and 0 <= j < rgba.shape[1]) or rgba[i, j, 3] == 0:
        return
    shade = min(1.25, max(0.7, 1.0 + 0.5 * slope)) if math.isfinite(slope) else 1.0
    for k in range(3):
        pixel[k] = min(255, int(rgba[i, j, k] * shade))
    pixel[3] = 255


@njit(cache=True, nogil=True)
def _render(  # type: ignore[no-untyped-def]
    heights, is_known, place, tallest, rgba, picture_from_world, eye, axes, lens, width, height
):
    """(height, width, 4): each pixel's ray followed by small steps to the ground."""
    x0, y0, cell = place[0], place[1], place[2]
    out = np.zeros((height, width, 4), np.uint8)
    for v in range(height):
        for u in range(width):
            a, b = (u + 0.5 - lens[1]) / lens[0], (v + 0.5 - lens[2]) / lens[0]
            dx = a * axes[0, 0] + b * axes[1, 0] + axes[2, 0]
            dy = a * axes[0, 1] + b * axes[1, 1] + axes[2, 1]
            dz = a * axes[0, 2] + b * axes[1, 2] + axes[2, 2]
            if dz >= -1e-6:
                continue
            # from where the ray is as low as the highest ground to where it is below the lowest
            t = (tallest - eye[2]) / dz
            end = (-0.3 * tallest - cell - eye[2]) / dz
            step = STEP_CELLS * cell / math.sqrt(dx * dx + dy * dy + dz * dz)
            was_above = False
            while t < end:
                x, y, z = eye[0] + t * dx, eye[1] + t * dy, eye[2] + t * dz
                ground = _height(heights, (x - x0) / cell - 0.5, (y0 - y) / cell - 0.5)
                if ground >= z:  # never where nothing is drawn
                    # a ray that comes in below the ground, through the map's edge, sees no surface
                    if was_above or ground - z < EDGE_CELLS * cell:
                        slope = _height(heights, (x - x0) / cell + 0.5, (y0 - y) / cell - 0.5) - ground
                        _paint(out[v, u], rgba, picture_from_world, x, y, slope / cell)
                        if not is_known[int((y0 - y) / cell), int((x - x0) / cell)]:
                            for k in range(3):
                                out[v, u, k] += int(PALE_SHARE * (PALE - out[v, u, k]))
                    break
                was_above = math.isfinite(ground)
                t += step
    return out
