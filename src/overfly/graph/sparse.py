"""The sparse least-squares solver: Gauss-Newton, damped (Levenberg-Marquardt) as soon as a step does not help.

The pattern is analysed once; every iteration linearises, factorises and steps. Robust kernels enter as weights (IRLS).
Sources: Kuemmerle et al., "g2o", ICRA 2011; Nielsen, "Damping parameter in Marquardt's method", 1999.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from overfly.geometry.poses import FloatArray
from overfly.graph.cholesky import Factor, factorise
from overfly.graph.linearise import (
    Freedom,
    NormalEquations,
    constraint_chi2,
    move,
    normal_equations,
    prior_chi2,
)
from overfly.graph.pose_graph import PoseGraph
from overfly.graph.robust import PLAIN, Robust
from overfly.graph.symbolic import Symbolic, analyse
from overfly.types import BoolArray, IntArray

SMALLEST_DAMPING, LARGEST_DAMPING = 1e-9, 1e12


@dataclass(frozen=True, eq=False)
class Pattern:
    """Which constraints are solved for and where their blocks stand in the matrix.

    constraints (k,): numbers of the active constraints; slot (k,): the pair of nodes each belongs to, of ``n_pairs``;
    flipped (k,): whether it names the pair the other way round; fixed (n,): nodes that hold the frame.
    """

    constraints: IntArray
    slot: IntArray
    flipped: BoolArray
    fixed: BoolArray
    symbolic: Symbolic

    @property
    def n_pairs(self) -> int:
        return len(self.symbolic.pair_row)


def find_pattern(graph: PoseGraph, order: IntArray | None = None) -> Pattern:
    """Analyse the active part of the graph. order: an elimination order to keep, nodes added since are put last."""
    constraints = graph.active
    n = len(graph)
    low = np.minimum(graph.i[constraints], graph.j[constraints])
    high = np.maximum(graph.i[constraints], graph.j[constraints])
    pairs, slot = np.unique(low * n + high, return_inverse=True)
    first, second = pairs // n, pairs % n
    if order is not None and len(order) < n:
        order = np.concatenate([order, np.arange(len(order), n)])
    return Pattern(
        constraints,
        slot,
        graph.i[constraints] > graph.j[constraints],
        frame_nodes(graph, first, second),
        analyse(n, first, second, order),
    )


def frame_nodes(graph: PoseGraph, first: IntArray, second: IntArray) -> BoolArray:
    """(n,) the oldest node of every connected part that no position prior ties to the world."""
    n = len(graph)
    links = coo_matrix((np.ones(len(first)), (first, second)), shape=(n, n))
    n_parts, part = connected_components(links, directed=False)
    nodes, _, information = graph.position_priors
    tied = np.zeros(n_parts, dtype=bool)
    tied[part[nodes[information[:, 0, 0] > 0]]] = True
    fixed = np.zeros(n, dtype=bool)
    oldest = np.unique(part, return_index=True)[1]
    fixed[oldest[~tied]] = True
    return fixed


@dataclass(frozen=True)
class SparseSettings:
    """Stop when an iteration gains less than this part of the cost, or after so many iterations."""

    max_iterations: int = 100
    relative_gain: float = 1e-6


@dataclass(frozen=True, eq=False)
class Solution:
    """iterations made, cost before and after (robust), whether it converged, and the last undamped-enough factor."""

    iterations: int
    cost_before: float
    cost_after: float
    converged: bool


def solve(
    graph: PoseGraph,
    pattern: Pattern,
    freedom: Freedom,
    robust: Robust = PLAIN,
    settings: SparseSettings = SparseSettings(),  # noqa: B008  frozen
) -> Solution:
    """Minimise the robust cost over the poses, in place. Never leaves a worse estimate than it found."""
    damping, growth = 0.0, 2.0
    cost = before = total_cost(graph, pattern, robust)
    iteration, converged = 0, False
    while iteration < settings.max_iterations and not converged:
        equations = linearised(graph, pattern, freedom, robust)
        while True:  # until a step helps
            iteration += 1
            positions, quaternions = graph.positions.copy(), graph.quaternions.copy()
            step = damped_step(pattern, equations, damping)
            if step is not None:
                move(graph, step)
                new_cost = total_cost(graph, pattern, robust)
                if new_cost <= cost:
                    break
                graph.positions[:], graph.quaternions[:] = positions, quaternions
                if _expected_gain(equations, step, damping) < settings.relative_gain * cost:
                    new_cost = cost
                    break
            damping, growth = max(damping * growth, SMALLEST_DAMPING), 4.0 * growth
            if damping > LARGEST_DAMPING or iteration >= settings.max_iterations:
                return Solution(iteration, before, cost, False)
        converged = cost - new_cost <= settings.relative_gain * cost
        cost = new_cost
        damping, growth = (damping / 10.0 if damping > SMALLEST_DAMPING else 0.0), 2.0
    return Solution(iteration, before, cost, converged)


def linearised(graph: PoseGraph, pattern: Pattern, freedom: Freedom, robust: Robust) -> NormalEquations:
    """Normal equations with one off-diagonal block for each pair of the pattern."""
    weights = robust.weights(constraint_chi2(graph, pattern.constraints))
    equations = normal_equations(graph, pattern.constraints, weights, pattern.fixed, freedom)
    blocks = equations.off_diagonal
    if pattern.flipped.any():
        blocks[pattern.flipped] = blocks[pattern.flipped].transpose(0, 2, 1)
    off_diagonal = np.empty((pattern.n_pairs, *blocks.shape[1:]))
    off_diagonal[pattern.slot] = blocks
    if pattern.n_pairs < len(pattern.slot):  # several constraints between the same two nodes
        off_diagonal[:] = 0.0
        np.add.at(off_diagonal, pattern.slot, blocks)
    return NormalEquations(equations.diagonal, off_diagonal, equations.gradient)


def damped_step(pattern: Pattern, equations: NormalEquations, damping: float) -> FloatArray | None:
    """(n, d) step of (H + damping diag(H)) dx = -g, or None where that is not positive definite."""
    factor = damped_factor(pattern, equations, damping)
    if factor is None:
        return None
    step = factor.solve(-equations.gradient)
    return step if np.isfinite(step).all() else None


def damped_factor(pattern: Pattern, equations: NormalEquations, damping: float) -> Factor | None:
    diagonal = equations.diagonal
    if damping > 0:
        diagonal = diagonal.copy()
        entries = np.arange(diagonal.shape[-1])
        diagonal[:, entries, entries] *= 1.0 + damping
    return factorise(pattern.symbolic, diagonal, equations.off_diagonal)


def _expected_gain(equations: NormalEquations, step: FloatArray, damping: float) -> float:
    """Twice what the quadratic model promises at most: -g dx."""
    return float(-(equations.gradient * step).sum()) * (1.0 + damping)


def total_cost(graph: PoseGraph, pattern: Pattern, robust: Robust) -> float:
    values = constraint_chi2(graph, pattern.constraints)
    return float(robust.costs(values).sum() + prior_chi2(graph).sum())
