"""Optical flow of points from picture to picture, in pictures that are reduced."""

from __future__ import annotations

import math

import cv2
import numpy as np

from overfly.types import BoolArray, Float32Array, UInt8Array
from overfly.vision.alignment import halved
from overfly.vision.observation import Observation

COARSE_WIDTH_PX = 160  # of the picture in which the motion is sought: finer detail is not needed for it
COARSE_WINDOW_PX = 15
COARSE_LEVELS = 2


def coarse_picture(view: Observation) -> tuple[UInt8Array, float]:
    """The picture reduced for the motion, and by how much."""
    level = max(1, round(math.log2(view.gray.shape[1] / COARSE_WIDTH_PX)))
    coarse = view.pyramid[min(level, len(view.pyramid) - 1)]
    for _ in range(level - len(view.pyramid) + 1):
        coarse = halved(coarse)
    return coarse, 2.0**level


def flow(
    last: UInt8Array, current: UInt8Array, px: Float32Array, guess: Float32Array
) -> tuple[Float32Array, BoolArray]:
    """Pyramidal Lucas-Kanade from a guess."""
    usable = np.isfinite(guess).all(axis=1, keepdims=True)
    guess = np.where(usable, guess, px).astype(np.float32)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        last,
        current,
        np.ascontiguousarray(px),
        guess,
        winSize=(COARSE_WINDOW_PX, COARSE_WINDOW_PX),
        maxLevel=COARSE_LEVELS,
        criteria=(cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 10, 0.03),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=1e-4,
    )
    inside = ((found >= 0) & (found < np.array([current.shape[1], current.shape[0]]))).all(axis=1)
    return np.asarray(found, np.float32), (status.ravel() == 1) & inside
