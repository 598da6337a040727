"""The default features: Hessian blobs described by TEBLID (Suarez, Buenaposada, Baumela 2021), 256 bits."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from overfly.errors import UsageError
from overfly.types import Features, UInt8Array
from overfly.vision.features.hessian import detect_hessian
from overfly.vision.features.interface import Metric, checked_image, no_features, stretch_contrast

PATCH_SCALE = 10.0  # side of the described patch in keypoint diameters; measured, see docs/features.md
SIZE_IN_SIGMAS = 2.0  # keypoint diameter in sigmas
DESCRIPTOR_BYTES = 32


def _create_descriptor() -> cv2.Feature2D:
    if not hasattr(cv2, "xfeatures2d"):
        raise UsageError(
            "the default features need OpenCV's contrib modules: pip install opencv-contrib-python-headless"
        )
    return cv2.xfeatures2d.TEBLID.create(PATCH_SCALE, cv2.xfeatures2d.TEBLID_SIZE_256_BITS)


@dataclass(frozen=True, slots=True)
class HessianTeblid:
    """Determinant of Hessian detector, TEBLID descriptor; ``upright`` for cameras that keep their heading."""

    count: int
    upright: bool = False
    metric: Metric = Metric.HAMMING
    max_distance: float = 64.0  # bits
    _descriptor: cv2.Feature2D = field(default_factory=_create_descriptor, repr=False, compare=False)

    @property
    def name(self) -> str:
        return "hessian-teblid-upright" if self.upright else "hessian-teblid"

    def extract(self, gray: UInt8Array) -> Features:
        """gray: (H, W) uint8 -> at most ``count`` features, best first; ValueError for other arrays."""
        gray = checked_image(gray)
        found = detect_hessian(gray, self.count, self.upright)
        if len(found.px) == 0:
            return no_features(np.empty((0, DESCRIPTOR_BYTES), np.uint8))
        size = SIZE_IN_SIGMAS * found.sigma_px
        degrees = np.rad2deg(found.angle_rad) % 360.0
        columns = (found.px[:, 0], found.px[:, 1], size, degrees)
        # map() over lists is the quickest way to build OpenCV's keypoint objects: 0.2 ms for 500.
        keypoints = list(map(cv2.KeyPoint, *(column.tolist() for column in columns)))
        _, descriptors = self._descriptor.compute(stretch_contrast(gray), keypoints)
        return Features(
            found.px, np.asarray(descriptors, dtype=np.uint8), size, found.angle_rad, found.response
        )
