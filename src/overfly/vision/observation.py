"""One frame as the vision part sees it: gray, of working size, with features and levelled attitude found when
asked for.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray
from overfly.types import Features, Frame, MountedCamera, Rig, ScaleLandmark, UInt8Array
from overfly.vision.alignment import Pyramid, build_pyramid
from overfly.vision.features import Extractor
from overfly.vision.refine import TiltPrior


def working_rig(rig: Rig, max_width_px: int) -> Rig:
    """The rig with cameras wider than max_width_px reduced to that width."""
    cameras = []
    for mounted in rig.cameras:
        camera = mounted.camera
        if camera.width > max_width_px:
            camera = camera.scaled(max_width_px, round(camera.height * max_width_px / camera.width))
        cameras.append(MountedCamera(mounted.name, camera, mounted.body_from_cam))
    return Rig(tuple(cameras), rig.calibration_source, rig.level_sigma_rad)


def working_landmark(landmark: ScaleLandmark, rig: Rig, reduced: Rig) -> ScaleLandmark:
    """The object of known size as it is seen in the reduced pictures."""
    for full, small in zip(rig.cameras, reduced.cameras, strict=True):
        if full.name == landmark.camera:
            shrink = [small.camera.width / full.camera.width, small.camera.height / full.camera.height]
            return replace(landmark, corners_px=(landmark.corners_px + 0.5) * shrink - 0.5)
    return landmark


def feature_count(rig: Rig, at_reference_width: int) -> int:
    """Features for the rig's pictures, from the number for a picture 320 wide: wider ones show more ground or
    more detail.
    """
    return round(at_reference_width * math.sqrt(rig.cam0.camera.width / 320.0))


def working_image(image: UInt8Array, camera: Camera) -> UInt8Array:
    """Gray picture of the camera's size."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    if gray.shape != (camera.height, camera.width):
        gray = cv2.resize(gray, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.asarray(gray, np.uint8)


@dataclass(eq=False)
class Observation:
    """A frame, its working pictures, and what was found in the first of them."""

    frame: Frame
    rig: Rig
    extractor: Extractor
    tilt: TiltPrior
    prepared_s: float = 0.0  # how long prepare took

    @cached_property
    def images(self) -> tuple[UInt8Array, ...]:
        """Gray working pictures (H, W), one per camera."""
        return tuple(
            working_image(image, mounted.camera)
            for image, mounted in zip(self.frame.images, self.rig.cameras, strict=False)
        )

    def prepare(self, *, features: bool) -> None:
        """Compute now what will be asked for later: pictures and pyramid, or pictures and features."""
        began = time.perf_counter()
        _ = self.features if features else self.pyramid
        self.prepared_s = time.perf_counter() - began

    @property
    def gray(self) -> UInt8Array:
        return self.images[0]

    @cached_property
    def pyramid(self) -> Pyramid:
        """The first picture and its halvings."""
        return build_pyramid(self.gray)

    @cached_property
    def features(self) -> Features:
        return self.extractor.extract(self.gray)

    @cached_property
    def rays(self) -> FloatArray:
        """(n, 2) undistorted image coordinates of the features."""
        return self.rig.cam0.camera.rays_from_pixels(self.features.px)
