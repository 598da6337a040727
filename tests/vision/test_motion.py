"""Prediction by constant velocity, and when a frame becomes a node."""

from __future__ import annotations

import math

import numpy as np
import pytest

from overfly.config import NodeSettings
from overfly.geometry.poses import Pose
from overfly.vision.motion import LONGEST_GAP_S, ConstantVelocity, moved_enough

from .scenes import CAMERA, camera_pose, pose_error

STEP_NS = 100_000_000
TANGENT = np.array([0.1, -0.05, 0.02, 0.01, -0.02, 0.05])
START = camera_pose(1.0, 2.0, 3.0, 0.1, -0.1, 0.5)


def test_steady_motion_in_the_cameras_own_axes_goes_on() -> None:
    motion = ConstantVelocity()
    poses = [START]
    for _ in range(3):
        poses.append(poses[-1] @ Pose.exp(TANGENT))
    motion.update(0, poses[0])
    motion.update(STEP_NS, poses[1])
    predicted = motion.predict(2 * STEP_NS)
    assert predicted is not None
    np.testing.assert_allclose(pose_error(predicted, poses[2]), np.zeros(6), atol=1e-12)
    half = motion.predict(STEP_NS + STEP_NS // 2)
    assert half is not None
    np.testing.assert_allclose(pose_error(half, poses[1] @ Pose.exp(TANGENT / 2)), np.zeros(6), atol=1e-12)


def test_nothing_is_predicted_from_nothing_or_from_long_ago() -> None:
    motion = ConstantVelocity()
    assert motion.last_pose is None
    assert motion.predict(0) is None
    motion.update(0, START)
    first = motion.predict(STEP_NS)
    assert first is not None
    np.testing.assert_array_equal(first.matrix(), START.matrix())  # no velocity yet
    assert motion.predict(0) is None
    assert motion.predict(-STEP_NS) is None
    limit_ns = int(LONGEST_GAP_S * 1e9)
    assert motion.predict(limit_ns) is not None
    assert motion.predict(limit_ns + 1) is None
    assert motion.last_pose is START


def test_velocity_is_not_taken_over_a_gap_or_from_before_a_loss() -> None:
    motion = ConstantVelocity()
    motion.update(0, START)
    motion.update(2_000_000_000, START @ Pose.exp(TANGENT))
    after_gap = motion.predict(2_000_000_000 + STEP_NS)
    assert after_gap is not None
    np.testing.assert_array_equal(after_gap.matrix(), (START @ Pose.exp(TANGENT)).matrix())
    motion.update(2_000_000_000 + STEP_NS, START)
    motion.lose()
    still = motion.predict(2_000_000_000 + 2 * STEP_NS)
    assert still is not None
    np.testing.assert_array_equal(still.matrix(), START.matrix())


def test_when_the_map_moves_the_prediction_moves_with_it() -> None:
    moved = Pose.exp(np.array([5.0, -3.0, 0.2, 0.0, 0.0, 0.8]))
    one, other = ConstantVelocity(), ConstantVelocity()
    for stamp, pose in ((0, START), (STEP_NS, START @ Pose.exp(TANGENT))):
        one.update(stamp, pose)
        other.update(stamp, moved @ pose)
    one.move(moved)
    expected, found = other.predict(2 * STEP_NS), one.predict(2 * STEP_NS)
    assert expected is not None and found is not None
    np.testing.assert_allclose(pose_error(found, expected), np.zeros(6), atol=1e-12)
    ConstantVelocity().move(moved)  # nothing to move is no error


SETTINGS = NodeSettings(displacement=0.3, turn_deg=25.0, height_ratio=1.25)


def enough(now: Pose) -> bool:
    node = camera_pose(z=2.0)
    return moved_enough(node, now, (2.0, float(now.translation[2])), CAMERA, SETTINGS)


def test_a_view_that_stays_is_no_node() -> None:
    assert not enough(camera_pose(z=2.0))
    assert not enough(camera_pose(0.1, -0.1, 2.1, 0.01, 0.01, 0.1))


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("axis", [0, 1])
def test_displacement_is_a_share_of_the_smaller_side(axis: int, sign: float) -> None:
    """0.3 of 240 px at f = 288 and 2 m: half a metre."""
    limit = 0.3 * 240 / 288 * 2.0
    for factor, expected in ((0.97, False), (1.03, True)):
        place = [0.0, 0.0]
        place[axis] = sign * factor * limit
        assert enough(camera_pose(*place, 2.0)) is expected


def test_turns_about_any_axis_and_changes_of_height_count() -> None:
    for degrees, expected in ((24.0, False), (26.0, True)):
        assert enough(camera_pose(z=2.0, yaw=math.radians(degrees))) is expected
    for height, expected in ((2.45, False), (2.55, True), (1.65, False), (1.55, True)):
        assert enough(camera_pose(z=height)) is expected
    assert enough(camera_pose(z=2.0, roll=math.radians(16.0)))  # the view slides away under a tilt
    assert not enough(camera_pose(z=2.0, roll=math.radians(10.0)))


def test_a_view_that_lost_the_place_altogether_is_a_node() -> None:
    """Behind the camera there are no pixels to compare; that counts as moved."""
    assert enough(camera_pose(z=2.0, roll=math.pi))


def test_a_calm_prediction_goes_on_with_the_mean_motion() -> None:
    """Poses that jitter: the last two tell a velocity that is far off, all of late do not."""
    rng = np.random.default_rng(3)
    motion, pose = ConstantVelocity(), START
    assert motion.predict_calmly(0) is None
    errors, calm_errors = [], []
    for step in range(60):
        motion.update(step * STEP_NS, pose @ Pose.exp(rng.normal(0.0, 0.01, 6)))
        pose = pose @ Pose.exp(0.2 * TANGENT)
        if step > 10:
            last, calm = motion.predict((step + 1) * STEP_NS), motion.predict_calmly((step + 1) * STEP_NS)
            assert last is not None and calm is not None
            errors.append(pose_error(last, pose))
            calm_errors.append(pose_error(calm, pose))
    assert 0.3 < np.std(calm_errors) / np.std(errors) < 0.8
    motion.lose()
    kept = motion.predict_calmly(61 * STEP_NS)
    assert kept is not None and motion.last_pose is not None
    assert np.linalg.norm(pose_error(motion.last_pose, kept)) > 1e-3  # a lost camera moves on
    doubled = motion.predict_calmly(60 * STEP_NS)
    motion.rescale(2.0)
    after = motion.predict_calmly(60 * STEP_NS)
    assert doubled is not None and after is not None
    np.testing.assert_allclose(after.translation, 2.0 * doubled.translation, atol=1e-9)
