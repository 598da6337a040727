"""Compiled parts of adjusting a whole map: normal equations with the points eliminated, the step back, costs.

Observations are sorted by point: those of point m are starts[m] to starts[m + 1]. Right perturbations
(translation, rotation) of world_from_cam. P shared unknowns (of the camera) move all rays.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

HUBER = 2.0  # standard deviations from which on a residual counts linearly
NEAREST = 1e-6  # metres in front of the camera


@njit(cache=True, nogil=True)
def _huber(error: float) -> float:
    """Cost of a residual in standard deviations."""
    return error * error if error <= HUBER else 2.0 * HUBER * error - HUBER * HUBER


@njit(cache=True, nogil=True)
def _seen_from(rotation: Any, translation: Any, point: Any) -> Any:
    """A world point in the camera's frame."""
    dx, dy, dz = point[0] - translation[0], point[1] - translation[1], point[2] - translation[2]
    return (
        rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz,
        rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz,
        rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz,
    )


@njit(cache=True, nogil=True)
def _linearise(
    rotation: Any, translation: Any, point: Any, ray: Any, weight: float, inverse_depth: float,
    depth_weight: float, r: Any, Jp: Any, Jx: Any,
) -> float:  # fmt: skip
    """Residuals r (3,) in sigmas with Huber's weights, Jacobians by pose (3, 6) and point (3, 3); returns the
    weight of the reprojection, zero where the point is behind the camera. The third row is the measured
    inverse depth.
    """
    x, y, z = _seen_from(rotation, translation, point)
    r[:] = 0.0
    Jp[:] = 0.0
    Jx[:] = 0.0
    if z <= NEAREST:
        return 0.0
    inverse = 1.0 / z
    u, v = x * inverse, y * inverse
    ru, rv = (u - ray[0]) * weight, (v - ray[1]) * weight
    error = math.sqrt(ru * ru + rv * rv)
    w = weight * (math.sqrt(HUBER / error) if error > HUBER else 1.0)
    r[0], r[1] = (u - ray[0]) * w, (v - ray[1]) * w
    a = w * inverse
    Jp[0, 0], Jp[0, 2] = -a, a * u
    Jp[1, 1], Jp[1, 2] = -a, a * v
    Jp[0, 3], Jp[0, 4], Jp[0, 5] = w * u * v, -w * (1.0 + u * u), w * v
    Jp[1, 3], Jp[1, 4], Jp[1, 5] = w * (1.0 + v * v), -w * u * v, -w * u
    for c in range(3):
        Jx[0, c] = a * (rotation[c, 0] - u * rotation[c, 2])
        Jx[1, c] = a * (rotation[c, 1] - v * rotation[c, 2])
    if not math.isnan(inverse_depth):
        d = (inverse - inverse_depth) * depth_weight
        down = math.sqrt(HUBER / abs(d)) if abs(d) > HUBER else 1.0
        r[2] = d * down
        b = depth_weight * down * inverse * inverse
        # z falls by what the camera moves forward, and by what it turns: dz = -dt_z + (p x theta)_z
        Jp[2, 2] = b
        Jp[2, 3], Jp[2, 4] = b * y, -b * x
        for c in range(3):
            Jx[2, c] = -b * rotation[c, 2]
    return w


@njit(cache=True, nogil=True)
def _flatness(point: Any, camera: Any, flatness: float) -> Any:
    """Residual of a point's z against flat ground, in shares of a camera's height; derivatives by both."""
    height = camera[2]
    if flatness == 0.0 or height <= 1e-9:
        return 0.0, 0.0, 0.0
    error = flatness * point[2] / height
    return error, flatness / height, -error / height


@njit(cache=True, nogil=True)
def _invert(V: Any, damping: float, out: Any) -> None:
    """Inverse of the damped symmetric (3, 3) V; zero where it is singular, so that the point stays."""
    a, b, c = V[0, 0] * (1.0 + damping), V[0, 1], V[0, 2]
    d, e, f = V[1, 1] * (1.0 + damping), V[1, 2], V[2, 2] * (1.0 + damping)
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * A + b * B + c * C
    if not determinant > 1e-12 * a * d * f or not determinant > 0.0:
        out[:] = 0.0
        return
    s = 1.0 / determinant
    out[0, 0], out[0, 1], out[0, 2] = A * s, B * s, C * s
    out[1, 1], out[1, 2], out[2, 2] = (a * f - c * c) * s, (b * c - a * e) * s, (a * d - b * b) * s
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]


@njit(cache=True, nogil=True)
def _point_pairs(starts: Any, node: Any) -> Any:
    """(n,) keys low * 2^32 + high of the two nodes of every pair of observations of a point, in the order in
    which _reduce meets them.
    """
    count = 0
    for m in range(len(starts) - 1):
        k = starts[m + 1] - starts[m]
        count += k * (k - 1) // 2
    keys = np.empty(count, np.int64)
    at = 0
    for m in range(len(starts) - 1):
        for k in range(starts[m], starts[m + 1]):
            for o in range(k + 1, starts[m + 1]):
                low, high = min(node[k], node[o]), max(node[k], node[o])
                keys[at] = (np.int64(low) << 32) | np.int64(high)
                at += 1
    return keys


@njit(cache=True, nogil=True)
def _reduce(  # noqa: PLR0912
    rotations: Any, translations: Any, points: Any, starts: Any, node: Any, rays: Any, weight: Any,
    inverse_depth: Any, depth_weight: float, flatness: float, damping: float, by_camera: Any, pair: Any,
    diagonal: Any, off_diagonal: Any, gradient: Any, border: Any, corner: Any, corner_gradient: Any,
    V_inverse: Any, Vg: Any, cross: Any, point_border: Any,
) -> None:  # fmt: skip
    """Add all observations, points eliminated, to the blocks of the reduced system; keep each point's inv(V),
    gradient, and its blocks with the poses (k, 6, 3) and with the shared unknowns (m, P, 3) for the way back.

    by_camera (k, 2, P): how the measured rays move with the shared unknowns.
    """
    P = by_camera.shape[2]
    r, Jp, Jx, V = np.zeros(3), np.zeros((3, 6)), np.zeros((3, 3)), np.zeros((3, 3))
    Jc, WV, BV = np.zeros((2, P)), np.zeros((6, 3)), np.zeros((P, 3))
    at = 0
    for m in range(len(starts) - 1):
        first, last = starts[m], starts[m + 1]
        V[:] = 0.0
        Vg[m] = 0.0
        point_border[m] = 0.0
        for k in range(first, last):
            n = node[k]
            cross[k] = 0.0
            w = _linearise(
                rotations[n], translations[n], points[m], rays[k], weight[k], inverse_depth[k], depth_weight,
                r, Jp, Jx,
            )  # fmt: skip
            for p in range(P):
                Jc[0, p], Jc[1, p] = -w * by_camera[k, 0, p], -w * by_camera[k, 1, p]
            for row in range(3):
                for p in range(3):
                    Vg[m, p] += Jx[row, p] * r[row]
                    for q in range(3):
                        V[p, q] += Jx[row, p] * Jx[row, q]
                for p in range(6):
                    gradient[n, p] += Jp[row, p] * r[row]
                    for q in range(6):
                        diagonal[n, p, q] += Jp[row, p] * Jp[row, q]
                    for q in range(3):
                        cross[k, p, q] += Jp[row, p] * Jx[row, q]
            for row in range(2):
                for p in range(P):
                    corner_gradient[p] += Jc[row, p] * r[row]
                    for q in range(P):
                        corner[p, q] += Jc[row, p] * Jc[row, q]
                    for q in range(6):
                        border[n, q, p] += Jp[row, q] * Jc[row, p]
                    for q in range(3):
                        point_border[m, p, q] += Jc[row, p] * Jx[row, q]
        error, by_point, by_height = _flatness(points[m], translations[node[first]], flatness)
        if by_point != 0.0:
            V[2, 2] += by_point * by_point
            Vg[m, 2] += by_point * error
            n = node[first]
            up = rotations[n, 2]
            for p in range(3):
                gradient[n, p] += by_height * up[p] * error
                cross[first, p, 2] += by_height * up[p] * by_point
                for q in range(3):
                    diagonal[n, p, q] += by_height * up[p] * by_height * up[q]
        _invert(V, damping, V_inverse[m])
        for p in range(P):
            for q in range(3):
                BV[p, q] = (
                    point_border[m, p, 0] * V_inverse[m, 0, q]
                    + point_border[m, p, 1] * V_inverse[m, 1, q]
                    + point_border[m, p, 2] * V_inverse[m, 2, q]
                )
            for q in range(3):
                corner_gradient[p] -= BV[p, q] * Vg[m, q]
            for q in range(P):
                for c in range(3):
                    corner[p, q] -= BV[p, c] * point_border[m, q, c]
        for k in range(first, last):
            n = node[k]
            for p in range(6):
                for q in range(3):
                    WV[p, q] = (
                        cross[k, p, 0] * V_inverse[m, 0, q]
                        + cross[k, p, 1] * V_inverse[m, 1, q]
                        + cross[k, p, 2] * V_inverse[m, 2, q]
                    )
                for q in range(3):
                    gradient[n, p] -= WV[p, q] * Vg[m, q]
                for q in range(P):
                    for c in range(3):
                        border[n, p, q] -= WV[p, c] * point_border[m, q, c]
                w0, w1, w2 = WV[p, 0], WV[p, 1], WV[p, 2]
                for q in range(6):
                    diagonal[n, p, q] -= w0 * cross[k, q, 0] + w1 * cross[k, q, 1] + w2 * cross[k, q, 2]
            for o in range(k + 1, last):
                block = off_diagonal[pair[at]]
                at += 1
                if node[o] > n:
                    for p in range(6):
                        w0, w1, w2 = WV[p, 0], WV[p, 1], WV[p, 2]
                        for q in range(6):
                            block[p, q] -= w0 * cross[o, q, 0] + w1 * cross[o, q, 1] + w2 * cross[o, q, 2]
                else:
                    for p in range(6):
                        w0, w1, w2 = WV[p, 0], WV[p, 1], WV[p, 2]
                        for q in range(6):
                            block[q, p] -= w0 * cross[o, q, 0] + w1 * cross[o, q, 1] + w2 * cross[o, q, 2]


@njit(cache=True, nogil=True)
def _move_points(
    points: Any, starts: Any, node: Any, V_inverse: Any, Vg: Any, cross: Any, point_border: Any, step: Any,
    shared: Any,
) -> Any:  # fmt: skip
    """The points after the step (n, 6) of the poses and that of the shared unknowns, by back-substitution."""
    moved = points.copy()
    b = np.zeros(3)
    for m in range(len(starts) - 1):
        b[:] = Vg[m]
        for p in range(len(shared)):
            for c in range(3):
                b[c] += point_border[m, p, c] * shared[p]
        for k in range(starts[m], starts[m + 1]):
            for p in range(6):
                for c in range(3):
                    b[c] += cross[k, p, c] * step[node[k], p]
        for p in range(3):
            moved[m, p] -= V_inverse[m, p, 0] * b[0] + V_inverse[m, p, 1] * b[1] + V_inverse[m, p, 2] * b[2]
    return moved


@njit(cache=True, nogil=True)
def _errors(
    rotations: Any, translations: Any, points: Any, starts: Any, node: Any, rays: Any, weight: Any,
    inverse_depth: Any, depth_weight: float, flatness: float, errors: Any,
) -> float:  # fmt: skip
    """Reprojection errors (k,) in standard deviations, infinite behind the camera, into errors; returns the
    robust cost, in which such an observation counts as one far off.
    """
    cost = 0.0
    for m in range(len(starts) - 1):
        cost += _flatness(points[m], translations[node[starts[m]]], flatness)[0] ** 2
        for k in range(starts[m], starts[m + 1]):
            x, y, z = _seen_from(rotations[node[k]], translations[node[k]], points[m])
            if z <= NEAREST:
                errors[k] = math.inf
                cost += _huber(1e4)
                continue
            ru, rv = x / z - rays[k, 0], y / z - rays[k, 1]
            errors[k] = math.sqrt(ru * ru + rv * rv) * weight[k]
            cost += _huber(errors[k])
            if not math.isnan(inverse_depth[k]):
                cost += _huber(abs(1.0 / z - inverse_depth[k]) * depth_weight)
    return cost
