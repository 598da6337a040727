"""Pairwise consistency: a loop is believed once a second one, between nearby nodes, tells the same.

Two loops i-j and k-l with i near k and j near l close a short cycle i, k, l, j through the trajectory between
them; wrong loops rarely have a neighbour at all, and hardly ever one that agrees. Source: Mangelson et al.,
"Pairwise consistent measurement set maximization for robust multi-robot map merging", ICRA 2018, reduced to
neighbours.
"""

from __future__ import annotations

import numpy as np

from overfly.graph.covariance import tangent_covariance
from overfly.graph.gate import Gate
from overfly.graph.pose_graph import PoseGraph
from overfly.types import Constraint, IntArray

PARTNERS = 4  # nearest loops that are asked


class Corroboration:
    """Remembers which loops have been confirmed by another. ``reach``: how many nodes apart their ends may
    lie.
    """

    def __init__(self, graph: PoseGraph, reach: int, gate: Gate) -> None:
        self._graph = graph
        self._reach = reach
        self._gate = gate
        self._numbers: list[int] = []
        self._ends: list[tuple[int, int]] = []
        self.confirmed: set[int] = set()

    def add(self, number: int) -> list[int]:
        """Take in the loop ``number``; returns the loops that are confirmed by it and were not before, itself
        included.
        """
        constraint = forward(self._graph.constraint(number))
        partners = self._partners(constraint)
        self._numbers.append(number)
        self._ends.append((constraint.i, constraint.j))
        if len(partners) == 0:
            return []
        distances = [self._distance(constraint, forward(self._graph.constraint(int(k)))) for k in partners]
        self._gate.remember(min(distances))
        agreeing = [int(k) for k, d in zip(partners, distances, strict=True) if self._gate.keeps(d)]
        fresh = [k for k in (*agreeing, number) if agreeing and k not in self.confirmed]
        self.confirmed.update(fresh)
        return fresh

    def _partners(self, constraint: Constraint) -> IntArray:
        if not self._numbers:
            return np.empty(0, np.int64)
        apart = np.abs(np.array(self._ends) - (constraint.i, constraint.j))
        near = np.flatnonzero(apart.max(axis=1) <= self._reach)
        nearest = near[np.argsort(apart[near].sum(axis=1), kind="stable")[:PARTNERS]]
        return np.array(self._numbers)[nearest]

    def _distance(self, a: Constraint, b: Constraint) -> float:
        """Squared distance of the cycle's error, every step along the trajectory taken as uncertain as the
        loops.
        """
        pose = self._graph.pose
        predicted = pose(a.i).inverse() @ pose(b.i) @ b.i_from_j @ pose(b.j).inverse() @ pose(a.j)
        error = (a.i_from_j.inverse() @ predicted).log()
        planar = self._graph.planar
        steps = 1 + abs(a.i - b.i) + abs(a.j - b.j)
        covariance = steps * (
            tangent_covariance(a.information, planar) + tangent_covariance(b.information, planar)
        )
        if planar:
            error, covariance = error[[0, 1, 5]], covariance[np.ix_([0, 1, 5], [0, 1, 5])]
        return float(error @ np.linalg.solve(covariance, error))


def forward(constraint: Constraint) -> Constraint:
    """The same constraint seen from its older node."""
    if constraint.i <= constraint.j:
        return constraint
    i_from_j = constraint.i_from_j.inverse()
    return Constraint(constraint.j, constraint.i, i_from_j, constraint.information, constraint.kind)
