"""The tree optimiser: stochastic gradient descent on constraints, each resolved along its path in a spanning
tree.

Nodes are held as poses relative to their parents, so turning one carries its whole subtree along. A
constraint's error is spread over the nodes of its tree path, the rotation as fractions of one angle about one
axis (exact however large it is), then the translation, each node taking the less, the more information
already passes through it. Sources: Grisetti et al., "A tree parameterization for efficiently computing
maximum likelihood maps using gradient descent", RSS 2007; "Nonlinear constraint network optimization for
efficient map learning", T-ITS 2009; Olson et al., ICRA 2006.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray
from overfly.graph.pose_graph import PoseGraph
from overfly.graph.symbolic import adjacency
from overfly.graph.tree_kernels import _from_parents, _sweep, _to_parents
from overfly.graph.tree_planar import _sweep_planar, planar_poses, write_planar_poses
from overfly.types import IntArray

RESOLVED_PARTLY = 0.03  # part of the constraints that the first iteration does not resolve in full
COOLING = 1e-4  # last learning rate by the first
ROTATION_COOLING = 1e-2  # so much lower is that of rotations: they settle first, positions follow
GREAT_MOVES = 0.25  # part of the iterations in which constraints keep their order


@dataclass(frozen=True, eq=False)
class Tree:
    """parent (n,), -1 at roots; level (n,) steps from the root; order (n,) parents before children."""

    parent: IntArray
    level: IntArray
    order: IntArray


def spanning_tree(graph: PoseGraph) -> Tree:
    """Every node hangs on the oldest node it shares a constraint with.

    Older means added before; where a part of the graph has a node without an older neighbour, nodes count as
    old as a breadth first walk meets them.
    """
    active = graph.active
    starts, neighbours = adjacency(len(graph), graph.i[active], graph.j[active])
    parent, level, order = _oldest_neighbour_tree(starts, neighbours)
    return Tree(parent, level, order)


@njit(cache=True, nogil=True)
def _oldest_neighbour_tree(starts: Any, neighbours: Any) -> Any:
    n = len(starts) - 1
    age = np.arange(n)
    order = np.arange(n)
    seen = np.zeros(n, np.bool_)
    end, orphans = 0, 0
    for root in range(n):  # breadth first, to see the parts of the graph
        if seen[root]:
            continue
        seen[root] = True
        order[end] = root
        head = end
        end += 1
        while head < end:
            node = order[head]
            head += 1
            youngest = True
            for p in range(starts[node], starts[node + 1]):
                other = neighbours[p]
                if other < node:
                    youngest = False
                if not seen[other]:
                    seen[other] = True
                    order[end] = other
                    end += 1
            if youngest and node != root:
                orphans += 1
    if orphans == 0:
        order = np.arange(n)
    for k in range(n):
        age[order[k]] = k
    parent = np.full(n, -1, np.int64)
    level = np.zeros(n, np.int64)
    for k in range(n):
        node = order[k]
        oldest = k
        for p in range(starts[node], starts[node + 1]):
            oldest = min(oldest, age[neighbours[p]])
        if oldest < k:
            parent[node] = order[oldest]
            level[node] = level[parent[node]] + 1
    return parent, level, order


@dataclass(eq=False)
class TreeState:
    """Parent-relative poses (n, 3), (n, 4), and the sums of information that pass each node (n, 2):
    translation, rotation.
    """

    tree: Tree
    positions: FloatArray
    quaternions: FloatArray
    passing: FloatArray


class TreeOptimiser:
    """Iterations of the tree optimiser over a graph whose constraints do not change.

    The learning rate cools geometrically over the planned iterations: from where all but a few constraints
    are resolved in full (great moves out of a poor start) to where none moves much any more (so that they
    agree on a compromise).
    """

    def __init__(self, graph: PoseGraph, planned: int = 100) -> None:
        self.graph = graph
        self.planned = planned
        tree = spanning_tree(graph)
        constraints = graph.active
        i, j = graph.i[constraints], graph.j[constraints]
        top = _path_tops(tree.parent, tree.level, i, j)
        by_level = np.argsort(tree.level[top], kind="stable")
        self.constraints, self.tops = constraints[by_level], top[by_level]
        self._levels = tree.level[self.tops]
        self._random = np.random.default_rng(0)
        self.strengths = path_strengths(graph.information, graph.planar)
        passing = np.zeros((len(graph), 2))
        _add_passing(tree.parent, tree.level, graph.i, graph.j, self.constraints, self.strengths, passing)
        positions, quaternions = np.empty((len(graph), 3)), np.empty((len(graph), 4))
        _to_parents(tree.parent, graph.positions, graph.quaternions, positions, quaternions)
        self.state = TreeState(tree, positions, quaternions, passing)
        shares = _natural_shares(
            tree.parent, tree.level, graph.i, graph.j, self.constraints, self.strengths, passing
        )
        self.first_rate = 1.0 / max(float(np.quantile(shares, RESOLVED_PARTLY)), 1e-9) if len(shares) else 1.0
        self.iteration = 0

    def iterate(self, count: int = 1) -> None:
        """Handle every constraint ``count`` times, top of the tree first, and write the poses back to the
        graph.
        """
        graph, state = self.graph, self.state
        numbers = np.arange(self.iteration + 1, self.iteration + count + 1)
        progress = np.minimum(numbers / self.planned, 1.0)
        rates = self.first_rate * COOLING**progress
        strengths = (self.strengths * (1.0, ROTATION_COOLING**part) for part in progress)
        if graph.planar:
            self._sweep_plane(rates, strengths)
        else:
            for rate, strength in zip(rates, strengths, strict=True):
                turn = self._turn()
                _sweep(
                    state.tree.parent, state.tree.level, graph.i, graph.j, graph.measured_positions,
                    graph.measured_quaternions, self.constraints[turn], self.tops[turn], strength,
                    state.passing, rate, state.positions, state.quaternions,
                )  # fmt: skip
        _from_parents(
            state.tree.parent,
            state.tree.order,
            state.positions,
            state.quaternions,
            graph.positions,
            graph.quaternions,
        )

    def _turn(self) -> IntArray:
        """The order of the next sweep: by level; after the great moves, constraints of one level as drawn by
        lot, so that none has the last word every time. The same for the same graph.
        """
        self.iteration += 1
        if self.iteration <= GREAT_MOVES * self.planned:
            return np.arange(len(self._levels))
        return np.argsort(self._levels + self._random.random(len(self._levels)))

    def _sweep_plane(self, rates: FloatArray, strengths: Iterable[FloatArray]) -> None:
        graph, state = self.graph, self.state
        measured = planar_poses(graph.measured_positions, graph.measured_quaternions)
        relative = planar_poses(state.positions, state.quaternions)
        for rate, strength in zip(rates, strengths, strict=True):
            turn = self._turn()
            _sweep_planar(
                state.tree.parent, state.tree.level, graph.i, graph.j, measured, self.constraints[turn],
                self.tops[turn], strength, state.passing, rate, relative,
            )  # fmt: skip
        write_planar_poses(relative, state.positions, state.quaternions)


def path_strengths(information: FloatArray, planar: bool) -> FloatArray:
    """(m, 2) information a constraint puts on translation and on rotation (per radian squared): largest
    diagonal entries.
    """
    diagonal = np.einsum("kaa->ka", information)
    if planar:
        return np.stack([diagonal[:, :2].max(axis=1), diagonal[:, 5]], axis=1)
    return np.stack([diagonal[:, :3].max(axis=1), diagonal[:, 3:].max(axis=1) / 4.0], axis=1)


@njit(cache=True, nogil=True)
def _path_tops(parent: Any, level: Any, i: Any, j: Any) -> Any:
    """Lowest common ancestor of each pair; -1 in different trees."""
    tops = np.empty(len(i), np.int64)
    for k in range(len(i)):
        a, b = i[k], j[k]
        while a != b:
            if level[a] >= level[b]:
                a = parent[a]
                if a < 0:
                    break
            else:
                b = parent[b]
        tops[k] = a
    return tops


@njit(cache=True, nogil=True)
def _add_passing(
    parent: Any, level: Any, i: Any, j: Any, constraints: Any, strengths: Any, passing: Any
) -> None:
    for k in range(len(constraints)):
        c = constraints[k]
        a, b = i[c], j[c]
        while a != b:
            if level[a] >= level[b]:
                passing[a, 0] += strengths[c, 0]
                passing[a, 1] += strengths[c, 1]
                a = parent[a]
            else:
                passing[b, 0] += strengths[c, 0]
                passing[b, 1] += strengths[c, 1]
                b = parent[b]


@njit(cache=True, nogil=True)
def _natural_shares(
    parent: Any, level: Any, i: Any, j: Any, constraints: Any, strengths: Any, passing: Any
) -> Any:
    """What share of its error each constraint would take at rate 1, the smaller of translation and
    rotation.
    """
    shares = np.empty(len(constraints))
    for k in range(len(constraints)):
        c = constraints[k]
        a, b = i[c], j[c]
        sum_t, sum_r = 0.0, 0.0
        while a != b:
            if level[a] >= level[b]:
                n = a
                a = parent[a]
            else:
                n = b
                b = parent[b]
            sum_t += 1.0 / passing[n, 0]
            sum_r += 1.0 / passing[n, 1]
        shares[k] = min(strengths[c, 0] * sum_t, strengths[c, 1] * sum_r)
    return shares
