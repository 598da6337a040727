"""All poses of a map and all points they share, adjusted together: the finish of a map.

Minimised over the poses, the points X and, where asked for, unknowns of the camera that all rays share:
  Huber(reprojection residual)        each observation, in its standard deviations
  Huber(1/z - measured inverse depth) where a second camera measured it
  (tilt error)^2, (height error)^2    each pose with an attitude or range measurement
  (position error)^2                  each pose with a position (GPS)
  (relative pose error)^2             pairs of poses between which odometry or a place seen again says
  (error of turn)^2                   pairs of poses between which a gyroscope was heard
  (X.z / height)^2                    each point, where there is one camera only (flat ground z = 0, softly)
by Levenberg-Marquardt. The points are eliminated (Schur complement; Triggs et al. 1999, "Bundle adjustment -
a modern synthesis", section 6); what remains is block sparse and goes to the Cholesky factorisation of the
pose graph.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from overfly.geometry.poses import FloatArray
from overfly.graph.cholesky import Factor, factorise
from overfly.graph.points_kernels import _errors, _move_points, _point_pairs, _reduce
from overfly.graph.points_priors import FAULTS, SIZE, add_priors, prior_cost
from overfly.graph.points_problem import PointProblem, PointSolution
from overfly.graph.symbolic import Symbolic, analyse
from overfly.types import IntArray

ENOUGH = 1e-5  # relative decrease of the cost below which there is nothing left to gain
NO_KEYS = np.zeros(0, np.int64)
FIRST_DAMPING, SMALLEST_DAMPING, LARGEST_DAMPING = 1e-4, 1e-9, 1e6


@dataclass(slots=True, eq=False)
class _State:
    rotations: FloatArray
    translations: FloatArray
    points: FloatArray
    common: FloatArray
    shared: FloatArray
    rays: FloatArray
    weight: FloatArray
    error: FloatArray
    cost: float


@dataclass(slots=True, eq=False)
class _System:
    """Reduced normal equations, and what the way back to the points needs. Of the border, the unknowns beside
    poses and points, the first are those of points_priors.
    """

    diagonal: FloatArray
    off_diagonal: FloatArray
    gradient: FloatArray
    border: FloatArray
    corner: FloatArray
    corner_gradient: FloatArray
    V_inverse: FloatArray
    Vg: FloatArray
    cross: FloatArray
    point_border: FloatArray


@dataclass(slots=True, eq=False)
class _Pattern:
    """keys (b,): the two nodes, low * 2^32 + high, of each off-diagonal block; pair (..): which of them takes
    each pair of observations of a point; relative (c,): and each relative pose; turns (c,): and each turn."""

    keys: IntArray
    pair: IntArray
    relative: IntArray
    turns: IntArray
    symbolic: Symbolic


def adjust_points(problem: PointProblem, iterations: int = 30) -> PointSolution | None:
    """Solve; None when the system is singular from the start."""
    pattern = _find_pattern(problem)
    shared = np.zeros(0)
    if problem.shared is not None:
        first = problem.shared.expected if problem.shared.start is None else problem.shared.start
        shared = first.copy()
    state = _evaluated(
        problem, problem.rotations, problem.translations, problem.points, np.zeros(problem.n_common), shared
    )
    before, damping, system, solved = state.cost, FIRST_DAMPING, None, 0
    while solved < iterations:
        solved += 1
        system = _normal_equations(problem, pattern, state, damping)
        step = _step(pattern, system, damping)
        if step is None:
            damping *= 10.0
            if damping > LARGEST_DAMPING:
                return None
            continue
        moved = _moved(problem, state, system, *step)
        if moved.cost < state.cost:
            gain = (state.cost - moved.cost) / state.cost
            state, damping = moved, max(0.1 * damping, SMALLEST_DAMPING)
            if gain < ENOUGH:
                break
        else:
            damping *= 10.0
            if damping > LARGEST_DAMPING:
                break
    system = _normal_equations(problem, pattern, state, 0.0)
    return PointSolution(
        state.rotations, state.translations, state.points, system.V_inverse, state.error, state.common,
        state.shared, _shared_covariance(pattern, system, len(state.shared)), (before, state.cost), solved,
    )  # fmt: skip


def _find_pattern(problem: PointProblem, more: IntArray = NO_KEYS) -> _Pattern:
    """more (..): keys of blocks that are wanted beside those that are needed."""
    points = _point_pairs(problem.starts, problem.node)
    relative = NO_KEYS if problem.relative is None else problem.relative.pairs()
    turns = NO_KEYS if problem.turns is None else problem.turns.pairs()
    keys, pair = np.unique(np.concatenate([points, relative, turns, more]), return_inverse=True)
    symbolic = analyse(len(problem.rotations), keys >> 32, keys & 0xFFFFFFFF)
    first, second = len(points), len(points) + len(relative)
    return _Pattern(keys, pair[:first], pair[first:second], pair[second : second + len(turns)], symbolic)


def _evaluated(
    problem: PointProblem,
    rotations: FloatArray,
    translations: FloatArray,
    points: FloatArray,
    common: FloatArray,
    shared: FloatArray,
) -> _State:
    """The state with its robust cost."""
    rays, weight = problem.rays, 1.0 / problem.sigma
    if problem.shared is not None:
        rays, growth = problem.shared.rays_of(shared)
        weight = weight / growth
    error = np.empty(len(problem.node))
    cost = _errors(
        rotations, translations, points, problem.starts, problem.node, rays, weight,
        problem.inverse_depth, 1.0 / problem.inverse_depth_sigma, problem.flatness, error,
    )  # fmt: skip
    cost += prior_cost(problem, rotations, translations, common)
    if problem.relative is not None:
        cost += problem.relative.cost(rotations, translations, common[SIZE])
    if problem.turns is not None:
        cost += problem.turns.cost(rotations, common[FAULTS])
    if problem.shared is not None:
        cost += float(np.sum(((shared - problem.shared.expected) / problem.shared.sigma) ** 2))
    return _State(rotations, translations, points, common, shared, rays, weight, error, cost)


def _normal_equations(problem: PointProblem, pattern: _Pattern, state: _State, damping: float) -> _System:
    system = _empty(problem, pattern, len(state.shared))
    _reduce(
        state.rotations, state.translations, state.points, problem.starts, problem.node, state.rays,
        state.weight, problem.inverse_depth, 1.0 / problem.inverse_depth_sigma, problem.flatness,
        damping, _rays_by_shared(problem, state), pattern.pair, system.diagonal, system.off_diagonal,
        system.gradient, system.border, system.corner, system.corner_gradient, system.V_inverse, system.Vg,
        system.cross, system.point_border,
    )  # fmt: skip
    _make_room(system, problem.n_common)
    _add_sensors(problem, pattern, state, system)
    return system


def _empty(problem: PointProblem, pattern: _Pattern, P: int) -> _System:
    n, m, k = len(problem.rotations), len(problem.points), len(problem.node)
    return _System(
        np.zeros((n, 6, 6)), np.zeros((len(pattern.keys), 6, 6)), np.zeros((n, 6)), np.zeros((n, 6, P)),
        np.zeros((P, P)), np.zeros(P), np.zeros((m, 3, 3)), np.zeros((m, 3)), np.zeros((k, 6, 3)),
        np.zeros((m, P, 3)),
    )  # fmt: skip


def _add_sensors(problem: PointProblem, pattern: _Pattern, state: _State, system: _System) -> None:
    """Whatever is no observation of a point, to a system with room for the common unknowns."""
    if problem.relative is not None:
        problem.relative.add_to(
            state.rotations, state.translations, state.common[SIZE], pattern.relative,
            system.diagonal, system.off_diagonal, system.gradient,
            system.border[:, :, SIZE], system.corner[SIZE : SIZE + 1, SIZE], system.corner_gradient[SIZE:],
        )  # fmt: skip
    if problem.turns is not None:
        problem.turns.add_to(
            state.rotations, state.common[FAULTS], pattern.turns, system.diagonal, system.off_diagonal,
            system.gradient, system.border[:, :, FAULTS], system.corner[FAULTS, FAULTS],
            system.corner_gradient[FAULTS],
        )  # fmt: skip
    add_priors(
        problem, state.rotations, state.translations, state.common, system.diagonal, system.gradient,
        system.border, system.corner, system.corner_gradient,
    )  # fmt: skip
    if problem.shared is not None:
        information = problem.shared.sigma**-2.0
        common = problem.n_common
        system.corner[common:, common:] += np.diag(information)
        system.corner_gradient[common:] += information * (state.shared - problem.shared.expected)


def _make_room(system: _System, more: int) -> None:
    """For the common unknowns, before the camera's in the border."""
    n, _, P = system.border.shape
    system.border = np.concatenate([np.zeros((n, 6, more)), system.border], axis=2)
    corner = np.zeros((P + more, P + more))
    corner[more:, more:] = system.corner
    system.corner, system.corner_gradient = corner, np.append(np.zeros(more), system.corner_gradient)


def _rays_by_shared(problem: PointProblem, state: _State) -> FloatArray:
    """(k, 2, P) derivatives by the shared unknowns of the rays and, since residuals count in units of their
    deviations, of these; by central differences.
    """
    derivative = np.empty((len(problem.node), 2, len(state.shared)))
    if problem.shared is None:
        return derivative
    which = np.repeat(np.arange(len(state.points)), np.diff(problem.starts))
    away = state.points[which] - state.translations[problem.node]
    in_cam = np.einsum("kji,kj->ki", state.rotations[problem.node], away)
    left = in_cam[:, :2] / np.maximum(in_cam[:, 2:], 1e-6) - state.rays
    _, growth_now = problem.shared.rays_of(state.shared)
    for p, sigma in enumerate(problem.shared.sigma):
        nudge = np.zeros(len(state.shared))
        nudge[p] = 1e-3 * sigma
        (ahead, more), (behind, less) = (
            problem.shared.rays_of(state.shared + sign * nudge) for sign in (1.0, -1.0)
        )
        growth = (more - less) / growth_now
        derivative[:, :, p] = (ahead - behind + left * growth[:, None]) / (2e-3 * sigma)
    return derivative


def _factor(pattern: _Pattern, system: _System, damping: float) -> Factor | None:
    diagonal = system.diagonal.copy()
    entries = np.arange(6)
    diagonal[:, entries, entries] *= 1.0 + damping
    diagonal[:, entries, entries] += 1e-9
    return factorise(pattern.symbolic, diagonal, system.off_diagonal)


def _step(pattern: _Pattern, system: _System, damping: float) -> tuple[FloatArray, FloatArray] | None:
    """Steps of the poses (n, 6) and of the border's unknowns, or None where there is none."""
    factor = _factor(pattern, system, damping)
    if factor is None:
        return None
    right = np.concatenate([-system.gradient[:, :, None], system.border], axis=2)
    solved = factor.solve(right)
    alone, by_shared = solved[:, :, 0], solved[:, :, 1:]
    corner = system.corner - np.einsum("ndp,ndq->pq", system.border, by_shared)
    corner += damping * np.diag(np.diag(corner))
    along = np.einsum("ndp,nd->p", system.border, alone)
    shared = np.linalg.solve(corner, -system.corner_gradient - along)
    step = alone - by_shared @ shared
    return (step, shared) if np.isfinite(step).all() else None


def _moved(
    problem: PointProblem, state: _State, system: _System, step: FloatArray, shared: FloatArray
) -> _State:
    points = _move_points(
        state.points, problem.starts, problem.node, system.V_inverse, system.Vg, system.cross,
        system.point_border, step, shared[problem.n_common :],
    )  # fmt: skip
    translations = state.translations + np.einsum("nij,nj->ni", state.rotations, step[:, :3])
    rotations = state.rotations @ Rotation.from_rotvec(step[:, 3:]).as_matrix()
    common, shared = np.split(shared, [problem.n_common])
    common, shared = state.common + common, state.shared + shared
    return _evaluated(problem, rotations, translations, points, common, shared)


def _shared_covariance(pattern: _Pattern, system: _System, P: int) -> FloatArray:
    """(P, P), NaN where the system does not determine them."""
    factor = _factor(pattern, system, 0.0) if P else None
    if factor is None:
        return np.full((P, P), np.nan)
    corner = system.corner - np.einsum("ndp,ndq->pq", system.border, factor.solve(system.border))
    return np.asarray(np.linalg.inv(corner)[-P:, -P:])
