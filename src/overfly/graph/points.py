"""All poses of a map and all points they share, adjusted together: the finish of a map.

Minimised over the poses, the points X and, where asked for, unknowns of the camera that all rays share:
  Huber(reprojection residual)        each observation, in its standard deviations
  Huber(1/z - measured inverse depth) where a second camera measured it
  (tilt error)^2, (height error)^2    each pose with an attitude or range measurement
  (position error)^2                  each pose with a position (GPS)
  (relative pose error)^2             pairs of poses between which odometry or a place seen again says
  (X.z / height)^2                    each point, where there is one camera only (flat ground z = 0, softly)
by Levenberg-Marquardt. The points are eliminated (Schur complement; Triggs et al. 1999, "Bundle adjustment -
a modern synthesis", section 6); what remains is block sparse and goes to the Cholesky factorisation of the
pose graph.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from overfly.geometry.poses import FloatArray
from overfly.graph.cholesky import Factor, factorise
from overfly.graph.points_kernels import _errors, _move_points, _point_pairs, _reduce
from overfly.graph.points_relative import RelativePoses
from overfly.graph.symbolic import Symbolic, analyse
from overfly.types import BoolArray, IntArray

HELD = 1e12  # information that holds the anchors
ENOUGH = 1e-5  # relative decrease of the cost below which there is nothing left to gain
FIRST_DAMPING, SMALLEST_DAMPING, LARGEST_DAMPING = 1e-4, 1e-9, 1e6
HEIGHT_OUTLIER = 3.0  # standard deviations from which on a height counts linearly: an echo from elsewhere


@dataclass(frozen=True, slots=True, eq=False)
class Shared:
    """Unknowns that move all rays: what is expected of them (P,), with standard deviations (P,), and rays_of,
    which gives for such values the rays (k, 2) of all observations, and by how much (k,) their deviations
    grow: pixels stay as exact as they are, so a longer focal length makes rays more exact. start: where to
    begin, if elsewhere.
    """

    expected: FloatArray
    sigma: FloatArray
    rays_of: Callable[[FloatArray], tuple[FloatArray, FloatArray]]
    start: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PointProblem:
    """Poses n, points m, observations k, sorted by point, a point at most once from each pose. Arrays:

    rotations (n, 3, 3), translations (n, 3): world_from_cam; anchors (n,) bool: poses whose x, y and yaw
    stay, because nothing else holds them; points (m, 3) world; starts (m + 1,): observations of point m are
    starts[m] to starts[m + 1]; node (k,) who sees it; rays (k, 2) undistorted image coordinates; sigma (k,)
    their standard deviation; inverse_depth (k,) 1/m, NaN where not measured; inverse_depth_sigma.
    level_from_cam (n, 3, 3), tilt_sigma (n,) infinite where not measured; height (n,), height_sigma (n,)
    and position (n, 3), position_sigma (n, 3) of the camera, metres, likewise.
    relief: standard deviation of the points' z as a share of the height above them, infinite for none.
    tilt_bias_sigma: of what the attitude sensor's roll and pitch are off by all the time, radians, or 0.
    relative: poses against each other, as odometry and places seen again have them.
    """

    rotations: FloatArray
    translations: FloatArray
    anchors: BoolArray
    points: FloatArray
    starts: IntArray
    node: IntArray
    rays: FloatArray
    sigma: FloatArray
    inverse_depth: FloatArray
    inverse_depth_sigma: float
    level_from_cam: FloatArray
    tilt_sigma: FloatArray
    height: FloatArray
    height_sigma: FloatArray
    position: FloatArray
    position_sigma: FloatArray
    relief: float
    tilt_bias_sigma: float = 0.0
    shared: Shared | None = None
    relative: RelativePoses | None = None

    @property
    def flatness(self) -> float:
        return 0.0 if math.isinf(self.relief) else 1.0 / self.relief


@dataclass(frozen=True, slots=True, eq=False)
class PointSolution:
    """Poses and points after the adjustment; point_covariance (m, 3, 3) given the poses; error (k,)
    reprojection errors in sigmas; tilt_bias (2,) of roll and pitch, radians, in levelled axes; shared (P,)
    with covariance (P, P) if all observations are independent; pose_covariance (6 k, 6 k) of the poses that
    were asked for, as perturbations of translation and rotation in their own axes, NaN where the system does
    not determine them; cost before and after.
    """

    rotations: FloatArray
    translations: FloatArray
    points: FloatArray
    point_covariance: FloatArray
    error: FloatArray
    tilt_bias: FloatArray
    shared: FloatArray
    shared_covariance: FloatArray
    pose_covariance: FloatArray
    cost: tuple[float, float]
    iterations: int


@dataclass(slots=True, eq=False)
class _State:
    rotations: FloatArray
    translations: FloatArray
    points: FloatArray
    bias: FloatArray
    shared: FloatArray
    rays: FloatArray
    weight: FloatArray
    error: FloatArray
    cost: float


@dataclass(slots=True, eq=False)
class _System:
    """Reduced normal equations, and what the way back to the points needs. Of the border, the unknowns beside
    poses and points, the first two are the tilt bias.
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
    """pair (..): which off-diagonal block takes each pair of observations of a point; relative (c,): and each
    relative pose."""

    pair: IntArray
    relative: IntArray
    symbolic: Symbolic
    n_pairs: int = field(default=0)


def adjust_points(
    problem: PointProblem, iterations: int = 30, uncertain: IntArray | None = None
) -> PointSolution | None:
    """Solve; None when the system is singular from the start. uncertain (k,): poses whose covariance is
    wanted, too.
    """
    pattern = _find_pattern(problem)
    shared = np.zeros(0)
    if problem.shared is not None:
        first = problem.shared.expected if problem.shared.start is None else problem.shared.start
        shared = first.copy()
    state = _evaluated(problem, problem.rotations, problem.translations, problem.points, np.zeros(2), shared)
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
        state.rotations, state.translations, state.points, system.V_inverse, state.error, state.bias,
        state.shared, _shared_covariance(pattern, system), _pose_covariance(pattern, system, uncertain),
        (before, state.cost), solved,
    )  # fmt: skip


def _find_pattern(problem: PointProblem) -> _Pattern:
    keys = _point_pairs(problem.starts, problem.node)
    n_keys = len(keys)
    if problem.relative is not None:
        keys = np.concatenate([keys, problem.relative.pairs()])
    unique, pair = np.unique(keys, return_inverse=True)
    first, second = unique >> 32, unique & 0xFFFFFFFF
    return _Pattern(pair[:n_keys], pair[n_keys:], analyse(len(problem.rotations), first, second), len(unique))


def _evaluated(
    problem: PointProblem,
    rotations: FloatArray,
    translations: FloatArray,
    points: FloatArray,
    bias: FloatArray,
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
    tilt = _tilt(problem, rotations)[0] - bias
    cost += float(np.sum((tilt / problem.tilt_sigma[:, None]) ** 2))
    error_z = np.abs(translations[:, 2] - problem.height) / problem.height_sigma
    far = error_z > HEIGHT_OUTLIER
    cost += float(np.sum(np.where(far, HEIGHT_OUTLIER * (2.0 * error_z - HEIGHT_OUTLIER), error_z**2)))
    cost += float(np.sum(((translations - problem.position) / problem.position_sigma) ** 2))
    if problem.relative is not None:
        cost += problem.relative.cost(rotations, translations)
    if problem.tilt_bias_sigma > 0:
        cost += float(np.sum((bias / problem.tilt_bias_sigma) ** 2))
    if problem.shared is not None:
        cost += float(np.sum(((shared - problem.shared.expected) / problem.shared.sigma) ** 2))
    return _State(rotations, translations, points, bias, shared, rays, weight, error, cost)


def _tilt(problem: PointProblem, rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Tilt against the sensor (n, 2), radians, and its derivative (n, 2, 3) by a right rotation."""
    up = rotations[:, 2]
    turned = np.zeros((len(up), 3, 3))
    turned[:, 0, 1], turned[:, 0, 2], turned[:, 1, 2] = -up[:, 2], up[:, 1], -up[:, 0]
    turned -= turned.transpose(0, 2, 1)
    level = problem.level_from_cam
    return np.einsum("nij,nj->ni", level, up)[:, :2], (level @ turned)[:, :2]


def _normal_equations(problem: PointProblem, pattern: _Pattern, state: _State, damping: float) -> _System:
    n, m, k, P = len(state.rotations), len(state.points), len(problem.node), len(state.shared)
    system = _System(
        np.zeros((n, 6, 6)), np.zeros((pattern.n_pairs, 6, 6)), np.zeros((n, 6)), np.zeros((n, 6, P)),
        np.zeros((P, P)), np.zeros(P), np.zeros((m, 3, 3)), np.zeros((m, 3)), np.zeros((k, 6, 3)),
        np.zeros((m, P, 3)),
    )  # fmt: skip
    _reduce(
        state.rotations, state.translations, state.points, problem.starts, problem.node, state.rays,
        state.weight, problem.inverse_depth, 1.0 / problem.inverse_depth_sigma, problem.flatness,
        damping, _rays_by_shared(problem, state), pattern.pair, system.diagonal, system.off_diagonal,
        system.gradient, system.border, system.corner, system.corner_gradient, system.V_inverse, system.Vg,
        system.cross, system.point_border,
    )  # fmt: skip
    if problem.relative is not None:
        problem.relative.add_to(
            state.rotations, state.translations, pattern.relative,
            system.diagonal, system.off_diagonal, system.gradient,
        )  # fmt: skip
    _add_bias(system)
    _add_priors(problem, state, system)
    return system


def _add_bias(system: _System) -> None:
    """Room for the tilt bias before the other unknowns of the border."""
    n, _, P = system.border.shape
    system.border = np.concatenate([np.zeros((n, 6, 2)), system.border], axis=2)
    corner = np.zeros((P + 2, P + 2))
    corner[2:, 2:] = system.corner
    system.corner, system.corner_gradient = corner, np.append(np.zeros(2), system.corner_gradient)


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


def _add_priors(problem: PointProblem, state: _State, system: _System) -> None:
    """What the other sensors say about each pose, the anchors, and the priors of the shared unknowns."""
    R = state.rotations
    tilt, by_turn = _tilt(problem, R)
    tilt = tilt - state.bias
    weight = problem.tilt_sigma**-2.0
    bias_information = problem.tilt_bias_sigma**-2.0 if problem.tilt_bias_sigma > 0 else HELD
    system.border[:, 3:, :2] -= np.einsum("nrp,n->npr", by_turn, weight)
    system.corner[:2, :2] += np.eye(2) * (weight.sum() + bias_information)
    system.corner_gradient[:2] += bias_information * state.bias - weight @ tilt
    system.diagonal[:, 3:, 3:] += np.einsum("nrp,nrq,n->npq", by_turn, by_turn, weight)
    system.gradient[:, 3:] += np.einsum("nrp,nr,n->np", by_turn, tilt, weight)
    error = state.translations[:, 2] - problem.height
    off = np.maximum(np.abs(error) / problem.height_sigma, HEIGHT_OUTLIER)
    weight = problem.height_sigma**-2.0 * HEIGHT_OUTLIER / off
    system.diagonal[:, :3, :3] += np.einsum("np,nq,n->npq", R[:, 2], R[:, 2], weight)
    system.gradient[:, :3] += R[:, 2] * (weight * error)[:, None]
    weights = problem.position_sigma**-2.0
    system.diagonal[:, :3, :3] += np.einsum("nrp,nrq,nr->npq", R, R, weights)
    system.gradient[:, :3] += np.einsum("nrp,nr->np", R, weights * (state.translations - problem.position))
    for n in np.flatnonzero(problem.anchors):
        system.diagonal[n, :3, :3] += HELD * R[n, :2].T @ R[n, :2]
        system.diagonal[n, 3:, 3:] += HELD * np.outer(R[n, 2], R[n, 2])
    if problem.shared is not None:
        information = problem.shared.sigma**-2.0
        system.corner[2:, 2:] += np.diag(information)
        system.corner_gradient[2:] += information * (state.shared - problem.shared.expected)


def _factor(pattern: _Pattern, system: _System, damping: float) -> Factor | None:
    diagonal = system.diagonal.copy()
    entries = np.arange(6)
    diagonal[:, entries, entries] *= 1.0 + damping
    diagonal[:, entries, entries] += 1e-9
    return factorise(pattern.symbolic, diagonal, system.off_diagonal)


def _step(pattern: _Pattern, system: _System, damping: float) -> tuple[FloatArray, FloatArray] | None:
    """Steps of the poses (n, 6) and of the border's unknowns (2 + P,), or None where there is none."""
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
        system.point_border, step, shared[2:],
    )  # fmt: skip
    translations = state.translations + np.einsum("nij,nj->ni", state.rotations, step[:, :3])
    rotations = state.rotations @ Rotation.from_rotvec(step[:, 3:]).as_matrix()
    return _evaluated(
        problem, rotations, translations, points, state.bias + shared[:2], state.shared + shared[2:]
    )


def _shared_covariance(pattern: _Pattern, system: _System) -> FloatArray:
    """(P, P), NaN where the system does not determine them."""
    P = len(system.corner_gradient) - 2
    factor = _factor(pattern, system, 0.0) if P else None
    if factor is None:
        return np.full((P, P), np.nan)
    corner = system.corner - np.einsum("ndp,ndq->pq", system.border, factor.solve(system.border))
    return np.asarray(np.linalg.inv(corner)[2:, 2:])


def _pose_covariance(pattern: _Pattern, system: _System, nodes: IntArray | None) -> FloatArray:
    """(6 k, 6 k), NaN where the system does not determine them."""
    if nodes is None or len(nodes) == 0:
        return np.zeros((0, 0))
    factor = _factor(pattern, system, 0.0)
    if factor is None:
        return np.full((6 * len(nodes), 6 * len(nodes)), np.nan)
    solved = factor.solve(system.border)
    corner = system.corner - np.einsum("ndp,ndq->pq", system.border, solved)
    by_border = solved[nodes].reshape(6 * len(nodes), -1)
    return np.asarray(factor.inverse_blocks(nodes) + by_border @ np.linalg.pinv(corner) @ by_border.T)
