"""How sure adjusted poses are when neighbours err alike: by leaving patches of ground out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.graph.test_points import focal_length, problem_of, seen, survey

from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.points import (
    _evaluated,
    _factor,
    _find_pattern,
    _normal_equations,
    _State,
    adjust_points,
)
from overfly.graph.points_influence import ground_patches
from overfly.graph.points_jackknife import (
    _influence,
    _inverse,
    _move_without,
    _pairs,
    _patches,
    jackknife_covariance,
)
from overfly.graph.points_problem import PointProblem, PointSolution
from overfly.types import BoolArray, IntArray


def independent_covariance(problem: PointProblem, solution: PointSolution, nodes: IntArray) -> FloatArray:
    """(6 k, 6 k) of poses, as if every observation erred by itself."""
    pattern, state = _find_pattern(problem), at_solution(problem, solution)
    system = _normal_equations(problem, pattern, state, 0.0)
    factor = _factor(pattern, system, 0.0)
    assert factor is not None
    by_border = factor.solve(system.border)
    corner = np.linalg.pinv(system.corner - np.einsum("ndp,ndq->pq", system.border, by_border))
    border = by_border[nodes].reshape(6 * len(nodes), -1)
    return np.asarray(factor.inverse_blocks(nodes) + border @ corner @ border.T)


def at_solution(problem: PointProblem, solution: PointSolution) -> _State:
    return _evaluated(
        problem, solution.rotations, solution.translations, solution.points, solution.common, solution.shared
    )


def errors(solution: PointSolution, poses: list[Pose], nodes: IntArray) -> FloatArray:
    """(6 k,) that take the true poses to the solution's, in their own axes."""
    found = [Pose(solution.rotations[n], solution.translations[n]) for n in nodes]
    return np.concatenate([(poses[n].inverse() @ one).log() for n, one in zip(nodes, found, strict=True)])


def erring_alike(problem: PointProblem, exact: FloatArray, alike: float, seed: int) -> PointProblem:
    """The same rays with as much noise, of which the share alike of the variance is common to what a pose
    sees of a square of the ground, 1 m wide; patches are three."""
    square = np.floor(problem.points[:, :2] + 0.37).astype(np.int64)
    which = np.repeat(np.arange(len(square)), np.diff(problem.starts))
    keys = np.column_stack([square[which], problem.node])
    _, group = np.unique(keys, axis=0, return_inverse=True)
    common = np.random.default_rng(seed).normal(0, 1e-3, (group.max() + 1, 2))[group.ravel()]
    noise = np.sqrt(1.0 - alike) * (problem.rays - exact) + np.sqrt(alike) * common
    return replace(problem, rays=exact + noise)


def squared_errors(alike: float, n_seeds: int) -> tuple[FloatArray, FloatArray]:
    """Normalised errors squared, per degree of freedom, of single poses (n,): if observations were
    independent, and by leaving patches out."""
    independent, honest = [], []
    for seed in range(n_seeds):
        poses, points = survey(4, 6, seed)
        _, _, exact = seen(poses, points)
        problem = erring_alike(problem_of(poses, points, 1e-3, 50 + seed), exact, alike, seed)
        solution = adjust_points(problem)
        assert solution is not None
        free = np.setdiff1d(np.arange(len(poses)), [0, len(poses) // 2, len(poses) - 1])  # given in place
        error = errors(solution, poses, free).reshape(-1, 6)
        for values, covariance in (
            (independent, independent_covariance(problem, solution, free)),
            (honest, jackknife_covariance(problem, solution, free)),
        ):
            blocks = covariance.reshape(len(free), 6, len(free), 6)[
                np.arange(len(free)), :, np.arange(len(free))
            ]
            values.append(
                np.einsum("ka,ka->k", error, np.linalg.solve(blocks, error[:, :, None])[:, :, 0]) / 6
            )
    return np.concatenate(independent), np.concatenate(honest)


def test_poses_are_as_sure_as_is_said_where_neighbours_err_alike() -> None:
    independent, honest = squared_errors(0.9, 8)
    assert independent.mean() > 2.2
    assert 0.6 < honest.mean() < 1.6


def test_and_where_they_do_not_it_costs_little() -> None:
    independent, honest = squared_errors(0.0, 8)
    assert 0.8 < independent.mean() < 1.3
    assert 0.6 < honest.mean() < 1.4


def converged(problem: PointProblem) -> tuple[PointProblem, PointSolution]:
    """Solved until nothing moves, and the problem that starts there."""
    for _ in range(6):
        solution = adjust_points(problem)
        assert solution is not None
        shared = None if problem.shared is None else replace(problem.shared, start=solution.shared)
        problem = replace(
            problem, rotations=solution.rotations, translations=solution.translations, points=solution.points,
            shared=shared,
        )  # fmt: skip
    return problem, solution


def without(problem: PointProblem, left_out: BoolArray) -> PointProblem:
    """The problem without some of the points (m,)."""
    views = np.diff(problem.starts)
    rows = ~np.repeat(left_out, views)
    fewer = replace(
        problem, points=problem.points[~left_out], starts=np.append(0, np.cumsum(views[~left_out])),
        node=problem.node[rows], rays=problem.rays[rows], sigma=problem.sigma[rows],
        inverse_depth=problem.inverse_depth[rows], inverse_depth_sigma=problem.inverse_depth_sigma,
    )  # fmt: skip
    return fewer if problem.shared is None else replace(fewer, shared=focal_length(fewer))


@pytest.mark.parametrize(("relief", "refined"), [(np.inf, False), (0.1, False), (np.inf, True)])
def test_a_patch_left_out_moves_the_poses_as_solving_without_it_does(relief: float, refined: bool) -> None:
    """In one step of Gauss and Newton, which solving to the end without it hardly differs from."""
    poses, points = survey(3, 4, 5)
    nodes = np.arange(len(poses))
    problem = problem_of(poses, points, 1e-4, 7)
    problem = replace(problem, relief=relief, shared=focal_length(problem) if refined else None)
    problem, solution = converged(problem)  # no residual is large enough for Huber
    state, labels = at_solution(problem, solution), ground_patches(solution)
    patches = list(_patches(problem, state, labels))
    pattern = _find_pattern(problem, np.concatenate([_pairs(patch.nodes) for patch in patches]))
    system = _normal_equations(problem, pattern, state, 0.0)
    factor = _factor(pattern, system, 0.0)
    assert factor is not None
    inverse = _inverse(pattern, factor, system, problem.n_common)
    influence = _influence(factor, inverse, nodes)
    assert len(patches) == len(np.unique(labels)) > 20
    largest = np.argsort([-len(patch.nodes) for patch in patches])[:4]
    for number in largest.tolist():
        predicted = _move_without(patches[number], inverse, *influence)
        _, again = converged(without(problem, labels == np.unique(labels)[number]))
        before = [Pose(R, t) for R, t in zip(solution.rotations, solution.translations, strict=True)]
        moved = errors(again, before, nodes)
        np.testing.assert_allclose(predicted, moved, atol=0.05 * np.abs(moved).max())
