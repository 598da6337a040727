"""Working pictures and rigs: reduced together, so that rays stay what they were."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from overfly.geometry.cameras import Camera
from overfly.geometry.levelling import NADIR_BODY_FROM_CAM
from overfly.geometry.poses import Pose
from overfly.types import Frame, MountedCamera, Rig
from overfly.vision.features import create_extractor
from overfly.vision.observation import Observation, working_image, working_rig
from overfly.vision.refine import TiltPrior

from .scenes import level, smooth_texture

LARGE = Camera(1280, 960, 1150.0, 1150.0, 640.3, 478.2, coefficients=(-0.1, 0.03, 1e-3, 0.0))


def rig_of(camera: Camera, cameras: int = 1) -> Rig:
    mounts = [
        MountedCamera(f"cam{n}", camera, Pose(NADIR_BODY_FROM_CAM, np.array([0.0, 0.1 * n, 0.0])))
        for n in range(cameras)
    ]
    return Rig(tuple(mounts), "exif", 0.03)


def test_rigs_are_reduced_to_the_width_asked_for_and_keep_all_else() -> None:
    rig = rig_of(LARGE, 2)
    small = working_rig(rig, 640)
    for mounted, before in zip(small.cameras, rig.cameras, strict=True):
        assert (mounted.camera.width, mounted.camera.height) == (640, 480)
        assert mounted.name == before.name
        assert mounted.body_from_cam is before.body_from_cam
    assert small.calibration_source == "exif"
    assert small.level_sigma_rad == 0.03
    assert working_rig(rig, 1280).cam0.camera is LARGE


def test_a_spot_has_the_same_ray_in_the_recorded_and_in_the_working_picture() -> None:
    picture = np.zeros((960, 1280), np.uint8)
    cv2.circle(picture, (901, 333), 12, 255, -1)
    camera = working_rig(rig_of(LARGE), 640).cam0.camera
    small = working_image(picture, camera)
    assert small.shape == (480, 640)
    rows, columns = np.mgrid[:480, :640]
    weight = small.astype(float)
    px = np.array([[(weight * columns).sum(), (weight * rows).sum()]]) / weight.sum()
    expected = LARGE.rays_from_pixels(np.array([[901.0, 333.0]]))
    np.testing.assert_allclose(camera.rays_from_pixels(px), expected, atol=0.02 / camera.fx)


def test_colour_becomes_grey_by_brightness() -> None:
    colour = np.zeros((240, 320, 3), np.uint8)
    colour[..., 1] = 200  # green weighs most
    gray = working_image(colour, Camera(320, 240, 300, 300, 160, 120))
    assert gray.shape == (240, 320)
    assert gray[0, 0] == round(0.587 * 200)


def test_features_and_rays_belong_together() -> None:
    camera = Camera(320, 240, 288.0, 288.0, 161.4, 116.6, coefficients=(-0.12, 0.05, 0.0006, -0.0004))
    frame = Frame(3, 4, "five", (smooth_texture(1),))
    view = Observation(frame, rig_of(camera), create_extractor("orb", 100), TiltPrior(level(), 0.01))
    assert len(view.features) > 20
    assert view.features is view.features  # found once
    np.testing.assert_allclose(camera.pixels_from_rays(view.rays), view.features.px, atol=1e-3)
    assert view.gray is view.images[0]


def test_a_missing_second_picture_is_not_made_up() -> None:
    camera = Camera(320, 240, 288.0, 288.0, 159.5, 119.5)
    frame = Frame(0, 0, "", (smooth_texture(1),))
    view = Observation(frame, rig_of(camera, 2), create_extractor("orb", 100), TiltPrior(level(), 0.01))
    assert len(view.images) == 1


@pytest.mark.parametrize(("width", "height"), [(1000, 750), (1281, 961)])
def test_aspect_is_kept_to_a_pixel(width: int, height: int) -> None:
    camera = working_rig(rig_of(Camera(width, height, 900, 900, width / 2, height / 2)), 640).cam0.camera
    assert camera.width == 640
    assert abs(camera.height - 640 * height / width) <= 0.5
