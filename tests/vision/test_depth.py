"""Depth of features: on flat ground, and from a second camera."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from overfly.errors import CalibrationError
from overfly.geometry.cameras import Camera
from overfly.geometry.levelling import NADIR_BODY_FROM_CAM
from overfly.geometry.poses import FloatArray, Pose, rotation_from_euler
from overfly.types import Frame, MountedCamera, Rig
from overfly.vision.depth import DepthFinder, height_above_points
from overfly.vision.features import create_extractor
from overfly.vision.ground import STEEPEST_RAY_RAD, points_on_ground
from overfly.vision.observation import Observation
from overfly.vision.refine import TiltPrior
from overfly.vision.rig_bend import bent_rig
from overfly.vision.stereo import DISPARITY_SIGMA_PX, StereoMatcher, coarse_disparity

from .scenes import (
    CAMERA,
    camera_pose,
    ground_in_view,
    ground_texture,
    level,
    mono_rig,
    picture_of_ground,
    rays_of,
)

BARREL = Camera(320, 240, 288.0, 288.0, 161.4, 116.6, coefficients=(-0.12, 0.05, 0.0006, -0.0004))
BASELINE_M = 0.12


def stereo_rig(camera: Camera = CAMERA, *, crooked: bool = True) -> Rig:
    """Two cameras, the right one on the body's right, each turned by up to a degree."""
    turn = math.radians(0.8) if crooked else 0.0
    left = rotation_from_euler(turn, -turn, 0.5 * turn) @ NADIR_BODY_FROM_CAM
    right = rotation_from_euler(-0.5 * turn, turn, -turn) @ NADIR_BODY_FROM_CAM
    return Rig(
        (
            MountedCamera("cam0", camera, Pose(left, np.array([0.0, 0.5 * BASELINE_M, 0.0]))),
            MountedCamera("cam1", camera, Pose(right, np.array([0.0, -0.5 * BASELINE_M, 0.0]))),
        )
    )


# -- flat ground


def test_rays_meet_the_ground_where_the_points_are() -> None:
    rng = np.random.default_rng(0)
    pose = camera_pose(1.0, -2.0, 3.0, 0.1, -0.15, 0.8)
    points = ground_in_view(rng, pose, 50, 0.0) + np.array([0, 0, 0.4])
    depth = points_on_ground(rays_of(pose, points), pose, 0.4, 0.01, 0.05)
    np.testing.assert_allclose(pose.transform(depth.points_in_cam), points, atol=1e-9)
    assert not depth.is_measured


def test_sigma_of_assumed_depth_is_what_tilt_and_relief_do_to_it() -> None:
    """Against draws of the tilt about a random level axis and of the ground's height."""
    rng = np.random.default_rng(1)
    pose = camera_pose(z=2.0)
    rays = np.array([[0.0, 0.0], [0.3, 0.0], [-0.2, 0.4]])
    tilt_sigma, relief = 0.02, 0.03
    stated = points_on_ground(rays, pose, 0.0, tilt_sigma, relief).depth_sigma_m
    slants = []
    for _ in range(4000):
        wrong = Pose(
            rotation_from_euler(*rng.normal(0, tilt_sigma, 2), 0.0) @ pose.rotation, pose.translation
        )
        assumed = points_on_ground(rays, wrong, rng.normal(0, relief), 0.0, 0.0).points_in_cam
        slants.append(np.linalg.norm(assumed, axis=1))
    seen = np.std(slants, axis=0) / np.sqrt(1 + (rays**2).sum(axis=1))  # along the optical axis
    np.testing.assert_allclose(stated, seen, rtol=0.25)


def test_flat_rays_have_no_ground() -> None:
    flattest = math.tan(STEEPEST_RAY_RAD)
    rays = np.array([[0.99 * flattest, 0.0], [1.01 * flattest, 0.0], [0.0, 0.0]])
    depth = points_on_ground(rays, camera_pose(z=2.0), 0.0, 0.01, 0.02)
    np.testing.assert_array_equal(np.isfinite(depth.points_in_cam[:, 2]), [True, False, True])
    under = points_on_ground(rays, camera_pose(z=2.0), 5.0, 0.01, 0.02)
    assert np.isnan(under.points_in_cam).all()
    up = points_on_ground(rays, camera_pose(z=2.0, roll=math.pi), 0.0, 0.01, 0.02)
    assert np.isnan(up.points_in_cam).all()


# -- two cameras


def textured_points(
    rig: Rig, body: Pose, seed: int, ground_z: float = 0.0
) -> tuple[FloatArray, FloatArray, list]:
    """Pixels (n, 2) in cam0, true points (n, 3) in cam0, and both pictures."""
    texture = ground_texture(seed)
    poses = [body @ mounted.body_from_cam for mounted in rig.cameras]
    pictures = [
        picture_of_ground(texture, pose, mounted.camera, ground_z)
        for pose, mounted in zip(poses, rig.cameras, strict=True)
    ]
    u, v = np.meshgrid(np.linspace(50, 300, 14), np.linspace(15, 225, 10))
    px = np.column_stack([u.ravel(), v.ravel()])
    rays = rig.cam0.camera.rays_from_pixels(px)
    directions = np.column_stack([rays, np.ones(len(rays))]) @ poses[0].rotation.T
    depth = (ground_z - poses[0].translation[2]) / directions[:, 2]
    return px, np.column_stack([rays, np.ones(len(rays))]) * depth[:, None], pictures


@pytest.mark.parametrize("camera", [CAMERA, BARREL], ids=["pinhole", "barrel"])
@pytest.mark.parametrize(("height", "tilt"), [(1.0, 0.0), (1.6, 0.12), (2.4, -0.1)])
def test_depth_is_right_within_its_sigma(camera: Camera, height: float, tilt: float) -> None:
    rig = stereo_rig(camera)
    body = Pose(rotation_from_euler(tilt, -0.5 * tilt, 0.9), np.array([0.1, -0.2, height]))
    px, truth, pictures = textured_points(rig, body, 3)
    depth = StereoMatcher(rig).depth(pictures[0], pictures[1], px.astype(np.float32))
    assert depth.is_measured
    found = np.isfinite(depth.points_in_cam[:, 2])
    assert found.mean() > 0.6
    error = depth.points_in_cam[found, 2] - truth[found, 2]
    off = error / depth.depth_sigma_m[found]
    # the stated 0.15 px is for real pictures; clean ones are better, but not by an order, and not worse
    assert 0.02 < np.sqrt(np.mean(off**2)) < 1.0
    assert np.abs(np.median(off)) < 0.5
    expected = truth[found, 2] ** 2 * DISPARITY_SIGMA_PX / (camera.focal_px * BASELINE_M)
    np.testing.assert_allclose(depth.depth_sigma_m[found], expected, rtol=0.1)
    # in all three coordinates they lie on their own rays
    rays = camera.rays_from_pixels(px[found])
    points = depth.points_in_cam[found]
    np.testing.assert_allclose(points[:, :2] / points[:, 2:], rays, atol=1e-5)


@pytest.mark.parametrize(
    ("gain", "offset", "falloff"),
    [(1.0, 12.0, 0.0), (0.9, 0.0, 0.0), (1.1, -10.0, 0.15)],
    ids=["brighter", "darker", "other exposure and corners"],
)
def test_brightness_that_differs_between_the_cameras_moves_no_depth(
    gain: float, offset: float, falloff: float
) -> None:
    """What one camera sees brighter than the other is no shift: depths are those of cameras that agree."""
    rig = stereo_rig()
    body = Pose(rotation_from_euler(0.05, -0.03, 0.4), np.array([0.0, 0.0, 1.6]))
    px, truth, (left, right) = textured_points(rig, body, 8)
    v, u = np.mgrid[0:240, 0:320]
    corners = 1.0 - falloff * ((u - 160) ** 2 + (v - 120) ** 2) / (160**2 + 120**2)
    faint = [0.35 * (picture - picture.mean()) + 110.0 for picture in (left, right)]
    other = np.clip(gain * corners * faint[1] + offset, 0, 255)
    inverse_depths = [
        1.0
        / StereoMatcher(rig)
        .depth(faint[0].astype(np.uint8), second.astype(np.uint8), px.astype(np.float32))
        .points_in_cam[:, 2]
        for second in (faint[1], other)
    ]
    disparities = np.array(inverse_depths) * CAMERA.focal_px * BASELINE_M
    moved = disparities[1] - disparities[0]
    both = np.isfinite(moved)
    assert both.sum() > 0.95 * np.isfinite(disparities[0]).sum() > 0.8 * len(px)
    assert np.sqrt(np.mean(moved[both] ** 2)) < 0.05  # a quarter of a pixel and more, taken for a shift
    true = CAMERA.focal_px * BASELINE_M / truth[both, 2]
    assert np.median(np.abs(disparities[1, both] - true)) < 0.05


def test_other_ground_in_the_second_picture_gives_no_depth() -> None:
    rig = stereo_rig()
    body = Pose(np.eye(3), np.array([0.0, 0.0, 1.5]))
    px, _, pictures = textured_points(rig, body, 3)
    _, _, others = textured_points(rig, body, 4)
    depth = StereoMatcher(rig).depth(pictures[0], others[1], px.astype(np.float32))
    assert np.isfinite(depth.points_in_cam[:, 2]).mean() < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_faint_fine_grain_is_enough(seed: int) -> None:
    """Asphalt: a grain of a few grey levels that nothing is left of in a reduced picture, and the camera's
    noise."""
    rng = np.random.default_rng(seed)
    disparity, noise = 17, 1.2
    grain = cv2.GaussianBlur(rng.standard_normal((240, 360)), (0, 0), 1.0)
    grain = 4.0 * (grain - cv2.GaussianBlur(grain, (0, 0), 3.0)) / grain.std()
    pictures = [
        np.clip(np.rint(112.0 + view + noise * rng.standard_normal(view.shape)), 0, 255).astype(np.uint8)
        for view in (grain[:, : CAMERA.width], grain[:, disparity : disparity + CAMERA.width])
    ]
    px = np.column_stack([rng.uniform(40, 300, 300), rng.uniform(12, 228, 300)]).astype(np.float32)
    depth = StereoMatcher(stereo_rig(crooked=False)).depth(pictures[0], pictures[1], px)
    found = np.isfinite(depth.points_in_cam[:, 2])
    assert found.mean() > 0.8
    seen = CAMERA.focal_px * BASELINE_M / depth.points_in_cam[found, 2]
    assert np.abs(np.median(seen) - disparity) < 0.05
    assert 0.02 < np.std(seen) < 0.5


def test_flat_pictures_give_no_depth() -> None:
    gray = np.full((240, 320), 128, np.uint8)
    depth = StereoMatcher(stereo_rig()).depth(gray, gray, np.array([[100, 100], [200, 120]], np.float32))
    assert np.isnan(depth.points_in_cam).all()
    none = StereoMatcher(stereo_rig()).depth(gray, gray, np.empty((0, 2), np.float32))
    assert none.points_in_cam.shape == (0, 3)


@pytest.mark.parametrize("height", [0.8, 1.5, 3.0])
def test_disparity_of_the_ground_is_found_first(height: float) -> None:
    rig = stereo_rig(crooked=False)
    _, _, pictures = textured_points(rig, Pose(np.eye(3), np.array([0.0, 0.0, height])), 5)
    expected = CAMERA.focal_px * BASELINE_M / height
    assert coarse_disparity(pictures[0], pictures[1]) == pytest.approx(expected, abs=3.0)


def test_rigs_that_cannot_be_stereo_are_named() -> None:
    rig = stereo_rig()
    small = replace(rig.cameras[1], camera=CAMERA.scaled(160, 120))
    with pytest.raises(CalibrationError, match="same image size"):
        StereoMatcher(Rig((rig.cameras[0], small)))
    same_place = replace(rig.cameras[1], body_from_cam=rig.cameras[0].body_from_cam)
    with pytest.raises(CalibrationError, match="different places"):
        StereoMatcher(Rig((rig.cameras[0], same_place)))


def bent(rig: Rig, turn_deg: tuple[float, float, float]) -> Rig:
    """What is claimed of a rig whose second camera was turned so, about its own axes, after calibration."""
    return bent_rig(rig, -np.radians(turn_deg))


@pytest.mark.parametrize("turn_deg", [(1.0, 0.0, 0.0), (0.2, 0.0, -0.5), (-0.4, 0.3, 0.4)])
def test_a_knocked_rig_is_found_out_and_allowed_for(turn_deg: tuple[float, float, float]) -> None:
    rig = stereo_rig()
    body = Pose(rotation_from_euler(0.02, 0.0, 0.3), np.array([0.0, 0.0, 1.5]))
    matcher = StereoMatcher(bent(rig, turn_deg))
    for seed in range(3, 11):
        px, truth, pictures = textured_points(rig, body, seed)
        depth = matcher.depth(pictures[0], pictures[1], px.astype(np.float32))
    found = np.degrees(matcher.bend.turn_rad)
    np.testing.assert_allclose(found[[0, 2]], np.array(turn_deg)[[0, 2]], atol=0.1)
    known = np.isfinite(depth.points_in_cam[:, 2])
    assert known.mean() > 0.6
    ratio = float(np.median(depth.points_in_cam[known, 2] / truth[known, 2]))
    # Half a pixel of disparity is a tenth of a degree about the vertical, which only the corners show.
    unaided = CAMERA.focal_px * math.radians(abs(turn_deg[1])) / (CAMERA.focal_px * BASELINE_M / 1.5)
    assert abs(ratio - 1.0) < 0.02 + 0.6 * unaided


def test_a_straight_rig_stays_as_it_was_calibrated() -> None:
    rig = stereo_rig()
    matcher = StereoMatcher(rig)
    for seed in range(3, 11):
        px, _, pictures = textured_points(rig, Pose(np.eye(3), np.array([0.0, 0.0, 1.5])), seed)
        matcher.depth(pictures[0], pictures[1], px.astype(np.float32))
    assert matcher.bend.n_pairs == 8
    np.testing.assert_array_equal(matcher.bend.turn_rad, 0.0)


def test_a_rig_bent_beyond_sense_is_refused_rather_than_believed() -> None:
    """The second camera pitched by three degrees more than calibrated: rows no longer meet."""
    rig = stereo_rig(crooked=False)
    body = Pose(np.eye(3), np.array([0.0, 0.0, 1.5]))
    px, _, pictures = textured_points(rig, body, 3)
    depth = StereoMatcher(bent(rig, (3.0, 0.0, 0.0))).depth(pictures[0], pictures[1], px.astype(np.float32))
    assert np.isfinite(depth.points_in_cam[:, 2]).mean() < 0.05


# -- which of both


def observation(rig: Rig, pictures: list) -> Observation:
    frame = Frame(0, 0, "0", tuple(pictures))
    return Observation(frame, rig, create_extractor("orb", 50), TiltPrior(level(), 0.01))


def test_the_finder_measures_where_it_can() -> None:
    rig = stereo_rig()
    body = Pose(np.eye(3), np.array([0.0, 0.0, 1.5]))
    px, truth, pictures = textured_points(rig, body, 3)
    rays = CAMERA.rays_from_pixels(px)
    pose = body @ rig.cam0.body_from_cam
    finder = DepthFinder(rig)
    assert finder.is_metric
    assert finder.inverse_depth_sigma == pytest.approx(DISPARITY_SIGMA_PX / (CAMERA.focal_px * BASELINE_M))
    measured = finder.find(observation(rig, pictures), px.astype(np.float32), rays, pose, 0.01, 0.02)
    assert measured.is_measured
    # a frame whose second picture is missing falls back to the ground
    assumed = finder.find(observation(rig, pictures[:1]), px.astype(np.float32), rays, pose, 0.01, 0.02)
    assert not assumed.is_measured
    np.testing.assert_allclose(assumed.points_in_cam, truth, atol=1e-9)
    mono = DepthFinder(mono_rig())
    assert not mono.is_metric
    assert mono.measured(observation(mono_rig(), pictures[:1]), px.astype(np.float32)) is None


def test_height_above_points_is_along_the_vertical() -> None:
    pose = camera_pose(z=2.0, roll=0.2, pitch=-0.1)
    points = ground_in_view(np.random.default_rng(1), pose, 31, 0.0)
    seen = pose.inverse().transform(points)
    seen[3] = np.nan
    assert height_above_points(seen, level(0.2, -0.1)) == pytest.approx(2.0, abs=1e-9)
    assert math.isnan(height_above_points(np.full((2, 3), np.nan), level()))
