"""Vehicles: what their published figures say about how they move, and recorded flights in their manner."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.simulation.paths import STATE_RATE_HZ, Path, Route, smoothed, wobble

GRAVITY = 9.80665


@dataclass(frozen=True, slots=True)
class Vehicle:
    """How something that flies moves. Rates and time constants are those of the vehicle with its own inner loops.

    tilt_per_acceleration: how far the body leans to accelerate, as a share of atan(a / g): 1 for rotors, 0 for a rod.
    drag_per_s: linear drag over mass; velocity_lag_s, attitude_lag_s: time constants with which commands are followed.
    wobble: RMS of what the pilot, the hand or the air adds, in metres and radians, over band_hz.
    """

    name: str
    mass_kg: float
    max_speed_m_s: float
    max_acceleration_m_s2: float
    max_climb_m_s: float
    max_yaw_rate_rad_s: float
    max_tilt_rad: float
    tilt_per_acceleration: float
    drag_per_s: float
    velocity_lag_s: float
    attitude_lag_s: float
    wobble_m: float
    wobble_height_m: float
    wobble_tilt_rad: float
    wobble_yaw_rad: float
    band_hz: tuple[float, float]
    min_speed_m_s: float = 0.0


MULTIROTOR = Vehicle(
    "multirotor", 1.5, 10.0, 5.0, 2.5, 1.5, math.radians(35), 1.0, 0.30, 0.45, 0.12,
    0.05, 0.03, math.radians(0.8), math.radians(1.5), (0.15, 2.5),
)  # fmt: skip
ROD = Vehicle(
    "rod", 2.5, 1.8, 1.5, 0.6, 1.2, math.radians(12), 0.12, 0.0, 0.5, 0.3,
    0.04, 0.05, math.radians(1.8), math.radians(3.0), (0.2, 1.6),
)  # fmt: skip


def fly_route(route: Route, vehicle: Vehicle, seed: int) -> Path:
    """A recorded flight: the route flown by the vehicle, with its lean into accelerations and its unsteadiness.

    The body leans so that its thrust gives the acceleration and balances the drag (differential flatness of
    multirotors: Mellinger and Kumar 2011), scaled by what the vehicle needs to lean at all.
    """
    generator = np.random.default_rng([seed, 11])
    times, positions, headings = route.sample()
    rate = STATE_RATE_HZ
    headings = smoothed(headings, 2.0 / vehicle.max_yaw_rate_rad_s / 4.0, rate)
    drift = (0.05 * vehicle.band_hz[0], 0.6 * vehicle.band_hz[1])
    sway = [vehicle.wobble_m, vehicle.wobble_m, vehicle.wobble_height_m]
    positions = smoothed(positions, 0.25, rate)
    positions = positions + np.column_stack([wobble(times, rms, drift, generator) for rms in sway])
    headings = headings + wobble(times, vehicle.wobble_yaw_rad, vehicle.band_hz, generator)
    velocities = np.gradient(positions, times, axis=0)
    pull = np.gradient(velocities, times, axis=0) + vehicle.drag_per_s * velocities
    pull = smoothed(pull, vehicle.attitude_lag_s, rate) * vehicle.tilt_per_acceleration
    c, s = np.cos(headings), np.sin(headings)
    forward, left = c * pull[:, 0] + s * pull[:, 1], c * pull[:, 1] - s * pull[:, 0]
    limit = vehicle.max_tilt_rad
    pitch = np.clip(np.arctan2(forward, GRAVITY), -limit, limit)
    roll = np.clip(-np.arctan2(left, GRAVITY), -limit, limit)
    tilts = [wobble(times, vehicle.wobble_tilt_rad, vehicle.band_hz, generator) for _ in range(2)]
    return Path(times, np.column_stack([positions, roll + tilts[0], pitch + tilts[1], headings]))


def turn_into(euler_rad: FloatArray) -> FloatArray:
    """Euler angles (n, 3) with the yaw wrapped to (-pi, pi]."""
    wrapped = np.array(euler_rad)
    wrapped[:, 2] = math.pi - (math.pi - wrapped[:, 2]) % (2.0 * math.pi)
    return wrapped
