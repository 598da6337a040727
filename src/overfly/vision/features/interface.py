"""What every feature extractor offers, and the checks and helpers they share."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from operator import attrgetter
from typing import Protocol

import cv2
import numpy as np

from overfly.types import Features, Float32Array, IntArray, UInt8Array


class Metric(StrEnum):
    """How far two descriptors are from each other."""

    HAMMING = "hamming"  # bits that differ; uint8 descriptors
    EUCLIDEAN = "euclidean"  # float32 descriptors


class Extractor(Protocol):
    """Finds and describes features. Keeps nothing between images: same image, same features, bit for bit.

    One extractor may be used from several threads at once.
    """

    @property
    def name(self) -> str:
        """Name in the configuration and in map files; descriptors of different names cannot be compared."""
        ...

    @property
    def metric(self) -> Metric:
        """What descriptors are compared with."""
        ...

    @property
    def max_distance(self) -> float:
        """d_desc_max of the paper's Eq. 4: descriptors further apart, in the metric's unit, do not match."""
        ...

    def extract(self, gray: UInt8Array) -> Features:
        """gray: (H, W) uint8 -> its features, best first, spread over the image.

        An image without texture has none. Raises ValueError when gray is not a two-dimensional uint8 array.
        """
        ...


def checked_image(gray: UInt8Array) -> UInt8Array:
    """The image as a contiguous array; raises ValueError when it is not (H, W) uint8."""
    if gray.ndim != 2 or gray.dtype != np.uint8:
        raise ValueError(f"features need a gray image (H, W) of uint8, not {gray.shape} of {gray.dtype}")
    return np.ascontiguousarray(gray)


def no_features(descriptors: np.ndarray) -> Features:
    """No features; descriptors: (0, d) of the extractor's type."""
    empty = np.empty(0, np.float32)
    return Features(np.empty((0, 2), np.float32), descriptors, empty, empty, empty)


def angles_from_degrees(degrees: Float32Array) -> Float32Array:
    """OpenCV's angles, degrees in [0, 360), as radians in (-pi, pi]."""
    return np.asarray(np.deg2rad((degrees + 180.0) % 360.0 - 180.0), dtype=np.float32)


def stretch_contrast(gray: UInt8Array) -> UInt8Array:
    """gray: (H, W) uint8 -> the same with its 1st to 99th percentile stretched over all grey levels.

    Descriptors with learned thresholds and detectors with fixed ones then see dark and hazy pictures as any
    others.
    """
    histogram = cv2.calcHist([gray], [0], None, [256], [0, 256]).ravel()
    share = np.cumsum(histogram) / gray.size
    low, high = (int(level) for level in np.searchsorted(share, (0.01, 0.99)))
    if high <= low:
        return gray
    levels = (np.arange(256) - low) * (255.0 / (high - low))
    return np.asarray(cv2.LUT(gray, np.clip(np.rint(levels), 0, 255).astype(np.uint8)), dtype=np.uint8)


_ATTRIBUTES = attrgetter("pt", "size", "angle", "response", "octave")


def keypoint_table(keypoints: Sequence[cv2.KeyPoint]) -> tuple[Float32Array, IntArray]:
    """OpenCV's keypoints -> (n, 5) of x, y, size, angle in degrees, response; and (n,) their octave as OpenCV
    packs it."""
    rows = [(*point, *others) for point, *others in map(_ATTRIBUTES, keypoints)]
    table = np.array(rows, np.float64).reshape(-1, 6)
    return table[:, :5].astype(np.float32), table[:, 5].astype(np.int64)
