"""Relative poses beside the points: they place what sees nothing, and leave alone what sees much."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.graph.test_points import largest_errors, problem_of, survey

from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.points import PointProblem, adjust_points
from overfly.graph.points_relative import RelativePoses, anchors, relative_poses, tied_nodes
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
@given(st.integers(0, 10_000), st.sampled_from([0.01, 1.0]))
def test_gradient_is_that_of_the_cost(seed: int, size: float) -> None:
    """At small errors, and beyond the bend of the robust cost."""
    generator = np.random.default_rng(seed)
    poses = [Pose.exp(generator.normal(0, 1, 6)) for _ in range(4)]
    relative = chain(poses, (0.1, 0.1), backwards=(1,))
    moved = [pose @ Pose.exp(0.01 * size * generator.normal(0, 1, 6)) for pose in poses]
    relative = replace(relative, information=relative.information / size**2)

    def arrays(at: list[Pose]) -> tuple[FloatArray, FloatArray]:
        return np.array([pose.rotation for pose in at]), np.array([pose.translation for pose in at])

    diagonal, off, gradient = np.zeros((4, 6, 6)), np.zeros((3, 6, 6)), np.zeros((4, 6))
    relative.add_to(*arrays(moved), np.arange(3), diagonal, off, gradient)
    step = generator.normal(0, 1, (4, 6))
    ahead, behind = (
        relative.cost(*arrays([pose @ Pose.exp(h * s) for pose, s in zip(moved, step, strict=True)]))
        for h in (1e-5, -1e-5)
    )
    measured = (ahead - behind) / 4e-5  # half the derivative: costs are squares
    assert abs(measured - np.sum(gradient * step)) < 0.05 * np.linalg.norm(gradient) * np.linalg.norm(step)
    assert np.linalg.norm(gradient) > 0.0
    whole = np.zeros((24, 24))
    for n in range(4):
        whole[6 * n : 6 * n + 6, 6 * n : 6 * n + 6] = diagonal[n]
    for n in range(3):
        whole[6 * n : 6 * n + 6, 6 * n + 6 : 6 * n + 12] = off[n]
        whole[6 * n + 6 : 6 * n + 12, 6 * n : 6 * n + 6] = off[n].T
    # All of it may be moved and turned as one.
    rigid = np.vstack([pose.inverse().adjoint() for pose in moved])
    assert np.abs(whole @ rigid).max() < 1e-9 * np.abs(whole).max() * np.abs(rigid).max() * 24
    assert np.linalg.eigvalsh(whole).min() > -1e-9 * np.abs(whole).max()


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
    relative = relative_poses(graph, np.arange(5), 1.0)
    assert relative.j.tolist() == [1, 3, 4]
    nothing = np.zeros(0, np.int64)
    seen_by = np.array([0, 1]), np.array([0, 0])
    free = np.zeros(5, np.bool_)
    assert np.flatnonzero(anchors(5, *seen_by, relative, free)).tolist() == [0, 2]
    assert np.flatnonzero(anchors(5, *seen_by, None, free)).tolist() == [0, 2, 3, 4]
    placed = np.array([False, False, True, True, False])
    assert np.flatnonzero(anchors(5, *seen_by, relative, placed)).tolist() == [0]
    assert len(tied_nodes(graph_of([guess]))) == len(nothing)


def test_lengths_follow_the_size_of_the_map() -> None:
    graph = graph_of([ConstraintKind.ODOMETRY])
    one, twice = (relative_poses(graph, np.arange(2), size) for size in (1.0, 2.0))
    np.testing.assert_allclose(twice.translations, 2.0 * one.translations)
    error = np.array([0.1, 0.1, 0.1, 0.01, 0.01, 0.01])
    longer = error * [2.0, 2.0, 2.0, 1.0, 1.0, 1.0]
    np.testing.assert_allclose(longer @ twice.information[0] @ longer, error @ one.information[0] @ error)
    # Information 4 of half a rotation vector is 1 of it.
    np.testing.assert_allclose(one.information[0], np.diag([4.0] * 3 + [1.0] * 3))


@given(st.floats(0.5, 2.0))
@settings(max_examples=20, deadline=None)
def test_how_much_longer_ways_are_than_measured(factor: float) -> None:
    """One way measured wrongly by metres does not decide."""
    poses, _ = survey(3, 4, 5)
    relative = chain(poses, (1.0, 0.1), backwards=(2, 5))
    relative.translations[4] += 300.0
    rotations = np.array([pose.rotation for pose in poses])
    translations = factor * np.array([pose.translation for pose in poses])
    assert abs(relative.growth(rotations, translations) / factor - 1.0) < 0.05
