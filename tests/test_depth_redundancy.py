"""Measurements of depth that tell the same count for what they are worth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from overfly.depth_redundancy import SAME_POINT, depth_redundancy
from overfly.vision.stereo import WINDOW_PX


def test_points_far_apart_count_fully_and_what_was_not_measured_counts_for_nothing() -> None:
    px = np.array([[10.0, 10.0], [10.0, 200.0], [10.5, 200.0], [150.0, 30.0]])
    depths = np.array([0.5, 0.5, np.nan, 0.5])
    factor = depth_redundancy(depths, np.arange(4), np.zeros(4, np.int64), px)
    np.testing.assert_allclose(factor, 1.0)


def test_one_window_measured_twice_is_one_measurement() -> None:
    px = np.array([[50.0, 60.0], [50.0, 60.0]])
    factor = depth_redundancy(np.full(2, 0.5), np.arange(2), np.zeros(2, np.int64), px)
    np.testing.assert_allclose(factor, 2.0)


def test_windows_of_different_pictures_do_not_overlap() -> None:
    px = np.full((3, 2), 50.0)
    factor = depth_redundancy(np.full(3, 0.5), np.arange(3), np.arange(3), px)
    np.testing.assert_allclose(factor, 1.0)


@given(st.integers(1, 12))
def test_a_point_measured_from_many_nodes_never_counts_for_more_than_its_correlation_allows(
    views: int,
) -> None:
    factor = depth_redundancy(
        np.full(views, 0.5), np.zeros(views, np.int64), np.arange(views), np.full((views, 2), 80.0)
    )
    # The mean of equally correlated measurements has at least the variance that they have in common.
    worth = np.sum(1.0 / factor)
    assert worth == pytest.approx(views / (1.0 + (views - 1) * SAME_POINT))
    assert 1.0 <= worth < 1.0 / SAME_POINT


@given(st.integers(0, 2**32 - 1))
def test_the_sum_of_the_overlaps_is_that_of_all_pairs(seed: int) -> None:
    generator = np.random.default_rng(seed)
    n = 40
    px, node = generator.uniform(0, 60, (n, 2)), generator.integers(0, 3, n)
    factor = depth_redundancy(np.full(n, 0.5), np.arange(n), node, px)
    apart = np.abs(px[:, None] - px[None])
    part = np.prod(np.maximum(1.0 - apart / WINDOW_PX, 0.0), axis=2) * (node[:, None] == node[None])
    np.testing.assert_allclose(factor, part.sum(axis=1))
