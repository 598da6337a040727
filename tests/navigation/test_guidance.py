"""Where an autopilot is asked to fly."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from overfly.navigation.mavlink.dialect import Autopilot, messages
from overfly.navigation.mavlink.guidance import obeys_targets, position_target
from overfly.navigation.mavlink.telemetry import LocalPosition
from overfly.types import Attitude

from .rules import over_the_wire
from .test_encoders import state

angles = st.floats(-3.1, 3.1)
HERE = LocalPosition(0, 100.0, 200.0, -30.0)


@given(own_yaw=angles, north_yaw=angles, ahead=st.floats(-50, 50), left=st.floats(-50, 50))
def test_the_way_is_the_same_whatever_the_frames(
    own_yaw: float, north_yaw: float, ahead: float, left: float
) -> None:
    """Metres ahead and to the left of the vehicle, in the map, are metres ahead and left
    for the autopilot.
    """
    one = state((5.0, 6.0, 7.0), yaw=own_yaw)
    c, s = math.cos(own_yaw), math.sin(own_yaw)
    place = np.array([5.0 + c * ahead - s * left, 6.0 + s * ahead + c * left, 9.0])
    attitude = Attitude(0.0, 0.0, 0.01, 0.5 * math.pi - north_yaw, 0.05)  # north_yaw: clockwise from north
    target = over_the_wire(position_target(one, place, HERE, attitude, (1, 1), 1234))
    north, east = target.x - 100.0, target.y - 200.0
    c, s = math.cos(north_yaw), math.sin(north_yaw)
    assert c * north + s * east == pytest.approx(ahead, abs=1e-3)
    assert s * north - c * east == pytest.approx(left, abs=1e-3)
    assert target.z == pytest.approx(-32.0)
    assert target.coordinate_frame == messages.MAV_FRAME_LOCAL_NED


def test_only_the_position_counts() -> None:
    attitude = Attitude(0.0, 0.0, 0.01, 0.0, 0.05)
    target = position_target(state(), np.zeros(3), HERE, attitude, (1, 1), 0)
    names = messages.enums["POSITION_TARGET_TYPEMASK"]
    ignored = {entry.name for value, entry in names.items() if value & target.type_mask == value and value}
    wanted = {"X_IGNORE", "Y_IGNORE", "Z_IGNORE", "FORCE_SET"}
    assert not {name for name in ignored if name.removeprefix("POSITION_TARGET_TYPEMASK_") in wanted}
    assert len(ignored & {entry.name for entry in names.values()}) == 8  # v, a, yaw and yaw rate


def test_nobody_is_sent_anywhere_by_a_guess() -> None:
    attitude = Attitude(0.0, 0.0, 0.01, 0.0, 0.05)
    guess = replace(state(quality=10), is_guess=True)
    assert position_target(guess, np.zeros(3), HERE, attitude, (1, 1), 0) is None
    headless = replace(attitude, yaw_rad=None)
    assert position_target(state(), np.zeros(3), HERE, headless, (1, 1), 0) is None


@pytest.mark.parametrize(
    ("autopilot", "custom_mode", "base_mode", "obeys"),
    [
        (Autopilot.ARDUPILOT, 4, 128, True),
        (Autopilot.ARDUPILOT, 4, 0, False),
        (Autopilot.ARDUPILOT, 5, 128, False),
        (Autopilot.PX4, 6 << 16, 128, True),
        (Autopilot.PX4, 3 << 16, 128, False),
    ],
)
def test_the_mode_is_the_pilots(autopilot: Autopilot, custom_mode: int, base_mode: int, obeys: bool) -> None:
    heartbeat = messages.MAVLink_heartbeat_message(2, 3, base_mode, custom_mode, 4, 3)
    assert obeys_targets(heartbeat, autopilot) is obeys
