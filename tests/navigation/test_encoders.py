"""What autopilots understand of our messages, by their own rules."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from overfly.geometry.geodesy import GeoOrigin, enu_from_geodetic
from overfly.geometry.poses import Pose, rotation_from_euler
from overfly.navigation.mavlink import (
    Autopilot,
    Placement,
    VehicleState,
    encode_global_position,
    encode_odometry,
)
from overfly.navigation.mavlink.dialect import messages

from . import rules

ORIGIN = GeoOrigin(47.4, 8.5, 430.0)
GEOREFERENCED = Placement(ORIGIN, 0.3)
angles = st.floats(-3.1, 3.1)
tilts = st.floats(-0.6, 0.6)
places = st.tuples(*[st.floats(-500.0, 500.0)] * 3)
sigmas = st.floats(0.005, 20.0)


def state(
    place: tuple[float, float, float] = (0.0, 0.0, 0.0),
    roll: float = 0.0,
    pitch: float = 0.0,
    yaw: float = 0.0,
    sigma_m: float = 0.05,
    sigma_rad: float = 0.01,
    velocity: tuple[float, float, float] | None = None,
    t_ns: int = 1_000_000_000,
    reset_counter: int = 0,
    quality: int = 80,
) -> VehicleState:
    return VehicleState(
        t_ns,
        Pose(rotation_from_euler(roll, pitch, yaw), np.array(place)),
        np.diag([sigma_m**2] * 3 + [sigma_rad**2] * 3),
        None if velocity is None else np.array(velocity),
        None if velocity is None else np.eye(3) * 0.01,
        quality,
        reset_counter,
    )


def taken(autopilot: Autopilot, one: VehicleState, placement: Placement | None = None) -> rules.Accepted:
    """What the autopilot's filter gets of the second of two such states."""
    decoder = rules.ArduPilot() if autopilot is Autopilot.ARDUPILOT else rules.Px4()
    accepted = None
    for earlier_ns in (100_000_000, 0):
        moved = VehicleState(
            one.t_ns - earlier_ns, one.world_from_body, one.covariance, one.velocity_m_s,
            one.velocity_covariance, one.quality, one.reset_counter,
        )  # fmt: skip
        message = encode_odometry(moved, placement or Placement(), autopilot)
        accepted = decoder.take(rules.over_the_wire(message))
    assert accepted is not None, decoder.refused
    return accepted


@pytest.mark.parametrize("autopilot", Autopilot)
def test_a_place_and_heading_that_anybody_can_check(autopilot: Autopilot) -> None:
    """One metre east, two north, three up, nose to the north-east, right side down, nose up."""
    placement = Placement(ORIGIN, 0.0)
    one = state((1.0, 2.0, 3.0), roll=0.1, pitch=-0.2, yaw=math.radians(45.0), velocity=(0.0, 5.0, 0.5))
    got = taken(autopilot, one, placement)
    np.testing.assert_allclose(got.position, [2.0, 1.0, -3.0], atol=1e-5)
    assert got.yaw_rad == pytest.approx(math.radians(45.0), abs=1e-5)
    assert got.tilt == pytest.approx((0.1, 0.2), abs=1e-5)  # aerospace: pitch is nose up
    assert got.velocity is not None
    np.testing.assert_allclose(got.velocity, [5.0, 0.0, -0.5], atol=1e-5)


@pytest.mark.parametrize("autopilot", Autopilot)
def test_without_north_x_stays_forward(autopilot: Autopilot) -> None:
    got = taken(autopilot, state((1.0, 2.0, 3.0), yaw=0.5))
    np.testing.assert_allclose(got.position, [1.0, -2.0, -3.0], atol=1e-5)
    assert got.yaw_rad == pytest.approx(-0.5, abs=1e-5)
    assert got.frame == "FRD"


def test_px4_is_told_when_the_frame_is_north_aligned_and_ardupilot_takes_only_frd() -> None:
    assert taken(Autopilot.PX4, state(), GEOREFERENCED).frame == "NED"
    assert taken(Autopilot.ARDUPILOT, state(), GEOREFERENCED).frame == "FRD"


@pytest.mark.parametrize("autopilot", Autopilot)
@given(place=places, roll=tilts, pitch=tilts, yaw=angles, turn=angles)
def test_any_pose_arrives(
    autopilot: Autopilot,
    place: tuple[float, float, float],
    roll: float,
    pitch: float,
    yaw: float,
    turn: float,
) -> None:
    got = taken(autopilot, state(place, roll, pitch, yaw, velocity=(1.0, -2.0, 0.3)), Placement(ORIGIN, turn))
    east = math.cos(turn) * place[0] - math.sin(turn) * place[1]
    north = math.sin(turn) * place[0] + math.cos(turn) * place[1]
    np.testing.assert_allclose(got.position, [north, east, -place[2]], atol=1e-3)
    assert math.cos(got.yaw_rad - (0.5 * math.pi - yaw - turn)) == pytest.approx(1.0, abs=1e-6)
    assert got.tilt == pytest.approx((roll, -pitch), abs=1e-4)
    assert got.velocity is not None
    assert np.linalg.norm(got.velocity) == pytest.approx(math.sqrt(5.09), abs=1e-4)


@given(horizontal=sigmas, vertical=sigmas, roll=tilts, yaw=angles)
def test_no_autopilot_believes_more_than_we_know(
    horizontal: float, vertical: float, roll: float, yaw: float
) -> None:
    """The deviation along each axis is at least the true one, and not absurdly larger."""
    one = state(roll=roll, yaw=yaw)
    rotation = one.world_from_body.rotation
    world = np.diag([horizontal**2, horizontal**2, vertical**2])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = rotation.T @ world @ rotation
    covariance[3:, 3:] = np.eye(3) * 0.02**2
    one = VehicleState(one.t_ns, one.world_from_body, covariance, None, None, 80, 0)
    largest = max(horizontal, vertical)
    for autopilot, floor in ((Autopilot.ARDUPILOT, 0.2), (Autopilot.PX4, 0.1)):
        got = taken(autopilot, one)
        assert np.all(got.position_sigma >= np.array([horizontal, horizontal, vertical]) * (1 - 1e-5))
        assert np.all(got.position_sigma <= max(floor, 3.0 * largest, 3.0 * largest ** (4 / 3)))
        assert got.yaw_sigma_rad >= 0.02 * (1 - 1e-5)
    # PX4 takes each axis by itself
    expected = np.maximum(0.1, [horizontal, horizontal, vertical])
    np.testing.assert_allclose(taken(Autopilot.PX4, one).position_sigma, expected, rtol=1e-4)


def test_entries_for_ardupilot_are_no_smaller_than_variances() -> None:
    for sigma in (0.01, 0.1, 1 / 3, 1.0, 5.0):
        message = encode_odometry(state(sigma_m=sigma), Placement(), Autopilot.ARDUPILOT)
        for entry in (0, 6, 11):
            assert message.pose_covariance[entry] >= sigma**2 * (1 - 1e-9)


def test_what_is_not_known_is_not_a_number() -> None:
    for autopilot in Autopilot:
        message = rules.over_the_wire(encode_odometry(state(), Placement(), autopilot))
        assert all(math.isnan(value) for value in (message.vx, message.vy, message.vz, message.yawspeed))
        assert math.isnan(message.velocity_covariance[0])
        assert taken(autopilot, state()).velocity is None


def test_a_changed_counter_resets_both() -> None:
    for decoder, autopilot in ((rules.ArduPilot(), Autopilot.ARDUPILOT), (rules.Px4(), Autopilot.PX4)):
        resets = []
        for n, counter in enumerate((0, 0, 0, 1, 1)):
            one = state(t_ns=n * 100_000_000, reset_counter=counter)
            got = decoder.take(rules.over_the_wire(encode_odometry(one, Placement(), autopilot)))
            resets.append(got is not None and got.is_reset)
        assert resets == [False, False, False, True, False]


@given(place=places, turn=angles)
def test_latitude_and_longitude_are_those_of_the_place(
    place: tuple[float, float, float], turn: float
) -> None:
    placement = Placement(ORIGIN, turn)
    east = math.cos(turn) * place[0] - math.sin(turn) * place[1]
    north = math.sin(turn) * place[0] + math.cos(turn) * place[1]
    for autopilot in Autopilot:
        raw = encode_global_position(state(place), placement, autopilot, 1_040_000_000, 1.7e9)
        message = rules.over_the_wire(raw)
        geodetic = np.array([[message.lat * 1e-7, message.lon * 1e-7, message.alt]])
        np.testing.assert_allclose(enu_from_geodetic(geodetic, ORIGIN)[0], [east, north, place[2]], atol=0.02)


def test_gps_input_for_ardupilot() -> None:
    placement = Placement(ORIGIN, 0.0)
    one = state((0.0, 0.0, 10.0), yaw=0.5 * math.pi, sigma_m=0.4, velocity=(1.0, 2.0, -0.5))
    message = encode_global_position(
        one, placement, Autopilot.ARDUPILOT, 0, 315_964_800 + 7 * 86_400 * 3 + 2.5
    )
    assert message.get_type() == "GPS_INPUT"
    assert (message.time_week, message.time_week_ms) == (3, 2500)
    assert message.fix_type == 3
    assert (message.vn, message.ve, message.vd) == pytest.approx((2.0, 1.0, 0.5))
    assert message.yaw == 36_000  # north: 0 would say that there is no heading
    assert message.horiz_accuracy == pytest.approx(0.4)
    still = encode_global_position(state(), placement, Autopilot.ARDUPILOT, 0, 1.7e9)
    assert still.ignore_flags & messages.GPS_INPUT_IGNORE_FLAG_VEL_HORIZ


def test_a_map_without_gps_has_no_latitude() -> None:
    for autopilot in Autopilot:
        assert encode_global_position(state(), Placement(), autopilot, 0, 1.7e9) is None


def test_px4_learns_how_old_the_position_is() -> None:
    message = encode_global_position(state(), GEOREFERENCED, Autopilot.PX4, 1_040_000_000, 1.7e9)
    assert message.get_type() == "GLOBAL_POSITION_SENSOR"
    assert message.processing_time == 40_000
    assert message.source == messages.GLOBAL_POSITION_SRC_VISION
