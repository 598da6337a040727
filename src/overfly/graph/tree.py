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

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray
from overfly.graph.pose_graph import PoseGraph
from overfly.graph.quaternions import (
    _conjugate,
    _exponential,
    _multiply,
    _normalised,
    _quaternion,
    _rotate,
    _vector,
)
from overfly.graph.symbolic import adjacency
from overfly.types import IntArray

RESOLVED_PARTLY = 0.03  # part of the constraints that the first iteration does not resolve in full
COOLING = 1e-4  # last learning rate by the first


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
        self.constraints = constraints[np.argsort(tree.level[top], kind="stable")]
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
        for _ in range(count):
            self.iteration += 1
            _sweep(
                state.tree.parent, state.tree.level, graph.i, graph.j, graph.measured_positions,
                graph.measured_quaternions, self.constraints, self.strengths, state.passing,
                self.first_rate * COOLING ** min(self.iteration / self.planned, 1.0), state.positions,
                state.quaternions,
            )  # fmt: skip
        _from_parents(
            state.tree.parent,
            state.tree.order,
            state.positions,
            state.quaternions,
            graph.positions,
            graph.quaternions,
        )


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


@njit(cache=True, nogil=True)
def _to_parents(parent: Any, positions: Any, quaternions: Any, relative_t: Any, relative_q: Any) -> None:
    for n in range(len(parent)):
        p = parent[n]
        if p < 0:
            relative_t[n] = positions[n]
            relative_q[n] = quaternions[n]
            continue
        back = _conjugate(_quaternion(quaternions[p]))
        t = _rotate(
            back,
            (
                positions[n, 0] - positions[p, 0],
                positions[n, 1] - positions[p, 1],
                positions[n, 2] - positions[p, 2],
            ),
        )
        q = _multiply(back, _quaternion(quaternions[n]))
        _store(relative_t[n], t)
        _store(relative_q[n], q)


@njit(cache=True, nogil=True)
def _from_parents(
    parent: Any, order: Any, relative_t: Any, relative_q: Any, positions: Any, quaternions: Any
) -> None:
    for k in range(len(order)):
        n = order[k]
        p = parent[n]
        if p < 0:
            continue
        here = _quaternion(quaternions[p])
        t = _rotate(here, _vector(relative_t[n]))
        _store(quaternions[n], _normalised(_multiply(here, _quaternion(relative_q[n]))))
        _store(positions[n], (positions[p, 0] + t[0], positions[p, 1] + t[1], positions[p, 2] + t[2]))


@njit(cache=True, nogil=True, inline="always")
def _store(row: Any, values: Any) -> None:
    for k in range(len(values)):
        row[k] = values[k]


@njit(cache=True, nogil=True)
def _climb(
    parent: Any, node: int, top: int, relative_t: Any, relative_q: Any, path: Any, Q: Any, T: Any
) -> int:
    """Path from below ``top`` down to ``node``, with poses in the axes of ``top``; returns its length."""
    length = 0
    n = node
    while n != top:
        length += 1
        n = parent[n]
    n = node
    for k in range(length - 1, -1, -1):
        path[k] = n
        n = parent[n]
    q = (0.0, 0.0, 0.0, 1.0)
    x, y, z = 0.0, 0.0, 0.0
    for k in range(length):
        t = _rotate(q, _vector(relative_t[path[k]]))
        x, y, z = x + t[0], y + t[1], z + t[2]
        q = _multiply(q, _quaternion(relative_q[path[k]]))
        _store(Q[k], q)
        T[k, 0], T[k, 1], T[k, 2] = x, y, z
    return length


@njit(cache=True, nogil=True)
def _turn_leg(
    length: int,
    path: Any,
    passing: Any,
    unit: float,
    turn: Any,
    relative_t: Any,
    relative_q: Any,
    Q: Any,
    T: Any,
) -> None:
    """Turn the nodes of one leg about ``turn`` (axes of the top), each by what fell to it and to those above
    it.
    """
    done = 0.0
    q = (0.0, 0.0, 0.0, 1.0)
    x, y, z = 0.0, 0.0, 0.0
    for k in range(length):
        n = path[k]
        t = _rotate(q, _vector(relative_t[n]))
        x, y, z = x + t[0], y + t[1], z + t[2]
        T[k, 0], T[k, 1], T[k, 2] = x, y, z
        done += unit / passing[n, 1]
        turned = _multiply(_exponential(done * turn[0], done * turn[1], done * turn[2]), _quaternion(Q[k]))
        _store(relative_q[n], _normalised(_multiply(_conjugate(q), turned)))
        q = turned
        _store(Q[k], q)


@njit(cache=True, nogil=True)
def _shift_leg(
    length: int, path: Any, passing: Any, unit: float, shift: Any, relative_t: Any, Q: Any
) -> None:
    """Shift the nodes of one leg by their cumulated share of ``shift`` (axes of the top)."""
    for k in range(length):
        share = unit / passing[path[k], 0]
        step = (share * shift[0], share * shift[1], share * shift[2])
        if k > 0:
            step = _rotate(_conjugate(_quaternion(Q[k - 1])), step)
        for r in range(3):
            relative_t[path[k], r] += step[r]


@njit(cache=True, nogil=True)
def _rotation_vector(q: Any) -> Any:
    if q[3] < 0.0:
        q = (-q[0], -q[1], -q[2], -q[3])
    length = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    scale = 2.0 if length < 1e-10 else 2.0 * math.atan2(length, q[3]) / length
    return q[0] * scale, q[1] * scale, q[2] * scale


@njit(cache=True, nogil=True)
def _resolve(
    parent: Any, top: int, a: int, b: int, measured_t: Any, measured_q: Any, strength: Any, passing: Any,
    rate: float,
    relative_t: Any, relative_q: Any, path_a: Any, Qa: Any, Ta: Any, path_b: Any, Qb: Any, Tb: Any,
) -> None:  # fmt: skip
    """Move the nodes on the path from a to b so that this share of the constraint's error goes."""
    length_a = _climb(parent, a, top, relative_t, relative_q, path_a, Qa, Ta)
    length_b = _climb(parent, b, top, relative_t, relative_q, path_b, Qb, Tb)
    sum_t, sum_r = 0.0, 0.0
    for k in range(length_a):
        sum_t += 1.0 / passing[path_a[k], 0]
        sum_r += 1.0 / passing[path_a[k], 1]
    for k in range(length_b):
        sum_t += 1.0 / passing[path_b[k], 0]
        sum_r += 1.0 / passing[path_b[k], 1]
    share_t = min(1.0, rate * strength[0] * sum_t)
    share_r = min(1.0, rate * strength[1] * sum_r)
    qa = _quaternion(Qa[length_a - 1]) if length_a > 0 else (0.0, 0.0, 0.0, 1.0)
    qb = _quaternion(Qb[length_b - 1]) if length_b > 0 else (0.0, 0.0, 0.0, 1.0)
    turn = _rotation_vector(_multiply(_multiply(qa, _quaternion(measured_q)), _conjugate(qb)))
    _turn_leg(length_a, path_a, passing, -share_r / sum_r, turn, relative_t, relative_q, Qa, Ta)
    _turn_leg(length_b, path_b, passing, share_r / sum_r, turn, relative_t, relative_q, Qb, Tb)
    qa = _quaternion(Qa[length_a - 1]) if length_a > 0 else (0.0, 0.0, 0.0, 1.0)
    wanted = _rotate(qa, _vector(measured_t))
    ta = _vector(Ta[length_a - 1]) if length_a > 0 else (0.0, 0.0, 0.0)
    tb = _vector(Tb[length_b - 1]) if length_b > 0 else (0.0, 0.0, 0.0)
    shift = (wanted[0] - tb[0] + ta[0], wanted[1] - tb[1] + ta[1], wanted[2] - tb[2] + ta[2])
    _shift_leg(length_a, path_a, passing, -share_t / sum_t, shift, relative_t, Qa)
    _shift_leg(length_b, path_b, passing, share_t / sum_t, shift, relative_t, Qb)


@njit(cache=True, nogil=True)
def _sweep(
    parent: Any, level: Any, i: Any, j: Any, measured_t: Any, measured_q: Any, constraints: Any,
    strengths: Any,
    passing: Any, rate: float, relative_t: Any, relative_q: Any,
) -> None:  # fmt: skip
    deepest = level.max() + 1
    path_a, path_b = np.empty(deepest, np.int64), np.empty(deepest, np.int64)
    Qa, Qb = np.empty((deepest, 4)), np.empty((deepest, 4))
    Ta, Tb = np.empty((deepest, 3)), np.empty((deepest, 3))
    tops = _path_tops(parent, level, i[constraints], j[constraints])
    for k in range(len(constraints)):
        c = constraints[k]
        _resolve(
            parent, tops[k], i[c], j[c], measured_t[c], measured_q[c], strengths[c], passing, rate,
            relative_t,
            relative_q, path_a, Qa, Ta, path_b, Qb, Tb,
        )  # fmt: skip
