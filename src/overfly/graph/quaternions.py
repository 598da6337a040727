"""Quaternions (x, y, z, w) inside compiled kernels: scalars in, tuples out. The typed, checked versions are
in geometry.
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit


@njit(cache=True, nogil=True, inline="always")
def _vector_at(rows: Any, k: int) -> Any:
    """Row k of (n, 3). Numbers are taken one by one: an array for the row would be counted as one more
    reference, which costs more than all the rest.
    """
    return rows[k, 0], rows[k, 1], rows[k, 2]


@njit(cache=True, nogil=True, inline="always")
def _quaternion_at(rows: Any, k: int) -> Any:
    """Row k of (n, 4), likewise."""
    return rows[k, 0], rows[k, 1], rows[k, 2], rows[k, 3]


@njit(cache=True, nogil=True, inline="always")
def _multiply(a: Any, b: Any) -> Any:
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


@njit(cache=True, nogil=True, inline="always")
def _conjugate(q: Any) -> Any:
    return -q[0], -q[1], -q[2], q[3]


@njit(cache=True, nogil=True, inline="always")
def _rotate(q: Any, v: Any) -> Any:
    """q v q^-1."""
    qx, qy, qz, qw = q
    vx, vy, vz = v
    tx = 2.0 * (qy * vz - qz * vy)
    ty = 2.0 * (qz * vx - qx * vz)
    tz = 2.0 * (qx * vy - qy * vx)
    return (
        vx + qw * tx + qy * tz - qz * ty,
        vy + qw * ty + qz * tx - qx * tz,
        vz + qw * tz + qx * ty - qy * tx,
    )


@njit(cache=True, nogil=True, inline="always")
def _normalised(q: Any) -> Any:
    scale = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q[0] * scale, q[1] * scale, q[2] * scale, q[3] * scale


@njit(cache=True, nogil=True, inline="always")
def _exponential(x: float, y: float, z: float) -> Any:
    """Quaternion of a rotation vector."""
    half = 0.5 * math.sqrt(x * x + y * y + z * z)
    if half < 1e-8:
        return 0.5 * x, 0.5 * y, 0.5 * z, 1.0
    scale = 0.5 * math.sin(half) / half
    return scale * x, scale * y, scale * z, math.cos(half)


@njit(cache=True, nogil=True, inline="always")
def _heading(q: Any) -> float:
    """Angle of a rotation about z, [-pi, pi]."""
    return 2.0 * math.atan2(q[2], q[3]) if q[3] >= 0.0 else 2.0 * math.atan2(-q[2], -q[3])


@njit(cache=True, nogil=True, inline="always")
def _matrix_into(q: Any, R: Any) -> None:
    x, y, z, w = q
    R[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    R[0, 1] = 2.0 * (x * y - z * w)
    R[0, 2] = 2.0 * (x * z + y * w)
    R[1, 0] = 2.0 * (x * y + z * w)
    R[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    R[1, 2] = 2.0 * (y * z - x * w)
    R[2, 0] = 2.0 * (x * z - y * w)
    R[2, 1] = 2.0 * (y * z + x * w)
    R[2, 2] = 1.0 - 2.0 * (x * x + y * y)


@njit(cache=True, nogil=True, inline="always")
def _vector(row: Any) -> Any:
    return row[0], row[1], row[2]


@njit(cache=True, nogil=True, inline="always")
def _quaternion(row: Any) -> Any:
    return row[0], row[1], row[2], row[3]
