"""Descriptors by node and the trees over them, against plain comparison of everything with everything."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from overfly.revisit.descriptors import DescriptorBlocks, comparable
from overfly.revisit.tree import LEAF_SIZE, DescriptorTrees
from overfly.types import Features
from overfly.vision.features.interface import Metric
from overfly.vision.matching import compare_kernel

BYTES = 32


def features_of(descriptors: NDArray[np.uint8] | NDArray[np.float32]) -> Features:
    n = len(descriptors)
    zero = np.zeros(n, np.float32)
    return Features(np.zeros((n, 2), np.float32), descriptors, zero, zero, zero)


def random_descriptors(generator: np.random.Generator, count: int, metric: Metric) -> np.ndarray:
    if metric is Metric.HAMMING:
        return generator.integers(0, 256, (count, BYTES), dtype=np.uint8)
    return generator.normal(size=(count, 64)).astype(np.float32)


def with_flipped_bits(
    generator: np.random.Generator, descriptors: NDArray[np.uint8], share: float
) -> NDArray[np.uint8]:
    flips = generator.random((len(descriptors), 8 * BYTES)) < share
    return np.asarray(descriptors ^ np.packbits(flips, axis=1))


def all_distances(a: np.ndarray, b: np.ndarray, metric: Metric) -> np.ndarray:
    """The twin: (len(a), len(b)) distances in the metric's unit."""
    if metric is Metric.HAMMING:
        return np.unpackbits(a[:, None] ^ b[None], axis=2).sum(axis=2).astype(float)
    return np.linalg.norm(a[:, None].astype(float) - b[None], axis=2)


@given(st.integers(0, 10_000), st.sampled_from(list(Metric)))
def test_distances_equal_the_twin(seed: int, metric: Metric) -> None:
    generator = np.random.default_rng(seed)
    a, b = random_descriptors(generator, 3, metric), random_descriptors(generator, 4, metric)
    binary = metric is Metric.HAMMING
    x, y = comparable(a, metric), comparable(b, metric)
    found = [[compare_kernel(x, i, y, j) for j in range(len(y))] for i in range(len(x))]
    distance = np.array(found) if binary else np.sqrt(found)
    assert np.allclose(distance, all_distances(a, b, metric), rtol=1e-5)


@given(st.integers(0, 10_000), st.sampled_from(list(Metric)))
def test_votes_equal_the_twin(seed: int, metric: Metric) -> None:
    generator = np.random.default_rng(seed)
    nodes = [random_descriptors(generator, int(n), metric) for n in generator.integers(0, 30, 6)]
    queries = random_descriptors(generator, 12, metric)
    limit = 112.0 if metric is Metric.HAMMING else 10.0
    blocks = DescriptorBlocks(metric)
    for node in nodes:
        blocks.add(features_of(node))
    chosen = generator.permutation(6)[:4]
    votes = blocks.votes(comparable(queries, metric), chosen, limit)
    nearest = np.array([all_distances(queries, nodes[k], metric).min(axis=1, initial=np.inf) for k in chosen])
    expected = ((nearest <= limit) & (nearest <= 1.2 * nearest.min(axis=0) + 1e-4)).sum(axis=1)
    assert votes.tolist() == expected.tolist()


def test_rows_belong_to_their_nodes() -> None:
    generator = np.random.default_rng(1)
    blocks = DescriptorBlocks(Metric.HAMMING)
    counts = [3, 0, 1500, 2]
    for count in counts:
        blocks.add(features_of(random_descriptors(generator, count, Metric.HAMMING)))
    assert len(blocks) == 4
    assert blocks.n_features == len(blocks.table) == sum(counts)
    owners = blocks.nodes_of(np.arange(sum(counts)))
    assert owners.tolist() == np.repeat(np.arange(4), counts).tolist()


@pytest.mark.parametrize("metric", list(Metric))
def test_a_search_without_limit_is_exact(metric: Metric) -> None:
    generator = np.random.default_rng(2)
    stored, queries = random_descriptors(generator, 3000, metric), random_descriptors(generator, 40, metric)
    table = comparable(stored, metric)
    trees = DescriptorTrees(metric, 2)
    for first in range(0, 3000, 700):  # in pieces, as a map grows
        trees.insert(table, first, min(first + 700, 3000))
    row, distance = trees.nearest(table, comparable(queries, metric), 10**6)
    truth = all_distances(queries, stored, metric)
    assert np.allclose(distance, truth.min(axis=1), rtol=1e-5)
    assert np.allclose(truth[np.arange(40), row], truth.min(axis=1), rtol=1e-5)


def test_few_comparisons_find_most_noisy_descriptors_in_a_large_map() -> None:
    generator = np.random.default_rng(3)
    stored = random_descriptors(generator, 100_000, Metric.HAMMING)
    chosen = generator.integers(0, len(stored), 300)
    queries = with_flipped_bits(generator, stored[chosen], 0.08)
    table = comparable(stored, Metric.HAMMING)
    trees = DescriptorTrees(Metric.HAMMING, 4)
    trees.insert(table, 0, len(table))
    row, _ = trees.nearest(table, comparable(queries, Metric.HAMMING), 400)
    found = float(np.mean(row == chosen))
    assert found > 0.8
    one_tree = DescriptorTrees(Metric.HAMMING, 1)
    one_tree.insert(table, 0, len(table))
    row, _ = one_tree.nearest(table, comparable(queries, Metric.HAMMING), 400)
    assert float(np.mean(row == chosen)) < found


def test_equal_descriptors_do_not_fill_the_trees_for_ever() -> None:
    table = comparable(np.full((10 * LEAF_SIZE, BYTES), 7, np.uint8), Metric.HAMMING)
    trees = DescriptorTrees(Metric.HAMMING, 2)
    trees.insert(table, 0, len(table))
    row, distance = trees.nearest(table, table[:1], 10_000)
    assert distance[0] == 0
    assert 0 <= row[0] < len(table)


def test_an_empty_map_holds_no_neighbour() -> None:
    trees = DescriptorTrees(Metric.HAMMING, 3)
    table = comparable(np.zeros((1, BYTES), np.uint8), Metric.HAMMING)
    row, distance = trees.nearest(table, table, 100)
    assert row.tolist() == [-1]
    assert np.isinf(distance[0])
    assert DescriptorBlocks(Metric.HAMMING).votes(table, np.empty(0, np.int64), 64.0).tolist() == []
