"""How sure the shape of a map is: what is left of the uncertainty of its poses when the map as a whole may be
moved and turned.

Absolute covariances are relative to what holds the map, mostly its first node, whose own tilt would be
counted as an error of height at the far end. Shape is free of that (inner constraints; Baarda's S
transformation, 1973).
"""

from __future__ import annotations

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.graph.points_problem import PointSolution
from overfly.types import IntArray

UNCERTAIN_NODES = 60  # whose ground's height is given a deviation; between them it changes little


def some_of(n: int) -> IntArray:
    """(k,) of n nodes, spread evenly."""
    return np.unique(np.linspace(0, n - 1, UNCERTAIN_NODES).round().astype(np.int64))


def ground_sigma(
    n: int, nodes: IntArray, some: IntArray, solution: PointSolution, ground_m: FloatArray
) -> FloatArray:
    """(n,) deviation of the ground's height below each node of a map.

    nodes (m,): that were adjusted; some (k,): of these, whose covariance the solution has; ground_m (m,):
    height of the ground below them.
    """
    depth_m = solution.translations[some, 2] - ground_m[some]
    known = ground_deviations(
        solution.rotations[some], solution.translations[some], solution.pose_covariance, depth_m
    )
    # where the system does not say, nothing is added to what matching says
    return np.interp(np.arange(n), nodes[some], np.nan_to_num(known))


def ground_deviations(
    rotations: FloatArray, translations: FloatArray, covariance: FloatArray, depth_m: FloatArray
) -> FloatArray:
    """(k,) standard deviations, metres, of the ground's height under k cameras.

    rotations (k, 3, 3), translations (k, 3): world_from_cam. covariance (6 k, 6 k): of their translations and
    rotations in their own axes. depth_m (k,): of the ground below each. The ground is off by as much as its
    camera, and by its depth times what the size of the map is off by.
    """
    k = len(translations)
    if k < 3:
        return np.zeros(k)
    own_axes = covariance.reshape(k, 6, k, 6)[:, :3, :, :3]
    world = np.einsum("iab,ibjc,jdc->iajd", rotations, own_axes, rotations).reshape(3 * k, 3 * k)
    arm = translations - translations.mean(axis=0)
    turns = np.cross(np.eye(3)[None, :, :], arm[:, None, :]).transpose(0, 2, 1)  # (k, 3, axis)
    moves = np.concatenate([np.tile(np.eye(3), (k, 1, 1)), turns], axis=2).reshape(3 * k, 6)
    shape = np.eye(3 * k) - moves @ np.linalg.pinv(moves)
    growth = shape @ arm.ravel()
    squared = float(growth @ growth)
    height = shape[2::3]
    if squared > 0.0:
        height = height - np.outer(depth_m, growth) / squared
    return np.asarray(np.sqrt(np.maximum(np.einsum("ia,ia->i", height @ world, height), 0.0)))
