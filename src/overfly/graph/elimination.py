"""Elimination of a part of a graph: an order of its nodes, and the fronts that follow from it.

Minimum degree on the filled graph itself, its rows held as sets of bits: made for the few hundred nodes that
one constraint concerns, where the analysis of a whole graph would cost more than the work it plans. Sources:
George and Liu, "The evolution of the minimum degree ordering algorithm", SIAM Review 1989; Kaess et al.,
"iSAM2", IJRR 2012 (only the top of the tree is ordered anew, the newest nodes last).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from overfly.graph.symbolic import Symbolic
from overfly.types import BoolArray, IntArray


@dataclass(frozen=True, eq=False)
class Fronts:
    """Fronts in the order of their elimination, F of them.

    own_starts (F + 1,), own: nodes eliminated in each. separator_starts (F + 1,), separator: nodes below
    them that remain, in the order in which they will be eliminated. parent (F,): the front in which the first
    of these is eliminated, -1 at a root.
    """

    own_starts: IntArray
    own: IntArray
    separator_starts: IntArray
    separator: IntArray
    parent: IntArray

    def multiplications(self, block: int) -> float:
        """About how many their factorisation takes, with blocks of so many rows."""
        own = np.diff(self.own_starts).astype(np.float64)
        rows = own + np.diff(self.separator_starts)
        return float(block**3 * (own * rows**2).sum())


def whole_fronts(symbolic: Symbolic) -> Fronts:
    """The fronts of a whole graph that has been analysed."""
    return Fronts(
        symbolic.starts,
        symbolic.order,
        symbolic.row_starts,
        symbolic.order[symbolic.rows],
        symbolic.parent,
    )


def eliminate_part(
    nodes: IntArray, pairs: IntArray, cliques: IntArray, clique_starts: IntArray, late: BoolArray
) -> Fronts:
    """Order and eliminate ``nodes`` (k,), any numbers, joined by pairs (p, 2) and by cliques, both as places
    in ``nodes``; clique c is cliques[clique_starts[c] : clique_starts[c + 1]]. late (k,): nodes that go last.
    """
    return Fronts(*_eliminate(nodes, pairs, cliques, clique_starts, late))


@njit(cache=True, nogil=True, inline="always")
def _bits(word: Any) -> Any:
    """How many bits of a uint64 are set."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit(cache=True, nogil=True)
def _members(row: Any, found: Any) -> int:
    """Numbers in the set ``row``, ascending, into ``found``; how many."""
    count = 0
    for w in range(len(row)):
        word = row[w]
        while word != np.uint64(0):
            lowest = word & (~word + np.uint64(1))
            found[count] = 64 * w + _bits(lowest - np.uint64(1))
            count += 1
            word ^= lowest
    return count


@njit(cache=True, nogil=True, inline="always")
def _bit(k: int) -> Any:
    return np.uint64(1) << np.uint64(k & 63)


@njit(cache=True, nogil=True)
def _adjacency(n: int, pairs: Any, cliques: Any, clique_starts: Any) -> Any:
    n_words = (n + 63) // 64
    adjacent = np.zeros((n, n_words), np.uint64)
    for k in range(len(pairs)):
        a, b = pairs[k, 0], pairs[k, 1]
        adjacent[a, b >> 6] |= _bit(b)
        adjacent[b, a >> 6] |= _bit(a)
    clique = np.empty(n_words, np.uint64)
    for c in range(len(clique_starts) - 1):
        clique[:] = np.uint64(0)
        for k in range(clique_starts[c], clique_starts[c + 1]):
            clique[cliques[k] >> 6] |= _bit(cliques[k])
        for k in range(clique_starts[c], clique_starts[c + 1]):
            for w in range(n_words):
                adjacent[cliques[k], w] |= clique[w]
    for k in range(n):
        adjacent[k, k >> 6] &= ~_bit(k)
    return adjacent


@njit(cache=True, nogil=True)
def _minimum_degree(adjacent: Any, late: Any) -> Any:
    """Order (k,) and each node's place in it. Leaves in ``adjacent`` each node's neighbours at its own
    elimination.
    """
    n, n_words = adjacent.shape
    order, position = np.empty(n, np.int64), np.full(n, -1, np.int64)
    degree = np.empty(n, np.int64)
    for k in range(n):
        degree[k] = n if late[k] else 0
        for w in range(n_words):
            degree[k] += _bits(adjacent[k, w])
    members = np.empty(n, np.int64)
    for step in range(n):
        best = -1
        for k in range(n):
            if position[k] < 0 and (best < 0 or degree[k] < degree[best]):
                best = k
        order[step], position[best] = best, step
        count = _members(adjacent[best], members)
        for m in range(count):
            k = members[m]
            total = n if late[k] else 0
            for w in range(n_words):
                adjacent[k, w] |= adjacent[best, w]
            adjacent[k, k >> 6] &= ~_bit(k)
            adjacent[k, best >> 6] &= ~_bit(best)
            for w in range(n_words):
                total += _bits(adjacent[k, w])
            degree[k] = total
    return order, position


@njit(cache=True, nogil=True)
def _amalgamate(adjacent: Any, order: Any, position: Any) -> Any:
    """Per column the last column of its front, and its parent in the elimination tree (-1 at a root).

    A child front joins its parent's where that adds few explicit zeros.
    """
    n = len(order)
    count, above = np.empty(n, np.int64), np.full(n, -1, np.int64)
    members = np.empty(n, np.int64)
    for k in range(n):
        count[k] = _members(adjacent[k], members)
        for m in range(count[k]):
            if above[k] < 0 or position[members[m]] < position[above[k]]:
                above[k] = members[m]
    top, width, zeros = np.arange(n), np.ones(n, np.int64), np.zeros(n)
    first_child, sibling = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    for step in range(n):
        k = order[step]
        child = first_child[k]
        while child >= 0:
            added = zeros[k] + zeros[child] + width[child] * (width[k] + count[k] - count[child])
            total = width[k] + width[child]
            blocks = total * (total + 1) / 2 + total * count[k]
            limit = 0.8 if total <= 2 else (0.4 if total <= 5 else (0.15 if total <= 12 else 0.05))
            if added <= limit * blocks:
                top[child], width[k], zeros[k] = k, total, added
            child = sibling[child]
        if above[k] >= 0:
            sibling[k], first_child[above[k]] = first_child[above[k]], k
    for step in range(n - 1, -1, -1):
        k = order[step]
        top[k] = top[top[k]]
    return top, above


@njit(cache=True, nogil=True)
def _list_fronts(adjacent: Any, order: Any, position: Any, top: Any, above: Any) -> Any:
    n = len(order)
    number = np.full(n, -1, np.int64)
    widths, heights = np.zeros(n, np.int64), np.zeros(n, np.int64)
    members = np.empty(n, np.int64)
    n_fronts = 0
    for step in range(n):
        k = order[step]
        if top[k] == k:
            number[k] = n_fronts
            heights[n_fronts] = _members(adjacent[k], members)
            n_fronts += 1
    for k in range(n):
        widths[number[top[k]]] += 1
    own_starts, separator_starts = np.zeros(n_fronts + 1, np.int64), np.zeros(n_fronts + 1, np.int64)
    own_starts[1:] = np.cumsum(widths[:n_fronts])
    separator_starts[1:] = np.cumsum(heights[:n_fronts])
    own, separator = np.empty(n, np.int64), np.empty(separator_starts[-1], np.int64)
    filled = own_starts[:-1].copy()
    parent = np.full(n_fronts, -1, np.int64)
    for step in range(n):
        k = order[step]
        front = number[top[k]]
        own[filled[front]] = k
        filled[front] += 1
        if top[k] == k:
            count = _members(adjacent[k], members)
            places = np.sort(position[members[:count]])
            separator[separator_starts[front] : separator_starts[front + 1]] = order[places]
            if above[k] >= 0:
                parent[front] = number[top[above[k]]]
    return own_starts, own, separator_starts, separator, parent


@njit(cache=True, nogil=True)
def _eliminate(nodes: Any, pairs: Any, cliques: Any, clique_starts: Any, late: Any) -> Any:
    adjacent = _adjacency(len(nodes), pairs, cliques, clique_starts)
    order, position = _minimum_degree(adjacent, late)
    top, above = _amalgamate(adjacent, order, position)
    own_starts, own, separator_starts, separator, parent = _list_fronts(adjacent, order, position, top, above)
    return own_starts, nodes[own], separator_starts, nodes[separator], parent
