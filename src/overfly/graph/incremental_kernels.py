"""Compiled parts of ``incremental``: what changed in a graph, and which part of the factor that concerns."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray
from overfly.graph.elimination import _eliminate
from overfly.graph.front_tree import _separators
from overfly.graph.jacobians import _chi2, _move_from
from overfly.graph.pose_graph import PoseGraph, State
from overfly.graph.sparse import _join_parts
from overfly.types import BoolArray, IntArray, UInt8Array

_ACTIVE = int(State.ACTIVE)


class Given(NamedTuple):
    """What the graph holds: poses (n, 3) and (n, 4), constraints (m,) and their states; views."""

    positions: FloatArray
    quaternions: FloatArray
    i: IntArray
    j: IntArray
    measured_positions: FloatArray
    measured_quaternions: FloatArray
    information: FloatArray
    states: UInt8Array

    @staticmethod
    def by(graph: PoseGraph) -> Given:
        return Given(
            graph.positions, graph.quaternions, graph.i, graph.j, graph.measured_positions,
            graph.measured_quaternions, graph.information, graph.states,
        )  # fmt: skip


class NodeColumns(NamedTuple):
    """positions (n, 3), quaternions (n, 4): where nodes are linearised; steps (n, d) from there. left_at (n,
    3), left_turned (n, 4): poses as they were left. first (n,): chain of constraints (``Equations``). oldest
    (n,): link towards the oldest node of the same connected part, which is held: fixed (n,). unsolved (n,):
    fronts that were replaced since the last step, by name.
    """

    positions: FloatArray
    quaternions: FloatArray
    steps: FloatArray
    left_at: FloatArray
    left_turned: FloatArray
    first: IntArray
    oldest: IntArray
    fixed: BoolArray
    unsolved: BoolArray

    @staticmethod
    def empty(n: int, d: int) -> NodeColumns:
        return NodeColumns(
            np.zeros((n, 3)), np.zeros((n, 4)), np.zeros((n, d)), np.zeros((n, 3)), np.zeros((n, 4)),
            np.full(n, -1, np.int64), np.arange(n), np.zeros(n, np.bool_), np.zeros(n, np.bool_),
        )  # fmt: skip


class ConstraintColumns(NamedTuple):
    """following (m, 2), used (m,), blocks (m, 3, d, d), gradients (m, 2, d): as in ``Equations``.
    measured_positions (m, 3), measured_quaternions (m, 4), stiffness (m, 2): constraints as they were taken
    in; of their information the ends of the diagonal, for nothing rewrites the rest alone. linear_values,
    values (m,): chi2 where linearised, and now.
    """

    following: IntArray
    used: BoolArray
    blocks: FloatArray
    gradients: FloatArray
    measured_positions: FloatArray
    measured_quaternions: FloatArray
    stiffness: FloatArray
    linear_values: FloatArray
    values: FloatArray

    @staticmethod
    def empty(m: int, d: int) -> ConstraintColumns:
        return ConstraintColumns(
            np.full((m, 2), -1, np.int64), np.zeros(m, np.bool_), np.zeros((m, 3, d, d)),
            np.zeros((m, 2, d)), np.zeros((m, 3)), np.zeros((m, 4)), np.zeros((m, 2)), np.zeros(m),
            np.zeros(m),
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _find_changes(
    given: Any, nodes: Any, constraints: Any, n_old: int, m_old: int, stale: Any, placed: Any,
    is_refreshed: bool,
) -> Any:  # fmt: skip
    """Nodes to be linearised where they are: new ones, both ends of new constraints, those that others have
    moved, and stale ones. Constraints that count again, no longer or otherwise, or whose nodes are linearised
    anew, held or no longer held. Old nodes (n_old of them) that this concerns. is_refreshed: look at all that
    constraints hold; otherwise not at their information, which is far too much to read each time. placed
    (k,): nodes whose position is known; the parts of the graph that they belong to need no node to be held.
    """
    n, m, i, j = len(given.positions), len(given.i), given.i, given.j
    anew = np.zeros(n, np.bool_)
    anew[n_old:] = True
    anew[stale] = True
    for c in range(m_old, m):
        anew[i[c]] = anew[j[c]] = True
        constraints.following[c, 0], nodes.first[i[c]] = nodes.first[i[c]], 2 * c
        constraints.following[c, 1], nodes.first[j[c]] = nodes.first[j[c]], 2 * c + 1
    _find_moved(given.positions[:n_old], nodes.left_at, anew)
    _find_moved(given.quaternions[:n_old], nodes.left_turned, anew)
    used = given.states == _ACTIVE
    otherwise = _hold_oldest(i, j, used, constraints.used, m_old, placed, nodes) | anew
    rewritten = (
        is_refreshed
        or not _are_equal(given.measured_positions[:m_old], constraints.measured_positions[:m_old])
        or not _are_equal(given.measured_quaternions[:m_old], constraints.measured_quaternions[:m_old])
    )
    concerned = anew.copy()
    touched, n_touched = np.empty(m, np.int64), 0
    for c in range(m):
        differs = otherwise[i[c]] or otherwise[j[c]]
        if rewritten or c >= m_old:
            differs = _take_measured(given, constraints, c) or differs
        if used[c] != constraints.used[c] or (used[c] and differs):
            touched[n_touched] = c
            n_touched += 1
            concerned[i[c]] = concerned[j[c]] = True
    constraints.used[:] = used
    return np.flatnonzero(anew), touched[:n_touched], np.flatnonzero(concerned[:n_old])


@njit(cache=True, nogil=True)
def _are_equal(a: Any, b: Any) -> bool:
    """Whether two arrays, each in one piece, hold the same numbers."""
    a, b = a.reshape(-1), b.reshape(-1)
    different = 0  # counted without a branch, which is faster than to stop at the first
    for k in range(len(a)):
        different += a[k] != b[k]
    return different == 0


@njit(cache=True, nogil=True)
def _find_moved(poses: Any, left: Any, anew: Any) -> None:
    """Enter the nodes that are not where they were left."""
    if not _are_equal(poses, left[: len(poses)]):
        for k in range(len(poses)):
            anew[k] |= not _are_equal(poses[k], left[k])


@njit(cache=True, nogil=True)
def _hold_oldest(
    i: Any, j: Any, used: Any, was_used: Any, m_old: int, placed: Any, nodes: Any
) -> Any:  # fmt: skip
    """Hold the oldest node of every connected part without a node whose position is known; (n,) whether nodes
    are now held or no longer.
    """
    begin = m_old
    if not _are_equal(used[:m_old], was_used[:m_old]):
        begin, nodes.oldest[:] = 0, np.arange(len(nodes.oldest))
    _join_parts(nodes.oldest, i[begin:], j[begin:], used[begin:])
    free, differs = np.zeros(len(nodes.oldest), np.bool_), np.zeros(len(nodes.oldest), np.bool_)
    free[nodes.oldest[placed]] = True
    for k in range(len(differs)):
        fixed = nodes.oldest[k] == k and not free[k]
        differs[k] = fixed != nodes.fixed[k]
        nodes.fixed[k] = fixed
    return differs


@njit(cache=True, nogil=True, inline="always")
def _take_measured(given: Any, constraints: Any, c: int) -> bool:
    """Take in a constraint; whether it is not what it was."""
    differs = False
    for r in range(3):
        differs |= constraints.measured_positions[c, r] != given.measured_positions[c, r]
        constraints.measured_positions[c, r] = given.measured_positions[c, r]
    for r in range(4):
        differs |= constraints.measured_quaternions[c, r] != given.measured_quaternions[c, r]
        constraints.measured_quaternions[c, r] = given.measured_quaternions[c, r]
    for r in range(2):
        differs |= constraints.stiffness[c, r] != given.information[c, 5 * r, 5 * r]
        constraints.stiffness[c, r] = given.information[c, 5 * r, 5 * r]
    return differs


@njit(cache=True, nogil=True)
def _order_part(
    given: Any, nodes: Any, constraints: Any, tree: Any, front_nodes: Any, part: Any, orphans: Any
) -> Any:
    """The fronts (``Fronts``) of a part of the nodes (k,), joined by their constraints and by what hangs
    below them; the newest node last.
    """
    place = np.full(len(nodes.first), -1, np.int64)
    for p in range(len(part)):
        place[part[p]] = p
    pairs, count = np.empty((len(given.i), 2), np.int64), 0
    for node in part:
        entry = nodes.first[node]
        while entry >= 0:
            c, side = entry // 2, entry % 2
            entry = constraints.following[c, side]
            other = given.j[c]
            held = nodes.fixed[node] or nodes.fixed[other]
            if side == 0 and constraints.used[c] and place[other] >= 0 and not held:
                pairs[count, 0], pairs[count, 1] = place[node], place[other]
                count += 1
    separators, starts = _separators(tree, front_nodes, orphans)
    return _eliminate(part, pairs[:count], place[separators], starts, part >= len(nodes.first) - 1)


@njit(cache=True, nogil=True)
def _take_poses(given: Any, nodes: Any, some: Any) -> None:
    """Linearise these nodes where they stand."""
    for k in some:
        for r in range(3):
            nodes.positions[k, r] = nodes.left_at[k, r] = given.positions[k, r]
        for r in range(4):
            nodes.quaternions[k, r] = nodes.left_turned[k, r] = given.quaternions[k, r]
        nodes.steps[k] = 0.0


@njit(cache=True, nogil=True)
def _follow_steps(given: Any, nodes: Any, constraints: Any, some: Any, planar: bool) -> Any:
    """Move these nodes to where their steps lead; chi2 then, and where everything was linearised."""
    _move_from(
        nodes.positions, nodes.quaternions, nodes.steps, some, given.positions, given.quaternions,
        nodes.left_at, nodes.left_turned,
    )  # fmt: skip
    moved = np.zeros(len(nodes.first), np.bool_)
    moved[some] = True
    changed, count = np.empty(len(given.i), np.int64), 0
    for c in range(len(given.i)):
        if constraints.used[c] and (moved[given.i[c]] or moved[given.j[c]]):
            changed[count] = c
            count += 1
    changed = changed[:count]
    constraints.values[changed] = _chi2(
        given.positions, given.quaternions, given.i, given.j, given.measured_positions,
        given.measured_quaternions, given.information, changed, planar,
    )  # fmt: skip
    return _sum_used(constraints.values, constraints.used), _sum_used(
        constraints.linear_values, constraints.used
    )


@njit(cache=True, nogil=True)
def _sum_used(values: Any, used: Any) -> float:
    total = 0.0
    for c in range(len(values)):
        if used[c]:
            total += values[c]
    return total
