"""What a patch of ground looks like from elsewhere: its Jacobian, and how it bends."""

from __future__ import annotations

import numpy as np
import pytest

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import Pose
from overfly.vision.alignment import PATCH_SPREAD_PX2, SIDE, align_patches, build_pyramid
from overfly.vision.patch_warp import curvature, inverse_warp, patch_rays, with_steps

from .scenes import camera_pose, ground_texture, picture_of_ground

BARREL = Camera(320, 240, 288.0, 288.0, 161.4, 116.6, coefficients=(-0.12, 0.05, 0.0006, -0.0004))


def test_spread_is_that_of_a_patch() -> None:
    offsets = np.arange(SIDE) - SIDE // 2
    assert pytest.approx(np.mean(offsets.astype(float) ** 2)) == PATCH_SPREAD_PX2


def test_jacobian_and_curvature_of_a_known_map() -> None:
    """A quadratic map: both are exact."""
    rng = np.random.default_rng(1)
    linear = np.array([[1.1, 0.2], [-0.3, 0.9]])
    bend = rng.normal(0, 1e-3, (2, 3))  # of x squared, y squared and their product
    places = rng.uniform(-50, 50, (7, 2))

    def mapped(px: np.ndarray) -> np.ndarray:
        x, y = px.T
        return px @ linear.T + np.column_stack([x * x, y * y, x * y]) @ bend.T

    steps = mapped(with_steps(places))
    expected = np.broadcast_to(bend[:, 0] + bend[:, 1], (7, 2))
    np.testing.assert_allclose(curvature(steps), expected, atol=1e-9)
    x, y = places.T
    slope = np.stack(
        [
            linear[:, 0] + 2 * np.outer(x, bend[:, 0]) + np.outer(y, bend[:, 2]),
            linear[:, 1] + 2 * np.outer(y, bend[:, 1]) + np.outer(x, bend[:, 2]),
        ],
        axis=-1,
    )
    np.testing.assert_allclose(inverse_warp(steps) @ slope, np.broadcast_to(np.eye(2), (7, 2, 2)), atol=1e-9)


def test_a_lens_that_bends_patches_moves_no_point() -> None:
    """A camera that flies one way through a bent lens: without the correction all points are found beside
    where they are, to the same side.
    """
    off, off_uncorrected = [], []
    for seed in range(4):
        texture = ground_texture(seed)
        before, now = camera_pose(z=2.0), camera_pose(y=0.55, z=2.0)
        pictures = [picture_of_ground(texture, pose, BARREL) for pose in (before, now)]
        u, v = np.meshgrid(np.linspace(30, 290, 24), np.linspace(30, 210, 16))
        px = np.column_stack([u.ravel(), v.ravel()])
        rays = BARREL.rays_from_pixels(with_steps(px)).reshape(-1, 5, 2)
        world = np.column_stack([rays[:, 0], np.ones(len(px))]) * 2.0
        world = before.transform(world)
        seen = patch_rays(
            before.rotation[None], before.translation[None], np.zeros(len(px), np.int64), now, rays, world,
            np.arange(len(px)),
        )  # fmt: skip
        steps = BARREL.pixels_from_rays(seen)
        true = steps[::5]
        aligned = align_patches(
            [build_pyramid(pictures[0])], np.zeros(len(px), np.int64), build_pyramid(pictures[1]), px,
            inverse_warp(steps), true,
        )  # fmt: skip
        found_px, found = aligned.px, aligned.found
        assert found.sum() > 60
        off_uncorrected.append((found_px - true)[found])
        off.append((found_px - PATCH_SPREAD_PX2 * curvature(steps) - true)[found])
    moved = np.linalg.norm(np.mean(np.concatenate(off), axis=0))
    moved_uncorrected = np.linalg.norm(np.mean(np.concatenate(off_uncorrected), axis=0))
    assert moved_uncorrected > 0.003
    assert moved < 0.4 * moved_uncorrected


def test_what_is_out_of_sight_has_no_warp() -> None:
    px = np.array([[160.0, 120.0]])
    rays = BARREL.rays_from_pixels(with_steps(px)).reshape(-1, 5, 2)
    level = camera_pose(z=2.0)
    seen = patch_rays(
        level.rotation[None], level.translation[None], np.zeros(1, np.int64), Pose(np.eye(3), np.zeros(3)),
        rays, np.array([[0.0, 0.0, -1.0]]), np.arange(1),
    )  # fmt: skip
    assert np.isnan(inverse_warp(BARREL.pixels_from_rays(seen))).all()
