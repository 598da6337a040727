"""Ground points that two views of a map have in common, found where the map says they must be.

The poses say where a point of one view is in the other, up to an error that is alike over the view: nearest
descriptors in a wide circle about the prediction give a shift, turn and stretch of the picture, and nearest
descriptors in a small circle about the prediction so corrected are the same point.
"""

from __future__ import annotations

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.types import Features, IntArray
from overfly.vision.features.interface import Metric
from overfly.vision.matching import match_guided

WIDE_SHARE, NARROW_SHARE = 0.06, 0.01  # of the picture's width: radii of the two circles
RATIO = 0.8  # of the nearest to the second nearest descriptor in the wide circle
FEWEST = 12  # points in common that are believed
LEAST_SHARE = 0.35  # of the wide matches, that agree on one correction
ROUNDS = 5


def common_points(
    predicted: FloatArray,
    mine: Features,
    theirs: Features,
    width_px: int,
    metric: Metric,
    max_distance: float,
) -> tuple[IntArray, IntArray] | None:
    """Rows of features of one view and of another that are the same points; None when too few agree.

    predicted (n, 2): where the first view's features should be in the second, pixels, NaN where they are
    not seen; max_distance: of descriptors, in the metric's unit.
    """
    described = mine.descriptors, theirs.descriptors, metric, max_distance
    wide, narrow = WIDE_SHARE * width_px, NARROW_SHARE * width_px
    a, b, _ = match_guided(*described, predicted, theirs.px, wide, RATIO)
    if len(a) < FEWEST:
        return None
    correction = agreed_correction(predicted[a], theirs.px[b].astype(np.float64), narrow)
    if correction is None:
        return None
    corrected = predicted @ correction[:, :2].T + correction[:, 2]
    a, b, _ = match_guided(*described, corrected, theirs.px, narrow)
    return (a, b) if len(a) >= FEWEST else None


def agreed_correction(predicted: FloatArray, seen: FloatArray, limit_px: float) -> FloatArray | None:
    """(2, 3) similarity of the picture that takes predictions (n, 2) to where the points are seen, fitted to
    the largest group that agrees on a shift; None when that is too small.
    """
    shift = seen - predicted
    apart = np.linalg.norm(shift[:, None] - shift[None], axis=2)
    agree = apart[np.argmax((apart < 3.0 * limit_px).sum(axis=1))] < 3.0 * limit_px
    correction = np.zeros((2, 3))
    for _ in range(ROUNDS):
        if agree.sum() < max(FEWEST, LEAST_SHARE * len(predicted)):
            return None
        correction = _similarity(predicted[agree], seen[agree])
        left = predicted @ correction[:, :2].T + correction[:, 2] - seen
        agree = np.linalg.norm(left, axis=1) < 1.5 * limit_px
    return correction


def _similarity(a: FloatArray, b: FloatArray) -> FloatArray:
    """(2, 3) shift, turn and stretch of the plane that takes a (n, 2) nearest to b (n, 2)."""
    middle_a, middle_b = a.mean(axis=0), b.mean(axis=0)
    x, y = (a - middle_a) @ [1.0, 1.0j], (b - middle_b) @ [1.0, 1.0j]
    turn = np.vdot(x, y) / max(float(np.vdot(x, x).real), 1e-12)
    linear = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
    return np.hstack([linear, (middle_b - linear @ middle_a)[:, None]])
