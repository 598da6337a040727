"""The ground as something to draw and to click on: where a ray meets it, and meshes that carry pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from overfly.geometry.poses import FloatArray

HeightAt = Callable[[FloatArray, FloatArray], FloatArray]  # x, y (any shape), metres, world -> z, metres

STEPS = 400  # along a ray, before the place is found exactly
HALVINGS = 30


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Ground whose height is known everywhere. low_m, high_m: it lies between them."""

    height_at: HeightAt
    low_m: float
    high_m: float

    @staticmethod
    def flat(height_m: float) -> Surface:
        return Surface(lambda x_m, _y_m: np.full(np.shape(x_m), height_m), height_m, height_m)

    @staticmethod
    def below_nodes(places: FloatArray) -> Surface:
        """places (n, 3), n > 0: points of the ground, metres, world; between them the nearest one's height
        holds."""
        tree = KDTree(places[:, :2])

        def height_at(x_m: FloatArray, y_m: FloatArray) -> FloatArray:
            _, nearest = tree.query(np.stack([x_m, y_m], axis=-1))
            return np.asarray(places[nearest, 2])

        return Surface(height_at, float(places[:, 2].min()), float(places[:, 2].max()))

    def meet(self, origin: FloatArray, direction: FloatArray) -> FloatArray | None:
        """(3,) where a ray first meets the ground, metres, world; None when it looks up or away from it.

        origin, direction (3,): of the ray, in the world.
        """
        if direction[2] >= -1e-6 or origin[2] <= self.low_m:
            return None
        margin = 0.01 * max(origin[2] - self.low_m, 1e-6)
        top, bottom = min(float(origin[2]), self.high_m + margin), self.low_m - margin
        begin, end = (origin[2] - top) / -direction[2], (origin[2] - bottom) / -direction[2]
        reach = np.linspace(begin, end, STEPS)
        below = np.flatnonzero(self._above(origin, direction, reach) <= 0.0)
        if len(below) == 0:
            return None
        low, high = reach[max(int(below[0]) - 1, 0)], reach[below[0]]
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            if self._above(origin, direction, np.array([middle]))[0] > 0.0:
                low = middle
            else:
                high = middle
        return np.asarray(origin + high * direction)

    def _above(self, origin: FloatArray, direction: FloatArray, reach: FloatArray) -> FloatArray:
        """Height above the ground of points along a ray."""
        points = origin + reach[:, None] * direction
        return np.asarray(points[:, 2] - self.height_at(points[:, 0], points[:, 1]))
