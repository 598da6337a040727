"""Compiled kernels of the tree optimiser in space: poses relative to parents, and resolving a constraint.

What is resolved, and in which shares, is told in ``tree``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from overfly.graph.quaternions import (
    _conjugate,
    _exponential,
    _multiply,
    _normalised,
    _quaternion,
    _rotate,
    _vector,
)


@njit(cache=True, nogil=True)
def _to_parents(parent: Any, positions: Any, quaternions: Any, relative_t: Any, relative_q: Any) -> None:
    for n in range(len(parent)):
        p = parent[n]
        if p < 0:
            relative_t[n] = positions[n]
            relative_q[n] = quaternions[n]
            continue
        back = _conjugate(_quaternion(quaternions[p]))
        t = _rotate(
            back,
            (
                positions[n, 0] - positions[p, 0],
                positions[n, 1] - positions[p, 1],
                positions[n, 2] - positions[p, 2],
            ),
        )
        q = _multiply(back, _quaternion(quaternions[n]))
        _store(relative_t[n], t)
        _store(relative_q[n], q)


@njit(cache=True, nogil=True)
def _from_parents(
    parent: Any, order: Any, relative_t: Any, relative_q: Any, positions: Any, quaternions: Any
) -> None:
    for k in range(len(order)):
        n = order[k]
        p = parent[n]
        if p < 0:
            continue
        here = _quaternion(quaternions[p])
        t = _rotate(here, _vector(relative_t[n]))
        _store(quaternions[n], _normalised(_multiply(here, _quaternion(relative_q[n]))))
        _store(positions[n], (positions[p, 0] + t[0], positions[p, 1] + t[1], positions[p, 2] + t[2]))


@njit(cache=True, nogil=True, inline="always")
def _store(row: Any, values: Any) -> None:
    for k in range(len(values)):
        row[k] = values[k]


@njit(cache=True, nogil=True)
def _climb(
    parent: Any, node: int, top: int, relative_t: Any, relative_q: Any, path: Any, Q: Any, T: Any
) -> int:
    """Path from below ``top`` down to ``node``, with poses in the axes of ``top``; returns its length."""
    length = 0
    n = node
    while n != top:
        length += 1
        n = parent[n]
    n = node
    for k in range(length - 1, -1, -1):
        path[k] = n
        n = parent[n]
    q = (0.0, 0.0, 0.0, 1.0)
    x, y, z = 0.0, 0.0, 0.0
    for k in range(length):
        t = _rotate(q, _vector(relative_t[path[k]]))
        x, y, z = x + t[0], y + t[1], z + t[2]
        q = _multiply(q, _quaternion(relative_q[path[k]]))
        _store(Q[k], q)
        T[k, 0], T[k, 1], T[k, 2] = x, y, z
    return length


@njit(cache=True, nogil=True)
def _turn_leg(
    length: int,
    path: Any,
    passing: Any,
    unit: float,
    turn: Any,
    relative_t: Any,
    relative_q: Any,
    Q: Any,
    T: Any,
) -> None:
    """Turn the nodes of one leg about ``turn`` (axes of the top), each by what fell to it and to those above
    it.
    """
    done = 0.0
    q = (0.0, 0.0, 0.0, 1.0)
    x, y, z = 0.0, 0.0, 0.0
    for k in range(length):
        n = path[k]
        t = _rotate(q, _vector(relative_t[n]))
        x, y, z = x + t[0], y + t[1], z + t[2]
        T[k, 0], T[k, 1], T[k, 2] = x, y, z
        done += unit / passing[n, 1]
        turned = _multiply(_exponential(done * turn[0], done * turn[1], done * turn[2]), _quaternion(Q[k]))
        _store(relative_q[n], _normalised(_multiply(_conjugate(q), turned)))
        q = turned
        _store(Q[k], q)


@njit(cache=True, nogil=True)
def _shift_leg(
    length: int, path: Any, passing: Any, unit: float, shift: Any, relative_t: Any, Q: Any
) -> None:
    """Shift the nodes of one leg by their cumulated share of ``shift`` (axes of the top)."""
    for k in range(length):
        share = unit / passing[path[k], 0]
        step = (share * shift[0], share * shift[1], share * shift[2])
        if k > 0:
            step = _rotate(_conjugate(_quaternion(Q[k - 1])), step)
        for r in range(3):
            relative_t[path[k], r] += step[r]


@njit(cache=True, nogil=True)
def _rotation_vector(q: Any) -> Any:
    if q[3] < 0.0:
        q = (-q[0], -q[1], -q[2], -q[3])
    length = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    scale = 2.0 if length < 1e-10 else 2.0 * math.atan2(length, q[3]) / length
    return q[0] * scale, q[1] * scale, q[2] * scale


@njit(cache=True, nogil=True)
def _resolve(
    parent: Any, top: int, a: int, b: int, measured_t: Any, measured_q: Any, strength: Any, passing: Any,
    rate: float,
    relative_t: Any, relative_q: Any, path_a: Any, Qa: Any, Ta: Any, path_b: Any, Qb: Any, Tb: Any,
) -> None:  # fmt: skip
    """Move the nodes on the path from a to b so that this share of the constraint's error goes."""
    length_a = _climb(parent, a, top, relative_t, relative_q, path_a, Qa, Ta)
    length_b = _climb(parent, b, top, relative_t, relative_q, path_b, Qb, Tb)
    sum_t, sum_r = 0.0, 0.0
    for k in range(length_a):
        sum_t += 1.0 / passing[path_a[k], 0]
        sum_r += 1.0 / passing[path_a[k], 1]
    for k in range(length_b):
        sum_t += 1.0 / passing[path_b[k], 0]
        sum_r += 1.0 / passing[path_b[k], 1]
    share_t = min(1.0, rate * strength[0] * sum_t)
    share_r = min(1.0, rate * strength[1] * sum_r)
    qa = _quaternion(Qa[length_a - 1]) if length_a > 0 else (0.0, 0.0, 0.0, 1.0)
    qb = _quaternion(Qb[length_b - 1]) if length_b > 0 else (0.0, 0.0, 0.0, 1.0)
    turn = _rotation_vector(_multiply(_multiply(qa, _quaternion(measured_q)), _conjugate(qb)))
    _turn_leg(length_a, path_a, passing, -share_r / sum_r, turn, relative_t, relative_q, Qa, Ta)
    _turn_leg(length_b, path_b, passing, share_r / sum_r, turn, relative_t, relative_q, Qb, Tb)
    qa = _quaternion(Qa[length_a - 1]) if length_a > 0 else (0.0, 0.0, 0.0, 1.0)
    wanted = _rotate(qa, _vector(measured_t))
    ta = _vector(Ta[length_a - 1]) if length_a > 0 else (0.0, 0.0, 0.0)
    tb = _vector(Tb[length_b - 1]) if length_b > 0 else (0.0, 0.0, 0.0)
    shift = (wanted[0] - tb[0] + ta[0], wanted[1] - tb[1] + ta[1], wanted[2] - tb[2] + ta[2])
    _shift_leg(length_a, path_a, passing, -share_t / sum_t, shift, relative_t, Qa)
    _shift_leg(length_b, path_b, passing, share_t / sum_t, shift, relative_t, Qb)


@njit(cache=True, nogil=True)
def _sweep(
    parent: Any, level: Any, i: Any, j: Any, measured_t: Any, measured_q: Any, constraints: Any, tops: Any,
    strengths: Any, passing: Any, rate: float, relative_t: Any, relative_q: Any,
) -> None:  # fmt: skip
    deepest = level.max() + 1
    path_a, path_b = np.empty(deepest, np.int64), np.empty(deepest, np.int64)
    Qa, Qb = np.empty((deepest, 4)), np.empty((deepest, 4))
    Ta, Tb = np.empty((deepest, 3)), np.empty((deepest, 3))
    for k in range(len(constraints)):
        c = constraints[k]
        _resolve(
            parent, tops[k], i[c], j[c], measured_t[c], measured_q[c], strengths[c], passing, rate,
            relative_t,
            relative_q, path_a, Qa, Ta, path_b, Qb, Tb,
        )  # fmt: skip
