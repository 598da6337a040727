"""Errors of constraints, their sum chi2, and the normal equations of one Gauss-Newton step.

Error of a constraint, as g2o files define it: e = (translation, vector part of the quaternion) of measured^-1
* predicted, predicted = X_i^-1 X_j; in planar graphs (x, y, angle). chi2 = sum e^T Omega e. Steps are
(translation, rotation vector) in the node's own axes, applied on the right (Freedom.FULL), or (x, y, z,
heading) in world axes with roll and pitch held (Freedom.LEVELLED), or (x, y, angle) in the node's own axes
(Freedom.PLANAR).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray
from overfly.graph.pose_graph import PoseGraph
from overfly.graph.quaternions import (
    _conjugate,
    _exponential,
    _heading,
    _matrix_into,
    _multiply,
    _normalised,
    _quaternion,
    _rotate,
    _vector,
)
from overfly.types import BoolArray, IntArray


class Freedom(IntEnum):
    """Degrees of freedom of a node."""

    PLANAR = 3
    LEVELLED = 4
    FULL = 6


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """H dx = -g in blocks of d: diagonal (n, d, d), off_diagonal (m, d, d) of (i, j) per constraint, gradient
    (n, d).
    """

    diagonal: FloatArray
    off_diagonal: FloatArray
    gradient: FloatArray


def constraint_errors(graph: PoseGraph, constraints: IntArray) -> FloatArray:
    """(k, 6) errors e of these constraints at the present estimate."""
    errors = np.empty((len(constraints), 6))
    _errors(
        graph.positions, graph.quaternions, graph.i, graph.j, graph.measured_positions,
        graph.measured_quaternions,
        constraints, graph.planar, errors,
    )  # fmt: skip
    return errors


def constraint_chi2(graph: PoseGraph, constraints: IntArray) -> FloatArray:
    """(k,) e^T Omega e of these constraints."""
    errors = constraint_errors(graph, constraints)
    return np.asarray(_quadratic_forms(errors, graph.information, constraints))


def chi2(graph: PoseGraph) -> float:
    """Sum over the active constraints and the priors, without robust kernels."""
    return float(constraint_chi2(graph, graph.active).sum() + prior_chi2(graph).sum())


def prior_chi2(graph: PoseGraph) -> FloatArray:
    """(k,) e^T Omega e of the position priors, then of the attitude priors."""
    nodes, values, information = graph.position_priors
    if len(nodes) + len(graph.attitude_priors[0]) == 0:
        return np.empty(0)
    offset = graph.positions[nodes] - values
    tilted, rotations, tilt_information = graph.attitude_priors
    errors = _attitude_errors(graph.quaternions, tilted, rotations)
    return np.concatenate(
        [np.einsum("ka,kab,kb->k", offset, information, offset), (errors**2 * tilt_information).sum(axis=1)]
    )


def normal_equations(
    graph: PoseGraph,
    constraints: IntArray,
    weights: FloatArray,
    fixed: BoolArray,
    freedom: Freedom,
    prior_weights: FloatArray | None = None,
) -> NormalEquations:
    """Linearise these constraints (k,), each weighted (k,), and all priors. Fixed nodes (n,) get a unit block
    and no step.

    prior_weights: (position priors + attitude priors,), 1 if not given.
    """
    n, d = len(graph), int(freedom)
    diagonal = np.zeros((n, d, d))
    off_diagonal = np.empty((len(constraints), d, d))
    gradient = np.zeros((n, d))
    _NORMAL_EQUATIONS[freedom](
        graph.positions, graph.quaternions, graph.i, graph.j, graph.measured_positions,
        graph.measured_quaternions,
        graph.information, constraints, weights, fixed, diagonal, off_diagonal, gradient,
    )  # fmt: skip
    nodes, values, information = graph.position_priors
    tilted, rotations, tilt_information = graph.attitude_priors
    if prior_weights is None:
        prior_weights = np.ones(len(nodes) + len(tilted))
    if len(prior_weights):
        _add_position_priors(
            graph.positions,
            graph.quaternions,
            nodes,
            values,
            information,
            prior_weights[: len(nodes)],
            diagonal,
            gradient,
        )
        _add_attitude_priors(
            graph.quaternions,
            tilted,
            rotations,
            tilt_information,
            prior_weights[len(nodes) :],
            diagonal,
            gradient,
        )
    diagonal[fixed] = np.eye(d)
    gradient[fixed] = 0.0
    return NormalEquations(diagonal, off_diagonal, gradient)


def move(graph: PoseGraph, step: FloatArray) -> None:
    """Apply a step (n, d) to all nodes, d telling which freedom it belongs to."""
    _move(graph.positions, graph.quaternions, step)


@njit(cache=True, nogil=True, inline="always")
def _error(positions: Any, quaternions: Any, a: int, b: int, measured_t: Any, measured_q: Any) -> Any:
    """Error pose measured^-1 * predicted (translation, quaternion with w >= 0) and the predicted
    translation.
    """
    qa = _conjugate(_quaternion(quaternions[a]))
    qm = _conjugate(_quaternion(measured_q))
    ta = positions[a]
    tb = positions[b]
    predicted = _rotate(qa, (tb[0] - ta[0], tb[1] - ta[1], tb[2] - ta[2]))
    te = _rotate(
        qm, (predicted[0] - measured_t[0], predicted[1] - measured_t[1], predicted[2] - measured_t[2])
    )
    qe = _multiply(qm, _multiply(qa, _quaternion(quaternions[b])))
    if qe[3] < 0.0:
        qe = (-qe[0], -qe[1], -qe[2], -qe[3])
    return te, qe, predicted


@njit(cache=True, nogil=True)
def _errors(
    positions: Any, quaternions: Any, i: Any, j: Any, measured_t: Any, measured_q: Any, constraints: Any,
    planar: bool,
    errors: Any,
) -> None:  # fmt: skip
    for k in range(len(constraints)):
        c = constraints[k]
        te, qe, _ = _error(positions, quaternions, i[c], j[c], measured_t[c], measured_q[c])
        for r in range(3):
            errors[k, r] = te[r]
            errors[k, 3 + r] = qe[r]
        if planar:
            errors[k, 2:5] = 0.0
            errors[k, 5] = _heading(qe)


@njit(cache=True, nogil=True)
def _quadratic_forms(errors: Any, information: Any, constraints: Any) -> Any:
    values = np.empty(len(constraints))
    for k in range(len(constraints)):
        total = 0.0
        for r in range(6):
            row = 0.0
            for s in range(6):
                row += information[constraints[k], r, s] * errors[k, s]
            total += errors[k, r] * row
        values[k] = total
    return values


@njit(cache=True, nogil=True)
def _jacobians(
    positions: Any, quaternions: Any, a: int, b: int, measured_t: Any, measured_q: Any, d: int, e: Any,
    A: Any, B: Any,
    Rm: Any, Ra: Any, Rb: Any,
) -> None:  # fmt: skip
    """Error e (d or 6 rows) with its derivatives A (6, d) to the step of node a and B (6, d) to that of node
    b.
    """
    te, qe, p = _error(positions, quaternions, a, b, measured_t, measured_q)
    x, y, z, w = qe
    e[0], e[1], e[2] = te
    e[3], e[4], e[5] = x, y, z
    A[:, :] = 0.0
    B[:, :] = 0.0
    _matrix_into(_quaternion(measured_q), Rm)
    if d == 3:
        c, s = 1.0 - 2.0 * z * z, 2.0 * z * w  # rotation of the error
        A[0, 0], A[0, 1], A[1, 0], A[1, 1] = -Rm[0, 0], -Rm[1, 0], -Rm[0, 1], -Rm[1, 1]
        A[0, 2] = Rm[0, 0] * p[1] - Rm[1, 0] * p[0]
        A[1, 2] = Rm[0, 1] * p[1] - Rm[1, 1] * p[0]
        A[5, 2] = -1.0
        B[0, 0], B[0, 1], B[1, 0], B[1, 1] = c, -s, s, c
        B[5, 2] = 1.0
        e[2], e[3], e[4], e[5] = 0.0, 0.0, 0.0, _heading(qe)
        return
    if d == 6:
        _matrix_into(qe, Rb)
        for r in range(3):
            for s in range(3):
                A[r, s] = -Rm[s, r]
                B[r, s] = Rb[r, s]
            A[r, 3] = Rm[1, r] * p[2] - Rm[2, r] * p[1]  # Rm^T [p]x
            A[r, 4] = Rm[2, r] * p[0] - Rm[0, r] * p[2]
            A[r, 5] = Rm[0, r] * p[1] - Rm[1, r] * p[0]
        for s in range(3):
            m0, m1, m2 = Rm[s, 0], Rm[s, 1], Rm[s, 2]  # column s of Rm^T
            A[3, 3 + s] = -0.5 * (w * m0 + z * m1 - y * m2)  # -(w I - [v]x) Rm^T / 2
            A[4, 3 + s] = -0.5 * (w * m1 - z * m0 + x * m2)
            A[5, 3 + s] = -0.5 * (w * m2 + y * m0 - x * m1)
        B[3, 3], B[3, 4], B[3, 5] = 0.5 * w, -0.5 * z, 0.5 * y
        B[4, 3], B[4, 4], B[4, 5] = 0.5 * z, 0.5 * w, -0.5 * x
        B[5, 3], B[5, 4], B[5, 5] = -0.5 * y, 0.5 * x, 0.5 * w
        return
    # levelled: world axes, so both nodes see the same Rm^T Ra^T; heading turns about the world's up, u in
    # axes of a
    _matrix_into(_quaternion(quaternions[a]), Ra)
    u = (Ra[2, 0], Ra[2, 1], Ra[2, 2])
    cross = (p[1] * u[2] - p[2] * u[1], p[2] * u[0] - p[0] * u[2], p[0] * u[1] - p[1] * u[0])
    for r in range(3):
        for s in range(3):
            value = 0.0
            for t in range(3):
                value += Rm[t, r] * Ra[s, t]
            A[r, s] = -value
            B[r, s] = value
        A[r, 3] = Rm[0, r] * cross[0] + Rm[1, r] * cross[1] + Rm[2, r] * cross[2]
    m = (
        Rm[0, 0] * u[0] + Rm[1, 0] * u[1] + Rm[2, 0] * u[2],
        Rm[0, 1] * u[0] + Rm[1, 1] * u[1] + Rm[2, 1] * u[2],
        Rm[0, 2] * u[0] + Rm[1, 2] * u[1] + Rm[2, 2] * u[2],
    )
    A[3, 3] = -0.5 * (w * m[0] + z * m[1] - y * m[2])
    A[4, 3] = -0.5 * (w * m[1] - z * m[0] + x * m[2])
    A[5, 3] = -0.5 * (w * m[2] + y * m[0] - x * m[1])
    for r in range(3, 6):  # turning both about the world's up leaves the error as it is
        B[r, 3] = -A[r, 3]


def _compile_normal_equations(d: int, rows: tuple[int, ...]) -> Any:
    """The kernel for steps of d numbers and errors of which these rows count, as constants, so that its loops
    unroll.
    """
    n_rows = len(rows)

    @njit(cache=True, nogil=True)
    def kernel(
        positions: Any, quaternions: Any, i: Any, j: Any, measured_t: Any, measured_q: Any, information: Any,
        constraints: Any, weights: Any, fixed: Any, diagonal: Any, off_diagonal: Any, gradient: Any,
    ) -> None:  # fmt: skip
        e = np.empty(6)
        A, B = np.empty((6, d)), np.empty((6, d))
        WA, WB = np.empty((n_rows, d)), np.empty((n_rows, d))
        Rm, Ra, Rb = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
        for k in range(len(constraints)):
            c = constraints[k]
            a, b = i[c], j[c]
            _jacobians(positions, quaternions, a, b, measured_t[c], measured_q[c], d, e, A, B, Rm, Ra, Rb)
            WA[:, :] = 0.0
            WB[:, :] = 0.0
            for r in range(n_rows):
                for t in range(n_rows):
                    value = weights[k] * information[c, rows[r], rows[t]]
                    for s in range(d):
                        WA[r, s] += value * A[rows[t], s]
                        WB[r, s] += value * B[rows[t], s]
            off_diagonal[k] = 0.0
            coupled = not (fixed[a] or fixed[b])
            for t in range(n_rows):
                for r in range(d):
                    left, right = A[rows[t], r], B[rows[t], r]
                    gradient[a, r] += WA[t, r] * e[rows[t]]
                    gradient[b, r] += WB[t, r] * e[rows[t]]
                    for s in range(d):
                        diagonal[a, r, s] += left * WA[t, s]
                        diagonal[b, r, s] += right * WB[t, s]
                    if coupled:
                        for s in range(d):
                            off_diagonal[k, r, s] += left * WB[t, s]

    return kernel


_NORMAL_EQUATIONS = {
    Freedom.PLANAR: _compile_normal_equations(3, (0, 1, 5)),
    Freedom.LEVELLED: _compile_normal_equations(4, (0, 1, 2, 3, 4, 5)),
    Freedom.FULL: _compile_normal_equations(6, (0, 1, 2, 3, 4, 5)),
}


@njit(cache=True, nogil=True)
def _add_position_priors(
    positions: Any,
    quaternions: Any,
    nodes: Any,
    values: Any,
    information: Any,
    weights: Any,
    diagonal: Any,
    gradient: Any,
) -> None:
    d = gradient.shape[1]
    n_axes = min(d, 3) if d != 3 else 2
    R = np.empty((3, 3))
    for k in range(len(nodes)):
        node = nodes[k]
        if d == 4:  # steps are in world axes
            R[:, :] = np.eye(3)
        else:
            _matrix_into(_quaternion(quaternions[node]), R)
        for r in range(n_axes):
            for a in range(3):
                for b in range(3):
                    value = weights[k] * R[a, r] * information[k, a, b]
                    gradient[node, r] += value * (positions[node, b] - values[k, b])
                    for s in range(n_axes):
                        diagonal[node, r, s] += value * R[b, s]


@njit(cache=True, nogil=True)
def _attitude_error(q: Any, rotation: Any, R: Any) -> Any:
    """Tilt about world x and y, and heading, of R measured^T: (3,)."""
    _matrix_into(q, R)
    u0 = R[0, 0] * rotation[2, 0] + R[0, 1] * rotation[2, 1] + R[0, 2] * rotation[2, 2]
    u1 = R[1, 0] * rotation[2, 0] + R[1, 1] * rotation[2, 1] + R[1, 2] * rotation[2, 2]
    sine = 0.0
    cosine = 0.0
    for t in range(3):
        sine += R[1, t] * rotation[0, t] - R[0, t] * rotation[1, t]
        cosine += R[0, t] * rotation[0, t] + R[1, t] * rotation[1, t]
    return -u1, u0, np.arctan2(sine, cosine)


@njit(cache=True, nogil=True)
def _attitude_errors(quaternions: Any, nodes: Any, rotations: Any) -> Any:
    errors = np.empty((len(nodes), 3))
    R = np.empty((3, 3))
    for k in range(len(nodes)):
        errors[k, 0], errors[k, 1], errors[k, 2] = _attitude_error(
            _quaternion(quaternions[nodes[k]]), rotations[k], R
        )
    return errors


@njit(cache=True, nogil=True)
def _add_attitude_priors(
    quaternions: Any, nodes: Any, rotations: Any, information: Any, weights: Any, diagonal: Any, gradient: Any
) -> None:
    """To first order a turn w in the node's axes changes the error by R w; roll and pitch do not count where
    they are held.
    """
    d = gradient.shape[1]
    R = np.empty((3, 3))
    for k in range(len(nodes)):
        node = nodes[k]
        e = _attitude_error(_quaternion(quaternions[node]), rotations[k], R)
        if d == 6:
            for a in range(3):
                value = weights[k] * information[k, a]
                for r in range(3):
                    gradient[node, 3 + r] += value * R[a, r] * e[a]
                    for s in range(3):
                        diagonal[node, 3 + r, 3 + s] += value * R[a, r] * R[a, s]
        else:
            value = weights[k] * information[k, 2]
            gradient[node, d - 1] += value * e[2]
            diagonal[node, d - 1, d - 1] += value


@njit(cache=True, nogil=True)
def _move(positions: Any, quaternions: Any, step: Any) -> None:
    d = step.shape[1]
    for n in range(len(step)):
        q = _quaternion(quaternions[n])
        dx = step[n]
        if d == 4:
            shift = (dx[0], dx[1], dx[2])
            q = _multiply(_exponential(0.0, 0.0, dx[3]), q)
        elif d == 3:
            shift = _rotate(q, (dx[0], dx[1], 0.0))
            q = _multiply(q, _exponential(0.0, 0.0, dx[2]))
        else:
            shift = _rotate(q, _vector(dx))
            q = _multiply(q, _exponential(dx[3], dx[4], dx[5]))
        q = _normalised(q)
        for r in range(3):
            positions[n, r] += shift[r]
        for r in range(4):
            quaternions[n, r] = q[r]
