"""Which ground a camera sees, and which is hidden behind higher ground."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray
from overfly.products.elevation import ElevationGrid
from overfly.types import BoolArray

STEP_CELLS = 0.7  # along the way to the camera
SLACK_CELLS = 1.0  # that ground must rise above the line of sight: heights are no surer than that


def is_hidden(ground: ElevationGrid, points: FloatArray, centre: FloatArray, highest_m: float) -> BoolArray:
    """(n,) whether ground lies between points (n, 3) on it and the camera's centre (3,); metres, world.

    highest_m: above it there is no ground. The grid has no unknown cells (ElevationGrid.extended).
    """
    return np.asarray(
        _is_hidden(
            ground.heights, ground.x0_m, ground.y0_m, ground.cell_m,
            np.ascontiguousarray(points, np.float64), np.asarray(centre, np.float64), highest_m,
        )
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _is_hidden(heights, x0, y0, cell, points, centre, highest):  # type: ignore[no-untyped-def]
    hidden = np.zeros(len(points), np.bool_)
    for n in range(len(points)):
        hidden[n] = _is_covered(
            heights, (x0, y0, cell), points[n, 0], points[n, 1], points[n, 2],
            centre[0], centre[1], centre[2], highest,
        )  # fmt: skip
    return hidden


@njit(cache=True, nogil=True)
def _is_covered(heights, frame, x, y, z, centre_x, centre_y, centre_z, highest):  # type: ignore[no-untyped-def]
    """Whether ground lies between a point of it and a camera. frame: of the heights, x0, y0, cell."""
    rows, columns = heights.shape
    if rows < 2 or columns < 2:  # level
        return False
    x0, y0, cell = frame
    dx, dy, dz = centre_x - x, centre_y - y, centre_z - z
    flat = math.sqrt(dx * dx + dy * dy)
    if dz <= 0.0 or flat < cell:
        return False
    # the line of sight leaves all ground below it where it is higher than the highest
    reach = min(1.0, (highest - z) / dz) * flat
    steps = int(reach / (STEP_CELLS * cell))
    for k in range(1, steps + 1):
        share = k * STEP_CELLS * cell / flat
        c = min(max((x + share * dx - x0) / cell - 0.5, 0.0), columns - 1.0)
        r = min(max((y0 - y - share * dy) / cell - 0.5, 0.0), rows - 1.0)
        c0, r0 = min(int(c), columns - 2), min(int(r), rows - 2)
        fc, fr = c - c0, r - r0
        above = (1.0 - fc) * heights[r0, c0] + fc * heights[r0, c0 + 1]
        below = (1.0 - fc) * heights[r0 + 1, c0] + fc * heights[r0 + 1, c0 + 1]
        if (1.0 - fr) * above + fr * below > z + share * dz + SLACK_CELLS * cell:
            return True
    return False
