"""Compiled parts of bundle adjustment: residuals, normal equations without the points, and the step back.

Arrays as in BundleProblem, observations sorted by point: those of point m are starts[m] to starts[m + 1].
slot (w,): place of each node among the free ones, -1 for nodes that stay.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from overfly.vision.refine import turn_kernel

MAX_ITERATIONS = 10
ENOUGH = 1e-4  # relative decrease of the cost below which there is nothing left to gain
HUBER = 2.0  # standard deviations from which on a residual counts linearly
HELD = 1e12  # information that holds the anchor
NEAREST = 1e-6  # metres in front of the camera
REORDERED = {"reassoc", "contract"}  # sums may be regrouped; NaN and infinity keep their meaning


@njit(cache=True, nogil=True, fastmath=REORDERED)
def _residuals(  # type: ignore[no-untyped-def]
    rotation, translation, point, ray, inverse_depth, weight, depth_weight, r, Jp, Jx
):
    """Residuals r (3,) in sigmas, Huber-weighted; Jacobians by pose and point. Returns (cost, error)."""
    dx, dy, dz = point[0] - translation[0], point[1] - translation[1], point[2] - translation[2]
    x = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
    y = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
    z = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
    if z <= NEAREST:
        return math.inf, math.inf
    inverse = 1.0 / z
    u, v = x * inverse, y * inverse
    r[0], r[1] = (u - ray[0]) * weight, (v - ray[1]) * weight
    error = math.sqrt(r[0] * r[0] + r[1] * r[1])
    down = 1.0
    cost = error * error
    if error > HUBER:
        down = math.sqrt(HUBER / error)
        cost = 2.0 * HUBER * error - HUBER * HUBER
    a = weight * inverse * down
    r[0] *= down
    r[1] *= down
    Jp[0, 0], Jp[0, 1], Jp[0, 2] = -a, 0.0, a * u
    Jp[1, 0], Jp[1, 1], Jp[1, 2] = 0.0, -a, a * v
    w = weight * down
    Jp[0, 3], Jp[0, 4], Jp[0, 5] = w * u * v, -w * (1.0 + u * u), w * v
    Jp[1, 3], Jp[1, 4], Jp[1, 5] = w * (1.0 + v * v), -w * u * v, -w * u
    for c in range(3):
        Jx[0, c] = a * (rotation[c, 0] - u * rotation[c, 2])
        Jx[1, c] = a * (rotation[c, 1] - v * rotation[c, 2])
    if math.isnan(inverse_depth):
        r[2] = 0.0
        Jp[2, :] = 0.0
        Jx[2, :] = 0.0
        return cost, error
    d = (inverse - inverse_depth) * depth_weight
    down = 1.0
    if abs(d) > HUBER:
        down = math.sqrt(HUBER / abs(d))
        cost += 2.0 * HUBER * abs(d) - HUBER * HUBER
    else:
        cost += d * d
    b = depth_weight * down * inverse * inverse
    r[2] = d * down
    # z falls by what the camera moves forward, and by what it turns: dz = -dt_z + (p x theta)_z
    Jp[2, 0], Jp[2, 1], Jp[2, 2] = 0.0, 0.0, b
    Jp[2, 3], Jp[2, 4], Jp[2, 5] = b * y, -b * x, 0.0
    for c in range(3):
        Jx[2, c] = -b * rotation[c, 2]
    return cost, error


@njit(cache=True, nogil=True)
def _prior_cost(  # type: ignore[no-untyped-def]
    rotations, translations, slot, level_from_cam, tilt_sigma, height, height_sigma, H, g
):
    """Add the priors of the free nodes to the normal equations; returns their cost."""
    cost = 0.0
    for n in range(rotations.shape[0]):
        at = slot[n] * 6
        if at < 0:
            continue
        up = rotations[n, 2]
        if math.isfinite(tilt_sigma[n]):
            weight = 1.0 / (tilt_sigma[n] * tilt_sigma[n])
            cross = np.array([[0.0, -up[2], up[1]], [up[2], 0.0, -up[0]], [-up[1], up[0], 0.0]])
            jacobian = level_from_cam[n] @ cross
            tilted = level_from_cam[n] @ up
            for row in range(2):
                cost += weight * tilted[row] * tilted[row]
                for p in range(3):
                    g[at + 3 + p] += weight * jacobian[row, p] * tilted[row]
                    for q in range(3):
                        H[at + 3 + p, at + 3 + q] += weight * jacobian[row, p] * jacobian[row, q]
        if math.isfinite(height_sigma[n]):
            weight = 1.0 / (height_sigma[n] * height_sigma[n])
            error = translations[n, 2] - height[n]
            if abs(error) > 3.0 * height_sigma[n]:  # a drop-out or an echo from elsewhere
                weight *= 3.0 * height_sigma[n] / abs(error)
            cost += weight * error * error
            for p in range(3):
                g[at + p] += weight * up[p] * error
                for q in range(3):
                    H[at + p, at + q] += weight * up[p] * up[q]
    return cost


@njit(cache=True, nogil=True)
def _hold(rotations, slot, anchor, H):  # type: ignore[no-untyped-def]
    """Keep the anchor's x, y and yaw where they are, by a weight beyond all measurements."""
    if anchor < 0 or slot[anchor] < 0:
        return
    at = slot[anchor] * 6
    for axis in range(3):
        offset = at + (3 if axis == 2 else 0)
        for p in range(3):
            for q in range(3):
                H[offset + p, offset + q] += HELD * rotations[anchor, axis, p] * rotations[anchor, axis, q]


@njit(cache=True, nogil=True, fastmath=REORDERED)
def _flatness(point, camera, flatness):  # type: ignore[no-untyped-def]
    """Residual of a point's z against flat ground, in shares of a camera's height; derivatives by both."""
    height = camera[2]
    if flatness == 0.0 or height <= 1e-9:
        return 0.0, 0.0, 0.0
    error = flatness * point[2] / height
    return error, flatness / height, -error / height


@njit(cache=True, nogil=True, fastmath=REORDERED)
def _error(rotations, translations, n, points, m, rays, k):  # type: ignore[no-untyped-def]
    """Inverse depth of point m in camera n, and reprojection error; zero and infinity if not in front."""
    dx = points[m, 0] - translations[n, 0]
    dy = points[m, 1] - translations[n, 1]
    dz = points[m, 2] - translations[n, 2]
    x = rotations[n, 0, 0] * dx + rotations[n, 1, 0] * dy + rotations[n, 2, 0] * dz
    y = rotations[n, 0, 1] * dx + rotations[n, 1, 1] * dy + rotations[n, 2, 1] * dz
    z = rotations[n, 0, 2] * dx + rotations[n, 1, 2] * dy + rotations[n, 2, 2] * dz
    if z <= NEAREST:
        return 0.0, math.inf
    ru, rv = x / z - rays[k, 0], y / z - rays[k, 1]
    return 1.0 / z, math.sqrt(ru * ru + rv * rv)


@njit(cache=True, nogil=True, fastmath=REORDERED)
def _huber(error):  # type: ignore[no-untyped-def]
    """Cost of a residual in standard deviations."""
    return error * error if error <= HUBER else 2.0 * HUBER * error - HUBER * HUBER


@njit(cache=True, nogil=True, fastmath=REORDERED)
def _points_cost(  # type: ignore[no-untyped-def]
    rotations, translations, points, starts, node, rays, weight, inverse_depth, depth_weight, flatness
):
    """Robust cost of all observations and of flat ground; infinite if a point came behind its camera."""
    cost = 0.0
    for m in range(points.shape[0]):
        cost += _flatness(points[m], translations[node[starts[m]]], flatness)[0] ** 2
        for k in range(starts[m], starts[m + 1]):
            inverse, error = _error(rotations, translations, node[k], points, m, rays, k)
            if inverse == 0.0:
                return math.inf
            cost += _huber(error * weight[k])
            if not math.isnan(inverse_depth[k]):
                cost += _huber(abs(inverse - inverse_depth[k]) * depth_weight)
    return cost


@njit(cache=True, nogil=True)
def _total_cost(  # type: ignore[no-untyped-def]
    rotations, translations, slot, points, starts, node, rays, weight, inverse_depth, depth_weight,
    level_from_cam, tilt_sigma, height, height_sigma, flatness,
):  # fmt: skip
    """All that is minimised."""
    size = 6 * (slot.max() + 1)
    priors = _prior_cost(
        rotations, translations, slot, level_from_cam, tilt_sigma, height, height_sigma,
        np.zeros((size, size)), np.zeros(size),
    )  # fmt: skip
    return priors + _points_cost(
        rotations, translations, points, starts, node, rays, weight, inverse_depth, depth_weight, flatness
    )


@njit(cache=True, nogil=True, fastmath=REORDERED)
def _eliminate(  # type: ignore[no-untyped-def]  # noqa: PLR0912
    rotations, translations, slot, points, starts, node, rays, weight, inverse_depth, depth_weight,
    flatness, damping, H, g, V_inverse, Vg, cross,
):  # fmt: skip
    """Build the reduced camera system in g and the upper triangle of H; keep each point's inv(V), gradient
    and cross blocks.
    """
    r, Jp, Jx, V = np.zeros(3), np.zeros((3, 6)), np.zeros((3, 3)), np.zeros((3, 3))
    for m in range(points.shape[0]):
        V[:] = 0.0
        Vg[m] = 0.0
        for k in range(starts[m], starts[m + 1]):
            n = node[k]
            at = slot[n] * 6
            cross[k] = 0.0
            cost, _ = _residuals(
                rotations[n],
                translations[n],
                points[m],
                rays[k],
                inverse_depth[k],
                weight[k],
                depth_weight,
                r,
                Jp,
                Jx,
            )
            if math.isinf(cost):
                continue
            for row in range(2 if math.isnan(inverse_depth[k]) else 3):
                for p in range(3):
                    Vg[m, p] += Jx[row, p] * r[row]
                    for q in range(p, 3):
                        V[p, q] += Jx[row, p] * Jx[row, q]
                if at < 0:
                    continue
                for p in range(6):
                    g[at + p] += Jp[row, p] * r[row]
                    for q in range(p, 6):
                        H[at + p, at + q] += Jp[row, p] * Jp[row, q]
                    for q in range(3):
                        cross[k, p, q] += Jp[row, p] * Jx[row, q]
        first = starts[m]
        error, by_point, by_height = _flatness(points[m], translations[node[first]], flatness)
        V[2, 2] += by_point * by_point
        Vg[m, 2] += by_point * error
        at = slot[node[first]] * 6
        if at >= 0 and by_height != 0.0:
            up = rotations[node[first], 2]
            for p in range(3):
                g[at + p] += by_height * up[p] * error
                cross[first, p, 2] += by_height * up[p] * by_point
                for q in range(p, 3):
                    H[at + p, at + q] += by_height * up[p] * by_height * up[q]
        _invert_symmetric(V, damping, V_inverse[m])
        _subtract_point(slot, node, first, starts[m + 1], cross, V_inverse[m], Vg[m], H, g)


@njit(cache=True, nogil=True, fastmath=REORDERED)
def _invert_symmetric(V, damping, out):  # type: ignore[no-untyped-def]
    """Inverse of the damped V, of which the upper triangle is given, by cofactors."""
    a = V[0, 0] * (1.0 + damping) + 1e-12
    d = V[1, 1] * (1.0 + damping) + 1e-12
    f = V[2, 2] * (1.0 + damping) + 1e-12
    b, c, e = V[0, 1], V[0, 2], V[1, 2]
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (a * aa + b * bb + c * cc)
    out[0, 0], out[1, 1], out[2, 2] = aa * scale, (a * f - c * c) * scale, (a * d - b * b) * scale
    out[0, 1] = out[1, 0] = bb * scale
    out[0, 2] = out[2, 0] = cc * scale
    out[1, 2] = out[2, 1] = (b * c - a * e) * scale


@njit(cache=True, nogil=True, fastmath=REORDERED)
def _subtract_point(slot, node, start, stop, cross, V_inverse, Vg, H, g):  # type: ignore[no-untyped-def]
    """Schur complement: take what one point explains out of the camera system, upper triangle only."""
    WV = np.empty((6, 3))
    for k in range(start, stop):
        at = slot[node[k]] * 6
        if at < 0:
            continue
        for p in range(6):
            c0, c1, c2 = cross[k, p, 0], cross[k, p, 1], cross[k, p, 2]
            for q in range(3):
                WV[p, q] = c0 * V_inverse[0, q] + c1 * V_inverse[1, q] + c2 * V_inverse[2, q]
            g[at + p] -= WV[p, 0] * Vg[0] + WV[p, 1] * Vg[1] + WV[p, 2] * Vg[2]
        for other in range(start, stop):
            to = slot[node[other]] * 6
            if to < at:  # below the diagonal, or a node that stays
                continue
            for p in range(6):
                w0, w1, w2 = WV[p, 0], WV[p, 1], WV[p, 2]
                for q in range(6):
                    H[at + p, to + q] -= (
                        w0 * cross[other, q, 0] + w1 * cross[other, q, 1] + w2 * cross[other, q, 2]
                    )


@njit(cache=True, nogil=True)
def _normal_equations(  # type: ignore[no-untyped-def]
    rotations, translations, slot, points, starts, node, rays, weight, inverse_depth, depth_weight,
    level_from_cam, tilt_sigma, height, height_sigma, flatness, anchor, damping, V_inverse, Vg, cross,
):  # fmt: skip
    """Damped reduced system H step = -g of the free poses; fills V_inverse, Vg and cross of the points."""
    size = 6 * (slot.max() + 1)
    H, g = np.zeros((size, size)), np.zeros(size)
    _prior_cost(rotations, translations, slot, level_from_cam, tilt_sigma, height, height_sigma, H, g)
    _eliminate(
        rotations, translations, slot, points, starts, node, rays, weight, inverse_depth, depth_weight,
        flatness, damping, H, g, V_inverse, Vg, cross,
    )  # fmt: skip
    _hold(rotations, slot, anchor, H)
    for p in range(size):
        for q in range(p):
            H[p, q] = H[q, p]
        H[p, p] += damping * abs(H[p, p]) + 1e-9
    return H, g


@njit(cache=True, nogil=True, fastmath=REORDERED)
def _moved(  # type: ignore[no-untyped-def]
    rotations, translations, slot, points, starts, node, V_inverse, Vg, cross, step
):
    """Poses after the step, and the points, which follow by back-substitution."""
    rotations, translations, points = rotations.copy(), translations.copy(), points.copy()
    for n in range(rotations.shape[0]):
        at = slot[n] * 6
        if at >= 0:
            translations[n] += rotations[n] @ step[at : at + 3]
            rotations[n] = turn_kernel(rotations[n], step[at + 3 : at + 6])
    for m in range(points.shape[0]):
        b0, b1, b2 = Vg[m, 0], Vg[m, 1], Vg[m, 2]
        for k in range(starts[m], starts[m + 1]):
            at = slot[node[k]] * 6
            if at < 0:
                continue
            for p in range(6):
                b0 += cross[k, p, 0] * step[at + p]
                b1 += cross[k, p, 1] * step[at + p]
                b2 += cross[k, p, 2] * step[at + p]
        for p in range(3):
            points[m, p] -= V_inverse[m, p, 0] * b0 + V_inverse[m, p, 1] * b1 + V_inverse[m, p, 2] * b2
    return rotations, translations, points


@njit(cache=True, nogil=True)
def _reprojection_errors(rotations, translations, points, starts, node, rays, weight):  # type: ignore[no-untyped-def]
    """(k,) reprojection errors in standard deviations, infinite behind the camera."""
    found = np.empty(node.shape[0])
    for m in range(points.shape[0]):
        for k in range(starts[m], starts[m + 1]):
            found[k] = _error(rotations, translations, node[k], points, m, rays, k)[1] * weight[k]
    return found


@njit(cache=True, nogil=True)
def adjust_kernel(  # type: ignore[no-untyped-def]
    rotations, translations, slot, points, starts, node, rays, weight, inverse_depth, inverse_depth_sigma,
    level_from_cam, tilt_sigma, height, height_sigma, relief, anchor,
):  # fmt: skip
    """Levenberg-Marquardt; poses, points, residuals, covariances of both, costs before and after."""
    depth_weight = 1.0 / inverse_depth_sigma
    flatness = 0.0 if math.isinf(relief) else 1.0 / relief
    M, K = points.shape[0], node.shape[0]
    V_inverse, Vg, cross = np.zeros((M, 3, 3)), np.zeros((M, 3)), np.zeros((K, 6, 3))
    before = _total_cost(
        rotations, translations, slot, points, starts, node, rays, weight, inverse_depth, depth_weight,
        level_from_cam, tilt_sigma, height, height_sigma, flatness,
    )  # fmt: skip
    cost = before
    damping = 1e-4
    for _ in range(MAX_ITERATIONS):
        H, g = _normal_equations(
            rotations, translations, slot, points, starts, node, rays, weight, inverse_depth, depth_weight,
            level_from_cam, tilt_sigma, height, height_sigma, flatness, anchor, damping, V_inverse, Vg, cross,
        )  # fmt: skip
        step = np.linalg.solve(H, -g)
        new_rotations, new_translations, new_points = _moved(
            rotations, translations, slot, points, starts, node, V_inverse, Vg, cross, step
        )
        new_cost = _total_cost(
            new_rotations, new_translations, slot, new_points, starts, node, rays, weight, inverse_depth,
            depth_weight, level_from_cam, tilt_sigma, height, height_sigma, flatness,
        )  # fmt: skip
        if new_cost < cost:
            gain = (cost - new_cost) / cost
            rotations, translations, points, cost = new_rotations, new_translations, new_points, new_cost
            damping = max(damping * 0.1, 1e-9)
            if gain < ENOUGH:
                break
        else:
            damping *= 10.0
            if damping > 1e3:
                break
    H, _ = _normal_equations(
        rotations, translations, slot, points, starts, node, rays, weight, inverse_depth, depth_weight,
        level_from_cam, tilt_sigma, height, height_sigma, flatness, anchor, 0.0, V_inverse, Vg, cross,
    )  # fmt: skip
    residual = _reprojection_errors(rotations, translations, points, starts, node, rays, weight)
    return rotations, translations, points, residual, np.linalg.inv(H), V_inverse, before, cost
