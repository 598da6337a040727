"""Least squares kept up to date: a new constraint costs what it concerns, not what the graph holds.

Every node has the pose at which its constraints were linearised and a step from there, which solves the
linear problem. A change refactors the fronts from its nodes up to the root, which are ordered anew, and
changes the steps of the nodes it reaches. Where the linear problem no longer foretells chi2, the nodes that
turned furthest are linearised anew. Source: Kaess et al., "iSAM2", IJRR 2012, with normal equations in place
of QR, chi2 itself as the test in place of a threshold on the steps, and bounds in units of chi2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from overfly.graph.elimination import Fronts, eliminate_part, whole_fronts
from overfly.graph.front_tree import Equations, FrontTree
from overfly.graph.jacobians import _move_from
from overfly.graph.linearise import Freedom, constraint_chi2, linearise_each
from overfly.graph.pose_graph import Column, PoseGraph, State
from overfly.graph.sparse import WATCHDOG, find_pattern, frame_nodes
from overfly.types import BoolArray, IntArray

LARGEST_PART = 0.6  # of the nodes: more are ordered and linearised as a whole
MOST_NODES = 1500  # ordered as a part
LEFT_OUT = 0.3  # of the gain that is looked for: nodes whose steps change by less in all are left alone
LARGEST_GAIN = 0.01  # of chi2: the solution is at least so good, whatever is asked for
ROUNDING = 1e-9  # of chi2
TURNED = 0.2  # of the largest turn: nodes that turned further are linearised anew


@dataclass(frozen=True, eq=False)
class Settled:
    """cost: chi2 now. mismatch: by how much it differs from what the linear problem says. converged: whether
    that is little.
    """

    cost: float
    mismatch: float
    converged: bool


class IncrementalSolver:
    """The solution of the active part of a growing graph, without robust kernels and absolute constraints."""

    def __init__(self, graph: PoseGraph, freedom: Freedom) -> None:
        self.graph = graph
        self.freedom = freedom
        d = int(freedom)
        self.factor = FrontTree(d)
        self.fixed: BoolArray = np.empty(0, np.bool_)
        self._positions, self._quaternions = Column((3,)), Column((4,))  # where nodes are linearised
        self._written = Column((7,))  # poses as they were left
        self._steps = Column((d,))
        self._first = Column(dtype=np.int64)
        self._following = Column((2,), dtype=np.int64)
        self._used = Column(dtype=np.bool_)
        self._measured = Column((13,))  # constraints as they were taken in
        self._blocks, self._gradients = Column((3, d, d)), Column((2, d))
        self._linear_values, self._values = Column(), Column()  # chi2 where linearised, and now
        self._unsolved = Column(dtype=np.bool_)  # fronts that were replaced since the last step, by name
        self._stale: IntArray = np.empty(0, np.int64)  # nodes to be linearised anew

    def solve(self, max_iterations: int, relative_gain: float) -> Settled | None:
        """Move the nodes of the graph to where its constraints agree best; None, and no node moved, where
        that would not help.
        """
        graph = self.graph
        before = graph.positions.copy(), graph.quaternions.copy()
        first_cost, cost, mismatch, converged = np.inf, np.inf, np.inf, False
        for iteration in range(max_iterations):
            if not self.take_in():
                graph.positions[:], graph.quaternions[:] = before
                return None
            if iteration == 0:
                first_cost = self._cost()
            least = LEFT_OUT * min(relative_gain, LARGEST_GAIN) * self._cost() / len(graph)
            self._move(least)
            cost = self._cost()
            foretold = float(self._linear_values.view[self._used.view].sum()) - self.factor.total_gain()
            mismatch = abs(cost - foretold)
            converged = mismatch <= relative_gain * cost + ROUNDING
            self._stale = np.empty(0, np.int64) if converged else self._turned()
            if converged or not cost < WATCHDOG * first_cost:
                break
        if not cost <= (1.0 + relative_gain) * first_cost + ROUNDING:
            graph.positions[:], graph.quaternions[:] = before
            return None
        return Settled(cost, mismatch, converged)

    def take_in(self) -> bool:
        """Bring the factor up to date with the graph without moving it; False where its constraints do not
        determine it. The solver is then of no more use.
        """
        graph = self.graph
        n_old, m_old = len(self._first.view), len(self._used.view)
        self._grow()
        used = graph.states == State.ACTIVE
        fixed = frame_nodes(graph, graph.i[used], graph.j[used])
        anew = np.zeros(len(graph), np.bool_)  # nodes to be linearised where they are now
        anew[n_old:] = anew[self._stale] = True
        anew[graph.i[m_old:]] = anew[graph.j[m_old:]] = True
        changed = np.empty(graph.n_constraints, np.bool_)
        _find_changes(
            graph.positions, graph.quaternions, self._written.view, graph.measured_positions,
            graph.measured_quaternions, graph.information, self._measured.view, used, self._used.view,
            graph.i, graph.j, fixed, self.fixed, anew, changed,
        )  # fmt: skip
        self._used.view[:], self.fixed = used, fixed
        self._stale = np.empty(0, np.int64)
        touched = np.flatnonzero(changed)
        ends = np.concatenate([graph.i[touched], graph.j[touched], np.flatnonzero(anew)])
        nodes, orphans = self.factor.affected(ends[ends < n_old])
        if len(nodes) == 0:
            return True
        if len(nodes) > min(LARGEST_PART * len(graph), MOST_NODES):
            anew[:] = True
            touched, orphans = np.flatnonzero(used), np.empty(0, np.int64)
            fronts = whole_fronts(find_pattern(graph).symbolic)
        else:
            fronts = self._part(nodes, orphans)
        self._linearise(np.flatnonzero(anew), touched[used[touched]])
        equations = Equations(
            graph.i, graph.j, self._used.view, self._first.view, self._following.view, self._blocks.view,
            self._gradients.view, fixed,
        )  # fmt: skip
        self._unsolved.view[nodes] = False
        self._unsolved.view[fronts.own[fronts.own_starts[:-1]]] = True
        return self.factor.replace(fronts, orphans, equations)

    def _grow(self) -> None:
        """Room for the nodes and constraints that the graph has gained."""
        graph = self.graph
        n_old, m_old = len(self._first.view), len(self._used.view)
        n, m, d = len(graph) - n_old, graph.n_constraints - m_old, int(self.freedom)
        self._first.extend(np.full(n, -1, np.int64))
        self._following.extend(np.full((m, 2), -1, np.int64))
        _chain(graph.i, graph.j, m_old, self._first.view, self._following.view)
        for column, shape in (
            (self._positions, (n, 3)), (self._quaternions, (n, 4)), (self._written, (n, 7)),
            (self._steps, (n, d)), (self._measured, (m, 13)), (self._blocks, (m, 3, d, d)),
            (self._gradients, (m, 2, d)), (self._linear_values, (m,)), (self._values, (m,)),
        ):  # fmt: skip
            column.extend(np.zeros(shape))
        self._unsolved.extend(np.zeros(n, np.bool_))
        self._used.extend(np.zeros(m, np.bool_))
        self.fixed = np.concatenate([self.fixed, np.zeros(n, np.bool_)])
        self.factor.grow(len(graph))

    def _part(self, nodes: IntArray, orphans: IntArray) -> Fronts:
        """The top of the tree in a new order, the newest node last."""
        place = np.full(len(self.graph), -1, np.int64)
        place[nodes] = np.arange(len(nodes))
        separators, starts = self.factor.separators(orphans)
        pairs = _pairs_within(self.graph.i, self.graph.j, self._used.view, self.fixed, place)
        late = nodes >= len(self.graph) - 1
        return eliminate_part(nodes, pairs, place[separators], starts, late)

    def _linearise(self, nodes: IntArray, constraints: IntArray) -> None:
        """These constraints, after these nodes have been taken where they stand."""
        graph = self.graph
        self._positions.view[nodes] = graph.positions[nodes]
        self._quaternions.view[nodes] = graph.quaternions[nodes]
        self._written.view[nodes, :3] = graph.positions[nodes]
        self._written.view[nodes, 3:] = graph.quaternions[nodes]
        self._steps.view[nodes] = 0.0
        linearise_each(
            graph, self.freedom, constraints, self._positions.view, self._quaternions.view,
            self._blocks.view, self._gradients.view, self._linear_values.view,
        )  # fmt: skip
        self._values.view[constraints] = constraint_chi2(graph, constraints)

    def _move(self, least: float) -> None:
        """Solve for the steps, and move the nodes whose step changed by more than ``least`` in chi2."""
        graph = self.graph
        fresh = np.flatnonzero(self._unsolved.view)
        self._unsolved.view[fresh] = False
        nodes = self.factor.solve(self._steps.view, fresh, least)
        _move_from(
            self._positions.view, self._quaternions.view, self._steps.view, nodes, graph.positions,
            graph.quaternions, self._written.view,
        )  # fmt: skip
        moved = np.zeros(len(graph), np.bool_)
        moved[nodes] = True
        constraints = np.flatnonzero(self._used.view & (moved[graph.i] | moved[graph.j]))
        self._values.view[constraints] = constraint_chi2(graph, constraints)

    def _cost(self) -> float:
        return float(self._values.view[self._used.view].sum())

    def _turned(self) -> IntArray:
        """The nodes that turned furthest since they were linearised."""
        steps = self._steps.view
        turns = np.abs(steps[:, 3:] if self.freedom is not Freedom.PLANAR else steps[:, 2:]).max(axis=1)
        return np.flatnonzero((turns > TURNED * turns.max()) & (turns > 0.0))


@njit(cache=True, nogil=True)
def _chain(i: Any, j: Any, begin: int, first: Any, following: Any) -> None:
    """Enter constraints from number ``begin`` on into the chains of their nodes."""
    for c in range(begin, len(i)):
        following[c, 0], first[i[c]] = first[i[c]], 2 * c
        following[c, 1], first[j[c]] = first[j[c]], 2 * c + 1


@njit(cache=True, nogil=True)
def _find_changes(
    positions: Any, quaternions: Any, written: Any, measured_t: Any, measured_q: Any, information: Any,
    measured: Any, used: Any, was_used: Any, i: Any, j: Any, fixed: Any, was_fixed: Any, anew: Any,
    changed: Any,
) -> None:  # fmt: skip
    """Nodes that others have moved, into ``anew``; constraints that count again, no longer or otherwise, or
    whose nodes are linearised anew or held or no longer held, into ``changed``.
    """
    for n in range(len(positions)):
        for r in range(3):
            anew[n] = anew[n] or positions[n, r] != written[n, r]
        for r in range(4):
            anew[n] = anew[n] or quaternions[n, r] != written[n, 3 + r]
    for c in range(len(i)):
        differs = False
        for r in range(3):
            differs = differs or measured[c, r] != measured_t[c, r]
            measured[c, r] = measured_t[c, r]
        for r in range(4):
            differs = differs or measured[c, 3 + r] != measured_q[c, r]
            measured[c, 3 + r] = measured_q[c, r]
        for r in range(6):
            differs = differs or measured[c, 7 + r] != information[c, r, r]
            measured[c, 7 + r] = information[c, r, r]
        a, b = i[c], j[c]
        moved = differs or anew[a] or anew[b] or fixed[a] != was_fixed[a] or fixed[b] != was_fixed[b]
        changed[c] = used[c] != was_used[c] or (used[c] and moved)


@njit(cache=True, nogil=True)
def _pairs_within(i: Any, j: Any, used: Any, fixed: Any, place: Any) -> Any:
    """(p, 2) places of the nodes that a constraint joins, both of which have one."""
    pairs = np.empty((len(i), 2), np.int64)
    count = 0
    for c in range(len(i)):
        a, b = i[c], j[c]
        if used[c] and place[a] >= 0 and place[b] >= 0 and not (fixed[a] or fixed[b]):
            pairs[count, 0], pairs[count, 1] = place[a], place[b]
            count += 1
    return pairs[:count]
