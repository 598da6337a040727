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

from overfly.geometry.poses import FloatArray, Pose, rotation_from_quaternion
from overfly.types import BoolArray, IntArray
from overfly.vision.bundle_kernels import adjust_kernel


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
    rotations, translations, points, residual, covariance, point_covariance, before, after = adjust_kernel(
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
