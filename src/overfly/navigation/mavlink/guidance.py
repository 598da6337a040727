"""Where an autopilot is asked to fly: position targets, for those who asked for it.

The autopilot flies them in GUIDED (ArduPilot) or OFFBOARD (PX4) and passes them over otherwise. The mode is
never changed from here, and nothing is armed: that is the pilot's.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from overfly.geometry.aerospace import FRD_FROM_FLU
from overfly.geometry.poses import FloatArray, rotation_z
from overfly.navigation.mavlink.dialect import Autopilot, messages
from overfly.navigation.mavlink.state import VehicleState
from overfly.navigation.mavlink.telemetry import LocalPosition
from overfly.types import Attitude

LEAST_QUALITY = 40  # nobody is sent anywhere by a guess
_GUIDED = 4  # ArduPilot's copter and blimp
_PX4_OFFBOARD = 6  # main mode, the third byte
# Only the position counts: velocity, acceleration, yaw and turn rate are ignored.
_POSITION_ONLY = 0b0000_1101_1111_1000


def position_target(
    state: VehicleState,
    place_m: FloatArray,
    reported: LocalPosition,
    attitude: Attitude,
    target: tuple[int, int],
    now_ms: int,
) -> Any | None:
    """SET_POSITION_TARGET_LOCAL_NED for a place (3,) of the map's world; None when the state is a guess.

    The way there, as the fix sees it, is turned by the headings that map and autopilot give the same vehicle
    and added to where the autopilot believes to be: so it holds however their frames lie to each other.
    """
    if state.is_guess or state.quality < LEAST_QUALITY or attitude.yaw_rad is None:
        return None
    rotation = state.world_from_body.rotation
    own_yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    ahead = rotation_z(-own_yaw) @ (np.asarray(place_m) - state.world_from_body.translation)
    ned_yaw = 0.5 * math.pi - attitude.yaw_rad
    way = rotation_z(ned_yaw) @ FRD_FROM_FLU @ ahead
    return messages.MAVLink_set_position_target_local_ned_message(
        now_ms % 2**32,
        *target,
        messages.MAV_FRAME_LOCAL_NED,
        _POSITION_ONLY,
        reported.north_m + way[0],
        reported.east_m + way[1],
        reported.down_m + way[2],
        0, 0, 0, 0, 0, 0, 0, 0,
    )  # fmt: skip


def obeys_targets(heartbeat: Any, autopilot: Autopilot) -> bool:
    """Whether the autopilot is in the mode that flies targets, and armed."""
    if not heartbeat.base_mode & messages.MAV_MODE_FLAG_SAFETY_ARMED:
        return False
    if autopilot is Autopilot.PX4:
        return bool((heartbeat.custom_mode >> 16) & 0xFF == _PX4_OFFBOARD)
    return bool(heartbeat.custom_mode == _GUIDED)
