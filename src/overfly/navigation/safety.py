"""What is always obeyed: the geofence and the height floor, whatever the mission or the operator asks."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.navigation.estimator import VehicleState, command_in_heading, velocity_in_world
from overfly.navigation.vehicle import Airframe
from overfly.types import VelocityCommand

# A velocity that falls off with the room that is left, this much slower than the vehicle answers, is followed
# without overshoot (a second-order system is critically damped at 4).
SLOWER_THAN_ANSWER = 5.0
BRAKING_SHARE = 0.35  # of the acceleration: the rest of the way is lost to the lag


@dataclass(frozen=True, slots=True)
class Fence:
    """A box in the map's world, metres: x and y of its sides, floor above the ground, ceiling in z."""

    x_low_m: float
    y_low_m: float
    x_high_m: float
    y_high_m: float
    floor_m: float
    ceiling_m: float

    def holds(self, x_m: float, y_m: float) -> bool:
        """Whether a place lies inside."""
        return self.x_low_m <= x_m <= self.x_high_m and self.y_low_m <= y_m <= self.y_high_m

    def nearest_inside(self, position: FloatArray) -> FloatArray:
        """The place (3,) inside that is nearest to a position (3,)."""
        low = [self.x_low_m, self.y_low_m, self.floor_m]
        return np.clip(position, low, [self.x_high_m, self.y_high_m, self.ceiling_m])


def guard(
    command: VelocityCommand,
    state: VehicleState,
    fence: Fence,
    airframe: Airframe,
    height_above_ground_m: float | None = None,
) -> VelocityCommand:
    """The command, less what would carry the vehicle out of the fence; outside, what brings it back.

    height_above_ground_m: by a range sensor, where there is one; the floor is above the ground, not above
    the map's zero.
    """
    asked = velocity_in_world(command, state.yaw_rad)
    height = float(state.position[2])
    above = height if height_above_ground_m is None else min(height_above_ground_m, height)
    room = np.array(
        [
            [state.position[0] - fence.x_low_m, fence.x_high_m - state.position[0]],
            [state.position[1] - fence.y_low_m, fence.y_high_m - state.position[1]],
            [above - fence.floor_m, fence.ceiling_m - height],
        ]
    )
    answer_s = airframe.response_s + airframe.pull_lag_s
    for axis in range(3):
        speed = float(state.velocity[axis])
        down = _allowed(float(room[axis, 0]), -speed, answer_s, airframe)
        up = _allowed(float(room[axis, 1]), speed, answer_s, airframe)
        # In a fence too narrow for both the first, which is the floor of the height, counts.
        asked[axis] = max(min(asked[axis], up), -down)
    return command_in_heading(asked, state.yaw_rad, command.yaw_rate_rad_s)


def _allowed(room_m: float, speed_m_s: float, answer_s: float, airframe: Airframe) -> float:
    """Largest velocity towards a side that is room_m away; negative outside: back inside.

    Faster than that already, the vehicle is told to go the other way, which brakes it hardest.
    """
    linear = room_m / (SLOWER_THAN_ANSWER * answer_s)
    if room_m > 0.0:
        linear = min(linear, math.sqrt(2.0 * BRAKING_SHARE * airframe.max_acceleration_m_s2 * room_m))
    excess = max(0.0, speed_m_s - max(linear, 0.0))
    return linear - 2.0 * excess


@dataclass(frozen=True, slots=True)
class SearchPattern:
    """An expanding square about the place where the vehicle was last known to be.

    leg_m: the first two legs; every two legs they grow by as much again.
    """

    centre_x_m: float
    centre_y_m: float
    leg_m: float
    speed_m_s: float

    def place(self, time_s: float) -> tuple[float, float]:
        """Where the vehicle should be so long after the search began."""
        left = self.speed_m_s * max(0.0, time_s)
        x, y, leg = self.centre_x_m, self.centre_y_m, 0
        while True:
            length = self.leg_m * (leg // 2 + 1)
            step_x, step_y = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[leg % 4]
            share = min(left, length)
            x, y = x + share * step_x, y + share * step_y
            left -= share
            if left <= 0.0:
                return x, y
            leg += 1
