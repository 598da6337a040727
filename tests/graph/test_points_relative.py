"""Relative poses beside the points: they place what sees nothing, and leave alone what sees much."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.graph.test_points import largest_errors, problem_of, survey

from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.points import adjust_points
from overfly.graph.points_priors import SIZE
from overfly.graph.points_problem import PointProblem
from overfly.graph.points_relative import (
    RelativePoses,
    anchors,
    left_by_odometry,
    parts,
    relative_poses,
    tied_nodes,
)
from overfly.graph.pose_graph import PoseGraph
from overfly.types import Constraint, ConstraintKind


def chain(poses: list[Pose], sigma: tuple[float, float], backwards: tuple[int, ...] = ()) -> RelativePoses:
    """From each pose to the next, exact, with deviations in metres and radians; some the other way round."""
    i, j = np.arange(len(poses) - 1), np.arange(1, len(poses))
    for k in backwards:
        i[k], j[k] = j[k], i[k]
    measured = [poses[a].inverse() @ poses[b] for a, b in zip(i.tolist(), j.tolist(), strict=True)]
    return RelativePoses(
        i, j, np.array([one.rotation for one in measured]), np.array([one.translation for one in measured]),
        np.tile(np.diag(np.repeat([sigma[0] ** -2.0, sigma[1] ** -2.0], 3)), (len(measured), 1, 1)),
    )  # fmt: skip


def blinded(problem: PointProblem, node: int) -> PointProblem:
    """The same without what one pose sees."""
    kept = problem.node != node
    views = np.add.reduceat(kept.astype(np.int64), problem.starts[:-1])
    kept &= np.repeat(views >= 2, np.diff(problem.starts))
    views = views[views >= 2]
    of_point = np.repeat(np.arange(len(problem.points)), np.diff(problem.starts))[kept]
    return replace(
        problem, points=problem.points[np.unique(of_point)], starts=np.concatenate([[0], np.cumsum(views)]),
        node=problem.node[kept], rays=problem.rays[kept], sigma=problem.sigma[kept],
        inverse_depth=problem.inverse_depth[kept],
    )  # fmt: skip


def test_a_pose_that_sees_nothing_is_where_odometry_has_it() -> None:
    poses, points = survey(3, 4, 2)
    problem = blinded(problem_of(poses, points, 0.0, 2, moved=0.5), 7)
    problem = replace(problem, relative=chain(poses, (0.1, 0.01), backwards=(6, 9)))
    solution = adjust_points(problem, iterations=60)
    assert solution is not None
    metres, radians = largest_errors(solution, poses)
    assert metres < 2e-3
    assert radians < 2e-4


def test_where_points_are_many_odometry_changes_little() -> None:
    """It is a tenth too long, as it says of itself: of 0.3 m, poses take less than they have noise."""
    poses, points = survey(3, 4, 5)
    problem = problem_of(poses, points, 1e-3, 6)
    exact = chain(poses, (0.3, 0.05))
    alone = adjust_points(problem)
    beside = adjust_points(replace(problem, relative=replace(exact, translations=1.1 * exact.translations)))
    assert alone is not None
    assert beside is not None
    moved = np.linalg.norm(beside.translations - alone.translations, axis=1)
    noise = math.sqrt(np.mean((alone.translations - [pose.translation for pose in poses]) ** 2))
    assert 1e-4 < moved.max() < noise


@settings(max_examples=25)
@given(st.integers(0, 10_000), st.sampled_from([0.01, 1.0]), st.floats(-0.5, 0.5))
def test_gradient_is_that_of_the_cost(seed: int, size: float, log_size: float) -> None:
    """At small errors, and beyond the bend of the robust cost."""
    generator = np.random.default_rng(seed)
    poses = [Pose.exp(generator.normal(0, 1, 6)) for _ in range(4)]
    relative = chain(poses, (0.1, 0.1), backwards=(1,))
    relative = replace(
        relative,
        translations=math.exp(-log_size) * relative.translations,
        information=relative.information / size**2,
    )
    moved = [pose @ Pose.exp(0.01 * size * generator.normal(0, 1, 6)) for pose in poses]

    def arrays(at: list[Pose]) -> tuple[FloatArray, FloatArray]:
        return np.array([pose.rotation for pose in at]), np.array([pose.translation for pose in at])

    diagonal, off, gradient = np.zeros((4, 6, 6)), np.zeros((3, 6, 6)), np.zeros((4, 6))
    by_size, of_size, along_size = np.zeros((4, 6)), np.zeros(1), np.zeros(1)
    relative.add_to(
        *arrays(moved), log_size, np.arange(3), diagonal, off, gradient, by_size, of_size, along_size
    )
    step, growth = generator.normal(0, 1, (4, 6)), generator.normal()
    ahead, behind = (
        relative.cost(
            *arrays([pose @ Pose.exp(h * s) for pose, s in zip(moved, step, strict=True)]),
            log_size + h * growth,
        )
        for h in (1e-5, -1e-5)
    )
    measured = (ahead - behind) / 4e-5  # half the derivative: costs are squares
    found = np.sum(gradient * step) + along_size[0] * growth
    length = np.hypot(np.linalg.norm(gradient), along_size[0]) * np.hypot(np.linalg.norm(step), growth)
    assert abs(measured - found) < 0.05 * length
    assert np.linalg.norm(gradient) > 0.0
    whole = np.zeros((25, 25))
    for n in range(4):
        whole[6 * n : 6 * n + 6, 6 * n : 6 * n + 6] = diagonal[n]
    for n in range(3):
        whole[6 * n : 6 * n + 6, 6 * n + 6 : 6 * n + 12] = off[n]
        whole[6 * n + 6 : 6 * n + 12, 6 * n : 6 * n + 6] = off[n].T
    whole[24, :24] = whole[:24, 24] = by_size.ravel()
    whole[24, 24] = of_size[0]
    # All of it may be moved and turned as one, and multiplied together with its size.
    rigid = np.vstack([pose.inverse().adjoint() for pose in moved] + [np.zeros((1, 6))])
    larger = np.zeros((25, 1))
    for n, pose in enumerate(moved):
        larger[6 * n : 6 * n + 3, 0] = pose.rotation.T @ pose.translation
    larger[24] = 1.0
    free = np.hstack([rigid, larger])
    assert np.abs(whole @ free).max() < 1e-9 * np.abs(whole).max() * np.abs(free).max() * 25
    assert np.linalg.eigvalsh(whole).min() > -1e-9 * np.abs(whole).max()


@pytest.mark.parametrize("wrong", [0.8, 1.02])
def test_relative_poses_say_nothing_of_the_size(wrong: float) -> None:
    """Ways of all poses measured too short or too long, and exactly: with a size of its own, the map is that
    of its positions; without, it is not."""
    poses, points = survey(3, 4, 8)
    problem = problem_of(poses, points, 1e-3, 9)
    sigma = np.full((len(poses), 3), math.inf)
    sigma[[0, 3, 8]] = 0.1
    exact = chain(poses, (1e-3, 1e-4))
    relative = replace(exact, translations=wrong * exact.translations)
    problem = replace(problem, position_sigma=sigma, relative=relative)
    errors = []
    for size_sigma in (10.0, 0.0):
        solution = adjust_points(replace(problem, size_sigma=size_sigma), iterations=60)
        assert solution is not None
        errors.append(largest_errors(solution, poses)[0])
        if size_sigma > 0.0:
            assert math.exp(solution.common[SIZE]) * wrong == pytest.approx(1.0, abs=1e-3)
    assert errors[0] < 0.01
    assert errors[1] > 10.0 * errors[0]


def graph_of(kinds: list[ConstraintKind]) -> PoseGraph:
    graph = PoseGraph()
    for k in range(len(kinds) + 1):
        graph.add_node(Pose(np.eye(3), np.array([float(k), 0.0, 0.0])))
    for k, kind in enumerate(kinds):
        ahead = Pose(np.eye(3), np.array([1.0, 0.0, 0.0]))
        graph.add_constraint(Constraint(k, k + 1, ahead, 4.0 * np.eye(6), kind))
    return graph


def test_guesses_of_where_a_piece_lies_do_not_count() -> None:
    odometry, guess = ConstraintKind.ODOMETRY, ConstraintKind.DEAD_RECKONING
    graph = graph_of([odometry, guess, odometry, ConstraintKind.BRIDGE])
    assert tied_nodes(graph).tolist() == [0, 1, 2, 3, 4]
    relative = relative_poses(graph, np.arange(5))
    assert relative.j.tolist() == [1, 3, 4]
    nothing = np.zeros(0, np.int64)
    seen_by = np.array([0, 1]), np.array([0, 0])
    free = np.zeros(5, np.bool_)
    tied, alone = parts(5, *seen_by, relative), parts(5, *seen_by, None)
    assert np.flatnonzero(anchors(tied, free)).tolist() == [0, 2]
    assert np.flatnonzero(anchors(alone, free)).tolist() == [0, 2, 3, 4]
    placed = np.array([False, False, True, True, False])
    assert np.flatnonzero(anchors(tied, placed)).tolist() == [0]
    assert len(tied_nodes(graph_of([guess]))) == len(nothing)


def test_information_is_that_of_rotation_vectors() -> None:
    """4 of half a rotation vector is 1 of it."""
    one = relative_poses(graph_of([ConstraintKind.ODOMETRY]), np.arange(2))
    np.testing.assert_allclose(one.information[0], np.diag([4.0] * 3 + [1.0] * 3))


def test_odometry_differs_from_the_map_by_as_much_as_it_was_wrong() -> None:
    """Poses err by a twentieth of what constraints, which are exact, claim, at both of their ends. Other
    constraints do not count, whatever they differ by."""
    generator = np.random.default_rng(3)
    graph = graph_of([ConstraintKind.ODOMETRY] * 300 + [ConstraintKind.REVISIT])
    assert left_by_odometry(graph) == 0.0
    assert left_by_odometry(graph_of([ConstraintKind.BRIDGE])) == 0.0
    turn = Pose.exp(np.array([0.0, 0.0, 0.0, 0.4, -0.2, 2.0]))
    for k in range(len(graph)):
        error = np.array([0.5, 0.5, 0.5, 1.0, 1.0, 1.0]) * generator.normal(0, 0.05, 6)
        graph.set_pose(k, turn @ graph.pose(k) @ Pose.exp(error))
    far = graph.pose(len(graph) - 1) @ Pose.exp(np.full(6, 1.0))
    without_last = left_by_odometry(graph)
    graph.set_pose(len(graph) - 1, far)
    assert left_by_odometry(graph) == without_last
    by_turns = 0.05**2 / 0.5**2 * 2.0 / 6.0  # about two axes, they move the end of the metre between, too
    assert 0.85 < without_last / (2.0 * 0.05**2 + by_turns) < 1.15
