"""Symbolic analysis of a block sparse matrix: elimination order, elimination tree, supernodes and where
everything goes.

Works on the graph of the blocks (nodes and the pairs of nodes that share a constraint), whatever the size of
a block, so one analysis serves the rotations, the positions and the poses. Sources: Liu, "The role of
elimination trees in sparse factorization", SIAM J. Matrix Anal. 1990; Davis, "Direct methods for sparse
linear systems", SIAM 2006.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from overfly.types import IntArray


@dataclass(frozen=True, eq=False)
class Symbolic:
    """What the factorisation of one sparsity pattern needs to know. S supernodes over n block columns in
    elimination order.

    order (n,): node eliminated k-th; rank (n,) its inverse. starts (S + 1,): first column of each supernode.
    row_starts (S + 1,), rows: the block rows below its columns, ascending. parent (S,): supernode of the
    first row, -1 at a root. places: for each entry of ``rows``, its position in the front of the parent.
    pair_*: per given pair, the supernode that takes the block, its block row in the front and column, and
    whether the block (first, second) has to be transposed.
    """

    order: IntArray
    rank: IntArray
    starts: IntArray
    row_starts: IntArray
    rows: IntArray
    parent: IntArray
    places: IntArray
    supernode: IntArray
    pair_supernode: IntArray
    pair_row: IntArray
    pair_column: IntArray
    pair_transposed: Any

    @property
    def n_nodes(self) -> int:
        return len(self.order)

    def block_count(self) -> int:
        """Blocks in the factor, explicit zeros of merged supernodes included."""
        widths = np.diff(self.starts)
        return int((widths * (widths + 1) // 2 + widths * np.diff(self.row_starts)).sum())


def analyse(n_nodes: int, first: IntArray, second: IntArray, order: IntArray | None = None) -> Symbolic:
    """Analyse the pattern with one diagonal block per node and one block per pair (first[k], second[k]), no
    pair twice.

    order: elimination order to keep (node eliminated k-th); minimum degree if not given.
    """
    neighbour_starts, neighbours = adjacency(n_nodes, first, second)
    if order is None:
        order = minimum_degree_order(n_nodes, first, second)
    rank = np.empty(n_nodes, np.int64)
    rank[order] = np.arange(n_nodes)
    tree = _elimination_tree(neighbour_starts, neighbours, order, rank)
    counts = _column_counts(neighbour_starts, neighbours, order, rank, tree)
    post = _postorder(tree, counts)
    order = order[post]
    rank[order] = np.arange(n_nodes)
    place = np.empty(n_nodes, np.int64)
    place[post] = np.arange(n_nodes)
    tree = np.where(tree[post] < 0, -1, place[tree[post]])
    counts = counts[post]
    starts = _supernodes(tree, counts)
    supernode = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    row_starts = np.concatenate([[0], np.cumsum(counts[starts[1:] - 1])])
    parent = np.where(tree[starts[1:] - 1] < 0, -1, supernode[tree[starts[1:] - 1]])
    rows = _supernode_rows(neighbour_starts, neighbours, order, rank, starts, row_starts, parent)
    places = _places_in_parent(starts, row_starts, rows, parent)
    low, high = rank[first], rank[second]
    transposed = low < high  # the factor holds blocks (row, column) with row > column
    low, high = np.minimum(low, high), np.maximum(low, high)
    owner = supernode[low]
    front_row = _front_rows(starts, row_starts, rows, owner, high)
    return Symbolic(
        order,
        rank,
        starts,
        row_starts,
        rows,
        parent,
        places,
        supernode,
        owner,
        front_row,
        low - starts[owner],
        transposed,
    )


def adjacency(n_nodes: int, first: IntArray, second: IntArray) -> tuple[IntArray, IntArray]:
    """Compressed neighbour lists: starts (n + 1,) and neighbours, each pair in both directions."""
    source = np.concatenate([first, second])
    target = np.concatenate([second, first])
    starts = np.concatenate([[0], np.cumsum(np.bincount(source, minlength=n_nodes))])
    return starts, target[np.argsort(source, kind="stable")]


def minimum_degree_order(n_nodes: int, first: IntArray, second: IntArray) -> IntArray:
    """Elimination order by multiple minimum degree (Liu 1985), as SuperLU in SciPy finds it for the matrix of
    the nodes.
    """
    if len(first) == 0:
        return np.arange(n_nodes)
    ones = np.full(2 * len(first), -1.0)
    source, target = np.concatenate([first, second]), np.concatenate([second, first])
    degree = np.bincount(source, minlength=n_nodes) + 1.0
    index = np.arange(n_nodes)
    matrix = csc_matrix(
        (np.concatenate([ones, degree]), (np.concatenate([source, index]), np.concatenate([target, index]))),
        shape=(n_nodes, n_nodes),
    )
    factors = splu(
        matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True, "Equil": False},
    )
    return np.argsort(np.asarray(factors.perm_c, dtype=np.int64))


@njit(cache=True, nogil=True)
def _elimination_tree(starts: Any, neighbours: Any, order: Any, rank: Any) -> Any:
    n = len(order)
    parent = np.full(n, -1, np.int64)
    ancestor = np.full(n, -1, np.int64)
    for k in range(n):
        node = order[k]
        for p in range(starts[node], starts[node + 1]):
            a = rank[neighbours[p]]
            while a < k:  # climb to the root of a's tree so far, shortening the path
                above = ancestor[a]
                ancestor[a] = k
                if above == -1:
                    parent[a] = k
                    break
                if above == k:
                    break
                a = above
    return parent


@njit(cache=True, nogil=True)
def _column_counts(starts: Any, neighbours: Any, order: Any, rank: Any, parent: Any) -> Any:
    """Blocks below the diagonal in each column of the factor."""
    n = len(order)
    counts = np.zeros(n, np.int64)
    seen = np.full(n, -1, np.int64)
    for k in range(n):
        seen[k] = k
        node = order[k]
        for p in range(starts[node], starts[node + 1]):
            a = rank[neighbours[p]]
            if a > k:
                continue
            while seen[a] != k:
                seen[a] = k
                counts[a] += 1
                a = parent[a]
    return counts


@njit(cache=True, nogil=True)
def _postorder(parent: Any, counts: Any) -> Any:
    """Columns with every child before its parent, the child with the fullest column last, next to its
    parent.
    """
    n = len(parent)
    first_child = np.full(n, -1, np.int64)
    sibling = np.full(n, -1, np.int64)
    fullest = np.full(n, -1, np.int64)
    for k in range(n):
        p = parent[k]
        if p >= 0 and (fullest[p] < 0 or counts[k] >= counts[fullest[p]]):
            fullest[p] = k
    for k in range(n):  # lists are read from their head, so the fullest goes in first and comes out last
        p = parent[k]
        if p >= 0 and fullest[p] == k:
            sibling[k] = first_child[p]
            first_child[p] = k
    for k in range(n - 1, -1, -1):
        p = parent[k]
        if p >= 0 and fullest[p] != k:
            sibling[k] = first_child[p]
            first_child[p] = k
    post = np.empty(n, np.int64)
    stack = np.empty(n, np.int64)
    done = 0
    for root in range(n):
        if parent[root] >= 0:
            continue
        top = 0
        stack[0] = root
        while top >= 0:
            k = stack[top]
            child = first_child[k]
            if child < 0:
                post[done] = k
                done += 1
                top -= 1
            else:
                first_child[k] = sibling[child]
                top += 1
                stack[top] = child
    return post


@njit(cache=True, nogil=True)
def _supernodes(parent: Any, counts: Any) -> Any:
    """First columns of the supernodes: equal structure is merged, and nearly equal where few zeros are
    added.
    """
    n = len(parent)
    starts = np.empty(n + 1, np.int64)
    zeros = np.zeros(n + 1)
    n_supernodes = 0
    k = 0
    while k < n:
        start = k
        while k + 1 < n and parent[k] == k + 1 and counts[k] == counts[k + 1] + 1:
            k += 1
        added = 0.0
        while n_supernodes > 0 and start <= parent[start - 1] <= k:  # try to take in the child just before
            child = starts[n_supernodes - 1]
            width, child_width = k + 1 - start, start - child
            fill = zeros[n_supernodes - 1] + added + child_width * (width + counts[k] - counts[start - 1])
            total = width + child_width
            blocks = total * (total + 1) / 2 + total * counts[k]
            limit = 0.8 if total <= 2 else (0.4 if total <= 5 else (0.15 if total <= 12 else 0.05))
            if fill > limit * blocks:
                break
            added = fill
            start = child
            n_supernodes -= 1
        starts[n_supernodes] = start
        zeros[n_supernodes] = added
        n_supernodes += 1
        k += 1
    starts[n_supernodes] = n
    return starts[: n_supernodes + 1].copy()


@njit(cache=True, nogil=True)
def _supernode_rows(
    starts: Any, neighbours: Any, order: Any, rank: Any, columns: Any, row_starts: Any, parent: Any
) -> Any:
    n_supernodes = len(columns) - 1
    rows = np.empty(row_starts[-1], np.int64)
    filled = row_starts[:-1].copy()
    seen = np.full(len(order), -1, np.int64)
    first_child = np.full(n_supernodes, -1, np.int64)
    sibling = np.full(n_supernodes, -1, np.int64)
    for s in range(n_supernodes):
        end = columns[s + 1]
        for k in range(columns[s], end):
            node = order[k]
            for p in range(starts[node], starts[node + 1]):
                a = rank[neighbours[p]]
                if a >= end and seen[a] != s:
                    seen[a] = s
                    rows[filled[s]] = a
                    filled[s] += 1
        child = first_child[s]
        while child >= 0:
            for p in range(row_starts[child], row_starts[child + 1]):
                a = rows[p]
                if a >= end and seen[a] != s:
                    seen[a] = s
                    rows[filled[s]] = a
                    filled[s] += 1
            child = sibling[child]
        rows[row_starts[s] : row_starts[s + 1]].sort()
        if parent[s] >= 0:
            sibling[s] = first_child[parent[s]]
            first_child[parent[s]] = s
    return rows


@njit(cache=True, nogil=True)
def _places_in_parent(starts: Any, row_starts: Any, rows: Any, parent: Any) -> Any:
    places = np.empty(len(rows), np.int64)
    for s in range(len(parent)):
        p = parent[s]
        if p < 0:
            continue
        width = starts[p + 1] - starts[p]
        q = row_starts[p]
        for r in range(row_starts[s], row_starts[s + 1]):
            if rows[r] < starts[p + 1]:
                places[r] = rows[r] - starts[p]
            else:
                while rows[q] != rows[r]:
                    q += 1
                places[r] = width + q - row_starts[p]
    return places


@njit(cache=True, nogil=True)
def _front_rows(starts: Any, row_starts: Any, rows: Any, owner: Any, high: Any) -> Any:
    """Position of block row ``high`` in the front of its owner."""
    found = np.empty(len(owner), np.int64)
    for k in range(len(owner)):
        s = owner[k]
        if high[k] < starts[s + 1]:
            found[k] = high[k] - starts[s]
        else:
            below = rows[row_starts[s] : row_starts[s + 1]]
            found[k] = starts[s + 1] - starts[s] + np.searchsorted(below, high[k])
    return found
