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

from overfly.types import BoolArray, Float32Array, IntArray
from overfly.vision.features.interface import Metric
from overfly.vision.matching import WORDS, compare_kernel

LEAF_SIZE = 24
FILLED = LEAF_SIZE  # column of a leaf, after its rows, that says how many there are
LARGEST_HEAP = 2048
INNER = np.dtype([("element", "i4"), ("value", "f4"), ("below", "i4"), ("above", "i4")])


class DescriptorTrees:
    """Trees over rows of one growing table of descriptors, which the caller keeps."""

    def __init__(self, metric: Metric, n_trees: int = 4) -> None:
        self.binary = metric is Metric.HAMMING
        self.n_trees = n_trees
        # Per tree and inner node: element, value, and both children; children >= 0 are inner nodes, ~leaf
        # are leaves. What is read together lies together: in a large map memory is what a search waits for.
        self._inner = np.zeros((n_trees, 64), INNER)
        self._leaves = np.zeros((n_trees, 64, LEAF_SIZE + 1), np.int32)
        self._n_inner = np.zeros(n_trees, np.int64)
        self._n_leaves = np.ones(n_trees, np.int64)
        self._root = np.full(n_trees, -1, np.int64)  # ~0: the first leaf

    def insert(self, table: NDArray[Any], first: int, last: int) -> None:
        """Enter rows first to last - 1 of the table (n, words), as comparable() makes them."""
        # Every row splits at most one leaf.
        needed = int(self._n_leaves.max()) + last - first + 1
        if needed > self._leaves.shape[1]:
            self._inner, self._leaves = (
                _longer(array, max(needed, 2 * array.shape[1])) for array in (self._inner, self._leaves)
            )
        for tree in range(self.n_trees):
            self._n_inner[tree], self._n_leaves[tree], self._root[tree] = _insert(
                table, first, last, tree, self.n_trees, self._root[tree], self._inner[tree],
                self._leaves[tree], self._n_inner[tree], self._n_leaves[tree],
            )  # fmt: skip

    def nearest(
        self, table: NDArray[Any], queries: NDArray[Any], comparisons: int, may_be: BoolArray | None = None
    ) -> tuple[IntArray, Float32Array]:
        """Row (q,) of the nearest descriptor found for each query, -1 for none, and its distance (q,) in
        the metric's unit.

        comparisons: how many rows a query is compared with at most, over all trees. may_be (n,): which rows
        of the table count; None: all.
        """
        every = np.empty(0, np.bool_)
        row, distance = _search(
            table,
            every if may_be is None else may_be,
            queries,
            comparisons,
            self._root,
            self._inner,
            self._leaves,
        )
        return row, distance if self.binary else np.sqrt(distance)


def _longer(array: NDArray[Any], length: int) -> NDArray[Any]:
    """The array with zeros after its second axis."""
    grown = np.zeros((array.shape[0], length, *array.shape[2:]), array.dtype)
    grown[:, : array.shape[1]] = array
    return grown


@njit(cache=True, nogil=True, inline="always")
def _element_of(table, row, element):  # type: ignore[no-untyped-def]
    """A bit as 0 or 1, or an element of a float descriptor."""
    if table.dtype == WORDS:
        word = np.uint64(table[row, element >> 6])
        return np.float32((word >> np.uint64(element & 63)) & np.uint64(1))
    return np.float32(table[row, element])


@njit(cache=True, nogil=True)
def _insert(table, first, last, tree, n_trees, root, inner, leaves, n_inner, n_leaves):  # type: ignore[no-untyped-def]
    for row in range(first, last):
        parent, is_above, at = -1, False, root
        while at >= 0:
            parent = at
            is_above = _element_of(table, row, inner[at].element) >= inner[at].value
            at = inner[at].above if is_above else inner[at].below
        leaf = ~at
        if leaves[leaf, FILLED] == LEAF_SIZE:
            best, cut = _best_split(table, leaves, leaf, tree, n_trees)
            if best < 0:
                continue  # as many equal descriptors as a leaf holds: one more tells nothing
            inner[n_inner].element, inner[n_inner].value = best, cut
            inner[n_inner].below, inner[n_inner].above = ~leaf, ~n_leaves
            _divide(table, leaves, leaf, n_leaves, best, cut)
            if parent < 0:
                root = n_inner
            elif is_above:
                inner[parent].above = n_inner
            else:
                inner[parent].below = n_inner
            leaf = n_leaves if _element_of(table, row, best) >= cut else leaf
            n_inner += 1
            n_leaves += 1
        if leaves[leaf, FILLED] < LEAF_SIZE:
            leaves[leaf, leaves[leaf, FILLED]] = row
            leaves[leaf, FILLED] += 1
    return n_inner, n_leaves, root


@njit(cache=True, nogil=True)
def _best_split(table, leaves, leaf, tree, n_trees):  # type: ignore[no-untyped-def]
    """Most spread element of a full leaf's descriptors, among those that are this tree's, and its mean; -1
    if all are equal."""
    binary = table.dtype == WORDS
    count = table.shape[1] * 64 if binary else table.shape[1]
    best, cut, largest = -1, np.float32(0.0), 0.0
    for e in range(tree, count, n_trees):
        total, squares = 0.0, 0.0
        for k in range(LEAF_SIZE):
            x = _element_of(table, leaves[leaf, k], e)
            total += x
            squares += x * x
        mean = total / LEAF_SIZE
        spread = squares / LEAF_SIZE - mean * mean
        if spread > largest * (1.0 + 1e-6) + 1e-12:
            best, cut, largest = e, np.float32(0.5 if binary else mean), spread
    return best, cut


@njit(cache=True, nogil=True)
def _divide(table, leaves, leaf, other, element, cut):  # type: ignore[no-untyped-def]
    """Move those rows of the leaf that are at or above the cut to the other leaf."""
    kept, moved = 0, 0
    for k in range(leaves[leaf, FILLED]):
        row = leaves[leaf, k]
        if _element_of(table, row, element) >= cut:
            leaves[other, moved] = row
            moved += 1
        else:
            leaves[leaf, kept] = row
            kept += 1
    leaves[leaf, FILLED], leaves[other, FILLED] = kept, moved


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
def _search(table, may_be, queries, comparisons, root, inner, leaves):  # type: ignore[no-untyped-def]
    found, distance = np.full(len(queries), -1, np.int64), np.full(len(queries), np.inf, np.float32)
    bounds = np.empty(LARGEST_HEAP, np.float32)
    trees, nodes = np.empty(LARGEST_HEAP, np.int32), np.empty(LARGEST_HEAP, np.int32)
    apart = np.empty(LEAF_SIZE, np.float32)
    for q in range(len(queries)):
        best, best_row = np.float32(np.inf), -1
        size, compared = 0, 0
        for tree in range(len(root)):
            size = _push(bounds, trees, nodes, size, np.float32(0.0), tree, root[tree])
        while size > 0 and compared < comparisons:
            bound, tree, at = bounds[0], trees[0], nodes[0]
            size = _pop(bounds, trees, nodes, size)
            if bound >= best:
                break
            while at >= 0:
                node = inner[tree, at]
                difference = _element_of(queries, q, node.element) - node.value
                near, far = (node.above, node.below) if difference >= 0 else (node.below, node.above)
                # Another bit is one more of distance; other elements add the square of how far beyond the
                # cut they are.
                beyond = np.float32(1.0) if table.dtype == WORDS else difference * difference
                if bound + beyond < best and size < LARGEST_HEAP:
                    size = _push(bounds, trees, nodes, size, bound + beyond, tree, far)
                at = near
            leaf = ~at
            count = leaves[tree, leaf, FILLED]
            for k in range(count):  # all before any is judged, so that memory is read ahead
                apart[k] = compare_kernel(queries, q, table, leaves[tree, leaf, k])
            for k in range(count):
                row = leaves[tree, leaf, k]
                if apart[k] < best and (len(may_be) == 0 or may_be[row]):
                    best, best_row = apart[k], row
            compared += count
        found[q], distance[q] = best_row, best
    return found, distance
