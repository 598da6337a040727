"""Least squares kept up to date: a new constraint costs what it concerns, not what the graph holds.

Every node has the pose at which its constraints were linearised and a step from there, which solves the
linear problem. A change refactors the fronts from its nodes up to the root, which are ordered anew, and
changes the steps of the nodes it reaches. Where the linear problem no longer foretells chi2, the nodes that
turned furthest are linearised anew. Source: Kaess et al., "iSAM2", IJRR 2012, with normal equations in place
of QR, chi2 itself as the test in place of a threshold on the steps, and bounds in units of chi2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from overfly.graph.absolute import AbsolutePart, placed_nodes
from overfly.graph.elimination import Fronts, whole_fronts
from overfly.graph.front_tree import Equations, FrontTree
from overfly.graph.growing import Table
from overfly.graph.incremental_kernels import (
    ConstraintColumns,
    Given,
    NodeColumns,
    _find_changes,
    _follow_steps,
    _order_part,
    _sum_used,
    _take_poses,
)
from overfly.graph.linearise import Freedom, constraint_chi2, linearise_each, prior_chi2
from overfly.graph.pose_graph import PoseGraph
from overfly.graph.sparse import WATCHDOG, find_pattern
from overfly.types import BoolArray, IntArray

LARGEST_PART = 0.6  # of the nodes: more are ordered and linearised as a whole
MOST_NODES = 1500  # ordered as a part
LEFT_OUT = 0.3  # of the gain that is looked for: nodes whose steps change by less in all are left alone
LARGEST_GAIN = 0.01  # of chi2: the solution is at least so good, whatever is asked for
MUCH_WORK = 1e8  # multiplications at once: after so many, what is left waits for the next constraint
ROUNDING = 1e-9  # of chi2
NO_NODES: IntArray = np.empty(0, np.int64)
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
    """The solution of the active part of a growing graph, without robust kernels."""

    def __init__(self, graph: PoseGraph, freedom: Freedom) -> None:
        self.graph = graph
        self.freedom = freedom
        d = int(freedom)
        self.factor = FrontTree(d)
        self._nodes = Table(lambda n: NodeColumns.empty(n, d))
        self._constraints = Table(lambda m: ConstraintColumns.empty(m, d))
        self._absolute = AbsolutePart(freedom)
        self._stale: IntArray = NO_NODES  # nodes to be linearised anew
        self._is_refreshed = False

    @property
    def fixed(self) -> BoolArray:
        """(n,) nodes that hold the frame."""
        return self._nodes.view.fixed

    def refresh(self) -> None:
        """The information of constraints was rewritten. (Poses and measurements that were are found out.)"""
        self._is_refreshed = True

    def solve(self, max_iterations: int, relative_gain: float) -> Settled | None:
        """Move the nodes of the graph to where its constraints agree best; None, and no node moved, where
        that would not help.
        """
        graph = self.graph
        before = graph.positions.copy(), graph.quaternions.copy()
        enough = self.factor.multiplications + MUCH_WORK
        first_cost, cost, mismatch, converged = np.inf, np.inf, np.inf, False
        for iteration in range(max_iterations):
            if not self.take_in():
                graph.positions[:], graph.quaternions[:] = before
                return None
            if iteration == 0:
                first_cost = cost = self._cost()
            least = LEFT_OUT * min(relative_gain, LARGEST_GAIN) * cost / len(graph)
            cost, linear_cost = self._move(least)
            mismatch = abs(cost - (linear_cost - self.factor.total_gain()))
            converged = mismatch <= relative_gain * cost + ROUNDING
            self._stale = NO_NODES if converged else self._turned()
            is_late = self.factor.multiplications > enough and cost <= first_cost
            if converged or is_late or not cost < WATCHDOG * first_cost:
                break
        if not cost <= (1.0 + relative_gain) * first_cost + ROUNDING:
            graph.positions[:], graph.quaternions[:] = before
            return None
        return Settled(cost, mismatch, converged)

    def take_in(self) -> bool:
        """Bring the factor up to date with the graph without moving it; False where its constraints do not
        determine it. The solver is then of no more use.
        """
        graph, n_old, m_old = self.graph, len(self._nodes), len(self._constraints)
        self._nodes.grow(len(graph))
        self._constraints.grow(graph.n_constraints)
        self.factor.grow(len(graph))
        given, nodes, constraints = Given.by(graph), self._nodes.view, self._constraints.view
        stale, placed = self._stale, NO_NODES
        if self._absolute.concerns(graph):
            stale, placed = np.concatenate([stale, self._absolute.changed(graph)]), placed_nodes(graph)
        anew, touched, concerned = _find_changes(
            given, nodes, constraints, n_old, m_old, stale, placed, self._is_refreshed
        )  # fmt: skip
        self._stale, self._is_refreshed = NO_NODES, False
        part, orphans = self.factor.affected(concerned)
        if len(part) == 0:
            return True
        if len(part) > min(LARGEST_PART * len(graph), MOST_NODES):
            anew, touched = np.arange(len(graph)), np.flatnonzero(constraints.used)
            orphans = NO_NODES
            fronts = whole_fronts(find_pattern(graph).symbolic)
        else:
            tree, front_nodes = self.factor.tree, self.factor.nodes
            fronts = Fronts(*_order_part(given, nodes, constraints, tree, front_nodes, part, orphans))
        self._linearise(given, anew, touched)
        equations = Equations(
            given.i, given.j, constraints.used, nodes.first, constraints.following, constraints.blocks,
            constraints.gradients, nodes.fixed, self._absolute.blocks, self._absolute.gradients,
        )  # fmt: skip
        nodes.unsolved[part] = False
        nodes.unsolved[fronts.own[fronts.own_starts[:-1]]] = True
        return self.factor.replace(fronts, orphans, equations)

    def _linearise(self, given: Given, anew: IntArray, touched: IntArray) -> None:
        """These constraints, after these nodes have been taken where they stand."""
        nodes, constraints = self._nodes.view, self._constraints.view
        _take_poses(given, nodes, anew)
        linearise_each(
            self.graph, self.freedom, touched, nodes.positions, nodes.quaternions, constraints.blocks,
            constraints.gradients, constraints.linear_values,
        )  # fmt: skip
        constraints.values[touched] = constraint_chi2(self.graph, touched)
        if self._absolute.concerns(self.graph):
            self._absolute.linearise(self.graph, anew, nodes.positions, nodes.quaternions)

    def _move(self, least: float) -> tuple[float, float]:
        """Solve for the steps, and move the nodes whose step changed by more than ``least`` in chi2; chi2
        then, and where everything was linearised.
        """
        nodes = self._nodes.view
        moved = self.factor.solve(nodes.steps, nodes.unsolved, least)
        nodes.unsolved[:] = False
        cost, linear_cost = _follow_steps(
            Given.by(self.graph), nodes, self._constraints.view, moved, self.graph.planar
        )
        if self.graph.n_absolute:
            cost += float(prior_chi2(self.graph).sum())
            linear_cost += float(self._absolute.values.sum())
        return cost, linear_cost

    def _cost(self) -> float:
        constraints = self._constraints.view
        cost = float(_sum_used(constraints.values, constraints.used))
        return cost + float(prior_chi2(self.graph).sum()) if self.graph.n_absolute else cost

    def _turned(self) -> IntArray:
        """The nodes that turned furthest since they were linearised."""
        steps = self._nodes.view.steps
        turns = np.abs(steps[:, 3:] if self.freedom is not Freedom.PLANAR else steps[:, 2:]).max(axis=1)
        return np.flatnonzero((turns > TURNED * turns.max()) & (turns > 0.0))
