"""The sparse least-squares solver: Gauss-Newton, damped (Levenberg-Marquardt) as soon as a step does not
help.

The pattern is analysed once; every iteration linearises, factorises and steps. Robust kernels enter as
weights (IRLS). Sources: Kuemmerle et al., "g2o", ICRA 2011; Nielsen, "Damping parameter in Marquardt's
method", 1999.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

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
from overfly.graph.pose_graph import KINDS, PoseGraph
from overfly.graph.robust import CAUCHY, PLAIN, Kernel, Robust
from overfly.graph.steps import Steps, to_the_end
from overfly.graph.symbolic import Symbolic, analyse
from overfly.types import BoolArray, ConstraintKind, IntArray

REVISIT = KINDS.index(ConstraintKind.REVISIT)

SMALLEST_DAMPING, FIRST_DAMPING, LARGEST_DAMPING = 1e-7, 1e-5, 1e12
WATCHDOG = 10.0  # a full step may raise the cost so much for one iteration


@dataclass(frozen=True, eq=False)
class Pattern:
    """Which constraints are solved for and where their blocks stand in the matrix.

    constraints (k,): numbers of the active constraints; slot (k,): the pair of nodes each belongs to, of
    ``n_pairs``; flipped (k,): whether it names the pair the other way round; fixed (n,): nodes that hold the
    frame.
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
    """Analyse the active part of the graph. order: an elimination order to keep, nodes added since are put
    last.
    """
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
    oldest: IntArray = np.arange(len(graph))
    _join_parts(oldest, first, second, np.ones(len(first), np.bool_))
    fixed = np.asarray(oldest == np.arange(len(graph)))
    nodes, _, information = graph.position_priors
    fixed[oldest[nodes[information[:, 0, 0] > 0]]] = False
    return fixed


@njit(cache=True, nogil=True)
def _join_parts(root: Any, first: Any, second: Any, used: Any) -> None:
    """Union-find: root (n,) has of each node the oldest one that paths of links join it to, itself at first;
    brings it up to date with more links, of which the used ones count.
    """
    for k in range(len(first)):
        if not used[k]:
            continue
        a, b = first[k], second[k]
        while root[a] != a:
            root[a] = root[root[a]]
            a = root[a]
        while root[b] != b:
            root[b] = root[root[b]]
            b = root[b]
        root[max(a, b)] = min(a, b)
    for node in range(len(root)):  # parents are older, so their roots are final
        root[node] = root[root[node]]


@dataclass(frozen=True)
class SparseSettings:
    """Stop when an iteration gains less than this part of the cost, or after so many iterations."""

    max_iterations: int = 100
    relative_gain: float = 1e-6


@dataclass(frozen=True, eq=False)
class Solution:
    """Factorisations made, cost before and after (robust), whether little was left to gain, and the last
    undamped factor.

    mismatch: by how much the last step's gain differed from the quadratic model's: about what another step
    could change.
    """

    iterations: int
    cost_before: float
    cost_after: float
    converged: bool
    mismatch: float
    factor: Factor | None


def solve(
    graph: PoseGraph,
    pattern: Pattern,
    freedom: Freedom,
    robust: Robust = PLAIN,
    settings: SparseSettings = SparseSettings(),
) -> Solution:
    """Minimise the robust cost over the poses, in place. Never leaves a worse estimate than it found."""
    return to_the_end(solve_in_steps(graph, pattern, freedom, robust, settings))


def solve_in_steps(
    graph: PoseGraph, pattern: Pattern, freedom: Freedom, robust: Robust, settings: SparseSettings
) -> Steps[Solution]:
    """The same, pausing after every iteration."""
    damping, growth, mismatch = 0.0, 2.0, np.inf
    cost = before = total_cost(graph, pattern, robust)
    iteration, converged = 0, False
    factor = None
    while iteration < settings.max_iterations and not converged:
        start = graph.positions.copy(), graph.quaternions.copy()
        equations = linearised(graph, pattern, freedom, robust)
        step, new_factor = damped_step(pattern, equations, damping)
        yield
        factor = new_factor if damping == 0.0 and new_factor is not None else factor
        iteration += 1
        gain = 0.0 if step is None else float(-(equations.gradient * step).sum())
        new_cost = _cost_after(graph, pattern, robust, step)
        if new_cost > cost and damping == 0.0 and new_cost < WATCHDOG * cost:
            # A full step often has to cross a ridge: judge it by where the next one leads (watchdog,
            # Chamberlain 1982).
            ahead, _ = damped_step(pattern, linearised(graph, pattern, freedom, robust), 0.0)
            yield
            iteration += 1
            new_cost = _cost_after(graph, pattern, robust, ahead)
        if new_cost <= cost:
            mismatch = abs(cost - gain - new_cost)
            little = settings.relative_gain * cost
            # where the quadratic model foretold the new cost, another step has nothing left to gain
            converged = cost - new_cost <= little or (damping == 0.0 and mismatch <= little)
            cost = new_cost
            damping, growth = (damping / 10.0 if damping > SMALLEST_DAMPING else 0.0), 2.0
            continue
        graph.positions[:], graph.quaternions[:] = start
        converged = step is not None and gain < settings.relative_gain * cost
        mismatch = gain if converged else np.inf
        damping, growth = max(damping * growth, FIRST_DAMPING), 2.0 * growth
        if damping > LARGEST_DAMPING:
            break
    return Solution(iteration, before, cost, converged, mismatch, factor)


def _cost_after(graph: PoseGraph, pattern: Pattern, robust: Robust, step: FloatArray | None) -> float:
    if step is None:
        return np.inf
    move(graph, step)
    return total_cost(graph, pattern, robust)


def linearised(graph: PoseGraph, pattern: Pattern, freedom: Freedom, robust: Robust) -> NormalEquations:
    """Normal equations with one off-diagonal block for each pair of the pattern."""
    weights = np.ones(len(pattern.constraints))
    revisits = graph.kinds[pattern.constraints] == REVISIT
    if robust.kernel is not Kernel.NONE:
        weights[revisits] = robust.weights(constraint_chi2(graph, pattern.constraints[revisits]))
    prior_weights = np.ones_like(prior_values := prior_chi2(graph))
    doubted = np.flatnonzero(graph.robust_position_priors)
    prior_weights[doubted] = CAUCHY.weights(prior_values[doubted])
    equations = normal_equations(graph, pattern.constraints, weights, pattern.fixed, freedom, prior_weights)
    blocks = equations.off_diagonal
    if pattern.flipped.any():
        blocks[pattern.flipped] = blocks[pattern.flipped].transpose(0, 2, 1)
    off_diagonal = np.empty((pattern.n_pairs, *blocks.shape[1:]))
    off_diagonal[pattern.slot] = blocks
    if pattern.n_pairs < len(pattern.slot):  # several constraints between the same two nodes
        off_diagonal[:] = 0.0
        np.add.at(off_diagonal, pattern.slot, blocks)
    return NormalEquations(equations.diagonal, off_diagonal, equations.gradient)


def damped_step(
    pattern: Pattern, equations: NormalEquations, damping: float
) -> tuple[FloatArray | None, Factor | None]:
    """(n, d) step of (H + damping diag(H)) dx = -g and the factor, or None where that is not positive
    definite.
    """
    diagonal = equations.diagonal
    if damping > 0:
        diagonal = diagonal.copy()
        entries = np.arange(diagonal.shape[-1])
        diagonal[:, entries, entries] *= 1.0 + damping
    factor = factorise(pattern.symbolic, diagonal, equations.off_diagonal)
    if factor is None:
        return None, None
    step = factor.solve(-equations.gradient)
    return (step, factor) if np.isfinite(step).all() else (None, None)


def factor_now(graph: PoseGraph, pattern: Pattern, freedom: Freedom, robust: Robust = PLAIN) -> Factor | None:
    """Factor of the normal equations at the present poses, for covariances."""
    equations = linearised(graph, pattern, freedom, robust)
    return factorise(pattern.symbolic, equations.diagonal, equations.off_diagonal)


def total_cost(graph: PoseGraph, pattern: Pattern, robust: Robust) -> float:
    """Sum over constraints and priors; the kernel acts on revisits, odometry is believed."""
    values = constraint_chi2(graph, pattern.constraints)
    revisits = graph.kinds[pattern.constraints] == REVISIT
    prior_values = prior_chi2(graph)
    doubted = np.flatnonzero(graph.robust_position_priors)
    prior_values[doubted] = CAUCHY.costs(prior_values[doubted])
    return float(values[~revisits].sum() + robust.costs(values[revisits]).sum() + prior_values.sum())
