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
    """How something that flies moves. Rates and time constants are those of the vehicle with its own inner
    loops.

    tilt_per_acceleration: how far the body leans to accelerate, as a share of atan(a / g): 1 for rotors, 0
    for a rod. drag_per_s: linear drag over mass; velocity_lag_s, attitude_lag_s: time constants with which
    commands are followed. wobble: RMS of what the pilot, the hand or the air adds, in metres and radians,
    over band_hz.
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


# What is not named here as published or derived is assumed: wobble, accelerations, yaw rates, and the
# helicopter's speeds and drag.
#
# Velocity lags are gains of the autopilot, not of the vehicle. The velocity loop around an attitude loop is
# damped by half the root of their lags' ratio: PX4's ratio for the multirotor, 3, gives 0.9; helicopter and
# blimp have 4 and 3, the wing 2.5.
#
# A camera quadrotor: mass, speeds and tilt of the DJI Phantom 4 (manufacturer's data sheet), flown gently.
# Its drag is what the sheet implies: 42 degrees of tilt at 20 m/s, quadratic, which at 10 m/s is 0.22 1/s.
# Roll and pitch lag as identified for a multirotor of 1.5 kg (0.175 and 0.185 s; 0.16 to 0.26 s from 1.0 to
# 1.7 kg: parameters of the model predictive controllers of Kamel, ETH Zurich, 2015); velocity by the gain
# that PX4 corrects it with (MPC_XY_VEL_P_ACC, 1.8 1/s).
MULTIROTOR = Vehicle(
    "multirotor", 1.38, 15.0, 4.0, 4.0, 1.7, math.radians(35), 1.0, 0.22, 0.55, 0.18,
    0.05, 0.03, math.radians(0.8), math.radians(1.5), (0.15, 2.5),
)  # fmt: skip
# The Freiburg indoor blimp: 2.1 m long, 150 g of payload (Mueller, Paul, Burgard: Probabilistic velocity
# estimation for autonomous miniature airships, ICRA 2012). It floats, so its mass is that of the air it
# displaces. An ellipsoid twice as long as thick has a drag coefficient of 0.27 at such Reynolds numbers
# (Hoerner: Fluid-Dynamic Drag, 1965) and drags a fifth of its own mass of air along (Lamb: Hydrodynamics,
# 1932): 0.08 1/s for the bare hull at 1 m/s, taken twice with fins and gondola. Its top speed is
# assumed; the strongest acceleration is a little less than the drag at that speed. It rights itself like a
# pendulum: a third of the mass (gondola, batteries) 0.45 m below the middle against the inertia of hull, gas
# and air dragged along, 0.4 to 0.9 kg m^2, swings in 0.5 to 0.8 s per radian.
BLIMP = Vehicle(
    "blimp", 1.0, 1.0, 0.12, 0.3, 0.5, math.radians(4), 0.6, 0.15, 2.5, 0.8,
    0.05, 0.04, math.radians(0.8), math.radians(2.0), (0.05, 0.4),
)  # fmt: skip
# A light coaxial indoor helicopter, 80 g as muFly (Schafroth, Bermes, Bouabdallah, Siegwart: Modeling, system
# identification and robust control of a coaxial micro helicopter, 2010): quick and never quite still.
# Its attitude follows the stabilizer bar: about 0.35 s on model helicopters of 1.5 m rotor radius (Mettler,
# Tischler, Kanade: System identification modeling of a model-scale helicopter, CMU-RI-TR-00-03), which by
# the Froude scaling of that report, with the root of the size, is 0.09 s for a rotor of 0.09 m; the rest of
# the 0.10 s is the swashplate.
HELICOPTER = Vehicle(
    "helicopter", 0.08, 2.0, 2.0, 0.8, 2.0, math.radians(15), 1.0, 0.35, 0.4, 0.10,
    0.06, 0.07, math.radians(1.8), math.radians(4.0), (0.2, 2.5),
)  # fmt: skip
# A sensor platform on the tip of a rod that somebody carries (Steder et al. 2008): walking pace, sway of the
# steps near 2 Hz (cadence of walking: Murray, Drought and Kory 1964). Mass and lags are assumed.
ROD = Vehicle(
    "rod", 2.5, 1.8, 1.5, 0.6, 1.2, math.radians(12), 0.12, 0.0, 0.5, 0.3,
    0.03, 0.05, math.radians(1.8), math.radians(3.0), (0.2, 2.0),
)  # fmt: skip
# A foam mapping wing: mass and cruise speeds of the senseFly eBee (manufacturer's data sheet: 0.7 kg, 40 to
# 90 km/h). Roll and pitch lag as PX4 asks of a wing (FW_R_TC, FW_P_TC, 0.4 s). Its drag, 0.05 1/s at 16 m/s,
# is a glide ratio of 12. How it gathers speed and turns to a course is assumed.
FIXED_WING = Vehicle(
    "fixed wing", 0.70, 25.0, 3.0, 3.0, 0.8, math.radians(45), 1.0, 0.05, 1.0, 0.4,
    0.5, 0.4, math.radians(1.5), math.radians(1.0), (0.1, 1.5), 11.0,
)  # fmt: skip
VEHICLES = {vehicle.name: vehicle for vehicle in (MULTIROTOR, BLIMP, HELICOPTER, ROD, FIXED_WING)}


def fly_route(route: Route, vehicle: Vehicle, seed: int) -> Path:
    """A recorded flight: the route flown by the vehicle, with its lean into accelerations and its
    unsteadiness.

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
    if vehicle.min_speed_m_s:
        pull = across(pull, velocities)  # a wing leans into its turns only: its engine does the rest
    c, s = np.cos(headings), np.sin(headings)
    forward, left = c * pull[:, 0] + s * pull[:, 1], c * pull[:, 1] - s * pull[:, 0]
    limit = vehicle.max_tilt_rad
    pitch = np.clip(np.arctan2(forward, GRAVITY), -limit, limit)
    roll = np.clip(-np.arctan2(left, GRAVITY), -limit, limit)
    tilts = [wobble(times, vehicle.wobble_tilt_rad, vehicle.band_hz, generator) for _ in range(2)]
    return Path(times, np.column_stack([positions, roll + tilts[0], pitch + tilts[1], headings]))


def across(vectors: FloatArray, velocities: FloatArray) -> FloatArray:
    """The parts of vectors (n, 3) at right angles to the horizontal velocities (n, 3)."""
    along = velocities[:, :2] / np.maximum(np.linalg.norm(velocities[:, :2], axis=1, keepdims=True), 1e-6)
    parallel = np.sum(vectors[:, :2] * along, axis=1, keepdims=True) * along
    return np.column_stack([vectors[:, :2] - parallel, vectors[:, 2]])
