"""From the state to a command: fly to a place, and keep there."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from overfly.geometry.poses import FloatArray, wrap_angle
from overfly.navigation.estimator import VehicleState, command_in_heading
from overfly.navigation.vehicle import Airframe
from overfly.types import VelocityCommand

# Of the acceleration the vehicle has. Braking harder it would pass its place, because the pull follows late,
# and be there later: a blimp from 5 m away by 0.35 m with 0.6.
BRAKING_SHARE = 0.35
# The velocity loop is as quick as the pull that carries it allows, the position loop slower by a factor that
# damps both (damping 0.85).
QUICKEST_PER_S = 2.0
LOOP_TIMES_LAG = 0.8
POSITION_SHARE = 0.35
HEIGHT_SHARE = 0.25  # of the vertical response: critically damped
YAW_PER_S = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Setpoint:
    """Where the vehicle shall be: position (3,) m and yaw in the map's world; how fast at most."""

    position: FloatArray
    yaw_rad: float
    max_speed_m_s: float = math.inf


def steer(state: VehicleState, setpoint: Setpoint, airframe: Airframe) -> VelocityCommand:
    """The velocity command that brings the vehicle to the setpoint and keeps it there.

    Towards the place as fast as it can brake; the lag with which the vehicle follows is taken out by asking
    for more than is wanted while the velocity is not yet there.
    """
    velocity_gain = min(QUICKEST_PER_S, LOOP_TIMES_LAG / airframe.pull_lag_s)
    away = setpoint.position[:2] - state.position[:2]
    distance = float(np.linalg.norm(away))
    speed = min(
        POSITION_SHARE * velocity_gain * distance,
        math.sqrt(2.0 * BRAKING_SHARE * airframe.max_acceleration_m_s2 * distance),
        airframe.max_speed_m_s,
        setpoint.max_speed_m_s,
    )
    wanted = away * (speed / max(distance, 1e-9))
    pull = velocity_gain * (wanted - state.velocity[:2])
    strength = float(np.linalg.norm(pull))
    pull *= min(1.0, airframe.max_acceleration_m_s2 / max(strength, 1e-9))
    asked = state.velocity[:2] + airframe.response_s * pull
    up = HEIGHT_SHARE / airframe.response_s * float(setpoint.position[2] - state.position[2])
    up = float(np.clip(up, -airframe.max_climb_m_s, airframe.max_climb_m_s))
    turn = YAW_PER_S * wrap_angle(setpoint.yaw_rad - state.yaw_rad)
    turn = float(np.clip(turn, -airframe.max_yaw_rate_rad_s, airframe.max_yaw_rate_rad_s))
    return command_in_heading(np.append(asked, up), state.yaw_rad, turn)
