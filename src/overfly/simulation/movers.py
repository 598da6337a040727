"""Things and light that move: people seen from above, clouds, the vehicle's own shadow."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from overfly.simulation.noise import fractal_noise
from overfly.simulation.paths import Path
from overfly.simulation.relief import SUN
from overfly.simulation.rendering import NO_MOVERS, Movers
from overfly.types import Float32Array


@dataclass(frozen=True, slots=True)
class Walker:
    """A person from above, shoulders across the heading, who walks on a circle through ``start``."""

    start: tuple[float, float]
    heading_rad: float
    speed_m_s: float
    radius_m: float = 3.0
    reflectance: float = 0.06

    def discs(self, time_s: float) -> list[list[float]]:
        """Rows as in :class:`overfly.simulation.rendering.Movers`: shadow, shoulders, head."""
        heading = self.heading_rad + self.speed_m_s * time_s / self.radius_m
        x = self.start[0] + self.radius_m * (math.sin(heading) - math.sin(self.heading_rad))
        y = self.start[1] - self.radius_m * (math.cos(heading) - math.cos(self.heading_rad))
        c, s = math.cos(heading), math.sin(heading)
        shade_x, shade_y = x - 0.9 * SUN[0] / SUN[2], y - 0.9 * SUN[1] / SUN[2]
        return [
            [shade_x, shade_y, *_away_from_sun(), 0.85, 0.22, -0.55, 1.0],
            [x, y, c, s, 0.14, 0.24, self.reflectance, 1.0],
            [x + 0.03 * c, y + 0.03 * s, c, s, 0.10, 0.08, 0.5 * self.reflectance + 0.08, 1.0],
        ]


@dataclass(frozen=True, slots=True, eq=False)
class Clouds:
    """Shadows of clouds: light (n, n) shares, periodic, cell_m per cell, carried by the wind."""

    light: Float32Array
    cell_m: float
    wind_m_s: tuple[float, float]


def drifting_clouds(seed: int, depth: float, size_m: float, wind_m_s: tuple[float, float]) -> Clouds:
    """Cloud shadows about size_m across that take up to ``depth`` of the light."""
    n, cell = 128, size_m / 16.0
    noise = fractal_noise(0.0, 0.0, cell, (n, n), seed, 2.0 * size_m, finest_m=size_m / 4.0, gain=0.4)
    # Flattened towards its edges, the field meets itself there.
    ramp = np.abs(np.linspace(-1.0, 1.0, n, endpoint=False))
    edge = np.maximum(ramp[:, None], ramp[None, :]) ** 4
    light = 1.0 - depth * np.clip(0.5 + 0.8 * (1.0 - edge) * noise, 0.0, 1.0)
    return Clouds(light.astype(np.float32), cell, wind_m_s)


def moving(
    walkers: tuple[Walker, ...] = (), clouds: Clouds | None = None, shadow_of: Path | None = None
) -> Callable[[float], Movers]:
    """Everything that moves, as a function of time; shadow_of: the vehicle whose shadow falls on level
    ground.
    """

    def at(time_s: float) -> Movers:
        rows: list[list[float]] = []
        if shadow_of is not None:
            x, y, z = shadow_of.pose(time_s).translation
            rows.append([x - z * SUN[0] / SUN[2], y - z * SUN[1] / SUN[2], 1.0, 0.0, 0.25, 0.25, -0.5, 0.8])
        for walker in walkers:
            rows.extend(walker.discs(time_s))
        discs = np.array(rows, dtype=np.float64).reshape(-1, 8)
        if clouds is None:
            return Movers(discs, NO_MOVERS.clouds, 1.0, (0.0, 0.0))
        offset = (clouds.wind_m_s[0] * time_s, clouds.wind_m_s[1] * time_s)
        return Movers(discs, clouds.light, clouds.cell_m, offset)

    return at


def _away_from_sun() -> tuple[float, float]:
    length = math.hypot(SUN[0], SUN[1])
    return -float(SUN[0]) / length, -float(SUN[1]) / length
