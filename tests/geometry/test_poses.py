"""Rigid transforms: the axioms of the group, and the conventions that files and modules rely on."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from overfly.geometry.poses import (
    FloatArray,
    Pose,
    euler_from_rotation,
    interpolate,
    quaternion_from_rotation,
    rotation_from_euler,
    rotation_from_quaternion,
    rotation_from_vector,
    skew,
    stack_translations,
    vector_from_rotation,
    wrap_angle,
)

TIGHT = {"rtol": 0, "atol": 1e-9}

lengths = st.floats(-100.0, 100.0)
angles = st.floats(-math.pi, math.pi)


@st.composite
def directions(draw: st.DrawFn) -> FloatArray:
    vector = np.array([draw(st.floats(-1, 1)) for _ in range(3)])
    norm = np.linalg.norm(vector)
    return vector / norm if norm > 1e-3 else np.array([0.0, 0.6, -0.8])


@st.composite
def poses(draw: st.DrawFn) -> Pose:
    turn = draw(directions()) * draw(st.floats(0.0, math.pi))
    return Pose(Rotation.from_rotvec(turn).as_matrix(), np.array([draw(lengths) for _ in range(3)]))


def assert_same(a: Pose, b: Pose, atol: float = 1e-9) -> None:
    np.testing.assert_allclose(a.rotation, b.rotation, rtol=0, atol=atol)
    np.testing.assert_allclose(a.translation, b.translation, rtol=0, atol=atol * 1e3)


@given(poses(), poses(), poses())
def test_poses_are_a_group(a: Pose, b: Pose, c: Pose) -> None:
    assert_same((a @ b) @ c, a @ (b @ c))
    assert_same(a @ Pose.identity(), a)
    assert_same(Pose.identity() @ a, a)
    assert_same(a @ a.inverse(), Pose.identity())
    assert_same(a.inverse() @ a, Pose.identity())
    assert_same((a @ b).inverse(), b.inverse() @ a.inverse())


@given(poses(), poses())
def test_transform_matrix_and_product_are_the_same_map(a: Pose, b: Pose) -> None:
    points = np.array([[1.0, -2.0, 3.0], [0.3, 0.1, -0.7]])
    there = (a @ b).transform(points)
    np.testing.assert_allclose(there, a.transform(b.transform(points)), **TIGHT)
    homogeneous = np.column_stack([points, np.ones(2)]) @ (a.matrix() @ b.matrix()).T
    np.testing.assert_allclose(there, homogeneous[:, :3], **TIGHT)
    assert_same(Pose.from_matrix(a.matrix()), a)
    assert_same(Pose.from_matrix(a.matrix()[:3]), a)
    np.testing.assert_allclose(a.inverse().transform(a.transform(points)), points, **TIGHT)


def test_translation_is_the_place_of_the_origin() -> None:
    """b_from_a: the translation is in b, and is turned by what stands to its left."""
    quarter = Pose(rotation_from_euler(0, 0, math.pi / 2), np.array([10.0, 0.0, 0.0]))
    step = Pose(np.eye(3), np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose((quarter @ step).translation, [10.0, 1.0, 0.0], **TIGHT)
    np.testing.assert_allclose((step @ quarter).translation, [11.0, 0.0, 0.0], **TIGHT)


@given(
    directions(), st.one_of(st.floats(0.0, math.pi - 1e-9), st.floats(1e-12, 1e-4), st.just(math.pi - 1e-7))
)
def test_rotation_vectors_go_there_and_back(axis: FloatArray, angle: float) -> None:
    rotation = rotation_from_vector(axis * angle)
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(axis * angle).as_matrix(), rtol=0, atol=1e-13)
    np.testing.assert_allclose(vector_from_rotation(rotation), axis * angle, rtol=0, atol=1e-8)


@given(directions())
def test_half_a_turn_keeps_its_axis(axis: FloatArray) -> None:
    found = vector_from_rotation(rotation_from_vector(axis * math.pi))
    assert np.linalg.norm(found) == pytest.approx(math.pi, abs=1e-9)
    assert abs(float(found @ axis)) == pytest.approx(math.pi, abs=1e-7)


def test_tiny_rotations_keep_their_digits() -> None:
    """Where the sine of half the angle would vanish: relative, not absolute, accuracy."""
    for size in (1e-3, 1e-7, 1e-9, 1e-11):
        vector = size * np.array([0.36, -0.48, 0.8])
        found = vector_from_rotation(rotation_from_vector(vector))
        np.testing.assert_allclose(found, vector, rtol=1e-4, atol=0)


@given(poses())
def test_log_is_the_inverse_of_exp(pose: Pose) -> None:
    assert_same(Pose.exp(pose.log()), pose, 1e-8)
    np.testing.assert_array_equal(pose.log()[:3], pose.translation)


@given(poses(), st.lists(st.floats(-1, 1), min_size=6, max_size=6))
def test_adjoint_carries_a_perturbation_to_the_other_side(pose: Pose, tangent: list[float]) -> None:
    small = 1e-6 * np.array(tangent)
    moved = pose @ Pose.exp(small) @ pose.inverse()
    # second order: the square of the step times the lever arm
    np.testing.assert_allclose(moved.log(), pose.adjoint() @ small, rtol=0, atol=1e-9)


@given(poses(), poses())
def test_adjoints_multiply_like_poses(a: Pose, b: Pose) -> None:
    np.testing.assert_allclose((a @ b).adjoint(), a.adjoint() @ b.adjoint(), rtol=0, atol=1e-9)


@given(poses())
def test_quaternions_are_xyzw_as_in_scipy(pose: Pose) -> None:
    quaternion = pose.quaternion()
    assert quaternion[3] >= 0
    assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-12)
    expected = Rotation.from_matrix(pose.rotation).as_quat()
    assert abs(float(quaternion @ expected)) == pytest.approx(1.0, abs=1e-12)
    assert_same(Pose.from_quaternion(-3.0 * quaternion, pose.translation), pose)


@pytest.mark.parametrize("axis", range(3))
def test_quaternion_of_half_turns_which_have_no_real_part(axis: int) -> None:
    vector = np.zeros(3)
    vector[axis] = math.pi
    quaternion = quaternion_from_rotation(Rotation.from_rotvec(vector).as_matrix())
    expected = np.zeros(4)
    expected[axis] = 1.0
    np.testing.assert_allclose(np.abs(quaternion), expected, atol=1e-12)
    np.testing.assert_allclose(
        rotation_from_quaternion(quaternion), Rotation.from_rotvec(vector).as_matrix(), atol=1e-12
    )


@given(angles, st.floats(-1.5, 1.5), angles)
def test_euler_angles_are_zyx(roll: float, pitch: float, yaw: float) -> None:
    rotation = rotation_from_euler(roll, pitch, yaw)
    expected = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    np.testing.assert_allclose(rotation, expected, rtol=0, atol=1e-12)
    found = euler_from_rotation(rotation)
    np.testing.assert_allclose(rotation_from_euler(*found), rotation, rtol=0, atol=1e-9)
    assert found[1] == pytest.approx(pitch, abs=1e-9)


def test_signs_of_roll_pitch_and_yaw_in_a_body_with_x_forward_y_left_z_up() -> None:
    forward, left = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    assert (rotation_from_euler(0.1, 0, 0) @ left)[2] > 0  # right side down
    assert (rotation_from_euler(0, 0.1, 0) @ forward)[2] < 0  # nose down
    assert (rotation_from_euler(0, 0, 0.1) @ forward)[1] > 0  # nose to the left


def test_straight_up_has_an_euler_angle() -> None:
    rotation = rotation_from_euler(0.3, math.pi / 2, 0.0) * (1.0 + 1e-15)
    assert euler_from_rotation(rotation)[1] == pytest.approx(math.pi / 2, abs=1e-7)


@given(st.floats(-50, 50))
def test_wrapped_angles_are_the_same_angle(angle: float) -> None:
    wrapped = wrap_angle(angle)
    assert -math.pi <= wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


def test_wrapping_keeps_pi_and_turns_minus_pi() -> None:
    assert wrap_angle(math.pi) == pytest.approx(math.pi)
    assert wrap_angle(-math.pi) == pytest.approx(math.pi)


@given(poses(), poses(), st.floats(0, 1))
def test_interpolation_is_straight_and_steady(a: Pose, b: Pose, fraction: float) -> None:
    assert_same(interpolate(a, b, 0.0), a)
    assert_same(interpolate(a, b, 1.0), b, 1e-8)
    between = interpolate(a, b, fraction)
    expected = (1 - fraction) * a.translation + fraction * b.translation
    np.testing.assert_allclose(between.translation, expected, **TIGHT)
    whole = np.linalg.norm(vector_from_rotation(a.rotation.T @ b.rotation))
    part = np.linalg.norm(vector_from_rotation(a.rotation.T @ between.rotation))
    assert part == pytest.approx(fraction * whole, abs=1e-7)


@given(poses(), st.floats(0.1, 10))
def test_scaling_multiplies_lengths_only(pose: Pose, factor: float) -> None:
    scaled = pose.scaled(factor)
    np.testing.assert_array_equal(scaled.rotation, pose.rotation)
    points = np.array([[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(scaled.transform(factor * points), factor * pose.transform(points), **TIGHT)


@given(directions(), directions())
def test_skew_is_the_cross_product(a: FloatArray, b: FloatArray) -> None:
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), rtol=0, atol=1e-12)


def test_stack_of_no_poses_has_three_columns() -> None:
    assert stack_translations([]).shape == (0, 3)
    assert stack_translations([Pose.identity()] * 4).shape == (4, 3)
