"""ORB (Rublee et al. 2011) by OpenCV, selected so that features are spread over the image."""

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

CANDIDATES = 12  # times as many as are kept, to select from
FAST_THRESHOLD = 7  # grey levels of the stretched picture
CONTRAST_POWER = 1  # of FAST scores, which repeat better here than Harris responses and cost less
BORDER_PX = 19  # the turned sampling pattern reaches this far
DESCRIPTOR_BYTES = 32


@dataclass(frozen=True, slots=True)
class Orb:
    """FAST corners in a pyramid of eight levels 1.2 apart, steered BRIEF of 256 bits."""

    count: int
    name: str = "orb"
    metric: Metric = Metric.HAMMING
    max_distance: float = 64.0  # bits
    _detector: cv2.Feature2D = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        detector = cv2.ORB.create(
            CANDIDATES * self.count,
            edgeThreshold=BORDER_PX,
            fastThreshold=FAST_THRESHOLD,
            scoreType=cv2.ORB_FAST_SCORE,
        )
        object.__setattr__(self, "_detector", detector)

    def extract(self, gray: UInt8Array) -> Features:
        """gray: (H, W) uint8 -> at most ``count`` features, best first; ValueError for other arrays."""
        gray = stretch_contrast(checked_image(gray))
        found = self._detector.detect(gray) if min(gray.shape) > 2 * BORDER_PX else ()
        if len(found) == 0:
            return no_features(np.empty((0, DESCRIPTOR_BYTES), np.uint8))
        table, level = keypoint_table(found)
        octave = (level // 4).astype(np.int64)  # four levels of 1.2 are about one octave
        chosen = select_spread(table[:, :2], octave, table[:, 4], gray.shape, self.count, CONTRAST_POWER)
        kept, descriptors = self._detector.compute(gray, [found[k] for k in chosen])
        table, _ = keypoint_table(kept)
        return Features(
            px=np.ascontiguousarray(table[:, :2]),
            descriptors=np.asarray(descriptors, dtype=np.uint8),
            size_px=table[:, 2].copy(),
            angle_rad=angles_from_degrees(table[:, 3]),
            response=table[:, 4].copy(),
        )
