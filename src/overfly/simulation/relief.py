"""The shape of the ground: a grid of heights, bilinear between its nodes, flat beyond; and the light that
falls on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray
from overfly.simulation.kernels import BLOCK, ray_ranges
from overfly.types import Float32Array

SUN = np.array([-0.33, -0.47, 0.82]) / np.linalg.norm([-0.33, -0.47, 0.82])


@dataclass(frozen=True, slots=True, eq=False)
class HeightField:
    """z of nodes (rows, cols): node (r, c) stands at x0 + c cell_m, y0 + r cell_m. border_m: height of
    everything beyond.

    light (rows, cols): share of full daylight on each node, 0..1 and a little more on slopes that face the
    sun. blocks: highest z of each BLOCK x BLOCK cells.
    """

    heights: Float32Array
    light: Float32Array
    blocks: Float32Array
    x0: float
    y0: float
    cell_m: float
    border_m: float

    @property
    def lowest_m(self) -> float:
        return min(float(self.heights.min()), self.border_m)

    @property
    def highest_m(self) -> float:
        return max(float(self.heights.max()), self.border_m)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """z in metres at points x, y (any equal shape)."""
        return self._interpolate(self.heights, np.asarray(x, float), np.asarray(y, float), self.border_m)

    def _interpolate(self, grid: Float32Array, x: FloatArray, y: FloatArray, beyond: float) -> FloatArray:
        u, v = (x - self.x0) / self.cell_m, (y - self.y0) / self.cell_m
        rows, cols = grid.shape
        inside = (u >= 0) & (u <= cols - 1) & (v >= 0) & (v <= rows - 1)
        c = np.clip(np.floor(u).astype(np.int64), 0, cols - 2)
        r = np.clip(np.floor(v).astype(np.int64), 0, rows - 2)
        fu, fv = u - c, v - r
        low = grid[r, c] * (1.0 - fu) + grid[r, c + 1] * fu
        high = grid[r + 1, c] * (1.0 - fu) + grid[r + 1, c + 1] * fu
        return np.where(inside, low * (1.0 - fv) + high * fv, beyond)

    def ranges(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        """Distances along rays, in units of their directions (n, 3), from origins (n, 3) to the ground; inf
        where none is met.
        """
        out = np.empty(len(origins))
        ray_ranges(
            np.ascontiguousarray(origins, dtype=np.float64),
            np.ascontiguousarray(directions, dtype=np.float64),
            self.heights,
            self.blocks,
            self.kernel_arguments()[3],
            out,
        )
        return out

    def kernel_arguments(self) -> tuple[Float32Array, Float32Array, Float32Array, FloatArray]:
        frame = np.array(
            [self.x0, self.y0, self.cell_m, self.border_m, self.lowest_m, self.highest_m], dtype=np.float64
        )
        return self.heights, self.light, self.blocks, frame


def build_relief(
    heights: FloatArray, x0: float, y0: float, cell_m: float, *, border_m: float = 0.0, shaded: bool = True
) -> HeightField:
    """Height field with its light; heights (rows, cols), row 0 at the smallest y. shaded: False for even
    light.

    Raises ValueError for a grid that is none.
    """
    z = np.ascontiguousarray(heights, dtype=np.float32)
    if z.ndim != 2 or min(z.shape) < 2 or not np.isfinite(z).all():
        raise ValueError("a height field needs a grid of at least 2 x 2 finite heights")
    light = _light(z, cell_m) if shaded else np.ones_like(z)
    return HeightField(z, light, _block_tops(z), x0, y0, cell_m, border_m)


def flat_relief(height_m: float = 0.0) -> HeightField:
    return build_relief(np.full((2, 2), height_m), 0.0, 0.0, 1.0, border_m=height_m, shaded=False)


def _block_tops(z: Float32Array) -> Float32Array:
    rows, cols = -(-(z.shape[0] - 1) // BLOCK), -(-(z.shape[1] - 1) // BLOCK)
    padded = np.pad(z, ((0, rows * BLOCK + 1 - z.shape[0]), (0, cols * BLOCK + 1 - z.shape[1])), mode="edge")
    tops = np.full((rows, cols), -np.inf, dtype=np.float32)
    for dr in range(BLOCK + 1):
        for dc in range(BLOCK + 1):
            part = padded[dr : dr + rows * BLOCK : BLOCK, dc : dc + cols * BLOCK : BLOCK]
            np.maximum(tops, part[:rows, :cols], out=tops)
    return tops


def _light(z: Float32Array, cell_m: float) -> Float32Array:
    """Sun on the slope (Lambert) where the sun is not hidden, and sky light everywhere; 1 on open level
    ground.
    """
    dy, dx = np.gradient(z.astype(np.float64), cell_m)
    facing = (SUN[2] - dx * SUN[0] - dy * SUN[1]) / np.sqrt(1.0 + dx * dx + dy * dy)
    sun = np.clip(facing / SUN[2], 0.0, 1.4)
    if np.ptp(z) > 0.0:
        lit = np.ones(z.shape, dtype=np.float32)
        _cast_shadows(z, cell_m, SUN / math.hypot(SUN[0], SUN[1]), lit)
        sun *= cv2.GaussianBlur(lit, (3, 3), 0.0)
    return np.asarray(0.32 + 0.68 * sun, dtype=np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def _cast_shadows(z, cell, sun, lit):  # type: ignore[no-untyped-def]
    """lit = 0 where a walk towards the sun meets higher ground; sun: direction with horizontal length 1."""
    rows, cols = z.shape
    top = z.max()
    for r in range(rows):
        for c in range(cols):
            x, y, height = float(c), float(r), z[r, c] + 1e-3 * cell
            while True:
                x += sun[0]
                y += sun[1]
                height += sun[2] * cell
                i, j = int(x), int(y)
                if height > top or i < 0 or j < 0 or i >= cols - 1 or j >= rows - 1 or x < 0 or y < 0:
                    break
                fu, fv = x - i, y - j
                low = z[j, i] * (1.0 - fu) + z[j, i + 1] * fu
                high = z[j + 1, i] * (1.0 - fu) + z[j + 1, i + 1] * fu
                if low * (1.0 - fv) + high * fv > height:
                    lit[r, c] = 0.0
                    break
