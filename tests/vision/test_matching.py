"""Matching against plain NumPy twins."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.vision.features import Metric
from overfly.vision.matching import match_guided, match_mutual

KINDS = [(Metric.HAMMING, 32), (Metric.HAMMING, 61), (Metric.EUCLIDEAN, 64)]


def random_descriptors(rng, count, metric, length):
    if metric is Metric.HAMMING:
        return rng.integers(0, 256, (count, length), dtype=np.uint8)
    return rng.normal(size=(count, length)).astype(np.float32)


def all_distances(a, b, metric):
    if metric is Metric.HAMMING:
        return np.unpackbits(a[:, None] ^ b[None], axis=2).sum(axis=2).astype(float)
    return np.linalg.norm(a[:, None].astype(float) - b[None], axis=2)


def twin(distances, max_distance, max_ratio=np.inf):
    """Mutual nearest neighbours of a distance matrix with np.inf where a pair is not allowed: {i: (j,
    distance)}."""
    pairs = {}
    for i, row in enumerate(distances):
        j = int(np.argmin(row))
        second = np.partition(row, 1)[1] if len(row) > 1 else np.inf
        best = row[j]
        is_mutual = np.isfinite(best) and int(np.argmin(distances[:, j])) == i
        if is_mutual and best <= max_distance and (max_ratio == np.inf or best <= max_ratio * second):
            pairs[i] = (j, best)
    return pairs


def as_pairs(matches):
    return {int(i): (int(j), float(d)) for i, j, d in zip(*matches, strict=True)}


def assert_same(found, wanted):
    assert found.keys() == wanted.keys()
    for i, (j, distance) in wanted.items():
        assert found[i][0] == j
        assert found[i][1] == pytest.approx(distance, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize(("metric", "length"), KINDS)
@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_a=st.integers(1, 40),
    n_b=st.integers(1, 40),
    quantile=st.floats(0.0, 1.0),
    max_ratio=st.sampled_from([np.inf, 0.95, 0.8]),
)
def test_mutual_matches_are_those_of_the_twin(metric, length, seed, n_a, n_b, quantile, max_ratio):
    rng = np.random.default_rng(seed)
    a, b = random_descriptors(rng, n_a, metric, length), random_descriptors(rng, n_b, metric, length)
    b[: min(n_a, n_b) // 2] = a[: min(n_a, n_b) // 2]
    distances = all_distances(a, b, metric)
    limit = float(np.quantile(distances, quantile)) + 0.01
    index_a, index_b, distance = match_mutual(a, b, metric, limit, max_ratio)
    assert_same(as_pairs((index_a, index_b, distance)), twin(distances, limit, max_ratio))
    assert (np.diff(distance) >= 0).all()
    assert len(set(index_b.tolist())) == len(index_b)


@pytest.mark.parametrize(("metric", "length"), KINDS)
@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_a=st.integers(1, 60),
    n_b=st.integers(1, 60),
    radius=st.floats(0.0, 400.0),
)
def test_guided_matches_are_those_of_the_twin(metric, length, seed, n_a, n_b, radius):
    rng = np.random.default_rng(seed)
    a, b = random_descriptors(rng, n_a, metric, length), random_descriptors(rng, n_b, metric, length)
    px_b = rng.uniform([0, 0], [320, 240], (n_b, 2))
    predicted = rng.uniform([-100, -100], [420, 340], (n_a, 2))
    predicted[rng.random(n_a) < 0.2] = np.nan
    radii = radius * rng.uniform(0.1, 1.0, n_a)
    apart = np.linalg.norm(predicted[:, None] - px_b[None], axis=2)
    distances = all_distances(a, b, metric)
    distances[~(apart <= radii[:, None])] = np.inf
    found = match_guided(a, b, metric, 1e9, predicted, px_b, radii)
    assert_same(as_pairs(found), twin(distances, 1e9))
    found = match_guided(a, b, metric, 1e9, predicted, px_b, radii, max_ratio=0.9)
    assert_same(as_pairs(found), twin(distances, 1e9, 0.9))


@pytest.mark.parametrize(("metric", "length"), KINDS)
def test_guided_with_an_endless_radius_is_mutual(metric, length):
    rng = np.random.default_rng(5)
    a, b = random_descriptors(rng, 50, metric, length), random_descriptors(rng, 70, metric, length)
    px = rng.uniform(0, 300, (70, 2)).astype(np.float32)
    guided = match_guided(a, b, metric, 1e9, px[:50], px, np.inf)
    for one, other in zip(guided, match_mutual(a, b, metric, 1e9), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)


def test_of_equally_near_neighbours_the_first_counts():
    a = np.zeros((2, 32), np.uint8)
    b = np.zeros((3, 32), np.uint8)
    index_a, index_b, distance = match_mutual(a, b, Metric.HAMMING, 10.0)
    assert (index_a.tolist(), index_b.tolist(), distance.tolist()) == ([0], [0], [0.0])
    # A tie is ambiguous to the ratio test unless the distance itself is zero.
    b[:, 0] = 1
    assert len(match_mutual(a, b, Metric.HAMMING, 10.0, max_ratio=0.9)[0]) == 0


def test_the_limit_is_included():
    a = np.zeros((1, 32), np.uint8)
    b = np.full((1, 32), 3, np.uint8)
    assert len(match_mutual(a, b, Metric.HAMMING, 64.0)[0]) == 1
    assert len(match_mutual(a, b, Metric.HAMMING, 63.9)[0]) == 0


@pytest.mark.parametrize(("metric", "length"), KINDS)
@pytest.mark.parametrize(("n_a", "n_b"), [(0, 0), (0, 3), (3, 0)])
def test_no_features_have_no_matches(metric, length, n_a, n_b):
    rng = np.random.default_rng(1)
    a, b = random_descriptors(rng, n_a, metric, length), random_descriptors(rng, n_b, metric, length)
    for found in (
        match_mutual(a, b, metric, 1e9),
        match_guided(a, b, metric, 1e9, np.zeros((n_a, 2)), np.zeros((n_b, 2)), 5.0),
    ):
        assert [len(part) for part in found] == [0, 0, 0]


def test_descriptors_that_cannot_be_compared_are_refused():
    bits, numbers = np.zeros((2, 32), np.uint8), np.zeros((2, 32), np.float32)
    for a, b, metric in (
        (bits, numbers, Metric.HAMMING),
        (bits, bits, Metric.EUCLIDEAN),
        (bits, bits[:, :16], Metric.HAMMING),
        (numbers, numbers.ravel(), Metric.EUCLIDEAN),
    ):
        with pytest.raises(ValueError, match=r"descriptors"):
            match_mutual(a, b, metric, 1.0)
    with pytest.raises(ValueError, match="finite"):
        match_guided(bits, bits, Metric.HAMMING, 1.0, np.zeros((2, 2)), np.full((2, 2), np.nan), 1.0)
