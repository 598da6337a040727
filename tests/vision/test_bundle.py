"""Bundle adjustment against a general solver on a small problem, and against exact truth."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from overfly.geometry.poses import FloatArray, Pose, vector_from_rotation
from overfly.vision.bundle import BundleProblem, BundleSolution, adjust
from overfly.vision.bundle_kernels import HUBER, _residuals

from .scenes import (
    CAMERA,
    camera_pose,
    chi_square_bounds,
    ground_in_view,
    level,
    normalised_squared_errors,
    pose_error,
    rays_of,
)

SIGMA = 0.3 / CAMERA.focal_px
DEPTH_SIGMA = 0.02  # 1/m
TILT_SIGMA = 0.005
HEIGHT_SIGMA = 0.02
RELIEF = 0.025


def line_of_nodes(rng: np.random.Generator, count: int) -> list[Pose]:
    return [
        camera_pose(
            0.25 * n, 0.05 * rng.normal(), 2.0 + 0.05 * rng.normal(), *rng.uniform(-0.05, 0.05, 2), 0.05 * n
        )
        for n in range(count)
    ]


def exact_problem(seed: int, nodes: int = 4, points: int = 40, *, stereo: bool, fixed: int) -> BundleProblem:
    """All that is measured is exact; the first ``fixed`` nodes do not move."""
    rng = np.random.default_rng(seed)
    poses = line_of_nodes(rng, nodes)
    world = ground_in_view(rng, poses[nodes // 2], points, 0.05)
    node, point = np.meshgrid(np.arange(nodes), np.arange(points))
    node, point = node.ravel(), point.ravel()
    rays = np.array([rays_of(poses[n], world[[m]])[0] for n, m in zip(node, point, strict=True)])
    depth = np.array([poses[n].inverse().transform(world[m])[2] for n, m in zip(node, point, strict=True)])
    mono = np.full(len(node), np.nan)
    tilts = [pose.rotation.T @ np.array([0.0, 0.0, 1.0]) for pose in poses]
    levels = np.array([_level_of(up) for up in tilts])
    return BundleProblem(
        rotations=np.array([pose.rotation for pose in poses]),
        translations=np.array([pose.translation for pose in poses]),
        free=np.arange(nodes) >= fixed,
        points=world,
        node=node,
        point=point,
        rays=rays,
        sigma=np.full(len(node), SIGMA),
        inverse_depth=1.0 / depth if stereo else mono,
        inverse_depth_sigma=DEPTH_SIGMA,
        level_from_cam=levels,
        tilt_sigma=np.full(nodes, TILT_SIGMA),
        height=np.array([pose.translation[2] for pose in poses]),
        height_sigma=np.full(nodes, HEIGHT_SIGMA),
        relief=math.inf if stereo else RELIEF,
        anchor=0 if fixed == 0 else -1,
    )


def _level_of(up: FloatArray) -> FloatArray:
    """A rotation that takes ``up``, seen in the camera, to (0, 0, 1)."""
    side = np.cross([0.0, 1.0, 0.0], up)
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(up, side), up])


def noisy(problem: BundleProblem, rng: np.random.Generator) -> BundleProblem:
    """The same with every measurement disturbed by its own sigma."""
    count = len(problem.node)
    turns = rng.normal(0.0, 1.0, (len(problem.free), 3)) * TILT_SIGMA
    turns[:, 2] = 0.0
    return replace(
        problem,
        rays=problem.rays + rng.normal(0.0, 1.0, (count, 2)) * problem.sigma[:, None],
        inverse_depth=problem.inverse_depth + rng.normal(0.0, DEPTH_SIGMA, count),
        height=problem.height + rng.normal(0.0, 1.0, len(problem.free)) * HEIGHT_SIGMA,
        level_from_cam=np.array(
            [
                Pose.exp(np.concatenate([np.zeros(3), turn])).rotation @ level_
                for turn, level_ in zip(turns, problem.level_from_cam, strict=True)
            ]
        ),
    )


def displaced(problem: BundleProblem, rng: np.random.Generator, size: float = 1.0) -> BundleProblem:
    """The same problem, begun elsewhere; what is held stays."""
    rotations, translations = problem.rotations.copy(), problem.translations.copy()
    for n in np.flatnonzero(problem.free):
        step = rng.normal(0.0, 1.0, 6) * [0.02, 0.02, 0.02, 0.005, 0.005, 0.005] * size
        if n == problem.anchor:
            step[:] = 0.0
        moved = Pose(rotations[n], translations[n]) @ Pose.exp(step)
        rotations[n], translations[n] = moved.rotation, moved.translation
    points = problem.points + rng.normal(0.0, 0.02 * size, problem.points.shape)
    return replace(problem, rotations=rotations, translations=translations, points=points)


def solved(problem: BundleProblem) -> BundleSolution:
    solution = adjust(problem)
    assert solution is not None
    return solution


def truth_of(problem: BundleProblem) -> list[Pose]:
    return [Pose(r, t) for r, t in zip(problem.rotations, problem.translations, strict=True)]


@pytest.mark.parametrize("stereo", [True, False])
@pytest.mark.parametrize("fixed", [0, 2])
def test_exact_data_stay_exact(stereo: bool, fixed: int) -> None:
    exact = exact_problem(1, stereo=stereo, fixed=fixed)
    if not stereo:  # the ground is flat then, as the prior says
        flat = exact.points * [1, 1, 0]
        rays = np.array(
            [rays_of(truth_of(exact)[n], flat[[m]])[0] for n, m in zip(exact.node, exact.point, strict=True)]
        )
        exact = replace(exact, points=flat, rays=rays)
    solution = solved(exact)
    assert solution.cost[0] < 1e-12
    for pose, truth in zip(solution.poses, truth_of(exact), strict=True):
        np.testing.assert_allclose(pose_error(pose, truth), np.zeros(6), atol=1e-8)
    back = solved(displaced(exact, np.random.default_rng(1)))
    assert back.cost[0] > 100
    assert back.cost[1] < 1e-3
    for pose, truth in zip(back.poses, truth_of(exact), strict=True):
        np.testing.assert_allclose(pose_error(pose, truth), np.zeros(6), atol=2e-4)
    np.testing.assert_allclose(back.points, exact.points, atol=1e-3)


@pytest.mark.parametrize("stereo", [True, False])
def test_jacobians_against_differences(stereo: bool) -> None:
    rng = np.random.default_rng(3)
    pose = camera_pose(0.1, 0.2, 2.0, 0.1, -0.2, 0.5)
    point = np.array([0.3, -0.1, 0.05])
    seen = pose.inverse().transform(point)
    ray = seen[:2] / seen[2] + rng.normal(0, 1e-4, 2)  # well inside Huber's limit
    inverse = 1.0 / seen[2] + 1e-3 if stereo else math.nan

    def residual(camera: Pose, at: FloatArray) -> FloatArray:
        r, by_pose, by_point = np.zeros(3), np.zeros((3, 6)), np.zeros((3, 3))
        _residuals(
            camera.rotation,
            camera.translation,
            at,
            ray,
            inverse,
            1 / SIGMA,
            1 / DEPTH_SIGMA,
            r,
            by_pose,
            by_point,
        )
        return r

    r, by_pose, by_point = np.zeros(3), np.zeros((3, 6)), np.zeros((3, 3))
    cost, error = _residuals(
        pose.rotation, pose.translation, point, ray, inverse, 1 / SIGMA, 1 / DEPTH_SIGMA, r, by_pose, by_point
    )
    assert cost == pytest.approx(float(r @ r))
    assert error == pytest.approx(float(np.linalg.norm(r[:2])))
    step = 1e-7
    for axis in range(6):
        tangent = step * np.eye(6)[axis]
        numeric = (residual(pose @ Pose.exp(tangent), point) - residual(pose @ Pose.exp(-tangent), point)) / (
            2 * step
        )
        np.testing.assert_allclose(by_pose[:, axis], numeric, rtol=1e-4, atol=1e-3)
    for axis in range(3):
        move = step * np.eye(3)[axis]
        numeric = (residual(pose, point + move) - residual(pose, point - move)) / (2 * step)
        np.testing.assert_allclose(by_point[:, axis], numeric, rtol=1e-4, atol=1e-3)


def twin_residuals(problem: BundleProblem, x: FloatArray) -> FloatArray:
    """Every term of the cost as a residual vector; squared and added they are the cost, Huber left out."""
    free = np.flatnonzero(problem.free)
    poses = truth_of(problem)
    for slot, n in enumerate(free):
        poses[n] = poses[n] @ Pose.exp(x[6 * slot : 6 * slot + 6])
    points = problem.points + x[6 * len(free) :].reshape(-1, 3)
    out: list[float] = []
    for k, (n, m) in enumerate(zip(problem.node, problem.point, strict=True)):
        seen = poses[n].inverse().transform(points[m])
        out += list((seen[:2] / seen[2] - problem.rays[k]) / problem.sigma[k])
        if math.isfinite(problem.inverse_depth[k]):
            out.append((1 / seen[2] - problem.inverse_depth[k]) / problem.inverse_depth_sigma)
    for n in free:
        up = problem.level_from_cam[n] @ poses[n].rotation[2]
        out += list(up[:2] / problem.tilt_sigma[n])
        out.append((poses[n].translation[2] - problem.height[n]) / problem.height_sigma[n])
    if math.isfinite(problem.relief):
        first_seen_by = [
            poses[problem.node[np.flatnonzero(problem.point == m)[0]]] for m in range(len(points))
        ]
        heights = np.array([pose.translation[2] for pose in first_seen_by])
        out += list(points[:, 2] / heights / problem.relief)
    return np.array(out)


@pytest.mark.parametrize("stereo", [True, False])
def test_a_general_solver_finds_the_same(stereo: bool) -> None:
    """Noise of half a sigma: hardly a residual reaches Huber's limit, so plain least squares is the same."""
    rng = np.random.default_rng(8)
    exact = exact_problem(8, nodes=3, points=12, stereo=stereo, fixed=1)
    calm = noisy(exact, rng)
    calm = replace(calm, rays=exact.rays + 0.5 * (calm.rays - exact.rays))
    solution = solved(calm)
    size = 6 * int(calm.free.sum()) + 3 * len(calm.points)
    twin = least_squares(lambda x: twin_residuals(calm, x), np.zeros(size), xtol=1e-12, ftol=1e-12)
    assert solution.cost[1] == pytest.approx(2.0 * twin.cost, rel=1e-3)
    free = np.flatnonzero(calm.free)
    jacobian = twin.jac
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    poses_size = 6 * len(free)
    sigma = np.sqrt(np.diag(covariance))
    for slot, n in enumerate(free):
        expected = truth_of(calm)[n] @ Pose.exp(twin.x[6 * slot : 6 * slot + 6])
        off = pose_error(solution.poses[n], expected) / sigma[6 * slot : 6 * slot + 6]
        assert np.abs(off).max() < 0.05
    relative = np.abs(solution.pose_covariance - covariance[:poses_size, :poses_size])
    relative /= np.outer(sigma[:poses_size], sigma[:poses_size])
    assert relative.max() < 0.02
    points = calm.points + twin.x[poses_size:].reshape(-1, 3)
    assert (np.abs(solution.points - points).ravel() / sigma[poses_size:]).max() < 0.05


def test_the_anchor_keeps_its_place_and_heading() -> None:
    exact = exact_problem(2, stereo=True, fixed=0)
    rng = np.random.default_rng(2)
    solution = solved(displaced(noisy(exact, rng), rng))
    world = solution.poses[0].translation - exact.translations[0]
    turned = vector_from_rotation(solution.poses[0].rotation @ exact.rotations[0].T)
    assert np.abs(world[:2]).max() < 1e-6
    assert 1e-5 < abs(world[2]) < 3 * HEIGHT_SIGMA
    assert 1e-5 < np.abs(turned[:2]).max() < 3 * TILT_SIGMA
    assert abs(turned[2]) < float(turned[:2] @ turned[:2]) + 1e-7  # what two tilts in a row turn, no more


def test_fixed_nodes_do_not_move() -> None:
    exact = exact_problem(3, stereo=True, fixed=2)
    rng = np.random.default_rng(3)
    solution = solved(displaced(noisy(exact, rng), rng))
    for n in (0, 1):
        np.testing.assert_allclose(solution.poses[n].translation, exact.translations[n], atol=1e-14)
        np.testing.assert_allclose(solution.poses[n].rotation, exact.rotations[n], atol=1e-12)
    assert solution.pose_covariance.shape == (12, 12)


@pytest.mark.parametrize("fixed", [0, 1])
def test_covariance_is_honest(fixed: int) -> None:
    """Joint error of all free nodes over 80 draws; the anchor's held directions carry none."""
    squares, degrees = [], 0
    for seed in range(80):
        exact = exact_problem(100 + seed, nodes=3, points=25, stereo=True, fixed=fixed)
        solution = solved(noisy(exact, np.random.default_rng(seed)))
        truth = truth_of(exact)
        error = np.concatenate([pose_error(solution.poses[n], truth[n]) for n in np.flatnonzero(exact.free)])
        covariance = solution.pose_covariance
        if fixed == 0:  # leave out the held ones: rotate to world axes and take what is free
            turn = np.eye(len(error))
            turn[:3, :3] = turn[3:6, 3:6] = exact.rotations[0]
            rows = np.array([2, 3, 4, *range(6, len(error))])
            error, covariance = (turn @ error)[rows], (turn @ covariance @ turn.T)[np.ix_(rows, rows)]
        squares.append(normalised_squared_errors(error[None], covariance[None])[0])
        degrees = len(error)
    low, high = chi_square_bounds(80 * degrees)
    # Huber at two sigmas gives away a few percent of what Gaussian noise would allow
    assert 0.93 * low < np.mean(squares) / degrees < 1.07 * high


def test_points_know_their_accuracy_given_the_poses() -> None:
    exact = exact_problem(5, stereo=True, fixed=4)
    held = replace(exact, free=np.array([False, False, False, True]))
    squares = []
    for seed in range(30):
        disturbed = noisy(held, np.random.default_rng(seed))
        # the one free node is told where it is
        firm = replace(disturbed, free=np.array([False, False, False, True]))
        solution = solved(firm)
        squares.append(normalised_squared_errors(solution.points - exact.points, solution.point_covariance))
    mean = float(np.mean(squares)) / 3
    assert 0.85 < mean < 1.3  # a little above one: the covariance is conditional on the free node


def test_wrong_matches_pull_no_further_than_hubers_line() -> None:
    """Observations wrong by 40 and by 4000 sigmas do the same harm, and little."""
    exact = exact_problem(6, stereo=True, fixed=2)
    wrong = np.flatnonzero(exact.node == 3)[:4]
    harm = []
    for size in (40.0, 400.0):
        rays = exact.rays.copy()
        rays[wrong] += size * SIGMA
        solution = solved(replace(exact, rays=rays))
        harm.append(float(np.abs(pose_error(solution.poses[3], truth_of(exact)[3])).max()))
        assert (solution.residual[wrong] > 5).all()
        right = np.delete(np.arange(len(rays)), wrong)
        of_other_points = right[~np.isin(exact.point[right], exact.point[wrong])]
        assert solution.residual[of_other_points].max() < HUBER
    assert harm[1] < 2.0 * harm[0] + 1e-9
    assert harm[0] < 20 * SIGMA * 2.0


def test_a_range_that_is_an_echo_counts_less() -> None:
    """A metre off with a sigma of 2 cm: squared it would weigh as much as thousands of features."""
    exact = exact_problem(7, stereo=True, fixed=2)
    height = exact.height.copy()
    height[3] += 1.0
    lifted = solved(replace(exact, height=height))
    assert abs(lifted.poses[3].translation[2] - exact.translations[3][2]) < 0.01


def test_order_of_the_observations_does_not_matter() -> None:
    exact = exact_problem(9, stereo=True, fixed=1)
    disturbed = noisy(exact, np.random.default_rng(9))
    order = np.random.default_rng(0).permutation(len(exact.node))
    shuffled = replace(
        disturbed,
        node=disturbed.node[order],
        point=disturbed.point[order],
        rays=disturbed.rays[order],
        sigma=disturbed.sigma[order],
        inverse_depth=disturbed.inverse_depth[order],
    )
    one, other = solved(disturbed), solved(shuffled)
    np.testing.assert_allclose(other.points, one.points, atol=1e-9)
    np.testing.assert_allclose(other.residual, one.residual[order], atol=1e-6)


def test_the_adjustment_does_not_touch_what_it_is_given() -> None:
    problem = displaced(exact_problem(10, stereo=True, fixed=1), np.random.default_rng(1))
    before = [problem.rotations.copy(), problem.translations.copy(), problem.points.copy()]
    solved(problem)
    for kept, now in zip(before, (problem.rotations, problem.translations, problem.points), strict=True):
        np.testing.assert_array_equal(kept, now)


def test_level_helper_agrees_with_the_sensor() -> None:
    """The twin's tilt is the one that levelling gives, up to a yaw that the prior does not see."""
    pose = camera_pose(roll=0.1, pitch=-0.05, yaw=1.3)
    np.testing.assert_allclose(level(0.1, -0.05) @ pose.rotation[2], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(_level_of(pose.rotation[2]) @ pose.rotation[2], [0, 0, 1], atol=1e-12)
