"""What other sensors say of the poses of a map, and the unknowns that all of it has in common:

bias    the attitude sensor's constant tilt error, about x and y, radians
size    logarithm of how much longer the map's ways are than relative poses have them
level   how much too high positions are, metres: the map's zero is the ground
faults  of the gyroscope, where there is one, as in points_turns.py
"""

from __future__ import annotations

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.graph.points_problem import PointProblem
from overfly.graph.points_turns import FAULT_SIGMAS, N_FAULTS

HELD = 1e12  # information that holds the anchors, and what is not to be found
HEIGHT_OUTLIER = 3.0  # standard deviations from which on a height counts linearly: an echo from elsewhere
BIAS, SIZE, LEVEL, FAULTS = slice(0, 2), 2, 3, slice(4, 4 + N_FAULTS)


def prior_cost(
    problem: PointProblem, rotations: FloatArray, translations: FloatArray, common: FloatArray
) -> float:
    """Of poses world_from_cam, rotations (n, 3, 3) and translations (n, 3), and the unknowns common."""
    tilt = _tilt(problem, rotations)[0] - common[BIAS]
    cost = float(np.sum((tilt / problem.tilt_sigma[:, None]) ** 2))
    error_z = np.abs(translations[:, 2] - problem.height) / problem.height_sigma
    far = error_z > HEIGHT_OUTLIER
    cost += float(np.sum(np.where(far, HEIGHT_OUTLIER * (2.0 * error_z - HEIGHT_OUTLIER), error_z**2)))
    cost += float(np.sum((_position_errors(problem, translations, common) / problem.position_sigma) ** 2))
    return cost + float(np.sum(_information(problem) * common**2))


def add_priors(
    problem: PointProblem, rotations: FloatArray, translations: FloatArray, common: FloatArray,
    diagonal: FloatArray, gradient: FloatArray, border: FloatArray, corner: FloatArray,
    corner_gradient: FloatArray,
) -> None:  # fmt: skip
    """Add to the normal equations, of which border (n, 6, 4 or more), corner and its gradient begin with the
    common unknowns; also what holds the anchors."""
    R, own = rotations, np.arange(len(common))
    information = _information(problem)
    corner[own, own] += information
    corner_gradient[own] += information * common
    tilt, by_turn = _tilt(problem, R)
    tilt = tilt - common[BIAS]
    weight = problem.tilt_sigma**-2.0
    border[:, 3:, BIAS] -= np.einsum("nrp,n->npr", by_turn, weight)
    corner[BIAS, BIAS] += np.eye(2) * weight.sum()
    corner_gradient[BIAS] -= weight @ tilt
    diagonal[:, 3:, 3:] += np.einsum("nrp,nrq,n->npq", by_turn, by_turn, weight)
    gradient[:, 3:] += np.einsum("nrp,nr,n->np", by_turn, tilt, weight)
    error = translations[:, 2] - problem.height
    off = np.maximum(np.abs(error) / problem.height_sigma, HEIGHT_OUTLIER)
    weight = problem.height_sigma**-2.0 * HEIGHT_OUTLIER / off
    diagonal[:, :3, :3] += np.einsum("np,nq,n->npq", R[:, 2], R[:, 2], weight)
    gradient[:, :3] += R[:, 2] * (weight * error)[:, None]
    weights = problem.position_sigma**-2.0
    error = _position_errors(problem, translations, common)
    diagonal[:, :3, :3] += np.einsum("nrp,nrq,nr->npq", R, R, weights)
    gradient[:, :3] += np.einsum("nrp,nr->np", R, weights * error)
    border[:, :3, LEVEL] += R[:, 2] * weights[:, 2:]
    corner[LEVEL, LEVEL] += weights[:, 2].sum()
    corner_gradient[LEVEL] += weights[:, 2] @ error[:, 2]
    for n in np.flatnonzero(problem.anchors):
        diagonal[n, :3, :3] += HELD * R[n, :2].T @ R[n, :2]
        diagonal[n, 3:, 3:] += HELD * np.outer(R[n, 2], R[n, 2])


def _information(problem: PointProblem) -> FloatArray:
    """Of the common unknowns, expected at zero; one without a deviation stays there."""
    sigma = np.array([problem.tilt_bias_sigma] * 2 + [problem.size_sigma, problem.level_sigma])
    if problem.turns is not None:
        sigma = np.append(sigma, FAULT_SIGMAS)
    return np.where(sigma > 0.0, np.maximum(sigma, HELD**-0.5) ** -2.0, HELD)


def _position_errors(problem: PointProblem, translations: FloatArray, common: FloatArray) -> FloatArray:
    """(n, 3) metres."""
    error = translations - problem.position
    error[:, 2] += common[LEVEL]
    return error


def _tilt(problem: PointProblem, rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Tilt against the sensor (n, 2), radians, and its derivative (n, 2, 3) by a right rotation."""
    up = rotations[:, 2]
    turned = np.zeros((len(up), 3, 3))
    turned[:, 0, 1], turned[:, 0, 2], turned[:, 1, 2] = -up[:, 2], up[:, 1], -up[:, 0]
    turned -= turned.transpose(0, 2, 1)
    level = problem.level_from_cam
    return np.einsum("nij,nj->ni", level, up)[:, :2], (level @ turned)[:, :2]
