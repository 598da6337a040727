"""Points that two views have in common are found through an error alike over the picture; no others."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.types import Features
from overfly.vision.common_points import agreed_correction, common_points
from overfly.vision.features.interface import Metric

WIDTH = 320


def features(px: np.ndarray, descriptors: np.ndarray) -> Features:
    n = len(px)
    return Features(
        px.astype(np.float32),
        descriptors,
        np.ones(n, np.float32),
        np.zeros(n, np.float32),
        np.ones(n, np.float32),
    )


def views(seed: int, shift: tuple[float, float], turn: float) -> tuple[np.ndarray, Features, Features]:
    """200 points, 150 of them in both views; predictions are off by a shift and a turn about the middle."""
    generator = np.random.default_rng(seed)
    px = generator.uniform(20, 300, (200, 2))
    descriptors = generator.integers(0, 256, (200, 32), dtype=np.uint8)
    c, s = np.cos(turn), np.sin(turn)
    seen = (px - 160) @ np.array([[c, s], [-s, c]]) + 160 + shift + generator.normal(0, 0.3, px.shape)
    theirs = descriptors.copy()
    theirs[:, 0] ^= 1  # one bit of difference
    theirs[150:] = generator.integers(0, 256, (50, 32), dtype=np.uint8)
    return px, features(px, descriptors), features(seen, theirs)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 1000), st.floats(-9, 9), st.floats(-9, 9), st.floats(-0.03, 0.03))
def test_an_error_that_is_alike_over_the_view_is_bridged(seed: int, x: float, y: float, turn: float) -> None:
    predicted, mine, theirs = views(seed, (x, y), turn)
    found = common_points(predicted, mine, theirs, WIDTH, Metric.HAMMING, 60.0)
    assert found is not None
    a, b = found
    assert (a == b).all()
    assert 140 <= len(a) <= 150


@pytest.mark.parametrize("shift", [(60.0, 0.0), (0.0, -45.0)])
def test_errors_beyond_the_wide_circle_are_not(shift: tuple[float, float]) -> None:
    predicted, mine, theirs = views(1, shift, 0.0)
    assert common_points(predicted, mine, theirs, WIDTH, Metric.HAMMING, 60.0) is None


def test_views_of_different_ground_have_nothing_in_common() -> None:
    predicted, mine, _ = views(2, (0.0, 0.0), 0.0)
    _, _, other = views(3, (0.0, 0.0), 0.0)
    assert common_points(predicted, mine, other, WIDTH, Metric.HAMMING, 60.0) is None
    hidden = np.full_like(predicted, np.nan)
    assert common_points(hidden, mine, other, WIDTH, Metric.HAMMING, 60.0) is None


def test_a_correction_needs_agreement() -> None:
    generator = np.random.default_rng(4)
    a = generator.uniform(0, 300, (40, 2))
    assert agreed_correction(a, a + generator.uniform(-18, 18, a.shape), 3.2) is None
    found = agreed_correction(a, a + np.array([4.0, -7.0]), 3.2)
    assert found is not None
    np.testing.assert_allclose(found, [[1, 0, 4], [0, 1, -7]], atol=1e-9)
