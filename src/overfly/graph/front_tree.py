"""A Cholesky factor that can be changed in part: dense fronts in a tree, each keeping what it passes on.

A front eliminates its own nodes, given the normal equations of their constraints and what its children pass
on. When a constraint is added, only the fronts on the way from its nodes to the root change; what the
branches below them pass on is still there. Sources: Liu, "The multifrontal method for sparse matrix
solution", SIAM Review 1992; Kaess et al., "iSAM2: Incremental smoothing and mapping using the Bayes tree",
IJRR 2012.

A front is named by the first of its own nodes. Its numbers lie in one stretch of a heap: a column-major panel
of its own columns over all its rows, the square update (lower triangle) for its parent, and the right-hand
side, own part solved (L y = b), the rest for the parent.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray
from overfly.graph.elimination import Fronts
from overfly.graph.front_kernels import _factor, _inverse_blocks, _solve
from overfly.graph.growing import Table
from overfly.graph.lapack import addresses
from overfly.types import BoolArray, IntArray

RESERVED = 2**24  # numbers: memory is taken when they are written, and a heap that grows has to be copied


class Equations(NamedTuple):
    """Normal equations, constraint by constraint: m constraints over n nodes, blocks of d.

    i, j (m,); used (m,): whether it counts; first (n,), following (m, 2): per node its constraints as a
    chain of 2 * constraint + side. blocks (m, 3, d, d): of (i, i), (i, j), (j, j); gradients (m, 2, d).
    fixed (n,): nodes that do not move. own_blocks (n, d, d), own_gradients (n, d): of absolute constraints,
    empty for none.
    """

    i: IntArray
    j: IntArray
    used: BoolArray
    first: IntArray
    following: IntArray
    blocks: FloatArray
    gradients: FloatArray
    fixed: BoolArray
    own_blocks: FloatArray
    own_gradients: FloatArray


class Tree(NamedTuple):
    """Per node the name of its front, -1 if it has none; the rest per front, at its name.

    width, below: nodes it owns and nodes below them. parent, first_child, sibling: names, -1 for none.
    nodes_at, values_at: where its nodes (own, then below) and numbers begin in the heaps. gain: |y|^2.
    stiffness (n, d): diagonal of the normal equations, by node.
    """

    front: IntArray
    width: IntArray
    below: IntArray
    parent: IntArray
    first_child: IntArray
    sibling: IntArray
    nodes_at: IntArray
    values_at: IntArray
    gain: FloatArray
    stiffness: FloatArray


class FrontTree:
    """The factor of a growing graph; its parts are replaced by :meth:`replace`."""

    def __init__(self, block: int) -> None:
        self.block = block
        self._table = Table(lambda n: _empty_tree(n, block))
        self.nodes: IntArray = np.empty(0, np.int64)  # heap: of every front its own, then those below
        self._values = np.empty(RESERVED)
        self._nodes_end = self._values_end = 0
        self._compact_at = 0
        self._routines = addresses()
        self.multiplications = 0.0  # of all factorisations so far, about

    @property
    def tree(self) -> Tree:
        return self._table.view

    @property
    def n_nodes(self) -> int:
        return len(self._table)

    def grow(self, n_nodes: int) -> None:
        """Make room for nodes that have no front yet."""
        self._table.grow(n_nodes)

    def affected(self, seeds: IntArray) -> tuple[IntArray, IntArray]:
        """Nodes of all fronts from those of ``seeds`` (nodes) up to the root and nodes without a front, and
        the fronts that hang below them.
        """
        nodes, orphans = _affected(self.tree, self.nodes, seeds)
        return nodes, orphans

    def replace(self, fronts: Fronts, orphans: IntArray, equations: Equations) -> bool:
        """Put these fronts in the place of those of their nodes, orphans below them; False where the
        equations are not positive definite, and the tree is then of no use.
        """
        n_nodes = len(fronts.own) + len(fronts.separator)
        n_values, multiplications = _costs(fronts.own_starts, fronts.separator_starts, self.block)
        self._nodes_end, self._values_end = _free_end(
            self.tree, fronts.own, self._nodes_end, self._values_end, self.block
        )  # fmt: skip
        self._make_room(fronts, n_nodes, n_values)
        self.multiplications += multiplications
        is_definite = _replace(
            self._routines, self.tree, self.nodes, self._values, self._nodes_end, self._values_end,
            fronts.own_starts, fronts.own, fronts.separator_starts, fronts.separator, fronts.parent, orphans,
            equations,
        )  # fmt: skip
        self._nodes_end += n_nodes
        self._values_end += n_values
        return bool(is_definite)

    def _make_room(self, fronts: Fronts, n_nodes: int, n_values: int) -> None:
        if len(fronts.own) == self.n_nodes:  # all of them are replaced
            self.tree.front[:] = -1
            self._nodes_end = self._values_end = 0
        if self._values_end + n_values > self._compact_at or self._nodes_end + n_nodes > len(self.nodes):
            self._nodes_end, self._values_end = _compact(self.tree, self.nodes, self._values, self.block)
            self.nodes = _with_room(self.nodes, self._nodes_end, n_nodes)
            self._values = _with_room(self._values, self._values_end, n_values)
            self._compact_at = min(2 * (self._values_end + n_values), len(self._values))

    def solve(self, steps: FloatArray, fresh: BoolArray, least: float) -> IntArray:
        """Bring the solution ``steps`` (n, d) up to date, in place; nodes (k,) whose step changed.

        fresh (n,): fronts that were replaced since the last time, by name. A branch is left alone where
        nothing it depends on changed by more than ``least`` in chi2.
        """
        return np.asarray(_solve(self._routines, self.tree, self.nodes, self._values, steps, fresh, least))

    def total_gain(self) -> float:
        """By how much the solution of the linear problem lowers chi2."""
        return float(_total_gain(self.tree.front, self.tree.gain))

    def inverse_blocks(self, nodes: IntArray) -> FloatArray:
        """(k d, k d) part of the inverse that belongs to these nodes (k,); costs a walk from each to the
        root.
        """
        return np.asarray(_inverse_blocks(self.tree, self.nodes, self._values, nodes))


def _empty_tree(n: int, block: int) -> Tree:
    names = [np.full(n, -1, np.int64) for _ in range(8)]
    return Tree._make([*names, np.zeros(n), np.zeros((n, block))])


def _with_room(heap: Any, end: int, more: int) -> Any:
    """The heap, or a larger one with the same beginning, where less than a third would be left free."""
    if 3 * (end + more) <= 2 * len(heap):
        return heap
    larger = np.empty(2 * (end + more), heap.dtype)
    larger[:end] = heap[:end]
    return larger


@njit(cache=True, nogil=True)
def _costs(own_starts: Any, separator_starts: Any, d: int) -> Any:
    """Numbers that fronts take in the heap, and about how many multiplications their factorisation."""
    size, multiplications = 0, 0.0
    for f in range(len(own_starts) - 1):
        width = (own_starts[f + 1] - own_starts[f]) * d
        below = (separator_starts[f + 1] - separator_starts[f]) * d
        size += (width + below) * (width + 1) + below * below
        multiplications += float(width) * (width + below) ** 2
    return size, multiplications


@njit(cache=True, nogil=True)
def _free_end(tree: Any, replaced: Any, node_end: int, value_end: int, d: int) -> Any:
    """Where the heaps end without the fronts of these nodes: the last ones are replaced most often, and
    memory that was just used is the fastest.
    """
    found = True
    while found:
        found = False
        for name in replaced:
            if tree.front[name] == name:
                nodes_to = tree.nodes_at[name] + tree.width[name] + tree.below[name]
                values_to = tree.values_at[name] + _front_size(tree, name, d)
                if nodes_to == node_end and values_to == value_end:
                    node_end, value_end, found = tree.nodes_at[name], tree.values_at[name], True
    return node_end, value_end


@njit(cache=True, nogil=True)
def _total_gain(front: Any, gain: Any) -> float:
    total = 0.0
    for node in range(len(front)):
        if front[node] == node:
            total += gain[node]
    return total


@njit(cache=True, nogil=True)
def _affected(tree: Any, nodes: Any, seeds: Any) -> Any:
    n = len(tree.front)
    marked = np.zeros(n, np.bool_)
    names = np.empty(n, np.int64)
    n_names = 0
    for seed in seeds:
        front = tree.front[seed]
        while front >= 0 and not marked[front]:
            marked[front] = True
            names[n_names] = front
            n_names += 1
            front = tree.parent[front]
    found, n_found = np.empty(n, np.int64), 0
    orphans, n_orphans = np.empty(n, np.int64), 0
    for k in range(n_names):
        front = names[k]
        for p in range(tree.nodes_at[front], tree.nodes_at[front] + tree.width[front]):
            found[n_found] = nodes[p]
            n_found += 1
        child = tree.first_child[front]
        while child >= 0:
            if not marked[child]:
                orphans[n_orphans] = child
                n_orphans += 1
            child = tree.sibling[child]
    for node in range(n):
        if tree.front[node] < 0:
            found[n_found] = node
            n_found += 1
    return np.sort(found[:n_found]), np.sort(orphans[:n_orphans])


@njit(cache=True, nogil=True)
def _separators(tree: Any, nodes: Any, fronts: Any) -> Any:
    starts = np.zeros(len(fronts) + 1, np.int64)
    for k in range(len(fronts)):
        starts[k + 1] = starts[k] + tree.below[fronts[k]]
    found = np.empty(starts[-1], np.int64)
    for k in range(len(fronts)):
        begin = tree.nodes_at[fronts[k]] + tree.width[fronts[k]]
        found[starts[k] : starts[k + 1]] = nodes[begin : begin + tree.below[fronts[k]]]
    return found, starts


@njit(cache=True, nogil=True)
def _front_size(tree: Any, front: int, d: int) -> Any:
    width, below = tree.width[front] * d, tree.below[front] * d
    return (width + below) * (width + 1) + below * below


@njit(cache=True, nogil=True)
def _compact(tree: Any, nodes: Any, values: Any, d: int) -> Any:
    """Move everything that is still in use to the front of the heaps; where the rest begins."""
    names = np.flatnonzero(tree.front == np.arange(len(tree.front)))
    node_end, value_end = 0, 0
    for front in names[np.argsort(tree.values_at[names])]:
        a, b = tree.nodes_at[front], tree.values_at[front]
        tree.nodes_at[front], tree.values_at[front] = node_end, value_end
        for k in range(a, a + tree.width[front] + tree.below[front]):
            nodes[node_end] = nodes[k]
            node_end += 1
        size = _front_size(tree, front, d)
        if b > value_end:
            for k in range(size):
                values[value_end + k] = values[b + k]
        value_end += size
    return node_end, value_end


@njit(cache=True, nogil=True)
def _install(
    tree: Any, nodes: Any, node_end: int, value_end: int, d: int, own_starts: Any, own: Any,
    separator_starts: Any, separator: Any, parent: Any, orphans: Any,
) -> None:  # fmt: skip
    """Enter new fronts into the tree, and hang the orphans on them."""
    for f in range(len(parent)):
        name = own[own_starts[f]]
        for k in range(own_starts[f], own_starts[f + 1]):
            tree.front[own[k]] = name
    for f in range(len(parent) - 1, -1, -1):  # parents first, so that their lists of children are empty
        name = own[own_starts[f]]
        width, below = own_starts[f + 1] - own_starts[f], separator_starts[f + 1] - separator_starts[f]
        tree.width[name], tree.below[name], tree.first_child[name] = width, below, -1
        tree.nodes_at[name], tree.values_at[name] = node_end, value_end
        nodes[node_end : node_end + width] = own[own_starts[f] : own_starts[f + 1]]
        nodes[node_end + width : node_end + width + below] = separator[
            separator_starts[f] : separator_starts[f + 1]
        ]
        node_end, value_end = node_end + width + below, value_end + _front_size(tree, name, d)
        tree.parent[name] = -1 if parent[f] < 0 else own[own_starts[parent[f]]]
        if parent[f] >= 0:
            above = tree.parent[name]
            tree.sibling[name], tree.first_child[above] = tree.first_child[above], name
    number = np.empty(len(tree.front), np.int64)  # of the fronts in the order of elimination
    for f in range(len(parent)):
        number[own[own_starts[f]]] = f
    for orphan in orphans:
        begin = tree.nodes_at[orphan] + tree.width[orphan]
        above = tree.front[nodes[begin]]
        for p in range(begin + 1, begin + tree.below[orphan]):
            other = tree.front[nodes[p]]
            if number[other] < number[above]:
                above = other
        tree.parent[orphan] = above
        tree.sibling[orphan], tree.first_child[above] = tree.first_child[above], orphan


@njit(cache=True, nogil=True)
def _replace(
    routines: Any, tree: Any, nodes: Any, values: Any, node_end: int, value_end: int, own_starts: Any,
    own: Any, separator_starts: Any, separator: Any, parent: Any, orphans: Any, equations: Any,
) -> bool:  # fmt: skip
    """Enter new fronts into the tree and factorise them."""
    _install(
        tree, nodes, node_end, value_end, tree.stiffness.shape[1], own_starts, own, separator_starts,
        separator, parent, orphans,
    )  # fmt: skip
    return _factor(routines, tree, nodes, values, own[own_starts[:-1]], equations)
