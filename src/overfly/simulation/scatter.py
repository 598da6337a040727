"""Small things that lie on the ground, thousands of them: grass blades, leaves, pebbles, twigs, litter.

They are drawn one by one with exact-coverage edges, in an order that depends on their place only, so that
tiles that share one agree on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray
from overfly.simulation.noise import hashed_uniform
from overfly.simulation.patches import Colour, Patch
from overfly.types import Float32Array

_PER_CELL = 4
_MOST_PER_PATCH = 30_000


class Outline(IntEnum):
    ELLIPSE = 0
    RECTANGLE = 1
    BLADE = 2
    LEAF = 3


@dataclass(frozen=True, slots=True)
class Scatter:
    """One kind of thing: how many per square metre, how large, which colours (each thing takes one, shaded a
    little).
    """

    outline: Outline
    per_m2: float
    length_m: tuple[float, float]
    width_ratio: tuple[float, float]
    colours: tuple[Colour, ...]
    shading: float = 0.3
    shadow: float = 0.0  # length of the shadow it throws, as a share of its length

    def objects(self, patch: Patch, seed: int) -> FloatArray:
        """(m, 9): x, y, angle, half length, half width, red, green, blue, shadow offset of those that touch
        the patch.
        """
        cell = math.sqrt(_PER_CELL / self.per_m2)
        reach = self.length_m[1] * (0.6 + self.shadow)
        first_i, first_j = math.floor((patch.x0 - reach) / cell), math.floor((patch.y0 - reach) / cell)
        last_i = math.floor((patch.x0 + patch.side_m + reach) / cell)
        last_j = math.floor((patch.y0 + patch.side_m + reach) / cell)
        count = (last_i - first_i + 1) * (last_j - first_j + 1) * _PER_CELL
        if count > _MOST_PER_PATCH or self.length_m[1] < patch.texel_m:
            return np.empty((0, 9))  # too fine to be told apart at this texel size
        rows, columns, numbers = np.meshgrid(
            np.arange(first_j, last_j + 1),
            np.arange(first_i, last_i + 1),
            np.arange(_PER_CELL),
            indexing="ij",
        )
        i, j = columns.ravel(), rows.ravel() * _PER_CELL + numbers.ravel()
        u = [hashed_uniform(i, j, channel, seed) for channel in range(7)]
        half = 0.5 * (self.length_m[0] + (self.length_m[1] - self.length_m[0]) * u[3] ** 2)
        width = self.width_ratio[0] + (self.width_ratio[1] - self.width_ratio[0]) * u[4]
        palette = np.asarray(self.colours)
        colour = (
            palette[(u[5] * len(palette)).astype(np.int64)]
            * (1.0 + self.shading * (2.0 * u[6] - 1.0))[:, None]
        )
        x, y = (i + u[0]) * cell, (j // _PER_CELL + u[1]) * cell
        return np.column_stack(
            [x, y, 2 * math.pi * u[2], half, half * width, colour, self.shadow * 2.0 * half]
        )


def draw(
    albedo: Float32Array, patch: Patch, objects: FloatArray, opacity: FloatArray, outline: Outline
) -> None:
    """Draw objects (m, 9), see :meth:`Scatter.objects`, onto albedo (n, n, 3) in place; opacity (m,) 0..1."""
    seen = opacity > 0.02
    _draw(
        albedo,
        patch.x0,
        patch.y0,
        patch.texel_m,
        np.ascontiguousarray(objects[seen]),
        np.ascontiguousarray(opacity[seen], dtype=np.float64),
        int(outline),
    )


@njit(cache=True, nogil=True)
def _outline_distance(outline, p, q, a, b):  # type: ignore[no-untyped-def]
    """Signed distance, near the edge, of the point (p along, q across) from an outline of half axes a, b;
    inside < 0.
    """
    if outline == 0:
        r = math.sqrt((p / a) ** 2 + (q / b) ** 2)
        return (r - 1.0) * b
    if outline == 1:
        return max(abs(p) - a, abs(q) - b)
    share = p / a
    if outline == 2:  # blade: broad at the foot, pointed, bent
        half = b * (1.0 - share) * 0.5
        return max(abs(q - 0.25 * a * share * share) - half, abs(p) - a)
    half = b * (1.0 - share * share)
    return max(abs(q) - half, abs(p) - a)


@njit(cache=True, nogil=True)
def _draw(albedo, x0, y0, texel, objects, opacity, outline):  # type: ignore[no-untyped-def]
    for m in range(objects.shape[0]):
        if objects[m, 8] > 0.0:  # its shadow first, away from a sun in the south-west
            offset = 0.7 * objects[m, 8]
            _stamp(
                albedo,
                x0,
                y0,
                texel,
                objects[m],
                objects[m, 0] + offset,
                objects[m, 1] + offset,
                0.45 * opacity[m],
                outline,
                True,
            )
        _stamp(albedo, x0, y0, texel, objects[m], objects[m, 0], objects[m, 1], opacity[m], outline, False)


@njit(cache=True, nogil=True)
def _stamp(albedo, x0, y0, texel, thing, x, y, opacity, outline, shadow):  # type: ignore[no-untyped-def]
    n = albedo.shape[0]
    c, s = math.cos(thing[2]), math.sin(thing[2])
    a, b = thing[3], thing[4]
    reach = a + 0.25 * a + texel
    col0, col1 = max(0, int((x - reach - x0) / texel)), min(n - 1, int((x + reach - x0) / texel))
    row0, row1 = max(0, int((y - reach - y0) / texel)), min(n - 1, int((y + reach - y0) / texel))
    # What is thinner than a texel covers part of it only.
    thin = min(1.0, 2.0 * b / texel)
    edge = min(texel, 2.0 * b)
    for row in range(row0, row1 + 1):
        dy = y0 + (row + 0.5) * texel - y
        for col in range(col0, col1 + 1):
            dx = x0 + (col + 0.5) * texel - x
            p, q = c * dx + s * dy, c * dy - s * dx
            covered = 0.5 - _outline_distance(outline, p, q, a, max(b, 0.5 * texel)) / max(edge, texel)
            if covered <= 0.0:
                continue
            share = np.float32(min(1.0, covered) * thin * opacity)
            if shadow:
                for channel in range(3):
                    albedo[row, col, channel] *= np.float32(1.0) - share
                continue
            # One half is turned to the light, the other away.
            light = 1.0 + (0.18 if q > 0.0 else -0.12)
            for channel in range(3):
                paint = np.float32(thing[5 + channel] * light)
                albedo[row, col, channel] += share * (paint - albedo[row, col, channel])
