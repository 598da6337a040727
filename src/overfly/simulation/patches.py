"""A square of ground while it is being painted, and the shapes that say which material lies where."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.simulation.noise import fractal_noise
from overfly.types import Float32Array

Colour = tuple[float, float, float]  # linear reflectance, red green blue, 0..1


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """n x n texels whose corner of smallest x and y is (x0, y0), metres; row 0 has the smallest y (south)."""

    x0: float
    y0: float
    texel_m: float
    n: int

    @property
    def x(self) -> FloatArray:
        """(1, n) texel centres, metres."""
        return np.asarray(self.x0 + (np.arange(self.n) + 0.5) * self.texel_m)[None, :]

    @property
    def y(self) -> FloatArray:
        """(n, 1) texel centres, metres."""
        return np.asarray(self.y0 + (np.arange(self.n) + 0.5) * self.texel_m)[:, None]

    @property
    def side_m(self) -> float:
        return self.n * self.texel_m

    def noise(
        self,
        seed: int,
        wavelength_m: float,
        *,
        finest_m: float = 0.0,
        gain: float = 0.6,
        stretch: float = 1.0,
        angle_rad: float = 0.0,
        ridged: bool = False,
    ) -> Float32Array:
        """(n, n) noise of unit deviation; see :func:`overfly.simulation.noise.fractal_noise`."""
        return fractal_noise(
            self.x0,
            self.y0,
            self.texel_m,
            (self.n, self.n),
            seed,
            wavelength_m,
            finest_m=finest_m,
            gain=gain,
            stretch=stretch,
            angle_rad=angle_rad,
            ridged=ridged,
        )


class Paintable(Protocol):
    """Anything that has a colour everywhere."""

    def paint(self, patch: Patch) -> Float32Array:
        """(n, n, 3) float32 linear reflectance of the patch."""
        ...


Material = Callable[[Patch, int], Float32Array]  # (patch, seed) -> (n, n, 3) linear reflectance


def mix(first: Colour | Float32Array, second: Colour | Float32Array, share: Float32Array) -> Float32Array:
    """Colours blended per texel: share (n, n) of the second, clipped to 0..1 -> (n, n, 3)."""
    share = np.clip(share, 0.0, 1.0)[..., None].astype(np.float32)
    a, b = np.asarray(first, dtype=np.float32), np.asarray(second, dtype=np.float32)
    return np.asarray(a + share * (b - a))


def line_coverage(distance_m: FloatArray | Float32Array, width_m: float, texel_m: float) -> Float32Array:
    """Share of a texel that a long line of width_m covers, its axis distance_m from the texel's centre: an
    exact box filter.
    """
    half = 0.5 * width_m
    upper = np.clip(distance_m + 0.5 * texel_m, -half, half)
    lower = np.clip(distance_m - 0.5 * texel_m, -half, half)
    return ((upper - lower) / texel_m).astype(np.float32)


Bounds = tuple[float, float, float, float]  # x0, y0, x1, y1


@dataclass(frozen=True, slots=True)
class Shape:
    """Where a layer lies: signed distance (metres, negative inside) with an edge that may wander by ragged_m.

    bounds: a box that holds the shape. blend_m: width over which it fades into what is below.
    """

    distance: Callable[[FloatArray, FloatArray], FloatArray] = field(repr=False)
    bounds: Bounds
    ragged_m: float = 0.0
    blend_m: float = 0.0

    def coverage(self, x: FloatArray, y: FloatArray, texel_m: float) -> Float32Array:
        """Share of the layer at points x, y (broadcast): 1 inside, 0 outside, blended on the edge."""
        width = max(texel_m, self.blend_m, 1e-9)
        reach = self.ragged_m + width
        x0, y0, x1, y1 = self.bounds
        if (
            x.size == 0
            or x.max() < x0 - reach
            or x.min() > x1 + reach
            or y.max() < y0 - reach
            or y.min() > y1 + reach
        ):
            return np.zeros(np.broadcast(x, y).shape, dtype=np.float32)
        distance = self.distance(x, y)
        near_edge = np.abs(distance) < reach
        if self.ragged_m and near_edge.any():
            distance = distance + self.ragged_m * _wander(x / self.ragged_m, y / self.ragged_m)
        return np.clip(0.5 - distance / width, 0.0, 1.0).astype(np.float32)


def _wander(x: FloatArray, y: FloatArray) -> FloatArray:
    """Smooth, aperiodic-looking edge displacement in -1..1, for an edge that wanders by 1."""
    total = 0.0 * (x + y)
    for k, wavelength in enumerate((17.0, 8.1, 4.3, 2.3)):
        a = 2.0 * math.pi / wavelength
        total = total + 0.55 ** (k + 1) * np.sin(a * (math.cos(k) * x + math.sin(k) * y) + k) * np.cos(
            a * (math.sin(k + 0.7) * x - math.cos(k + 0.7) * y)
        )
    return np.asarray(total)


def rectangle(
    centre: tuple[float, float],
    size_m: tuple[float, float],
    angle_rad: float = 0.0,
    *,
    ragged_m: float = 0.0,
    blend_m: float = 0.0,
) -> Shape:
    """Rectangle of size_m (along its own x and y), turned by angle_rad."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)

    def distance(x: FloatArray, y: FloatArray) -> FloatArray:
        dx, dy = x - centre[0], y - centre[1]
        p = np.abs(c * dx + s * dy) - 0.5 * size_m[0]
        q = np.abs(c * dy - s * dx) - 0.5 * size_m[1]
        outside = np.hypot(np.maximum(p, 0.0), np.maximum(q, 0.0))
        return np.asarray(outside + np.minimum(np.maximum(p, q), 0.0))

    reach = 0.5 * math.hypot(*size_m)
    return Shape(distance, _around(np.array([centre]), reach), ragged_m, blend_m)


def disc(
    centre: tuple[float, float], radius_m: float, *, ragged_m: float = 0.0, blend_m: float = 0.0
) -> Shape:
    return Shape(
        lambda x, y: np.hypot(x - centre[0], y - centre[1]) - radius_m,
        _around(np.array([centre]), radius_m),
        ragged_m,
        blend_m,
    )


def band(
    points: FloatArray, width_m: float, *, ragged_m: float = 0.0, blend_m: float = 0.0, closed: bool = False
) -> Shape:
    """Everything within half of width_m of the polyline ``points`` (n, 2): a path, a road, a ditch."""
    nodes = np.asarray(points, dtype=np.float64)
    ends = np.roll(nodes, -1, axis=0) if closed else nodes[1:]
    starts = nodes if closed else nodes[:-1]

    def distance(x: FloatArray, y: FloatArray) -> FloatArray:
        nearest = np.full(np.broadcast(x, y).shape, np.inf)
        for a, b in zip(starts, ends, strict=True):
            along = b - a
            share = ((x - a[0]) * along[0] + (y - a[1]) * along[1]) / max(float(along @ along), 1e-12)
            share = np.clip(share, 0.0, 1.0)
            np.minimum(
                nearest, np.hypot(x - a[0] - share * along[0], y - a[1] - share * along[1]), out=nearest
            )
        return nearest - 0.5 * width_m

    return Shape(distance, _around(nodes, 0.5 * width_m), ragged_m, blend_m)


def _around(points: FloatArray, reach: float) -> Bounds:
    """Box that holds everything within reach of the points (n, 2)."""
    (x0, y0), (x1, y1) = points.min(axis=0) - reach, points.max(axis=0) + reach
    return float(x0), float(y0), float(x1), float(y1)
