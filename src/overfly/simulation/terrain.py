"""Things with height: rolling ground, kerbs, boxes, tables, trees, gathered on one grid."""

from __future__ import annotations

import math

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.simulation.noise import fractal_noise
from overfly.simulation.patches import Shape, rectangle
from overfly.simulation.relief import HeightField, build_relief


class Terrain:
    """A grid of heights to build on; bounds_m x0, y0, x1, y1; level (0) at its rim and beyond."""

    def __init__(self, bounds_m: tuple[float, float, float, float], cell_m: float) -> None:
        self.x0, self.y0 = bounds_m[0], bounds_m[1]
        self.cell_m = cell_m
        cols, rows = (math.ceil((bounds_m[k + 2] - bounds_m[k]) / cell_m) + 1 for k in (0, 1))
        self.z = np.zeros((rows, cols))

    @property
    def x(self) -> FloatArray:
        return np.asarray(self.x0 + np.arange(self.z.shape[1]) * self.cell_m)[None, :]

    @property
    def y(self) -> FloatArray:
        return np.asarray(self.y0 + np.arange(self.z.shape[0]) * self.cell_m)[:, None]

    def roll(self, height_m: float, wavelength_m: float, seed: int, finest_m: float = 1.0) -> Terrain:
        """Add gentle hills of the given RMS height."""
        half = 0.5 * self.cell_m
        corner = self.x0 - half, self.y0 - half
        self.z += height_m * fractal_noise(
            *corner, self.cell_m, self.z.shape, seed, wavelength_m, finest_m=finest_m, gain=0.45
        )
        return self

    def box(
        self,
        centre: tuple[float, float],
        size_m: tuple[float, float],
        height_m: float,
        angle_rad: float = 0.0,
    ) -> Terrain:
        """A box, step or kerb: raises the rectangle by height_m, walls one cell wide."""
        return self.raise_inside(rectangle(centre, size_m, angle_rad), height_m)

    def raise_inside(self, shape: Shape, height_m: float) -> Terrain:
        self.z += height_m * shape.coverage(self.x, self.y, self.cell_m)
        return self

    def tree(self, centre: tuple[float, float], radius_m: float, height_m: float, seed: int) -> Terrain:
        """A crown: a rough dome, for what is seen from above."""
        r0, c0 = (
            int((centre[k] - radius_m - origin) / self.cell_m) for k, origin in ((1, self.y0), (0, self.x0))
        )
        count = math.ceil(2.0 * radius_m / self.cell_m) + 3
        rows, cols = slice(max(0, r0), max(0, r0 + count)), slice(max(0, c0), max(0, c0 + count))
        away = np.hypot(self.x[:, cols] - centre[0], self.y[rows] - centre[1])
        dome = np.sqrt(np.clip(1.0 - (away / radius_m) ** 2, 0.0, 1.0))
        generator = np.random.default_rng([seed, 8])
        rough = 0.75 + 0.25 * generator.random(dome.shape)
        self.z[rows, cols] += height_m * dome * rough
        return self

    def build(self) -> HeightField:
        """The height field, let down to level towards its rim: over a twelfth of its width."""
        rows, cols = self.z.shape
        reach = max(1, min(rows, cols) // 12)
        r = np.minimum(np.arange(rows), np.arange(rows)[::-1])[:, None]
        c = np.minimum(np.arange(cols), np.arange(cols)[::-1])[None, :]
        fall = np.clip(np.minimum(r, c) / reach, 0.0, 1.0)
        return build_relief(self.z * fall, self.x0, self.y0, self.cell_m)
