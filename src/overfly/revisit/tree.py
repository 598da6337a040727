"""Nearest neighbours among all descriptors of the map: kd-trees searched best bin first (Lowe 2004; the
paper, section IV).

The trees grow with the map: a new descriptor goes down to its leaf, and a leaf that is full is split, so
that there is never anything to rebuild. Float descriptors are split at the mean of their most spread
element, binary ones at the bit that halves the leaf best. A query visits leaves in the order of how far
they can be at least and stops after a number of comparisons, so that its cost hardly grows with the map.
Several trees, each of which splits at other elements, miss less than one with as many comparisons.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from overfly.types import Float32Array, IntArray
from overfly.vision.features.interface import Metric
from overfly.vision.matching import compare_kernel

LEAF_SIZE = 24
LARGEST_HEAP = 2048


class DescriptorTrees:
    """Trees over rows of one growing table of descriptors, which the caller keeps."""

    def __init__(self, metric: Metric, n_trees: int = 4) -> None:
        self.binary = metric is Metric.HAMMING
        self.n_trees = n_trees
        # Per tree and inner node: element, value, and both children; children >= 0 are inner nodes, ~leaf
        # are leaves.
        self._element = np.zeros((n_trees, 64), np.int32)
        self._value = np.zeros((n_trees, 64), np.float32)
        self._child = np.zeros((n_trees, 64, 2), np.int32)
        self._rows = np.zeros((n_trees, 64, LEAF_SIZE), np.int32)
        self._filled = np.zeros((n_trees, 64), np.int32)
        self._n_inner = np.zeros(n_trees, np.int64)
        self._n_leaves = np.ones(n_trees, np.int64)
        self._root = np.full(n_trees, -1, np.int64)  # ~0: the first leaf

    def insert(self, table: NDArray[Any], first: int, last: int) -> None:
        """Enter rows first to last - 1 of the table (n, words), as comparable() makes them."""
        # Every row splits at most one leaf.
        needed = int(self._n_leaves.max()) + last - first + 1
        if needed > self._filled.shape[1]:
            self._grow(max(needed, 2 * self._filled.shape[1]))
        for tree in range(self.n_trees):
            self._n_inner[tree], self._n_leaves[tree], self._root[tree] = _insert(
                table, first, last, self.binary, tree, self.n_trees, self._root[tree], self._element[tree],
                self._value[tree], self._child[tree], self._rows[tree], self._filled[tree],
                self._n_inner[tree], self._n_leaves[tree],
            )  # fmt: skip

    def _grow(self, size: int) -> None:
        for name in ("_element", "_value", "_child", "_rows", "_filled"):
            old = getattr(self, name)
            grown = np.zeros((old.shape[0], size, *old.shape[2:]), old.dtype)
            grown[:, : old.shape[1]] = old
            setattr(self, name, grown)

    def nearest(
        self, table: NDArray[Any], queries: NDArray[Any], comparisons: int
    ) -> tuple[IntArray, Float32Array]:
        """Row (q,) of the nearest descriptor found for each query, -1 for none, and its distance (q,) in
        the metric's unit.

        comparisons: how many rows a query is compared with at most, over all trees.
        """
        row, distance = _search(
            table, queries, self.binary, comparisons, self._root, self._element, self._value, self._child,
            self._rows, self._filled,
        )  # fmt: skip
        return row, distance if self.binary else np.sqrt(distance)


@njit(cache=True, nogil=True, inline="always")
def _element_of(descriptor, element, binary):  # type: ignore[no-untyped-def]
    """A bit as 0 or 1, or an element of a float descriptor."""
    if binary:
        word = np.uint64(descriptor[element >> 6])
        return np.float32((word >> np.uint64(element & 63)) & np.uint64(1))
    return np.float32(descriptor[element])


@njit(cache=True, nogil=True)
def _insert(  # type: ignore[no-untyped-def]
    table, first, last, binary, tree, n_trees, root, element, value, child, rows, filled, n_inner, n_leaves
):
    for row in range(first, last):
        parent, side, at = -1, 0, root
        while at >= 0:
            parent = at
            side = 1 if _element_of(table[row], element[at], binary) >= value[at] else 0
            at = child[at, side]
        leaf = ~at
        if filled[leaf] == LEAF_SIZE:
            best, cut = _best_split(table, rows[leaf], binary, tree, n_trees)
            if best < 0:
                continue  # as many equal descriptors as a leaf holds: one more tells nothing
            element[n_inner], value[n_inner] = best, cut
            child[n_inner, 0], child[n_inner, 1] = ~leaf, ~n_leaves
            _divide(table, rows, filled, leaf, n_leaves, best, cut, binary)
            if parent < 0:
                root = n_inner
            else:
                child[parent, side] = n_inner
            leaf = n_leaves if _element_of(table[row], best, binary) >= cut else leaf
            n_inner += 1
            n_leaves += 1
        if filled[leaf] < LEAF_SIZE:
            rows[leaf, filled[leaf]] = row
            filled[leaf] += 1
    return n_inner, n_leaves, root


@njit(cache=True, nogil=True)
def _best_split(table, rows, binary, tree, n_trees):  # type: ignore[no-untyped-def]
    """Most spread element of the leaf's descriptors, among those that are this tree's, and its mean; -1 if
    all are equal."""
    count = table.shape[1] * 64 if binary else table.shape[1]
    best, cut, largest = -1, np.float32(0.0), 0.0
    for e in range(tree, count, n_trees):
        total, squares = 0.0, 0.0
        for row in rows:
            x = _element_of(table[row], e, binary)
            total += x
            squares += x * x
        mean = total / len(rows)
        spread = squares / len(rows) - mean * mean
        if spread > largest * (1.0 + 1e-6) + 1e-12:
            best, cut, largest = e, np.float32(0.5 if binary else mean), spread
    return best, cut


@njit(cache=True, nogil=True)
def _divide(table, rows, filled, leaf, other, element, cut, binary):  # type: ignore[no-untyped-def]
    """Move those rows of the leaf that are at or above the cut to the other leaf."""
    kept, moved = 0, 0
    for k in range(filled[leaf]):
        row = rows[leaf, k]
        if _element_of(table[row], element, binary) >= cut:
            rows[other, moved] = row
            moved += 1
        else:
            rows[leaf, kept] = row
            kept += 1
    filled[leaf], filled[other] = kept, moved


@njit(cache=True, nogil=True)
def _push(bounds, trees, nodes, size, bound, tree, node):  # type: ignore[no-untyped-def]
    at = size
    while at > 0 and bounds[(at - 1) // 2] > bound:
        up = (at - 1) // 2
        bounds[at], trees[at], nodes[at] = bounds[up], trees[up], nodes[up]
        at = up
    bounds[at], trees[at], nodes[at] = bound, tree, node
    return size + 1


@njit(cache=True, nogil=True)
def _pop(bounds, trees, nodes, size):  # type: ignore[no-untyped-def]
    """Removes the first entry of a heap of ``size`` entries."""
    size -= 1
    bound, tree, node = bounds[size], trees[size], nodes[size]
    at = 0
    while 2 * at + 1 < size:
        down = 2 * at + 1
        if down + 1 < size and bounds[down + 1] < bounds[down]:
            down += 1
        if bounds[down] >= bound:
            break
        bounds[at], trees[at], nodes[at] = bounds[down], trees[down], nodes[down]
        at = down
    bounds[at], trees[at], nodes[at] = bound, tree, node
    return size


@njit(cache=True, nogil=True)
def _search(table, queries, binary, comparisons, root, element, value, child, rows, filled):  # type: ignore[no-untyped-def]
    found = np.full(len(queries), -1, np.int64)
    distance = np.full(len(queries), np.inf, np.float32)
    bounds = np.empty(LARGEST_HEAP, np.float32)
    trees = np.empty(LARGEST_HEAP, np.int64)
    nodes = np.empty(LARGEST_HEAP, np.int64)
    for q in range(len(queries)):
        size, compared = 0, 0
        for tree in range(len(root)):
            size = _push(bounds, trees, nodes, size, np.float32(0.0), tree, root[tree])
        while size > 0 and compared < comparisons:
            bound, tree, at = bounds[0], trees[0], nodes[0]
            size = _pop(bounds, trees, nodes, size)
            if bound >= distance[q]:
                break
            while at >= 0:
                difference = _element_of(queries[q], element[tree, at], binary) - value[tree, at]
                side = 1 if difference >= 0 else 0
                # Another bit is one more of distance; other elements add the square of how far beyond the
                # cut they are.
                further = bound + (np.float32(1.0) if binary else difference * difference)
                if further < distance[q] and size < LARGEST_HEAP:
                    size = _push(bounds, trees, nodes, size, further, tree, child[tree, at, 1 - side])
                at = child[tree, at, side]
            leaf = ~at
            for k in range(filled[tree, leaf]):
                row = rows[tree, leaf, k]
                d = compare_kernel(queries[q], table[row], binary)
                compared += 1
                if d < distance[q]:
                    distance[q], found[q] = d, row
    return found, distance
