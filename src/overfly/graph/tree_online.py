"""The tree optimiser online: a new constraint is resolved together with those that meet its path; all are
swept only now and then, so that the whole costs a few sweeps of the final graph.

Every node keeps its own learning rate between runs: raised where a new constraint contradicts what the node
holds, to the share that the new information has against the old, and cooled harmonically each time it is
used, so that old parts stay put. Source: Grisetti et al., "Online constraint network optimization for
efficient maximum likelihood map learning", ICRA 2008.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from overfly.graph.pose_graph import Column, PoseGraph
from overfly.graph.tree import TreeOptimiser, _path_tops, path_strengths
from overfly.graph.tree_kernels import _from_parents, _resolve, _to_parents
from overfly.types import IntArray

GROWTH = 0.05  # of the constraints resolved: then all are swept
SWEEPS = 10


class OnlineTree:
    """Spanning tree of a growing graph. Every node but the first is attached once, by the constraint that
    ties it to an older one.
    """

    def __init__(self, graph: PoseGraph) -> None:
        self.graph = graph
        self._parent = Column(dtype=np.int64)
        self._level = Column(dtype=np.int64)
        self._positions = Column((3,))
        self._quaternions = Column((4,))
        self._passing = Column((2,))
        self._rate = Column()
        self._strengths = Column((2,))
        self._resolved = self._resolved_when_settled = 0  # constraints
        self._first = Column(
            dtype=np.int64
        )  # per node: its latest entry in the incidence list, constraint * 2 + side
        self._next = Column((2,), dtype=np.int64)

    def __len__(self) -> int:
        return len(self._parent.view)

    def attach(self, parent: int) -> None:
        """Hang the next node of the graph below ``parent`` (-1: a root) at the pose it has."""
        node = len(self)
        pose = self.graph.pose(node)
        relative = pose if parent < 0 else self.graph.pose(parent).inverse() @ pose
        self._parent.append(parent)
        self._level.append(0 if parent < 0 else self._level.view[parent] + 1)
        self._positions.append(relative.translation)
        self._quaternions.append(relative.quaternion())
        self._passing.append((1e-12, 1e-12))
        self._rate.append(0.0)
        self._first.append(-1)

    def add(self, number: int) -> None:
        """Take in constraint ``number`` of the graph, the next one, between attached nodes, without moving
        anything.
        """
        self._strengths.append(path_strengths(self.graph.information[number][None], self.graph.planar)[0])
        self._next.append((-1, -1))
        _take_in(
            self._parent.view, self._level.view, self.graph.i, self.graph.j, number, self._strengths.view,
            self._passing.view, self._first.view, self._next.view,
        )  # fmt: skip

    def resolve(self, number: int, sweeps: int) -> IntArray:
        """Sweep over the constraints that meet the path of this one, and write the poses back; their
        numbers. Whenever so resolved constraints have become a twentieth more, all are swept.
        """
        graph = self.graph
        constraints = _resolve_locally(
            self._parent.view, self._level.view, graph.i, graph.j, graph.measured_positions,
            graph.measured_quaternions, graph.states, number, sweeps, self._strengths.view,
            self._passing.view,
            self._rate.view, self._first.view, self._next.view, self._positions.view,
            self._quaternions.view,
        )  # fmt: skip
        _from_parents(
            self._parent.view, np.arange(len(self)), self._positions.view, self._quaternions.view,
            graph.positions,
            graph.quaternions,
        )  # fmt: skip
        self._resolved += 1
        if self._resolved > (1.0 + GROWTH) * self._resolved_when_settled:
            self._settle()
        return np.asarray(constraints)

    def _settle(self) -> None:
        """Sweep over all constraints, as in batch: what no loop's path has met is resolved too."""
        graph = self.graph
        self._resolved_when_settled = self._resolved
        TreeOptimiser(graph, SWEEPS).iterate(SWEEPS)
        _to_parents(
            self._parent.view, graph.positions, graph.quaternions, self._positions.view,
            self._quaternions.view,
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _take_in(
    parent: Any,
    level: Any,
    i: Any,
    j: Any,
    number: int,
    strengths: Any,
    passing: Any,
    first: Any,
    following: Any,
) -> None:
    a, b = i[number], j[number]
    following[number, 0], first[a] = first[a], 2 * number
    following[number, 1], first[b] = first[b], 2 * number + 1
    while a != b:
        if level[a] >= level[b]:
            passing[a] += strengths[number]
            a = parent[a]
        else:
            passing[b] += strengths[number]
            b = parent[b]


@njit(cache=True, nogil=True)
def _path(parent: Any, level: Any, a: int, b: int, path: Any) -> int:
    """Nodes of the tree path from a to b without its top."""
    length = 0
    while a != b:
        if level[a] >= level[b]:
            path[length] = a
            a = parent[a]
        else:
            path[length] = b
            b = parent[b]
        length += 1
    return length


@njit(cache=True, nogil=True)
def _resolve_locally(
    parent: Any, level: Any, i: Any, j: Any, measured_t: Any, measured_q: Any, states: Any, number: int,
    sweeps: int,
    strengths: Any, passing: Any, rate: Any, first: Any, following: Any, relative_t: Any, relative_q: Any,
) -> Any:  # fmt: skip
    deepest = level.max() + 1
    path = np.empty(2 * deepest, np.int64)
    length = _path(parent, level, i[number], j[number], path)
    count = 0
    met = np.empty(64, np.int64)
    for k in range(length):
        node = path[k]
        rate[node] = max(rate[node], 1.0)
        entry = first[node]
        while entry >= 0:
            c = entry // 2
            entry = following[c, entry % 2]
            if states[c] == 0:
                if count == len(met):
                    grown = np.empty(2 * count, np.int64)
                    grown[:count] = met
                    met = grown
                met[count] = c
                count += 1
    met = np.unique(met[:count])
    tops = _path_tops(parent, level, i[met], j[met])
    by_level = np.argsort(level[tops], kind="mergesort")
    path_a, path_b = np.empty(deepest, np.int64), np.empty(deepest, np.int64)
    Qa, Qb = np.empty((deepest, 4)), np.empty((deepest, 4))
    Ta, Tb = np.empty((deepest, 3)), np.empty((deepest, 3))
    for _ in range(sweeps):
        for k in by_level:
            c = met[k]
            length = _path(parent, level, i[c], j[c], path)
            fastest = 0.0
            for n in range(length):
                fastest = max(fastest, rate[path[n]])
            _resolve(
                parent, tops[k], i[c], j[c], measured_t[c], measured_q[c], strengths[c], passing, fastest,
                relative_t,
                relative_q, path_a, Qa, Ta, path_b, Qb, Tb,
            )  # fmt: skip
        for k in range(len(met)):
            for node in (i[met[k]], j[met[k]]):
                rate[node] = rate[node] / (1.0 + rate[node])
    return met
