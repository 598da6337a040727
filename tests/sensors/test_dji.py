"""Gimbal angles against a camera built by hand, and the entries of the XMP packet in both ways of writing."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from overfly.geometry.poses import rotation_from_euler
from overfly.sensors.calibration_files import nadir_mount
from overfly.sensors.dji import (
    camera_rotation_from_gimbal,
    factory_camera,
    parse_dji,
    read_attitude,
    tilt_from_nadir_rad,
)

DOWN = -math.pi / 2


def packet(**entries: object) -> str:
    elements = "".join(f"<drone-dji:{name}>{value}</drone-dji:{name}>\n" for name, value in entries.items())
    return (
        f"<rdf:Description xmlns:drone-dji='http://www.dji.com/drone-dji/1.0/'>{elements}</rdf:Description>"
    )


def gimbal(yaw_deg: float, pitch_deg: float, roll_deg: float) -> str:
    return packet(GimbalYawDegree=yaw_deg, GimbalPitchDegree=pitch_deg, GimbalRollDegree=roll_deg)


def test_straight_down_heading_east_by_hand() -> None:
    world_from_cam = camera_rotation_from_gimbal(math.pi / 2, DOWN, 0.0)
    # image right is south, image down is west, the axis goes down; world is east, north, up
    np.testing.assert_allclose(world_from_cam, [[0, -1, 0], [-1, 0, 0], [0, 0, -1]], atol=1e-12)


def test_the_horizon_to_the_north_by_hand() -> None:
    world_from_cam = camera_rotation_from_gimbal(0.0, 0.0, 0.0)
    np.testing.assert_allclose(world_from_cam, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)


@given(st.floats(-math.pi, math.pi), st.floats(DOWN, 0.0), st.floats(-0.2, 0.2))
def test_the_axis_points_where_yaw_and_pitch_say(yaw: float, pitch: float, roll: float) -> None:
    world_from_cam = camera_rotation_from_gimbal(yaw, pitch, roll)
    axis = [math.cos(pitch) * math.sin(yaw), math.cos(pitch) * math.cos(yaw), math.sin(pitch)]
    np.testing.assert_allclose(world_from_cam @ [0, 0, 1], axis, atol=1e-12)
    assert np.linalg.det(world_from_cam) == pytest.approx(1.0)
    assert tilt_from_nadir_rad(world_from_cam) == pytest.approx(pitch - DOWN, abs=1e-6)


@given(st.floats(-180, 180), st.floats(-90, -55), st.floats(-10, 10))
def test_the_attitude_and_the_nadir_mount_give_the_camera_back(yaw: float, pitch: float, roll: float) -> None:
    attitude = read_attitude(parse_dji(gimbal(yaw, pitch, roll)))
    assert attitude is not None and attitude.yaw_rad is not None
    body = rotation_from_euler(attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad)
    wanted = camera_rotation_from_gimbal(math.radians(yaw), math.radians(pitch), math.radians(roll))
    np.testing.assert_allclose(body @ nadir_mount().rotation, wanted, atol=1e-9)


@pytest.mark.parametrize(("yaw_deg", "east_rad"), [(0.0, math.pi / 2), (90.0, 0.0), (-90.0, math.pi)])
def test_compass_to_mathematical_heading(yaw_deg: float, east_rad: float) -> None:
    attitude = read_attitude(parse_dji(gimbal(yaw_deg, -90.0, 0.0)))
    assert attitude is not None and attitude.yaw_rad is not None
    assert math.cos(attitude.yaw_rad - east_rad) == pytest.approx(1.0)
    assert attitude.roll_rad == pytest.approx(0.0, abs=1e-12)
    assert attitude.pitch_rad == pytest.approx(0.0, abs=1e-12)


def test_small_tilts_have_the_right_sign() -> None:
    # 5 degrees short of straight down: the axis leans forward, which is the nose of the level body going up
    attitude = read_attitude(parse_dji(gimbal(30.0, -85.0, 0.0)))
    assert attitude is not None
    assert attitude.pitch_rad == pytest.approx(math.radians(-5.0))


def test_a_gimbal_that_turned_over_reads_the_same() -> None:
    upright = read_attitude(parse_dji(gimbal(20.0, -90.0, 0.0)))
    over = read_attitude(parse_dji(gimbal(-160.0, -90.0, 180.0)))
    assert upright is not None and over is not None
    assert over.yaw_rad == pytest.approx(upright.yaw_rad)


def test_an_airframe_without_gimbal() -> None:
    text = packet(FlightYawDegree="+90.0", FlightPitchDegree="+3.0", FlightRollDegree="-2.0")
    attitude = read_attitude(parse_dji(text))
    assert attitude is not None
    # nose up is pitch > 0 in FRD and pitch < 0 in FLU; roll is the same
    assert attitude.pitch_rad == pytest.approx(math.radians(-3.0))
    assert attitude.roll_rad == pytest.approx(math.radians(-2.0))
    assert attitude.yaw_rad == pytest.approx(0.0, abs=1e-12)
    assert read_attitude(parse_dji("")) is None


def test_attributes_read_like_elements() -> None:
    attributes = '<rdf:Description drone-dji:RelativeAltitude="+39.80" drone-dji:RtkFlag="50"/>'
    assert parse_dji(attributes) == parse_dji(packet(RelativeAltitude="+39.80", RtkFlag=50))
    assert parse_dji(attributes).number("RelativeAltitude") == 39.8
    assert parse_dji(packet(RelativeAltitude="n/a")).number("RelativeAltitude") is None


def test_calibrated_focal_length_follows_the_image_size() -> None:
    tags = parse_dji(
        packet(CalibratedFocalLength=3666.5, CalibratedOpticalCenterX=2736, CalibratedOpticalCenterY=1824)
    )
    full = factory_camera(tags, 5472, 3648, 5472)
    half = factory_camera(tags, 2736, 1824, 5472)
    retagged = factory_camera(tags, 2736, 1824, 2736)
    assert full is not None and half is not None and retagged is not None
    assert full.fx == pytest.approx(3666.5)
    assert (full.cx, full.cy) == (2735.5, 1823.5)
    for camera in (half, retagged):
        assert camera.fx == pytest.approx(3666.5 / 2)
        assert (camera.cx, camera.cy) == pytest.approx((1367.5, 911.5))


def test_factory_distortion() -> None:
    data = "2019-09-18;3678.87,3671.84,-8.1,-5.28,-0.26,0.11,-0.0008,-0.0001,-0.0391"
    camera = factory_camera(parse_dji(packet(DewarpData=data, DewarpFlag=0)), 5472, 3648, None)
    assert camera is not None
    assert (camera.fx, camera.fy) == (3678.87, 3671.84)
    assert (camera.cx, camera.cy) == pytest.approx((2735.5 - 8.1, 1823.5 - 5.28))
    assert camera.coefficients == (-0.26, 0.11, -0.0008, -0.0001, -0.0391)
    # already straightened by the camera: these coefficients no longer apply
    assert factory_camera(parse_dji(packet(DewarpData=data, DewarpFlag=1)), 5472, 3648, None) is None


@pytest.mark.parametrize("value", ["0.000000", "nan", "8.8", ""])
def test_a_focal_length_that_cannot_be_is_ignored(value: str) -> None:
    assert factory_camera(parse_dji(packet(CalibratedFocalLength=value)), 5472, 3648, None) is None
