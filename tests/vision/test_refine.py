"""Refinement: exact on exact data, honest about its accuracy, and better than an attitude taken for truth."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.geometry.poses import FloatArray, Pose
from overfly.vision.refine import HeightPrior, Refinement, TiltPrior, _add_points, refine_pose, turn_kernel

from .scenes import (
    CAMERA,
    camera_pose,
    chi_square_bounds,
    ground_in_view,
    level,
    normalised_squared_errors,
    pose_error,
    rays_of,
    sight,
)

SIGMA = 0.5 / CAMERA.focal_px
LIMITS = (8.0 / CAMERA.focal_px, 2.5 / CAMERA.focal_px)
WIDE = (math.inf, math.inf)
FREE = 10.0  # radians: a tilt sensor that says nothing


def refined(
    start: Pose,
    points: FloatArray,
    rays: FloatArray,
    tilt: TiltPrior,
    limits: tuple[float, float] = LIMITS,
    height: HeightPrior | None = None,
) -> Refinement:
    found = refine_pose(start, points, rays, SIGMA, limits, tilt, height)
    assert found is not None
    return found


@settings(max_examples=40)
@given(st.integers(0, 10**6), st.lists(st.floats(-1, 1), min_size=6, max_size=6))
def test_exact_data_give_the_exact_pose(seed: int, off: list[float]) -> None:
    scene = sight(seed, 40)
    start = scene.pose @ Pose.exp(np.array(off) * [0.03, 0.03, 0.03, 0.01, 0.01, 0.01])
    matches = scene.correspondences
    found = refined(start, matches.points, matches.rays, TiltPrior(scene.tilt, 0.01), WIDE)
    np.testing.assert_allclose(pose_error(found.world_from_cam, scene.pose), np.zeros(6), atol=1e-6)
    assert found.inliers.all()
    assert found.rms < 1e-6
    rotation = found.world_from_cam.rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_turn_is_the_exponential(vector: list[float]) -> None:
    rotation = camera_pose(roll=0.2, pitch=0.1, yaw=1.0).rotation
    expected = rotation @ Pose.exp(np.concatenate([np.zeros(3), vector])).rotation
    np.testing.assert_allclose(turn_kernel(rotation, np.array(vector)), expected, atol=1e-12)


def residuals(pose: Pose, points: FloatArray, rays: FloatArray, spread: FloatArray) -> FloatArray:
    """Whitened residuals (2 n,): by the inverse root of sigma^2 I + e e', e the image of the spread."""
    seen = pose.inverse().transform(points)
    moved = spread @ pose.rotation
    out = []
    for p, m, ray in zip(seen, moved, rays, strict=True):
        residual = p[:2] / p[2] - ray
        image = (m[:2] - p[:2] / p[2] * m[2]) / p[2]
        values, vectors = np.linalg.eigh(SIGMA**2 * np.eye(2) + np.outer(image, image))
        out.append(vectors @ np.diag(values**-0.5) @ vectors.T @ residual)
    return np.concatenate(out)


@pytest.mark.parametrize("spread_m", [0.0, 0.02, 0.3])
def test_gradient_and_information_against_differences(spread_m: float) -> None:
    """Small residuals, so that Huber counts them all fully and the whitening hardly depends on the pose."""
    rng = np.random.default_rng(4)
    pose = camera_pose(0.3, -0.2, 2.0, 0.1, -0.05, 0.7)
    points = ground_in_view(rng, pose, 12)
    spread = rng.normal(0.0, 1.0, (12, 3)) * spread_m
    rays = rays_of(pose, points) + rng.normal(0.0, 1e-5, (12, 2))
    information, gradient, inliers = np.zeros((6, 6)), np.zeros(6), np.zeros(12, np.bool_)
    cost, count = _add_points(
        pose.rotation, pose.translation, points, rays, spread, SIGMA, 1.0, information, gradient, inliers
    )
    assert count == 12 and inliers.all()
    information = np.triu(information) + np.triu(information, 1).T
    step = 1e-6
    columns = []
    for axis in np.eye(6):
        ahead = residuals(pose @ Pose.exp(step * axis), points, rays, spread)
        behind = residuals(pose @ Pose.exp(-step * axis), points, rays, spread)
        columns.append((ahead - behind) / (2 * step))
    jacobian = np.array(columns).T
    here = residuals(pose, points, rays, spread)
    assert cost == pytest.approx(here @ here, rel=1e-3, abs=1e-12)
    scale = np.abs(jacobian.T @ jacobian).max()
    np.testing.assert_allclose(information, jacobian.T @ jacobian, rtol=0, atol=2e-2 * scale)
    np.testing.assert_allclose(
        gradient, jacobian.T @ here, rtol=0, atol=2e-2 * math.sqrt(scale) * np.linalg.norm(here)
    )


def test_spread_frees_a_point_along_its_line_only() -> None:
    """Points moved along the spread that they admit to hardly disturb; moved across it they do."""
    rng = np.random.default_rng(9)
    pose = camera_pose(z=2.0)
    points = ground_in_view(rng, pose, 60)
    rays = rays_of(pose, points)
    uncertain = np.arange(60) < 30
    along = np.zeros((60, 3))
    along[uncertain] = np.array([0.1, 0.0, 0.0])
    moved = points + along
    tilt = TiltPrior(level(), FREE)
    trusting = refine_pose(pose, moved, rays, SIGMA, WIDE, tilt)
    knowing = refine_pose(pose, moved, rays, SIGMA, WIDE, tilt, spread=along)
    across = refine_pose(pose, moved, rays, SIGMA, WIDE, tilt, spread=along[:, [1, 0, 2]])
    assert trusting is not None and knowing is not None and across is not None
    errors = [np.linalg.norm(pose_error(f.world_from_cam, pose)[:3]) for f in (trusting, knowing, across)]
    assert errors[1] < 2e-3
    assert errors[1] < 0.1 * errors[0]
    assert errors[2] > 0.5 * errors[0]


def position_errors(sigma_deg: float, fixed: bool, seeds: range) -> FloatArray:
    """Position errors as shares of the height, at 0.7 px noise and an attitude sensor of this sigma."""
    errors = []
    for seed in seeds:
        scene = sight(seed, 100, 0.0, 0.7, math.radians(sigma_deg), relief_m=0.05)
        tilt = TiltPrior(scene.tilt, 1e-5 if fixed else math.radians(sigma_deg))
        matches = scene.correspondences
        start = Pose(scene.tilt, np.zeros(3))
        yaw = scene.pose.rotation @ scene.tilt.T
        start = Pose(yaw @ scene.tilt, scene.pose.translation)
        found = refined(start, matches.points, matches.rays, tilt, WIDE)
        error = np.linalg.norm(pose_error(found.world_from_cam, scene.pose)[:3])
        errors.append(error / scene.pose.translation[2])
    return np.array(errors)


@pytest.mark.parametrize("sigma_deg", [0.5, 1.0])
def test_attitude_as_a_prior_beats_attitude_as_truth(sigma_deg: float) -> None:
    """Half a degree moves the ground by 0.9 % of the height; a hundred features know the tilt far better."""
    seeds = range(200, 260)
    as_truth = np.sqrt(np.mean(position_errors(sigma_deg, True, seeds) ** 2))
    as_prior = np.sqrt(np.mean(position_errors(sigma_deg, False, seeds) ** 2))
    moved = math.sqrt(2) * math.radians(sigma_deg)  # of roll and pitch together
    assert 0.5 * moved < as_truth < 1.5 * moved
    assert as_prior < 0.5 * as_truth
    # no estimate beats what 100 features at 0.7 px allow: noise / focal length / sqrt(n)
    assert as_prior > 0.7 / CAMERA.focal_px / 10.0


def test_an_exact_sensor_with_a_small_sigma_is_believed() -> None:
    errors = position_errors(0.01, True, range(300, 330))
    assert 1e-4 < np.sqrt(np.mean(errors**2)) < 2e-3


def test_tilt_prior_pulls_towards_what_it_says() -> None:
    """A firm prior gives the sensor's tilt, a loose one the features'."""
    rng = np.random.default_rng(2)
    pose = camera_pose(roll=0.05, pitch=-0.03)
    points = ground_in_view(rng, pose, 50)
    rays = rays_of(pose, points)
    wrong = level(0.06, -0.05)
    firm = refined(pose, points, rays, TiltPrior(wrong, 1e-5), WIDE).world_from_cam
    loose = refined(pose, points, rays, TiltPrior(wrong, 0.3), WIDE).world_from_cam
    up_firm, up_loose = wrong @ firm.rotation[2], wrong @ loose.rotation[2]
    assert np.linalg.norm(up_firm[:2]) < 1e-4
    assert np.linalg.norm(up_loose[:2]) == pytest.approx(math.hypot(0.01, 0.02), rel=0.02)


def test_height_prior_pulls_by_its_weight() -> None:
    rng = np.random.default_rng(3)
    pose = camera_pose(z=2.0)
    points = ground_in_view(rng, pose, 50)
    rays = rays_of(pose, points)
    tilt = TiltPrior(level(), 0.01)
    alone = refined(pose, points, rays, tilt)
    z_sigma = math.sqrt(
        float(
            (alone.world_from_cam.rotation @ alone.covariance[:3, :3] @ alone.world_from_cam.rotation.T)[2, 2]
        )
        / 0.25
    )
    wanted = HeightPrior(2.0 + 0.5 * z_sigma, z_sigma)
    half_way = refined(pose, points, rays, tilt, height=wanted)
    lifted = half_way.world_from_cam.translation[2] - 2.0
    # both say as much, so the answer is in the middle between them
    assert lifted == pytest.approx(0.25 * z_sigma, rel=0.1)
    held = refined(pose, points, rays, tilt, height=HeightPrior(2.001, 1e-7))
    assert held.world_from_cam.translation[2] == pytest.approx(2.001, abs=1e-5)


def test_outliers_are_told_from_inliers() -> None:
    for seed in range(5):
        scene = sight(400 + seed, 120, outliers=0.3, noise_px=0.4)
        matches = scene.correspondences
        start = scene.pose @ Pose.exp(np.full(6, 0.002))
        found = refined(start, matches.points, matches.rays, TiltPrior(scene.tilt, 0.01))
        # 2.5 px is six standard deviations; an outlier lands that near by chance only
        assert (found.inliers & ~scene.is_outlier).sum() == (~scene.is_outlier).sum()
        assert (found.inliers & scene.is_outlier).sum() <= 2
        error = np.linalg.norm(pose_error(found.world_from_cam, scene.pose)[:3])
        assert error < 0.01 * scene.pose.translation[2]


def test_huber_bounds_the_pull_of_outliers_inside_the_limit() -> None:
    """A fifth of the points off by 20 sigmas: least squares would follow a fifth of the way, 4 sigmas."""
    rng = np.random.default_rng(5)
    pose = camera_pose(z=2.0)
    points = ground_in_view(rng, pose, 100)
    rays = rays_of(pose, points)
    rays[:20, 0] += 20 * SIGMA
    held = TiltPrior(level(), 1e-5)
    found = refined(pose, points, rays, held, WIDE)
    shift = np.linalg.norm(pose_error(found.world_from_cam, pose)[:3]) / 2.0
    assert 0.1 * SIGMA < shift < 1.5 * SIGMA


def test_covariance_is_calibrated() -> None:
    """Errors of 200 scenes, in units of what the covariance promises, are chi-square with 6 degrees."""
    errors, covariances = [], []
    for seed in range(200):
        scene = sight(1000 + seed, 60, 0.0, 0.5, 0.01)
        matches = scene.correspondences
        found = refined(scene.pose, matches.points, matches.rays, TiltPrior(scene.tilt, 0.01))
        errors.append(pose_error(found.world_from_cam, scene.pose))
        covariances.append(found.covariance)
    mean = float(normalised_squared_errors(np.array(errors), np.array(covariances)).mean()) / 6
    low, high = chi_square_bounds(6 * 200)
    # the scale is itself estimated from 114 residuals, and Huber gives away a little
    assert 0.92 * low < mean < 1.08 * high


def test_covariance_follows_the_noise() -> None:
    """Residuals four times as large as was said: the covariance grows with them, by a factor of sixteen."""
    said = math.sqrt(np.median([_variance(seed, 0.5) for seed in range(500, 520)]))
    loud = math.sqrt(np.median([_variance(seed, 1.0) for seed in range(500, 520)]))
    assert 1.6 < loud / said < 2.2


def _variance(seed: int, noise_px: float) -> float:
    scene = sight(seed, 80, 0.0, noise_px)
    matches = scene.correspondences
    found = refined(scene.pose, matches.points, matches.rays, TiltPrior(scene.tilt, FREE), WIDE)
    return float(np.trace(found.covariance[:3, :3])) / scene.pose.translation[2] ** 2


def test_a_lucky_fit_is_not_taken_for_certainty() -> None:
    """Exact data: the variance is that of half the stated sigma, never zero."""
    scene = sight(77, 60)
    matches = scene.correspondences
    found = refined(scene.pose, matches.points, matches.rays, TiltPrior(scene.tilt, FREE))
    doubled = refine_pose(
        scene.pose, matches.points, matches.rays, 2 * SIGMA, LIMITS, TiltPrior(scene.tilt, FREE)
    )
    assert doubled is not None
    assert np.linalg.eigvalsh(found.covariance).min() > 0
    np.testing.assert_allclose(doubled.covariance, 4.0 * found.covariance, rtol=1e-3, atol=1e-12)


def test_too_few_points_give_no_pose() -> None:
    scene = sight(1, 10)
    matches = scene.correspondences
    tilt = TiltPrior(scene.tilt, 0.01)
    assert refine_pose(scene.pose, matches.points[:3], matches.rays[:3], SIGMA, LIMITS, tilt) is None
    assert refine_pose(scene.pose, matches.points[:0], matches.rays[:0], SIGMA, LIMITS, tilt) is None
    far_off = replace(matches, rays=matches.rays + 1.0)
    assert refine_pose(scene.pose, far_off.points, far_off.rays, SIGMA, LIMITS, tilt) is None


def test_points_behind_the_camera_are_no_inliers() -> None:
    scene = sight(2, 30)
    matches = scene.correspondences
    points = matches.points.copy()
    points[:5] = 2 * scene.pose.translation - points[:5]  # mirrored through the camera: the same ray, behind
    found = refined(scene.pose, points, matches.rays, TiltPrior(scene.tilt, 0.01))
    assert not found.inliers[:5].any()
    assert found.inliers[5:].all()
