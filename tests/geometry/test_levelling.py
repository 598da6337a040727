"""Levelled rays: what a camera that looks straight down would see."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from overfly.geometry.levelling import (
    NADIR_BODY_FROM_CAM,
    level_from_cam,
    level_rays,
    split_yaw,
    world_from_cam_rotation,
)
from overfly.geometry.poses import Pose, rotation_from_euler, rotation_z
from overfly.types import Attitude

tilts = st.floats(-0.5, 0.5)
yaws = st.floats(-math.pi, math.pi)


def crooked_mount() -> np.ndarray:
    return rotation_from_euler(0.02, -0.03, 0.1) @ NADIR_BODY_FROM_CAM


@given(tilts, tilts, yaws)
def test_levelled_rays_point_at_what_is_seen_but_for_the_yaw(roll: float, pitch: float, yaw: float) -> None:
    """(m - C).xy = (C.z - m.z) Rz(yaw) q for every point m that the tilted camera at C sees."""
    mount = crooked_mount()
    camera = Pose(rotation_from_euler(roll, pitch, yaw) @ mount, np.array([3.0, -1.0, 2.5]))
    points = np.array([[3.1, -1.2, 0.0], [2.4, -0.9, 0.3], [3.0, -1.0, -0.2], [3.3, -0.6, 0.1]])
    seen = camera.inverse().transform(points)
    q = level_rays(seen[:, :2] / seen[:, 2:], level_from_cam(Attitude(roll, pitch, 0.01, yaw), mount))
    below = camera.translation[2] - points[:, 2]
    in_world = (q * below[:, None]) @ rotation_z(yaw)[:2, :2].T
    visible = seen[:, 2] > 0.05
    assert visible.any()
    expected = points[:, :2] - camera.translation[:2]
    np.testing.assert_allclose(in_world[visible], expected[visible], rtol=0, atol=1e-9)


@given(tilts, tilts, yaws)
def test_rotation_of_the_camera_is_yaw_times_tilt(roll: float, pitch: float, yaw: float) -> None:
    mount = crooked_mount()
    level = level_from_cam(Attitude(roll, pitch, 0.01), mount)
    expected = rotation_from_euler(roll, pitch, yaw) @ mount
    np.testing.assert_allclose(world_from_cam_rotation(yaw, level), expected, rtol=0, atol=1e-12)
    found_yaw, found_level = split_yaw(expected, mount)
    assert math.remainder(found_yaw - yaw, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(found_level, level, rtol=0, atol=1e-9)


def test_without_attitude_the_body_is_level() -> None:
    np.testing.assert_array_equal(level_from_cam(None, NADIR_BODY_FROM_CAM), NADIR_BODY_FROM_CAM)
    # top of the picture is forward, its right-hand side is the body's right
    q = level_rays(np.array([[0.0, -0.2], [0.3, 0.0]]), NADIR_BODY_FROM_CAM)
    np.testing.assert_allclose(q, [[0.2, 0.0], [0.0, -0.3]], atol=1e-12)


def test_nose_down_looks_back() -> None:
    """Pitch lowers the nose, so the optical axis of a camera below the body swings backwards."""
    q = level_rays(np.zeros((1, 2)), level_from_cam(Attitude(0.0, 0.2, 0.01), NADIR_BODY_FROM_CAM))
    np.testing.assert_allclose(q, [[-math.tan(0.2), 0.0]], atol=1e-12)


def test_rolling_to_the_right_looks_left() -> None:
    q = level_rays(np.zeros((1, 2)), level_from_cam(Attitude(0.2, 0.0, 0.01), NADIR_BODY_FROM_CAM))
    np.testing.assert_allclose(q, [[0.0, math.tan(0.2)]], atol=1e-12)


def test_rays_above_the_horizon_are_not_on_the_ground() -> None:
    level = level_from_cam(Attitude(0.0, 1.2, 0.01), NADIR_BODY_FROM_CAM)
    q = level_rays(np.array([[0.0, 0.0], [0.0, 1.0]]), level)
    assert np.isfinite(q[0]).all()
    assert np.isnan(q[1]).all()
