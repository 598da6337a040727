"""SIFT (Lowe 2004) by OpenCV, selected so that features are spread; the patent ended in 2020."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from overfly.types import Features, UInt8Array
from overfly.vision.features.interface import (
    Metric,
    angles_from_degrees,
    checked_image,
    keypoint_table,
    no_features,
    stretch_contrast,
)
from overfly.vision.features.selection import select_spread

# Of the stretched picture; low, because the selection looks at how strong the features are beside each other.
CONTRAST_THRESHOLD = 0.01
CONTRAST_POWER = 1  # of differences of Gaussians
DESCRIPTOR_LENGTH = 128


def _create_detector() -> cv2.Feature2D:
    return cv2.SIFT.create(contrastThreshold=CONTRAST_THRESHOLD)


@dataclass(frozen=True, slots=True)
class Sift:
    """Difference of Gaussians, histograms of gradients; as RootSIFT (Arandjelovic, Zisserman 2012)."""

    count: int
    name: str = "sift"
    metric: Metric = Metric.EUCLIDEAN
    max_distance: float = 0.45  # of descriptors of length 1
    _detector: cv2.Feature2D = field(default_factory=_create_detector, repr=False, compare=False)

    def extract(self, gray: UInt8Array) -> Features:
        """gray: (H, W) uint8 -> at most ``count`` features, best first; ValueError for other arrays."""
        gray = stretch_contrast(checked_image(gray))
        found = self._detector.detect(gray)
        if len(found) == 0:
            return no_features(np.empty((0, DESCRIPTOR_LENGTH), np.float32))
        table, octave = keypoint_table(found)
        # OpenCV packs the octave into the low byte, -1 for the doubled picture.
        octave = (octave & 0xFF).astype(np.uint8).view(np.int8).astype(np.int64) + 1
        chosen = select_spread(table[:, :2], octave, table[:, 4], gray.shape, self.count, CONTRAST_POWER)
        _, descriptors = self._detector.compute(gray, [found[k] for k in chosen])
        shares = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1.0)
        table = table[chosen]
        return Features(
            px=np.ascontiguousarray(table[:, :2]),
            descriptors=np.sqrt(shares).astype(np.float32),
            size_px=table[:, 2].copy(),
            angle_rad=angles_from_degrees(table[:, 3]),
            response=table[:, 4].copy(),
        )
