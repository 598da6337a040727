"""Camera pose from two map points under known attitude (paper, section IV-A and Fig. 3).

With levelled rays (a, b, -1), q = (a, b), a camera at C with yaw psi sees point m where
``m.xy - C.xy = (C.z - m.z) R(psi) q``. Two points give four equations for the four unknowns x, y, z and yaw.
Subtracting them leaves, with D = m1.xy - m2.xy, dz = m2.z - m1.z and h the camera's height above m2,

    D = R(psi) [(h + dz) q1 - h q2]

whose squared length is a quadratic in h; the angle between both sides is the yaw.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray


@njit(cache=True, nogil=True)
def two_point_kernel(m1, m2, q1, q2, solutions):  # type: ignore[no-untyped-def]
    """Write up to two rows (cos psi, sin psi, x, y, z) into solutions (2, 5); return how many. For other
    kernels.
    """
    dx, dy = m1[0] - m2[0], m1[1] - m2[1]
    dz = m2[2] - m1[2]
    qx, qy = q1[0] - q2[0], q1[1] - q2[1]
    a = qx * qx + qy * qy
    b = dz * (q1[0] * qx + q1[1] * qy)
    c = dz * dz * (q1[0] * q1[0] + q1[1] * q1[1]) - (dx * dx + dy * dy)
    discriminant = b * b - a * c
    # Written so that NaN, a ray above the horizon, fails it, too.
    if not (a >= 1e-16 and discriminant >= 0.0 and dx * dx + dy * dy >= 1e-16):
        return 0
    root = math.sqrt(discriminant)
    count = 0
    for sign in (1.0, -1.0):
        h = (-b + sign * root) / a
        if h <= 0.0 or h + dz <= 0.0 or (count == 1 and root == 0.0):
            continue
        ex, ey = (h + dz) * q1[0] - h * q2[0], (h + dz) * q1[1] - h * q2[1]
        length2 = ex * ex + ey * ey
        if length2 < 1e-16:
            continue
        cosine, sine = (ex * dx + ey * dy) / length2, (ex * dy - ey * dx) / length2
        norm = 1.0 / math.sqrt(cosine * cosine + sine * sine)
        cosine, sine = cosine * norm, sine * norm
        # Both points vote for the camera's place; with the exact height they agree.
        x1 = m1[0] - (h + dz) * (cosine * q1[0] - sine * q1[1])
        y1 = m1[1] - (h + dz) * (sine * q1[0] + cosine * q1[1])
        x2 = m2[0] - h * (cosine * q2[0] - sine * q2[1])
        y2 = m2[1] - h * (sine * q2[0] + cosine * q2[1])
        solutions[count, 0] = cosine
        solutions[count, 1] = sine
        solutions[count, 2] = 0.5 * (x1 + x2)
        solutions[count, 3] = 0.5 * (y1 + y2)
        solutions[count, 4] = m2[2] + h
        count += 1
    return count


def solve_two_point(points: FloatArray, levelled: FloatArray) -> FloatArray:
    """Camera poses that see two map points along two levelled rays.

    points: (2, 3) metres, world. levelled: (2, 2) q of each ray. Returns (m, 4) rows x, y, z (metres, world)
    and yaw (radians), m in 0..2: none when the rays or points coincide or no camera above both points sees
    them so.
    """
    solutions = np.empty((2, 5))
    points = np.ascontiguousarray(points, dtype=np.float64)
    levelled = np.ascontiguousarray(levelled, dtype=np.float64)
    count = two_point_kernel(points[0], points[1], levelled[0], levelled[1], solutions)
    found = solutions[:count]
    return np.column_stack([found[:, 2:], np.arctan2(found[:, 1], found[:, 0])])
