"""Bundle adjustment of a few nodes and the points they share, with what the other sensors say.

Minimised over the poses of the free nodes and all points X is the sum of
  Huber(reprojection residual)        each observation, standard deviation sigma
  (1/z - measured inverse depth)^2    where a second camera measured it
  (tilt error)^2                      each node with an attitude measurement
  (height error)^2                    each node with a range measurement
  (X.z / height)^2                    each point, where there is one camera only (flat ground z = 0, softly)
The height in the last is that of the first node that sees the point, so that it does not matter how large
everything is: an absolute one would make the map shrink. It is minimised
by Levenberg-Marquardt over right perturbations (translation, rotation) of world_from_cam; the points are
eliminated by the Schur complement (Triggs et al. 1999, "Bundle adjustment - a modern synthesis", section 6).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray, Pose, rotation_from_quaternion
from overfly.types import BoolArray, IntArray
from overfly.vision.refine import turn_kernel

HUBER = 2.0  # standard deviations from which on a residual counts linearly
MAX_ITERATIONS = 10
HELD = 1e12  # information that holds the anchor
ENOUGH = 1e-4  # relative decrease of the cost below which there is nothing left to gain


@dataclass(frozen=True, slots=True, eq=False)
class BundleProblem:
    """Nodes w, points m, observations k, sorted by point. Arrays:

    rotations (w, 3, 3), translations (w, 3): world_from_cam; free (w,) bool; points (m, 3) world.
    node (k,), point (k,): who sees what; rays (k, 2) undistorted image coordinates; sigma (k,) their standard
    deviation; inverse_depth (k,) 1/m, NaN where not measured; inverse_depth_sigma.
    level_from_cam (w, 3, 3), tilt_sigma (w,) infinite where not measured; height (w,), height_sigma (w,)
    likewise.
    relief: standard deviation of the points' z as a share of the height above them, infinite for none.
    anchor: a free node whose x, y and yaw stay as they are because nothing else holds them, or -1.
    """

    rotations: FloatArray
    translations: FloatArray
    free: BoolArray
    points: FloatArray
    node: IntArray
    point: IntArray
    rays: FloatArray
    sigma: FloatArray
    inverse_depth: FloatArray
    inverse_depth_sigma: float
    level_from_cam: FloatArray
    tilt_sigma: FloatArray
    height: FloatArray
    height_sigma: FloatArray
    relief: float
    anchor: int = -1


@dataclass(frozen=True, slots=True, eq=False)
class BundleSolution:
    """poses: world_from_cam of all nodes; points (m, 3); point_covariance_z (m,) variance of z given the
    poses; pose_covariance (6f, 6f) joint, of the free nodes in order; residual (k,) reprojection error in
    sigmas; cost before, after.
    """

    poses: list[Pose]
    points: FloatArray
    point_covariance: FloatArray
    pose_covariance: FloatArray
    residual: FloatArray
    cost: tuple[float, float]


def adjust(problem: BundleProblem) -> BundleSolution | None:
    """Solve; None when the system is singular from the start."""
    p = problem
    order = np.argsort(p.point, kind="stable")
    starts = np.searchsorted(p.point[order], np.arange(len(p.points) + 1))
    slot = np.full(len(p.rotations), -1)
    slot[p.free] = np.arange(int(p.free.sum()))
    rotations, translations, points, residual, covariance, point_covariance, before, after = _adjust(
        p.rotations.copy(),
        p.translations.copy(),
        slot,
        p.points.copy(),
        starts,
        p.node[order],
        np.ascontiguousarray(p.rays[order]),
        1.0 / p.sigma[order],
        p.inverse_depth[order],
        p.inverse_depth_sigma,
        np.ascontiguousarray(p.level_from_cam),
        p.tilt_sigma,
        p.height,
        p.height_sigma,
        p.relief,
        p.anchor,
    )
    if not math.isfinite(after):
        return None
    unsorted = np.empty_like(residual)
    unsorted[order] = residual
    poses = [
        Pose(rotation_from_quaternion(Pose(rotation, translation).quaternion()), translation)
        for rotation, translation in zip(rotations, translations, strict=True)
    ]
    return BundleSolution(poses, points, point_covariance, covariance, unsorted, (before, after))


@njit(cache=True, nogil=True)
def _residuals(  # type: ignore[no-untyped-def]
    rotation, translation, point, ray, inverse_depth, weight, depth_weight, r, Jp, Jx
):
    """Residuals r (3,) in sigmas, Huber-weighted; Jacobians by pose and point. Returns (cost, error)."""
    dx, dy, dz = point[0] - translation[0], point[1] - translation[1], point[2] - translation[2]
    x = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
    y = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
    z = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
    if z <= 1e-6:
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


@njit(cache=True, nogil=True)
def _flatness(point, camera, flatness):  # type: ignore[no-untyped-def]
    """Residual of a point's z against flat ground, in shares of a camera's height; derivatives by both."""
    height = camera[2]
    if flatness == 0.0 or height <= 1e-9:
        return 0.0, 0.0, 0.0
    error = flatness * point[2] / height
    return error, flatness / height, -error / height


@njit(cache=True, nogil=True)
def _cost(  # type: ignore[no-untyped-def]
    rotations, translations, slot, points, starts, node, rays, weight, inverse_depth, depth_weight,
    level_from_cam, tilt_sigma, height, height_sigma, flatness, size,
):  # fmt: skip
    r, Jp, Jx = np.zeros(3), np.zeros((3, 6)), np.zeros((3, 3))
    cost = _prior_cost(
        rotations, translations, slot, level_from_cam, tilt_sigma, height, height_sigma,
        np.zeros((size, size)), np.zeros(size),
    )  # fmt: skip
    for m in range(points.shape[0]):
        cost += _flatness(points[m], translations[node[starts[m]]], flatness)[0] ** 2
        for k in range(starts[m], starts[m + 1]):
            n = node[k]
            cost += _residuals(
                rotations[n], translations[n], points[m], rays[k], inverse_depth[k], weight[k],
                depth_weight, r, Jp, Jx,
            )[0]  # fmt: skip
    return cost


@njit(cache=True, nogil=True)
def _eliminate(  # type: ignore[no-untyped-def]  # noqa: PLR0912
    rotations, translations, slot, points, starts, node, rays, weight, inverse_depth, depth_weight,
    flatness, damping, H, g, V_inverse, Vg, cross,
):  # fmt: skip
    """Build the reduced camera system in H, g; keep each point's inv(V), its gradient and cross blocks."""
    r, Jp, Jx = np.zeros(3), np.zeros((3, 6)), np.zeros((3, 3))
    for m in range(points.shape[0]):
        V = np.zeros((3, 3))
        b = np.zeros(3)
        for k in range(starts[m], starts[m + 1]):
            n = node[k]
            cost, _ = _residuals(
                rotations[n], translations[n], points[m], rays[k], inverse_depth[k], weight[k],
                depth_weight, r, Jp, Jx,
            )  # fmt: skip
            cross[k] = 0.0
            if math.isinf(cost):
                continue
            for p in range(3):
                for row in range(3):
                    b[p] += Jx[row, p] * r[row]
                for q in range(3):
                    for row in range(3):
                        V[p, q] += Jx[row, p] * Jx[row, q]
            at = slot[n] * 6
            if at < 0:
                continue
            for p in range(6):
                for row in range(3):
                    g[at + p] += Jp[row, p] * r[row]
                for q in range(6):
                    for row in range(3):
                        H[at + p, at + q] += Jp[row, p] * Jp[row, q]
                for q in range(3):
                    for row in range(3):
                        cross[k, p, q] += Jp[row, p] * Jx[row, q]
        first = starts[m]
        error, by_point, by_height = _flatness(points[m], translations[node[first]], flatness)
        V[2, 2] += by_point * by_point
        b[2] += by_point * error
        at = slot[node[first]] * 6
        if at >= 0 and by_height != 0.0:
            up = rotations[node[first], 2]
            for p in range(3):
                g[at + p] += by_height * up[p] * error
                cross[first, p, 2] += by_height * up[p] * by_point
                for q in range(3):
                    H[at + p, at + q] += by_height * up[p] * by_height * up[q]
        for p in range(3):
            V[p, p] = V[p, p] * (1.0 + damping) + 1e-12
        inverse = np.linalg.inv(V)
        V_inverse[m] = inverse
        Vg[m] = b
        for k in range(starts[m], starts[m + 1]):
            at = slot[node[k]] * 6
            if at < 0:
                continue
            WV = cross[k] @ inverse
            for p in range(6):
                g[at + p] -= WV[p, 0] * b[0] + WV[p, 1] * b[1] + WV[p, 2] * b[2]
            for k2 in range(starts[m], starts[m + 1]):
                to = slot[node[k2]] * 6
                if to < 0:
                    continue
                for p in range(6):
                    for q in range(6):
                        H[at + p, to + q] -= (
                            WV[p, 0] * cross[k2, q, 0]
                            + WV[p, 1] * cross[k2, q, 1]
                            + WV[p, 2] * cross[k2, q, 2]
                        )


@njit(cache=True, nogil=True)
def _adjust(  # type: ignore[no-untyped-def]  # noqa: PLR0912
    rotations, translations, slot, points, starts, node, rays, weight, inverse_depth, inverse_depth_sigma,
    level_from_cam, tilt_sigma, height, height_sigma, relief, anchor,
):  # fmt: skip
    size = 6 * (slot.max() + 1)
    depth_weight = 1.0 / inverse_depth_sigma
    flatness = 0.0 if math.isinf(relief) else 1.0 / relief
    M, K = points.shape[0], node.shape[0]
    V_inverse, Vg = np.zeros((M, 3, 3)), np.zeros((M, 3))
    cross = np.zeros((K, 6, 3))
    before = _cost(
        rotations, translations, slot, points, starts, node, rays, weight, inverse_depth, depth_weight,
        level_from_cam, tilt_sigma, height, height_sigma, flatness, size,
    )  # fmt: skip
    cost = before
    damping = 1e-4
    H = np.zeros((size, size))
    for _ in range(MAX_ITERATIONS):
        H[:] = 0.0
        g = np.zeros(size)
        _prior_cost(rotations, translations, slot, level_from_cam, tilt_sigma, height, height_sigma, H, g)
        _eliminate(
            rotations, translations, slot, points, starts, node, rays, weight, inverse_depth, depth_weight,
            flatness, damping, H, g, V_inverse, Vg, cross,
        )  # fmt: skip
        _hold(rotations, slot, anchor, H)
        for p in range(size):
            H[p, p] += damping * abs(H[p, p]) + 1e-9
        step = np.linalg.solve(H, -g)
        new_rotations, new_translations, new_points = rotations.copy(), translations.copy(), points.copy()
        for n in range(rotations.shape[0]):
            at = slot[n] * 6
            if at >= 0:
                new_translations[n] += rotations[n] @ step[at : at + 3]
                new_rotations[n] = turn_kernel(rotations[n], step[at + 3 : at + 6])
        for m in range(M):
            b = Vg[m].copy()
            for k in range(starts[m], starts[m + 1]):
                at = slot[node[k]] * 6
                if at >= 0:
                    b += cross[k].T @ step[at : at + 6]
            new_points[m] -= V_inverse[m] @ b
        new_cost = _cost(
            new_rotations, new_translations, slot, new_points, starts, node, rays, weight, inverse_depth,
            depth_weight, level_from_cam, tilt_sigma, height, height_sigma, flatness, size,
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
    H[:] = 0.0
    g = np.zeros(size)
    _prior_cost(rotations, translations, slot, level_from_cam, tilt_sigma, height, height_sigma, H, g)
    _eliminate(
        rotations, translations, slot, points, starts, node, rays, weight, inverse_depth, depth_weight,
        flatness, 0.0, H, g, V_inverse, Vg, cross,
    )  # fmt: skip
    _hold(rotations, slot, anchor, H)
    for p in range(size):
        H[p, p] += 1e-9
    covariance = np.linalg.inv(H)
    residual = np.zeros(K)
    r, Jp, Jx = np.zeros(3), np.zeros((3, 6)), np.zeros((3, 3))
    for m in range(M):
        for k in range(starts[m], starts[m + 1]):
            n = node[k]
            residual[k] = _residuals(
                rotations[n], translations[n], points[m], rays[k], inverse_depth[k], weight[k],
                depth_weight, r, Jp, Jx,
            )[1]  # fmt: skip
    return rotations, translations, points, residual, covariance, V_inverse, before, cost
