"""Compiled kernels of constraints: errors, their derivatives, normal equations, and steps of the nodes.

The conventions are those of ``linearise``. d is the number of directions a node moves in: 6, 4 or 3.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from overfly.graph.quaternions import (
    _conjugate,
    _exponential,
    _heading,
    _matrix_into,
    _multiply,
    _normalised,
    _quaternion_at,
    _rotate,
    _vector_at,
)


@njit(cache=True, nogil=True, inline="always")
def _error(positions: Any, quaternions: Any, a: int, b: int, measured_t: Any, measured_q: Any, c: int) -> Any:
    """Error pose measured^-1 * predicted (translation, quaternion with w >= 0) of constraint c, between nodes
    a and b, and the predicted translation.
    """
    qa = _conjugate(_quaternion_at(quaternions, a))
    qm = _conjugate(_quaternion_at(measured_q, c))
    ta, tb, tm = _vector_at(positions, a), _vector_at(positions, b), _vector_at(measured_t, c)
    predicted = _rotate(qa, (tb[0] - ta[0], tb[1] - ta[1], tb[2] - ta[2]))
    te = _rotate(qm, (predicted[0] - tm[0], predicted[1] - tm[1], predicted[2] - tm[2]))
    qe = _multiply(qm, _multiply(qa, _quaternion_at(quaternions, b)))
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
        te, qe, _ = _error(positions, quaternions, i[c], j[c], measured_t, measured_q, c)
        for r in range(3):
            errors[k, r] = te[r]
            errors[k, 3 + r] = qe[r]
        if planar:
            errors[k, 2:5] = 0.0
            errors[k, 5] = _heading(qe)


@njit(cache=True, nogil=True)
def _chi2(
    positions: Any, quaternions: Any, i: Any, j: Any, measured_t: Any, measured_q: Any, information: Any,
    constraints: Any, planar: bool,
) -> Any:  # fmt: skip
    """(k,) e^T Omega e of these constraints (k,)."""
    values = np.empty(len(constraints))
    for k in range(len(constraints)):
        c = constraints[k]
        te, qe, _ = _error(positions, quaternions, i[c], j[c], measured_t, measured_q, c)
        if planar:
            e = (te[0], te[1], 0.0, 0.0, 0.0, _heading(qe))
        else:
            e = (te[0], te[1], te[2], qe[0], qe[1], qe[2])
        values[k] = 0.0
        for r in range(6):
            row = 0.0
            for s in range(6):
                row += information[c, r, s] * e[s]
            values[k] += e[r] * row
    return values


@njit(cache=True, nogil=True)
def _jacobians(
    positions: Any, quaternions: Any, a: int, b: int, measured_t: Any, measured_q: Any, c: int, d: int,
    e: Any, A: Any, B: Any, Rm: Any, Ra: Any, Rb: Any,
) -> None:  # fmt: skip
    """Error e (d or 6 rows) of constraint c with its derivatives A (6, d) to the step of node a and B (6, d)
    to that of node b.
    """
    te, qe, p = _error(positions, quaternions, a, b, measured_t, measured_q, c)
    x, y, z, w = qe
    e[0], e[1], e[2] = te
    e[3], e[4], e[5] = x, y, z
    A[:, :] = 0.0
    B[:, :] = 0.0
    _matrix_into(_quaternion_at(measured_q, c), Rm)
    if d == 3:
        cosine, sine = 1.0 - 2.0 * z * z, 2.0 * z * w  # rotation of the error
        A[0, 0], A[0, 1], A[1, 0], A[1, 1] = -Rm[0, 0], -Rm[1, 0], -Rm[0, 1], -Rm[1, 1]
        A[0, 2] = Rm[0, 0] * p[1] - Rm[1, 0] * p[0]
        A[1, 2] = Rm[0, 1] * p[1] - Rm[1, 1] * p[0]
        A[5, 2] = -1.0
        B[0, 0], B[0, 1], B[1, 0], B[1, 1] = cosine, -sine, sine, cosine
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
    _matrix_into(_quaternion_at(quaternions, a), Ra)
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
            _jacobians(positions, quaternions, a, b, measured_t, measured_q, c, d, e, A, B, Rm, Ra, Rb)
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


def _compile_blocks(d: int, rows: tuple[int, ...]) -> Any:
    """The same kept apart by constraint: blocks (m, 3, d, d) of (i, i), (i, j) and (j, j), gradients (m, 2,
    d), and chi2 (m,).
    """
    n_rows = len(rows)

    @njit(cache=True, nogil=True)
    def kernel(
        positions: Any, quaternions: Any, i: Any, j: Any, measured_t: Any, measured_q: Any, information: Any,
        constraints: Any, blocks: Any, gradients: Any, chi2: Any,
    ) -> None:  # fmt: skip
        e = np.empty(6)
        A, B = np.empty((6, d)), np.empty((6, d))
        WA, WB = np.empty((n_rows, d)), np.empty((n_rows, d))
        Rm, Ra, Rb = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
        for c in constraints:
            _jacobians(positions, quaternions, i[c], j[c], measured_t, measured_q, c, d, e, A, B, Rm, Ra, Rb)
            WA[:, :] = 0.0
            WB[:, :] = 0.0
            blocks[c] = 0.0
            gradients[c] = 0.0
            chi2[c] = 0.0
            for r in range(n_rows):
                for t in range(n_rows):
                    value = information[c, rows[r], rows[t]]
                    chi2[c] += e[rows[r]] * value * e[rows[t]]
                    for s in range(d):
                        WA[r, s] += value * A[rows[t], s]
                        WB[r, s] += value * B[rows[t], s]
            for t in range(n_rows):
                for r in range(d):
                    left, right = A[rows[t], r], B[rows[t], r]
                    gradients[c, 0, r] += WA[t, r] * e[rows[t]]
                    gradients[c, 1, r] += WB[t, r] * e[rows[t]]
                    for s in range(d):
                        blocks[c, 0, r, s] += left * WA[t, s]
                        blocks[c, 1, r, s] += left * WB[t, s]
                        blocks[c, 2, r, s] += right * WB[t, s]

    return kernel


@njit(cache=True, nogil=True, inline="always")
def _moved(positions: Any, quaternions: Any, steps: Any, n: int) -> Any:
    """The pose (translation, quaternion) of node n after its step of 6, 4 or 3 numbers."""
    t, q, d = _vector_at(positions, n), _quaternion_at(quaternions, n), steps.shape[1]
    if d == 4:
        shift = _vector_at(steps, n)
        q = _multiply(_exponential(0.0, 0.0, steps[n, 3]), q)
    elif d == 3:
        shift = _rotate(q, (steps[n, 0], steps[n, 1], 0.0))
        q = _multiply(q, _exponential(0.0, 0.0, steps[n, 2]))
    else:
        shift = _rotate(q, _vector_at(steps, n))
        q = _multiply(q, _exponential(steps[n, 3], steps[n, 4], steps[n, 5]))
    return (t[0] + shift[0], t[1] + shift[1], t[2] + shift[2]), _normalised(q)


@njit(cache=True, nogil=True)
def _move(positions: Any, quaternions: Any, step: Any) -> None:
    for n in range(len(step)):
        t, q = _moved(positions, quaternions, step, n)
        for r in range(3):
            positions[n, r] = t[r]
        for r in range(4):
            quaternions[n, r] = q[r]


@njit(cache=True, nogil=True)
def _move_from(
    positions: Any, quaternions: Any, steps: Any, nodes: Any, to_positions: Any, to_quaternions: Any,
    copy_positions: Any, copy_quaternions: Any,
) -> None:  # fmt: skip
    """The poses of these nodes after their steps, written to two pairs of other arrays."""
    for n in nodes:
        t, q = _moved(positions, quaternions, steps, n)
        for r in range(3):
            to_positions[n, r] = copy_positions[n, r] = t[r]
        for r in range(4):
            to_quaternions[n, r] = copy_quaternions[n, r] = q[r]


@njit(cache=True, nogil=True)
def _displaced(
    positions: Any, quaternions: Any, old_positions: Any, old_quaternions: Any, least: float
) -> Any:
    moved = np.zeros(len(positions), np.bool_)
    for n in range(len(positions)):
        differs = False  # without a branch, which is faster
        for r in range(3):
            differs |= abs(positions[n, r] - old_positions[n, r]) > least
        for r in range(4):
            differs |= 2.0 * abs(quaternions[n, r] - old_quaternions[n, r]) > least
        moved[n] = differs
    return np.flatnonzero(moved)
