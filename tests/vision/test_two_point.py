"""Two points and an attitude give the pose: exactly, always, or not at all."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from overfly.geometry.poses import FloatArray, rotation_z
from overfly.vision.two_point import solve_two_point

places = st.floats(-5.0, 5.0)
reaches = st.floats(-0.8, 0.8)
heights = st.floats(0.3, 50.0)
yaws = st.floats(-math.pi, math.pi)


def seen_from(camera: FloatArray, yaw: float, q: FloatArray, z: FloatArray) -> FloatArray:
    """Points (n, 3) at heights z that the camera sees along levelled rays q (n, 2)."""
    below = (camera[2] - z)[:, None]
    xy = camera[:2] + (q * below) @ rotation_z(yaw)[:2, :2].T
    return np.column_stack([xy, z])


def reprojection_error(solution: FloatArray, points: FloatArray, q: FloatArray) -> float:
    """Largest distance between given and seen levelled rays."""
    below = solution[2] - points[:, 2]
    assert (below > 0).all(), "a solution from below"
    seen = ((points[:, :2] - solution[:2]) @ rotation_z(solution[3])[:2, :2]) / below[:, None]
    return float(np.abs(seen - q).max())


def is_among(solutions: FloatArray, camera: FloatArray, yaw: float, tolerance: float) -> bool:
    for solution in solutions:
        near = np.abs(solution[:3] - camera).max() < tolerance * camera[2]
        turned = abs(math.remainder(solution[3] - yaw, 2 * math.pi))
        if near and turned < tolerance:
            return True
    return False


@given(places, places, heights, yaws, reaches, reaches, reaches, reaches, st.floats(-0.7, 0.7))
def test_any_pose_is_recovered_from_any_two_points(
    x: float, y: float, height: float, yaw: float, a1: float, b1: float, a2: float, b2: float, step: float
) -> None:
    """step: how much higher the first point stands, as a share of the height."""
    q = np.array([[a1, b1], [a2, b2]])
    assume(np.linalg.norm(q[0] - q[1]) > 0.02)
    camera = np.array([x, y, height])
    points = seen_from(camera, yaw, q, np.array([step * height, 0.0]))
    # Of points above one another the yaw cannot be told; where both roots meet, they lose half the digits.
    base = np.linalg.norm(points[0, :2] - points[1, :2])
    assume(base > 1e-2 * height)
    dz, dq = -step * height, q[0] - q[1]
    slope = height * (dq @ dq) + dz * (q[0] @ dq)
    assume(abs(slope) > 1e-3 * height)
    solutions = solve_two_point(points, q)
    assert len(solutions) >= 1
    assert is_among(solutions, camera, yaw, 1e-6)


@given(places, places, heights, yaws, reaches, reaches, reaches, reaches, st.floats(-0.7, 0.7))
def test_every_solution_sees_both_points_where_they_are(
    x: float, y: float, height: float, yaw: float, a1: float, b1: float, a2: float, b2: float, step: float
) -> None:
    q = np.array([[a1, b1], [a2, b2]])
    assume(np.linalg.norm(q[0] - q[1]) > 0.02)
    points = seen_from(np.array([x, y, height]), yaw, q, np.array([step * height, 0.0]))
    assume(np.linalg.norm(points[0, :2] - points[1, :2]) > 1e-2 * height)
    for solution in solve_two_point(points, q):
        below = solution[2] - points[:, 2]
        assume((below > 1e-3 * height).all())  # hardly above a point, its ray amplifies rounding
        assert reprojection_error(solution, points, q) < 1e-5


def test_both_roots_are_given_when_both_see_the_points() -> None:
    """A step so high, seen so obliquely, that two heights explain the picture."""
    q = np.array([[0.9, 0.0], [0.3, 0.0]])
    found_two = 0
    for step in np.linspace(-0.9, 1.7, 61):
        points = seen_from(np.array([0.0, 0.0, 2.0]), 0.3, q, np.array([step, 0.0]))
        if np.linalg.norm(points[0, :2] - points[1, :2]) < 1e-3:
            continue
        solutions = solve_two_point(points, q)
        assert is_among(solutions, np.array([0.0, 0.0, 2.0]), 0.3, 1e-6)
        found_two += len(solutions) == 2
        if len(solutions) == 2:
            assert abs(solutions[0, 2] - solutions[1, 2]) > 1e-6
    assert found_two > 0


def test_order_of_the_points_does_not_matter() -> None:
    q = np.array([[0.3, -0.2], [-0.4, 0.1]])
    points = seen_from(np.array([1.0, 2.0, 3.0]), 1.1, q, np.array([0.4, -0.1]))
    np.testing.assert_allclose(
        solve_two_point(points, q)[0], solve_two_point(points[::-1], q[::-1])[0], atol=1e-12
    )


Q = np.array([[0.2, 0.1], [-0.3, 0.05]])
POINTS = seen_from(np.array([0.0, 0.0, 2.0]), 0.5, Q, np.zeros(2))


@pytest.mark.parametrize(
    ("points", "q"),
    [
        (POINTS, Q[[0, 0]]),  # one ray twice
        (POINTS[[0, 0]], Q),  # one point twice
        (POINTS, np.full((2, 2), np.nan)),  # above the horizon
        (np.array([[0.0, 0, 5.0], [0.01, 0, 0.0]]), np.array([[0.5, 0.0], [-0.5, 0.01]])),  # no height fits
    ],
    ids=["one ray", "one point", "no ray", "no height"],
)
def test_degenerate_input_gives_no_pose(points: FloatArray, q: FloatArray) -> None:
    solutions = solve_two_point(points, q)
    assert solutions.shape == (0, 4)


def test_a_camera_below_the_points_is_no_solution() -> None:
    """Mirrored rays: as if the points were seen from underneath with the yaw turned by half a turn."""
    for solution in solve_two_point(POINTS, -Q):
        assert solution[2] > POINTS[:, 2].max()
        assert reprojection_error(solution, POINTS, -Q) < 1e-9
