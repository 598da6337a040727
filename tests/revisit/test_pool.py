"""Matching a view with several nodes at once says what matching it with one after the other does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.geometry.poses import FloatArray
from overfly.revisit.pool import Pool, match_pool, pool_of
from overfly.types import Features
from overfly.vision.features.interface import Metric
from overfly.vision.matching import match_guided, match_mutual
from overfly.vision.odometry import PooledMatches, Reference

SIZE = np.array([320.0, 240.0])
LIMIT = {Metric.HAMMING: 16.0, Metric.EUCLIDEAN: 4.0}


def features(generator: np.random.Generator, count: int, metric: Metric) -> Features:
    """Descriptors so short that many are equally far apart."""
    zero = np.zeros(count, np.float32)
    px = (generator.random((count, 2)) * SIZE).astype(np.float32)
    descriptors = generator.integers(0, 256, (count, 3), dtype=np.uint8)
    if metric is Metric.EUCLIDEAN:
        descriptors = generator.integers(0, 4, (count, 5)).astype(np.float32)
    return Features(px, descriptors, zero, zero, zero)


def scene(seed: int, metric: Metric) -> tuple[list[Reference], Features, FloatArray]:
    """Three nodes, some points without a place, and a view with its rays, one of them not known."""
    generator = np.random.default_rng(seed)
    references = []
    for node in range(3):
        held = features(generator, int(generator.integers(0, 40)), metric)
        points = generator.normal(size=(len(held), 3))
        points[generator.random(len(held)) < 0.2, 2] = np.nan
        references.append(Reference(node + 4, held, points, 0.1 * points))
    view = features(generator, int(generator.integers(1, 60)), metric)
    rays = generator.normal(size=(len(view), 2))
    rays[0] = np.nan
    return references, view, rays


def rows_of(matches: PooledMatches) -> list[tuple[int, int, int, float]]:
    found = matches.correspondences
    columns = matches.node, found.map_index, found.frame_index, found.distance
    return list(zip(*(column.tolist() for column in columns), strict=True))


def in_order(rows: list[tuple[int, int, int, float]]) -> list[tuple[int, int, int, float]]:
    return sorted((row for row in rows if row[2] != 0), key=lambda row: (row[3], row[0], row[1]))


@pytest.mark.parametrize("metric", list(Metric))
@given(st.integers(0, 10**6))
@settings(max_examples=60, deadline=None)
def test_everywhere_it_is_mutual_matching_with_each_node(metric: Metric, seed: int) -> None:
    references, view, rays = scene(seed, metric)
    expected = []
    for one in references:
        usable = np.flatnonzero(np.isfinite(one.points[:, 2]))
        found = match_mutual(one.features.descriptors[usable], view.descriptors, metric, LIMIT[metric])
        expected += [(one.node, int(usable[a]), int(b), float(d)) for a, b, d in zip(*found, strict=True)]
    matches = match_pool(pool_of(references, metric), view, rays, metric, LIMIT[metric])
    assert rows_of(matches) == in_order(expected)
    chosen = matches.correspondences
    for place, (node, row, frame_row, _) in enumerate(rows_of(matches)):
        assert (chosen.points[place] == references[node - 4].points[row]).all()
        assert (chosen.rays[place] == rays[frame_row]).all()


@pytest.mark.parametrize("metric", list(Metric))
@given(st.integers(0, 10**6), st.floats(0.0, 300.0))
@settings(max_examples=60, deadline=None)
def test_near_a_place_it_is_guided_matching_with_each_node(metric: Metric, seed: int, reach: float) -> None:
    references, view, rays = scene(seed, metric)
    pool = pool_of(references, metric)
    generator = np.random.default_rng(seed + 1)
    middle = generator.random((len(pool.points), 2)) * SIZE
    radii = reach * generator.random(len(pool.points))
    middle[generator.random(len(middle)) < 0.1] = np.nan
    radii[generator.random(len(radii)) < 0.1] = np.nan
    expected = []
    for number, one in enumerate(references):
        usable = np.flatnonzero(np.isfinite(one.points[:, 2]))
        found = match_guided(
            one.features.descriptors[usable], view.descriptors, metric, LIMIT[metric],
            pool.of(middle, number), view.px, pool.of(radii, number),
        )  # fmt: skip
        expected += [(one.node, int(usable[a]), int(b), float(d)) for a, b, d in zip(*found, strict=True)]
    matches = match_pool(pool, view, rays, metric, LIMIT[metric], middle, radii)
    assert rows_of(matches) == in_order(expected)


def away_by_hand(
    pool: Pool, view: Features, metric: Metric, at: FloatArray, radius: float
) -> set[tuple[int, int, int]]:
    """(node, row, row of the view) of mutual nearest neighbours not within the radius of at (n, 2)."""
    chosen = set()
    for number in range(len(pool.nodes)):
        own = np.arange(pool.starts[number], pool.starts[number + 1])
        if metric is Metric.HAMMING:
            bits = np.unpackbits(pool.words[own].view(np.uint8), axis=1).astype(int)
            other = np.unpackbits(np.pad(view.descriptors, ((0, 0), (0, 5))), axis=1).astype(int)
        else:
            bits, other = pool.words[own], view.descriptors
        apart = (bits[:, None] != other[None]).sum(2).astype(float)
        if metric is Metric.EUCLIDEAN:
            apart = np.sqrt(((bits[:, None] - other[None]) ** 2).sum(2))
        near = np.linalg.norm(at[own][:, None] - view.px[None].astype(float), axis=2) <= radius
        apart[near] = np.inf
        for k in range(len(own)):
            b = int(apart[k].argmin())
            if apart[k, b] <= LIMIT[metric] and apart[:, b].argmin() == k and b != 0:
                chosen.add((int(pool.node[own[k]]), int(pool.row[own[k]]), b))
    return chosen


@pytest.mark.parametrize("metric", list(Metric))
@given(st.integers(0, 10**6))
@settings(max_examples=60, deadline=None)
def test_away_from_a_place_pairs_near_it_do_not_count(metric: Metric, seed: int) -> None:
    references, view, rays = scene(seed, metric)
    pool = pool_of(references, metric)
    generator = np.random.default_rng(seed + 2)
    at = view.px[generator.integers(0, len(view), len(pool.points))] + generator.normal(
        size=(len(pool.points), 2)
    )
    at[generator.random(len(at)) < 0.1] = np.nan
    matches = match_pool(pool, view, rays, metric, LIMIT[metric], not_px=at, exclusion_px=40.0)
    found = {row[:3] for row in rows_of(matches)}
    assert found == away_by_hand(pool, view, metric, at, 40.0)
