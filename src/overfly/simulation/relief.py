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
from overfly.types import Float32Array

BLOCK = 8  # cells per side of a block whose highest point is known, for skipping

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
        _ranges(
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


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _patch_crossing(z, r, c, u, v, w, du, dv, dw, t0, t1):  # type: ignore[no-untyped-def]
    """First t in [t0, t1] where the ray (u, v in cells, w in metres) meets the bilinear patch of cell (r, c);
    -1 if none.
    """
    a = float(z[r, c])
    b, e = z[r, c + 1] - a, z[r + 1, c] - a
    f = z[r + 1, c + 1] - a - b - e
    p, q = u - c, v - r
    # w + dw t = a + b (p + du t) + e (q + dv t) + f (p + du t)(q + dv t)
    c2 = -f * du * dv
    c1 = dw - b * du - e * dv - f * (p * dv + q * du)
    c0 = w - a - b * p - e * q - f * p * q
    slack = 1e-9 * (1.0 + abs(t1))
    if c0 + t0 * (c1 + t0 * c2) <= 0.0:
        return t0
    if abs(c2) < 1e-12 * abs(c1):
        t = -c0 / c1
        return t if t0 - slack <= t <= t1 + slack else -1.0
    disc = c1 * c1 - 4.0 * c2 * c0
    if disc < 0.0:
        return -1.0
    s = -0.5 * (c1 + math.copysign(math.sqrt(disc), c1))
    first, second = s / c2, c0 / s if s != 0.0 else -1.0
    if second < first:
        first, second = second, first
    if t0 - slack <= first <= t1 + slack:
        return first
    if t0 - slack <= second <= t1 + slack:
        return second
    return -1.0


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _walk_cells(z, u, v, w, du, dv, dw, per_u, per_v, t0, t1):  # type: ignore[no-untyped-def]
    """Walk the cells between t0 and t1 (Amanatides and Woo 1987) and return the first crossing, or -1.

    per_u, per_v: 1 / du and 1 / dv.
    """
    rows, cols = z.shape
    middle = t0 + 1e-9 * (1.0 + abs(t0))
    c = min(max(math.floor(u + du * middle), 0), cols - 2)
    r = min(max(math.floor(v + dv * middle), 0), rows - 2)
    t = t0
    for _ in range(8 * BLOCK):
        next_u = ((c + 1 if du > 0.0 else c) - u) * per_u
        next_v = ((r + 1 if dv > 0.0 else r) - v) * per_v
        leave = min(next_u, next_v, t1)
        top = max(z[r, c], z[r, c + 1], z[r + 1, c], z[r + 1, c + 1])
        if w + dw * leave <= top + 1e-6:
            hit = _patch_crossing(z, r, c, u, v, w, du, dv, dw, t, leave)
            if hit >= 0.0:
                return hit
        if leave >= t1:
            return -1.0
        if next_u <= next_v:
            c += 1 if du > 0.0 else -1
        else:
            r += 1 if dv > 0.0 else -1
        if c < 0 or r < 0 or c > cols - 2 or r > rows - 2:
            return -1.0
        t = max(t, leave)
    return -1.0


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def meet_ground(ox, oy, oz, dx, dy, dz, z, blocks, frame):  # type: ignore[no-untyped-def]
    """Distance along a descending ray to the ground, in units of its direction; inf when it does not come
    down.

    frame: x0, y0, cell, border height, lowest, highest. Beyond the grid the ground is the plane at border
    height.
    """
    cell, border, lowest, highest = frame[2], frame[3], frame[4], frame[5]
    if dz > -1e-3:
        return math.inf
    per_z = 1.0 / dz
    if highest - lowest < 1e-9:
        return (highest - oz) * per_z
    u, v = (ox - frame[0]) / cell, (oy - frame[1]) / cell
    # A ray that is exactly upright in one axis is leant by far less than a texel, so that it has a next cell.
    du, dv = dx / cell, dy / cell
    du, dv = (du if abs(du) > 1e-12 else 1e-12), (dv if abs(dv) > 1e-12 else 1e-12)
    per_u, per_v = 1.0 / du, 1.0 / dv
    t = max(0.0, (highest - oz) * per_z)
    end = (lowest - oz) * per_z
    plane = (border - oz) * per_z
    while t <= end:
        nudge = t + 1e-9 * (1.0 + t)
        bc = math.floor((u + du * nudge) / BLOCK)
        br = math.floor((v + dv * nudge) / BLOCK)
        next_u = ((bc + 1 if du > 0.0 else bc) * BLOCK - u) * per_u
        next_v = ((br + 1 if dv > 0.0 else br) * BLOCK - v) * per_v
        leave = max(min(next_u, next_v), nudge)
        if 0 <= bc < blocks.shape[1] and 0 <= br < blocks.shape[0]:
            if oz + dz * leave <= blocks[br, bc] + 1e-6:
                enter = max(t, (blocks[br, bc] + 1e-6 - oz) * per_z)
                hit = _walk_cells(z, u, v, oz, du, dv, dz, per_u, per_v, enter, min(leave, end + 1e-6))
                if hit >= 0.0:
                    return hit
        elif t <= plane <= leave:
            return plane
        t = leave
    return max(plane, 0.0) if plane >= 0.0 else end


@njit(cache=True, nogil=True, error_model="numpy")
def _ranges(origins, directions, z, blocks, frame, out):  # type: ignore[no-untyped-def]
    for n in range(len(out)):
        out[n] = meet_ground(
            origins[n, 0], origins[n, 1], origins[n, 2],
            directions[n, 0], directions[n, 1], directions[n, 2], z, blocks, frame,
        )  # fmt: skip
