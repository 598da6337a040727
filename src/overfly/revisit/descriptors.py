"""Descriptors of all nodes, contiguous node by node: a search over some nodes is exact and reads memory in
order."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from overfly.types import BoolArray, Features, IntArray
from overfly.vision.features.interface import Metric
from overfly.vision.matching import distances_kernel


class DescriptorBlocks:
    """One block of descriptors per node, in the order of the nodes."""

    def __init__(self, metric: Metric) -> None:
        self.metric = metric
        self._data: NDArray[Any] | None = None
        self._ends: list[int] = []

    def __len__(self) -> int:
        """Nodes stored."""
        return len(self._ends)

    @property
    def table(self) -> NDArray[Any]:
        """(n_features, words) all descriptors; valid until the next node is added."""
        assert self._data is not None
        return self._data[: self.n_features]

    def nodes_of(self, rows: IntArray) -> IntArray:
        """(k,) nodes that rows (k,) of the table belong to."""
        return np.searchsorted(np.array(self._ends), rows, side="right")

    def rows_of(self, nodes: IntArray) -> BoolArray:
        """(n_features,) whether a row of the table belongs to one of the nodes."""
        held = np.zeros(len(self), np.bool_)
        held[nodes] = True
        return np.repeat(held, np.diff(self._ends, prepend=0))

    @property
    def n_features(self) -> int:
        return self._ends[-1] if self._ends else 0

    def add(self, features: Features) -> None:
        """Append the block of the next node."""
        rows = comparable(features.descriptors, self.metric)
        begin, end = self.n_features, self.n_features + len(rows)
        if self._data is None:
            self._data = np.empty((1024, rows.shape[1]), rows.dtype)
        if end > len(self._data):
            grown = np.empty((max(end, 2 * len(self._data)), self._data.shape[1]), self._data.dtype)
            grown[:begin] = self._data[:begin]
            self._data = grown
        self._data[begin:end] = rows
        self._ends.append(end)

    def span(self, node: int) -> tuple[int, int]:
        """First and one past the last row of a node's block."""
        return (self._ends[node - 1] if node else 0), self._ends[node]

    def votes(self, queries: NDArray[Any], nodes: IntArray, max_distance: float) -> IntArray:
        """(k,) for each of the nodes, how many of the queries (q, words) have their nearest neighbour among
        all these nodes there, or one as near as that within a fifth.

        queries as comparable() makes them; max_distance in the metric's unit.
        """
        if len(nodes) == 0 or len(queries) == 0 or self._data is None:
            return np.zeros(len(nodes), np.int64)
        spans = np.array([self.span(int(node)) for node in nodes])
        columns = np.ascontiguousarray(queries.T)
        nearest = _nearest_of_blocks(columns, self._data, spans[:, 0], spans[:, 1])
        if self.metric is Metric.EUCLIDEAN:
            nearest = np.sqrt(nearest)
        best = nearest.min(axis=0)
        near = (nearest <= max_distance) & (nearest <= NEARLY_AS_NEAR * best)
        return np.asarray(near.sum(axis=1), np.int64)


NEARLY_AS_NEAR = 1.2  # of the nearest distance: the same ground seen from neighbouring nodes


def comparable(descriptors: NDArray[Any], metric: Metric) -> NDArray[Any]:
    """Descriptors as the kernels compare them: uint64 words for Hamming, float32 for Euclidean distance."""
    if metric is Metric.EUCLIDEAN:
        return np.ascontiguousarray(descriptors, np.float32)
    count, width = descriptors.shape
    padded = np.zeros((count, -(-width // 8) * 8), np.uint8)
    padded[:, :width] = descriptors
    return padded.view(np.uint64)


@njit(cache=True, nogil=True)
def _nearest_of_blocks(columns, data, begins, ends):  # type: ignore[no-untyped-def]
    """columns (words, q), data (n, words): (k, q) distance between each query and its nearest neighbour in
    each block; Euclidean ones are squared."""
    nearest = np.full((len(begins), columns.shape[1]), np.inf, np.float32)
    distances = np.empty(columns.shape[1], columns.dtype)
    for k in range(len(begins)):
        for row in range(begins[k], ends[k]):
            distances_kernel(data, row, columns, distances)
            for q in range(len(distances)):
                nearest[k, q] = min(nearest[k, q], np.float32(distances[q]))
    return nearest
