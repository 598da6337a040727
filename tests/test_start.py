"""How a map begins: height from the range sensor, from an object of known size, or as given."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from overfly.config import Config, HeightSettings
from overfly.geometry.cameras import Camera
from overfly.geometry.levelling import NADIR_BODY_FROM_CAM, level_from_cam
from overfly.geometry.poses import FloatArray, Pose, euler_from_rotation, rotation_from_euler
from overfly.start import (
    UNKNOWN_HEIGHT_M,
    Start,
    begin_height,
    first_pose,
    height_from_landmark,
    range_height,
)
from overfly.types import Altitude, AltitudeKind, Attitude, Frame, MountedCamera, Rig, ScaleLandmark
from overfly.vision.refine import TiltPrior

CAMERA = Camera(320, 240, 288.0, 288.0, 161.4, 116.6, coefficients=(-0.12, 0.05, 0.0006, -0.0004))
MOUNT = Pose(rotation_from_euler(0.02, -0.03, 0.05) @ NADIR_BODY_FROM_CAM, np.array([0.20, -0.10, -0.05]))
RIG = Rig((MountedCamera("cam0", CAMERA, MOUNT),))
CORNERS_M = np.array([[-0.3, 0.2], [0.3, 0.2], [0.3, -0.2], [-0.3, -0.2]])

tilts = st.floats(-0.4, 0.4)


def frame(altitude: Altitude | None = None, attitude: Attitude | None = None, t_ns: int = 7) -> Frame:
    return Frame(0, t_ns, "0", (np.zeros((240, 320), np.uint8),), attitude, altitude)


def level_of(roll: float, pitch: float) -> FloatArray:
    return level_from_cam(Attitude(roll, pitch, 0.01), MOUNT.rotation)


@given(tilts, tilts, st.floats(-3, 3), st.floats(0.5, 50.0), st.floats(-1, 1))
def test_height_of_the_camera_from_a_slanted_range(
    roll: float, pitch: float, yaw: float, height: float, ground: float
) -> None:
    """The range runs along the body's own down axis to level ground; the camera sits elsewhere on it."""
    body = Pose(rotation_from_euler(roll, pitch, yaw), np.array([3.0, -2.0, ground + height]))
    down = -body.rotation[:, 2]
    measured = -height / down[2]
    camera = body @ MOUNT
    altitude = Altitude(measured, 0.02, AltitudeKind.RANGE)
    found = range_height(frame(altitude), RIG, level_of(roll, pitch), ground)
    assert found is not None
    assert found.z_m == pytest.approx(camera.translation[2], abs=1e-9)
    assert found.sigma_m == pytest.approx(0.02)
    on_zero = range_height(frame(altitude), RIG, level_of(roll, pitch), None)
    assert on_zero is not None
    assert on_zero.z_m == pytest.approx(camera.translation[2] - ground, abs=1e-9)


@given(tilts, st.floats(0.5, 50.0), st.floats(0.02, 0.35))
def test_a_sonar_hears_the_nearest_ground_in_its_cone(roll: float, height: float, half_angle: float) -> None:
    """Over level ground and for any tilt, against all directions of the cone."""
    body = Pose(rotation_from_euler(roll, 0.0, 0.0), np.array([0.0, 0.0, height]))
    across = np.linspace(-half_angle, half_angle, 4001)  # in the plane in which it tilts
    directions = np.column_stack([np.zeros(len(across)), np.sin(across), -np.cos(across)])
    nearest = float(np.min(-height / (directions @ body.rotation[2])))
    altitude = Altitude(nearest, 0.02, AltitudeKind.RANGE, half_angle)
    found = range_height(frame(altitude), RIG, level_of(roll, 0.0), 0.0)
    assert found is not None
    assert found.z_m == pytest.approx((body @ MOUNT).translation[2], rel=1e-5, abs=1e-6)


def test_what_is_no_range_is_no_height() -> None:
    level = level_of(0, 0)
    assert range_height(frame(), RIG, level, None) is None
    above_start = Altitude(10.0, 0.5, AltitudeKind.ABOVE_START)
    assert range_height(frame(above_start), RIG, level, None) is None
    upside_down = level_of(math.pi, 0)
    assert range_height(frame(Altitude(2.0, 0.02, AltitudeKind.RANGE)), RIG, upside_down, None) is None


# -- an object of known size


def landmark_seen_from(body: Pose, place: FloatArray, turn: float, noise_px: float = 0.0) -> ScaleLandmark:
    """The object on the ground at place, turned; as the camera on this body sees its corners."""
    c, s = math.cos(turn), math.sin(turn)
    on_ground = CORNERS_M @ np.array([[c, s], [-s, c]]) + place
    world = np.column_stack([on_ground, np.zeros(4)])
    px = CAMERA.project((body @ MOUNT).inverse().transform(world))
    px = px + np.random.default_rng(0).normal(0.0, 1.0, px.shape) * noise_px
    return ScaleLandmark("paper", 7, "cam0", CORNERS_M, px)


@given(tilts, tilts, st.floats(-3, 3), st.floats(1.0, 6.0), st.floats(-3, 3))
def test_exact_corners_give_the_exact_height_and_tilt(
    roll: float, pitch: float, yaw: float, height: float, turn: float
) -> None:
    body = Pose(rotation_from_euler(0.2 * roll, 0.2 * pitch, yaw), np.array([0.5, 0.3, height]))
    camera = body @ MOUNT
    middle = camera.rotation @ np.array([0.05, -0.03, 1.0])
    place = camera.translation[:2] - middle[:2] * camera.translation[2] / middle[2]
    landmark = landmark_seen_from(body, place, turn)
    tilt = TiltPrior(level_of(0.2 * roll, 0.2 * pitch), 0.03)
    start = height_from_landmark(landmark, RIG, tilt)
    assert start is not None
    assert start.source == "landmark"
    assert start.height_m == pytest.approx(camera.translation[2], rel=1e-5)
    np.testing.assert_allclose(start.level_from_cam, tilt.level_from_cam, atol=1e-4)


def test_corners_correct_an_attitude_that_nobody_measured() -> None:
    """The camera is taken to hang level within three degrees, but it does not: large corners tell."""
    body = Pose(rotation_from_euler(0.05, -0.03, 1.0), np.array([0.0, 0.0, 1.2]))
    landmark = landmark_seen_from(body, np.array([0.0, 0.05]), 0.3)
    start = height_from_landmark(landmark, RIG, TiltPrior(level_of(0, 0), 0.05))
    assert start is not None
    assert start.height_m == pytest.approx((body @ MOUNT).translation[2], rel=0.02)
    up = level_of(0.05, -0.03).T @ [0.0, 0.0, 1.0]
    assert np.linalg.norm((start.level_from_cam @ up)[:2]) < 0.5 * math.hypot(0.05, 0.03)


def test_clicked_corners_err_by_little() -> None:
    body = Pose(rotation_from_euler(0.0, 0.0, 1.0), np.array([0.0, 0.0, 2.0]))
    start = height_from_landmark(
        landmark_seen_from(body, np.zeros(2), 0.3, noise_px=0.5), RIG, TiltPrior(level_of(0, 0), 0.01)
    )
    assert start is not None
    error = abs(start.height_m / (body @ MOUNT).translation[2] - 1.0)
    assert 1e-5 < error < 0.02  # 0.5 px on sides of 60 to 90 px


def test_landmarks_that_cannot_serve_are_passed_over() -> None:
    body = Pose(np.eye(3), np.array([0.0, 0.0, 2.0]))
    landmark = landmark_seen_from(body, np.zeros(2), 0.0)
    tilt = TiltPrior(level_of(0, 0), 0.01)
    assert height_from_landmark(replace(landmark, camera="cam7"), RIG, tilt) is None
    two = replace(landmark, corners_m=CORNERS_M[:2], corners_px=landmark.corners_px[:2])
    assert height_from_landmark(two, RIG, tilt) is None
    mirrored = replace(landmark, corners_px=landmark.corners_px[[1, 0, 3, 2]])
    wrong = height_from_landmark(mirrored, RIG, tilt)
    assert wrong is None or wrong.height_m > 0


# -- which source


def begun(
    altitude: Altitude | None = None, given: float | None = None, landmark: ScaleLandmark | None = None
) -> Start:
    config = Config(height=HeightSettings(given_m=given))
    return begin_height(frame(altitude), RIG, TiltPrior(level_of(0, 0), 0.05), config, landmark)


def test_the_most_trusted_source_wins() -> None:
    body = Pose(np.eye(3), np.array([0.0, 0.0, 2.0]))
    landmark = landmark_seen_from(body, np.zeros(2), 0.0)
    ranged = Altitude(3.0, 0.02, AltitudeKind.RANGE)
    above = Altitude(40.0, 0.5, AltitudeKind.ABOVE_START)
    assert begun(ranged, 5.0, landmark).source == "range"
    assert begun(above, 5.0, landmark).source == "landmark"
    assert begun(above, 5.0).source == "given"
    assert begun(above, 5.0).height_m == 5.0
    assert begun(above).source == "altitude"
    assert begun(above).height_m == 40.0
    assert begun(Altitude(0.2, 0.5, AltitudeKind.ABOVE_START)).source == "none"  # still on the ground
    assert begun().source == "none"
    assert begun().height_m == UNKNOWN_HEIGHT_M
    late = replace(landmark, t_ns=8)
    assert begun(None, 5.0, late).source == "given"  # its corners are of another frame


# -- the first pose


def test_the_first_pose_is_over_the_origin() -> None:
    start = Start(2.5, level_of(0.1, -0.05), "given")
    pose = first_pose(start, 0.7)
    np.testing.assert_array_equal(pose.translation, [0, 0, 2.5])
    body = pose.rotation @ MOUNT.rotation.T
    np.testing.assert_allclose(euler_from_rotation(body), (0.1, -0.05, 0.7), atol=1e-12)


def test_without_a_heading_the_pictures_right_is_the_worlds_x() -> None:
    pose = first_pose(Start(2.5, level_of(0.1, -0.05), "given"), None)
    right = pose.rotation[:, 0]
    assert right[0] > 0.9
    assert right[1] == pytest.approx(0.0, abs=1e-12)
    body = pose.rotation @ MOUNT.rotation.T
    assert euler_from_rotation(body)[:2] == pytest.approx((0.1, -0.05), abs=1e-12)
