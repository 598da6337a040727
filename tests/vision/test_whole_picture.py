"""Ground that shows next to nothing: all of the picture tells the motion, and the lens does not."""

from __future__ import annotations

import numpy as np
import pytest

from overfly.geometry.poses import Pose
from overfly.types import Float32Array, UInt8Array
from overfly.vision.alignment import Pyramid, build_pyramid
from overfly.vision.whole_picture import Plane, Shading, WholePicture, ground_plane

from .scenes import CAMERA, camera_pose, ground_texture, picture_of_ground, pose_error

LEVEL = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
NOISE = 4.0  # grey levels


def lens() -> Float32Array:
    """(240, 320) what a lens leaves of the light: 0.7 in the corners."""
    x, y = np.linspace(-1, 1, CAMERA.width), np.linspace(-1, 1, CAMERA.height)
    return np.asarray(1.0 - 0.15 * (x**2 + y[:, None] ** 2), np.float32)


def faint(pose: Pose, contrast: float, seed: int, shading: Float32Array | float = 1.0) -> Pyramid:
    """Ground whose deviation is about this many grey levels, and noise of more."""
    seen = picture_of_ground(ground_texture(3), pose).astype(np.float64)
    noise = NOISE * np.random.default_rng(seed).standard_normal(seen.shape)
    picture = (120.0 + contrast / 45.0 * (seen - 127.5)) * shading + noise
    return build_pyramid(np.clip(np.rint(picture), 0, 255).astype(np.uint8))


@pytest.mark.parametrize("seed", range(4))
def test_ground_fainter_than_the_noise_tells_the_pose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    before, now = camera_pose(0.0, 0.0, 1.6), camera_pose(0.09, -0.05, 1.6, 0.02, -0.01, 0.05)
    start = now @ Pose.exp(np.concatenate([rng.normal(0, 0.02, 3), rng.normal(0, 0.008, 3)]))
    found = WholePicture(CAMERA).fit(
        faint(before, 3.0, seed), before, faint(now, 3.0, seed + 9), start, LEVEL
    )
    assert found is not None
    error, first = pose_error(found.world_from_cam, now), pose_error(start, now)
    assert np.linalg.norm(error) < 0.5 * np.linalg.norm(first)
    squared = error @ np.linalg.solve(found.covariance, error)
    assert 0.001 < squared < 20.0  # believed neither much more nor much less than it is worth


def test_noise_alone_tells_nothing() -> None:
    pose = camera_pose(z=1.6)
    found = WholePicture(CAMERA).fit(faint(pose, 0.0, 1), pose, faint(pose, 0.0, 2), pose, LEVEL)
    assert found is None


def test_a_motion_far_from_the_start_is_not_believed() -> None:
    before, now = camera_pose(z=1.6), camera_pose(x=0.5, z=1.6)
    found = WholePicture(CAMERA).fit(faint(before, 40.0, 1), before, faint(now, 40.0, 2), before, LEVEL)
    assert found is None


def test_the_shading_of_the_lens_is_learnt_and_taken_out() -> None:
    """Darker corners stay where they are, which looks like no motion."""
    places = [camera_pose(0.3 * k, 0.2 * (-1) ** k, 1.6) for k in range(-4, 5)]
    before, now = camera_pose(0.0, 0.0, 1.6), camera_pose(0.12, 0.0, 1.6)
    naive, learnt = WholePicture(CAMERA), WholePicture(CAMERA)
    for k, place in enumerate(places):
        learnt.learn(faint(place, 3.0, k, lens()))
    errors = []
    for comparison in (naive, learnt):
        pictures = faint(before, 3.0, 20, lens()), faint(now, 3.0, 21, lens())
        found = comparison.fit(pictures[0], before, pictures[1], now, LEVEL)
        errors.append(np.inf if found is None else np.linalg.norm(pose_error(found.world_from_cam, now)))
    assert 1e-5 < errors[1] < 0.7 * errors[0]


def test_what_only_the_lens_shows_is_not_taken_for_ground_that_stays() -> None:
    """A dark middle, as of an old lens, makes pictures of any ground alike before it is known."""
    x, y = np.linspace(-1, 1, CAMERA.width), np.linspace(-0.75, 0.75, CAMERA.height)
    spot = np.asarray(1.0 - 0.4 * np.exp(-(x**2 + y[:, None] ** 2) / 0.08), np.float32)
    before, now = camera_pose(0.0, 0.0, 1.6), camera_pose(0.15, 0.0, 1.6)
    one, other = faint(before, 3.0, 20, spot), faint(now, 3.0, 21, spot)
    assert WholePicture(CAMERA).fit(one, before, other, now, LEVEL) is None


def test_shading_is_that_of_the_lens() -> None:
    shading = Shading(CAMERA)
    assert np.all(shading.over((160, 120)) == 1.0)
    for k in range(12):
        picture: UInt8Array = faint(camera_pose(0.3 * (k - 6), 0.0, 1.6), 5.0, k, lens())[-1]
        shading.learn(picture)
    np.testing.assert_allclose(shading.over((320, 240)), lens(), atol=0.03)


def test_the_plane_is_that_of_most_points() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-2.0, 2.0, (80, 3))
    points[:, 2] = 0.1 * points[:, 0] - 0.05 * points[:, 1] + 0.3 + rng.normal(0.0, 0.002, 80)
    points[:15, 2] += rng.uniform(0.3, 1.0, 15)
    plane = ground_plane(points)
    distance = points[15:] @ plane.normal - plane.offset
    assert np.linalg.norm(plane.normal) == pytest.approx(1.0)
    assert 0.0005 < np.sqrt(np.mean(distance**2)) < 0.004
