"""All poses and points of a map adjusted together: as exact as the measurements, and no more."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.points import adjust_points
from overfly.graph.points_influence import correlated_covariance, shared_influence
from overfly.graph.points_kernels import HUBER
from overfly.graph.points_priors import LEVEL
from overfly.graph.points_problem import PointProblem, PointSolution, Shared

DOWN = np.diag([1.0, -1.0, -1.0])
HEIGHT_M = 10.0


def survey(n_lines: int, n_columns: int, seed: int) -> tuple[list[Pose], FloatArray]:
    """Cameras over rough ground on a grid with two thirds of overlap, and points on the ground."""
    generator = np.random.default_rng(seed)
    poses = []
    for line in range(n_lines):
        for column in range(n_columns):
            tilt = Pose.exp(np.concatenate([np.zeros(3), generator.normal(0, 0.05, 3)]))
            at = np.array([3.0 * column, 3.0 * line, HEIGHT_M + generator.normal(0, 0.3)])
            poses.append(Pose(DOWN, at) @ tilt)
    size = np.array([3.0 * n_columns + 6.0, 3.0 * n_lines + 6.0])
    xy = generator.uniform(0, 1, (60 * n_lines * n_columns, 2)) * size - 4.5
    return poses, np.column_stack([xy, generator.normal(0, 0.5, len(xy))])


def seen(poses: list[Pose], points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Who sees what, by point then node, and the exact rays; points seen from one pose are left out."""
    rays = np.array([pose.inverse().transform(points) for pose in poses])
    rays = rays[:, :, :2] / rays[:, :, 2:]
    inside = (np.abs(rays) < 0.45).all(axis=2)
    inside[:, inside.sum(axis=0) < 2] = False
    point, node = np.nonzero(inside.T)
    return point, node, rays[node, point]


def problem_of(
    poses: list[Pose], points: FloatArray, sigma: float, seed: int, *, moved: float = 0.0
) -> PointProblem:
    """Rays with noise sigma; the estimate starts moved from the truth; the first pose holds frame and scale
    (by the second one's place)."""
    generator = np.random.default_rng(seed)
    point, node, rays = seen(poses, points)
    used, which = np.unique(point, return_inverse=True)
    start = [
        pose @ Pose.exp(moved * generator.normal(0, 1, 6) * [0.3, 0.3, 0.3, 0.02, 0.02, 0.02])
        for pose in poses
    ]
    n = len(poses)
    position = np.array([pose.translation for pose in poses])
    position_sigma = np.full((n, 3), math.inf)
    position_sigma[[0, n - 1]] = 1e-4
    position_sigma[n // 2] = 1e-4
    return PointProblem(
        np.array([pose.rotation for pose in start]),
        np.array([pose.translation for pose in start]),
        np.zeros(n, np.bool_),
        points[used] + moved * generator.normal(0, 0.3, (len(used), 3)),
        np.searchsorted(which, np.arange(len(used) + 1)),
        node,
        rays + generator.normal(0, sigma, rays.shape),
        np.full(len(rays), max(sigma, 1e-3)),
        np.full(len(rays), np.nan),
        1.0,
        np.array([pose.rotation for pose in poses]),
        np.full(n, math.inf),
        np.zeros(n),
        np.full(n, math.inf),
        position,
        position_sigma,
        math.inf,
    )


def largest_errors(solution: PointSolution, poses: list[Pose]) -> tuple[float, float]:
    """Metres and radians."""
    found = [Pose(R, t) for R, t in zip(solution.rotations, solution.translations, strict=True)]
    apart = np.array([(true.inverse() @ one).log() for true, one in zip(poses, found, strict=True)])
    return float(np.linalg.norm(apart[:, :3], axis=1).max()), float(
        np.linalg.norm(apart[:, 3:], axis=1).max()
    )


@pytest.mark.parametrize("seed", range(3))
def test_exact_measurements_give_exact_poses(seed: int) -> None:
    poses, points = survey(3, 4, seed)
    solution = adjust_points(problem_of(poses, points, 0.0, seed, moved=1.0), iterations=60)
    assert solution is not None
    metres, radians = largest_errors(solution, poses)
    assert metres < 1e-3
    assert radians < 1e-4
    assert solution.cost[1] < 1e-6 * solution.cost[0]


def test_noise_goes_into_poses_as_much_as_it_must() -> None:
    """A hundred observations a node at 1 mrad: a centimetre or so at 10 m, neither none nor ten."""
    poses, points = survey(3, 4, 5)
    solution = adjust_points(problem_of(poses, points, 1e-3, 6, moved=0.3))
    assert solution is not None
    metres, radians = largest_errors(solution, poses)
    assert 1e-3 < metres < 0.1
    assert 1e-4 < radians < 0.01
    views = 2.0 * len(solution.error) - 3.0 * len(solution.points) - 6.0 * len(poses)
    assert 0.85 < solution.cost[1] / views < 1.1  # what is left is the noise, by degrees of freedom


def test_outliers_hardly_count() -> None:
    poses, points = survey(3, 3, 7)
    problem = problem_of(poses, points, 1e-3, 8)
    wrong = np.random.default_rng(9).choice(len(problem.rays), len(problem.rays) // 50, replace=False)
    problem.rays[wrong] += 0.05
    solution = adjust_points(problem)
    assert solution is not None
    assert largest_errors(solution, poses)[0] < 0.2  # a quadratic cost: above a metre
    assert np.median(solution.error[wrong]) > 10.0


def test_the_same_minimum_as_a_dense_solver() -> None:
    """A twin that knows nothing of elimination: SciPy on all unknowns, with the same robust loss."""
    poses, points = survey(2, 2, 11)
    problem = problem_of(poses, points[::6], 2e-3, 12, moved=0.1)
    problem = replace(problem, relief=0.05, tilt_sigma=np.full(4, 0.02), tilt_bias_sigma=0.01)
    solution = adjust_points(problem, iterations=100)
    assert solution is not None
    which = np.repeat(np.arange(len(problem.points)), np.diff(problem.starts))
    first = problem.node[problem.starts[:-1]]

    def residuals(x: FloatArray) -> FloatArray:
        steps, X, bias = x[:24].reshape(4, 6), x[24:-2].reshape(-1, 3), x[-2:]
        now = [
            Pose(R, t) @ Pose.exp(step)
            for R, t, step in zip(solution.rotations, solution.translations, steps, strict=True)
        ]
        R, t = np.array([p.rotation for p in now]), np.array([p.translation for p in now])
        local = np.einsum("kji,kj->ki", R[problem.node], X[which] - t[problem.node])
        r = (local[:, :2] / local[:, 2:] - problem.rays) / problem.sigma[:, None]
        length = np.linalg.norm(r, axis=1)
        far = length > HUBER
        r[far] *= (np.sqrt(2 * HUBER * length[far] - HUBER**2) / length[far])[:, None]
        tilt = np.einsum("nij,nj->ni", problem.level_from_cam, R[:, 2])[:, :2] - bias
        there = np.isfinite(problem.position_sigma[:, 0])
        return np.concatenate(
            [
                r.ravel(),
                (tilt / problem.tilt_sigma[:, None]).ravel(),
                bias / problem.tilt_bias_sigma,
                ((t - problem.position) / problem.position_sigma)[there].ravel(),
                X[:, 2] / (problem.relief * t[first, 2]),
            ]
        )

    x = np.concatenate([np.zeros(24), solution.points.ravel(), solution.tilt_bias])
    at_ours = float(np.sum(residuals(x) ** 2))
    assert at_ours == pytest.approx(solution.cost[1], rel=1e-9)
    best = least_squares(residuals, x, method="trf", max_nfev=30)
    assert 2.0 * best.cost == pytest.approx(at_ours, rel=1e-4)


def test_a_wrong_focal_length_is_found_with_its_deviation() -> None:
    poses, points = survey(3, 4, 13)
    problem = problem_of(poses, points, 1e-3, 14)
    measured = problem.rays
    shared = Shared(
        np.zeros(1),
        np.array([0.2]),
        lambda x: (measured * 1.04 / (1.0 + x[0]), np.full(len(measured), 1.04 / (1.0 + x[0]))),
    )
    solution = adjust_points(replace(problem, shared=shared), iterations=60)
    assert solution is not None
    deviation = math.sqrt(solution.shared_covariance[0, 0])
    assert 1e-4 < deviation < 0.01
    assert abs(solution.shared[0] - 0.04) < 4.0 * deviation


def test_what_the_attitude_sensor_is_off_by_is_found() -> None:
    """Seen against positions, which know what is level."""
    poses, points = survey(3, 4, 15)
    problem = problem_of(poses, points, 1e-3, 16)
    off = Pose.exp(np.array([0, 0, 0, 0.01, -0.02, 0.0])).rotation
    problem = replace(
        problem,
        level_from_cam=off @ np.array([DOWN.T @ np.eye(3) @ DOWN @ pose.rotation for pose in poses]),
        tilt_sigma=np.full(len(poses), 0.01),
        tilt_bias_sigma=0.1,
    )
    solution = adjust_points(problem)
    assert solution is not None
    expected = (off @ np.array([0.0, 0.0, 1.0]))[:2]
    np.testing.assert_allclose(solution.tilt_bias, expected, atol=2e-3)
    assert np.linalg.norm(expected) > 0.02


def test_how_much_too_high_positions_are_is_found() -> None:
    """Against the ground, which is at zero; held to be nothing, they would lift the ground."""
    poses, points = survey(3, 4, 19)
    problem = problem_of(poses, points, 1e-3, 20)
    sigma = np.full((len(poses), 3), 0.01)
    high = problem.position + np.array([0.0, 0.0, 2.0])
    problem = replace(problem, position=high, position_sigma=sigma, relief=0.05)
    solution = adjust_points(replace(problem, level_sigma=30.0))
    held = adjust_points(problem)
    assert solution is not None
    assert held is not None
    assert solution.common[LEVEL] == pytest.approx(2.0, abs=0.05)
    assert held.common[LEVEL] == pytest.approx(0.0, abs=1e-6)
    assert largest_errors(solution, poses)[0] < 0.1
    assert largest_errors(held, poses)[0] > 1.0


def test_nothing_to_hold_the_map_is_no_crash() -> None:
    """Without an anchor, a position or a tilt the map is soft as a whole; damping keeps it where it is."""
    poses, points = survey(2, 2, 17)
    problem = problem_of(poses, points, 0.0, 18)
    problem = replace(problem, position_sigma=np.full((4, 3), math.inf))
    solution = adjust_points(problem)
    assert solution is not None
    assert largest_errors(solution, poses)[0] < 1e-3


def focal_length(problem: PointProblem) -> Shared:
    """The rays' focal length as the unknown, expected at 0 to a fifth."""
    measured = problem.rays
    return Shared(
        np.zeros(1),
        np.array([0.2]),
        lambda x: (measured / (1.0 + x[0]), np.full(len(measured), 1.0 / (1.0 + x[0]))),
    )


def focal_errors(alike: float, n_seeds: int) -> tuple[FloatArray, FloatArray]:
    """Errors of the focal length (n,) in the deviations of independent and of correlated errors. alike: share
    of the variance that points on the same square of ground seen from the same pose have in common."""
    formal, correlated = [], []
    for seed in range(n_seeds):
        poses, points = survey(3, 4, seed)
        problem = problem_of(poses, points, 1e-3, 50 + seed)
        _, _, exact = seen(poses, points)
        square = np.floor(problem.points[:, :2] / 3.0).astype(np.int64)
        which = np.repeat(np.arange(len(square)), np.diff(problem.starts))
        keys = np.column_stack([square[which], problem.node])
        _, group = np.unique(keys, axis=0, return_inverse=True)
        common = np.random.default_rng(seed).normal(0, 1e-3, (group.max() + 1, 2))[group.ravel()]
        noise = math.sqrt(1.0 - alike) * (problem.rays - exact) + math.sqrt(alike) * common
        problem = replace(problem, rays=exact + noise)
        problem = replace(problem, shared=focal_length(problem))
        solution = adjust_points(problem)
        assert solution is not None
        formal.append(solution.shared[0] / math.sqrt(solution.shared_covariance[0, 0]))
        correlated.append(solution.shared[0] / math.sqrt(correlated_covariance(problem, solution)[0, 0]))
    return np.array(formal), np.array(correlated)


def test_errors_that_neighbours_share_make_the_focal_length_less_certain() -> None:
    formal, correlated = focal_errors(0.9, 12)
    assert np.mean(formal**2) > 2.5  # as if all were independent: far too sure
    assert 0.3 < np.mean(correlated**2) < 2.5
    formal, correlated = focal_errors(0.0, 6)
    assert 0.2 < np.mean(correlated**2) / np.mean(formal**2) <= 1.0  # and where they are, it costs little


def solved_to_the_end(problem: PointProblem) -> PointSolution:
    """Steps until nothing moves any more: each call of the solver makes one at least."""
    shared = problem.shared
    assert shared is not None
    for _ in range(8):
        solution = adjust_points(problem)
        assert solution is not None
        problem = replace(
            problem, rotations=solution.rotations, translations=solution.translations,
            points=solution.points, shared=replace(shared, start=solution.shared),
        )  # fmt: skip
    return solution


def test_what_each_observation_moves_an_unknown_by() -> None:
    """Against solving again with one residual a quarter larger."""
    poses, points = survey(2, 3, 21)
    problem = problem_of(poses, points[::3], 1e-3, 22)
    problem = replace(problem, shared=focal_length(problem))
    solution = solved_to_the_end(problem)
    influence = shared_influence(problem, solution)
    assert influence is not None
    which = np.repeat(np.arange(len(problem.points)), np.diff(problem.starts))
    away = solution.points[which] - solution.translations[problem.node]
    local = np.einsum("kji,kj->ki", solution.rotations[problem.node], away)
    predicted = local[:, :2] / local[:, 2:] * (1.0 + solution.shared[0])
    deviation = math.sqrt(solution.shared_covariance[0, 0])
    inside = np.where(solution.error < 0.75 * HUBER, np.abs(influence[0]), 0.0)
    for k in np.argsort(-inside)[:3].tolist():
        rays = problem.rays.copy()
        rays[k] += 0.25 * (rays[k] - predicted[k])
        nudged = replace(problem, rays=rays)
        again = solved_to_the_end(replace(nudged, shared=focal_length(nudged)))
        moved = (again.shared[0] - solution.shared[0]) / 0.25 / deviation
        assert moved == pytest.approx(influence[0, k], rel=0.1)


def test_a_camera_straight_down_at_one_height_does_not_tell_its_focal_length() -> None:
    """Flat ground, level camera, positions: the ground may lie deeper and the focal length be longer."""
    poses, points = survey(3, 4, 23)
    level = [Pose(DOWN, pose.translation * [1.0, 1.0, 0.0] + [0.0, 0.0, HEIGHT_M]) for pose in poses]
    problem = problem_of(level, points * [1.0, 1.0, 0.0], 1e-3, 24)
    held = replace(problem, shared=focal_length(problem))
    solution = adjust_points(held)
    assert solution is not None
    assert 0.1 < math.sqrt(correlated_covariance(held, solution)[0, 0]) < 0.3  # what was expected: 0.2
