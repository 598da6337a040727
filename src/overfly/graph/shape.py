"""How sure the shape of a map is: what is left of the uncertainty of its poses when the map as a whole may be
moved and turned.

Absolute covariances are relative to what holds the map, mostly its first node, whose own tilt would be
counted as an error of height at the far end. Shape is free of that (inner constraints; Baarda's S
transformation, 1973).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from overfly.geometry.poses import FloatArray, Pose
from overfly.types import IntArray

UNCERTAIN_NODES = 60  # whose ground's height is given a deviation; between them it changes little


@dataclass(frozen=True, slots=True, eq=False)
class ShapeCovariance:
    """How sure some of the nodes of a map are.

    nodes (k,): which; poses (6 k, 6 k): joint covariance of their poses, relative to what holds the map, as
    perturbations of translation (metres) and rotation in their own axes. In the map's own shape: cameras,
    ground (k, 3, 3): covariance, square metres, of the camera's place and of the ground below it, in the axes
    of the node's camera.
    """

    nodes: IntArray
    poses: FloatArray
    cameras: FloatArray
    ground: FloatArray

    def relative(self, pose_of: Callable[[int], Pose], a: int, b: int) -> FloatArray:
        """(6, 6) covariance of the pose of the b-th of the nodes seen from the a-th, as a perturbation on the
        right. pose_of: world_from_cam of a node."""
        from_a = (pose_of(int(self.nodes[b])).inverse() @ pose_of(int(self.nodes[a]))).adjoint()
        rows = np.concatenate([np.arange(6 * a, 6 * a + 6), np.arange(6 * b, 6 * b + 6)])
        by_both = np.hstack([-from_a, np.eye(6)])
        return np.asarray(by_both @ self.poses[np.ix_(rows, rows)] @ by_both.T)

    def of_ground(self, pose_of: Callable[[int], Pose], xy: FloatArray) -> FloatArray:
        """(3, 3) covariance, square metres, world, of the ground at xy (2,), metres: that below the nearest
        node. pose_of: world_from_cam of a node. Zero where nothing is known."""
        if len(self.nodes) == 0:
            return np.zeros((3, 3))
        poses = [pose_of(node) for node in self.nodes.tolist()]
        away = np.array([pose.translation[:2] for pose in poses]) - xy
        nearest = int(np.argmin(np.hypot(away[:, 0], away[:, 1])))
        rotation = poses[nearest].rotation
        return np.asarray(rotation @ self.ground[nearest] @ rotation.T)


def some_of(n: int) -> IntArray:
    """(k,) of n nodes, spread evenly."""
    return np.unique(np.linspace(0, n - 1, UNCERTAIN_NODES).round().astype(np.int64))


def ground_sigma(
    n: int,
    nodes: IntArray,
    rotations: FloatArray,
    translations: FloatArray,
    covariance: FloatArray,
    ground_m: FloatArray,
) -> FloatArray:
    """(n,) deviation of the ground's height below each node of a map.

    nodes (k,): those whose poses, rotations (k, 3, 3) and translations (k, 3), have the covariance (6 k,
    6 k); ground_m (k,): height of the ground below them.
    """
    known = ground_deviations(rotations, translations, covariance, translations[:, 2] - ground_m)
    # where the system does not say, nothing is added to what matching says
    return np.interp(np.arange(n), nodes, np.nan_to_num(known))


def shape_covariance(
    nodes: IntArray,
    rotations: FloatArray,
    translations: FloatArray,
    covariance: FloatArray,
    ground_m: FloatArray,
) -> ShapeCovariance:
    """Arguments as those of :func:`ground_sigma`. Of no nodes where the system does not say, or where there
    are too few for a shape.
    """
    k = len(nodes)
    if k < 3 or not np.isfinite(covariance).all():
        return ShapeCovariance(nodes[:0], np.zeros((0, 0)), np.zeros((0, 3, 3)), np.zeros((0, 3, 3)))
    down = np.column_stack([np.zeros((k, 2)), ground_m - translations[:, 2]])
    across = np.cross(down[:, None, :], np.eye(3)[None, :, :]).transpose(0, 2, 1)  # down x, as a matrix
    by_moving = np.concatenate([rotations, np.zeros((k, 3, 3))], axis=2)
    below = np.concatenate([rotations, -across @ rotations], axis=2)
    found = []
    for places, jacobian in ((translations, by_moving), (translations + down, below)):
        world = np.einsum("iab,ibjd,jcd->iajc", jacobian, covariance.reshape(k, 6, k, 6), jacobian)
        keeps = _keeps_shape(places)
        kept = (keeps @ world.reshape(3 * k, 3 * k) @ keeps.T).reshape(k, 3, k, 3)
        own = kept[np.arange(k), :, np.arange(k)]
        found.append(np.einsum("iba,ibc,icd->iad", rotations, own, rotations))
    return ShapeCovariance(nodes, covariance, found[0], found[1])


def _keeps_shape(places: FloatArray) -> FloatArray:
    """(3 k, 3 k) what takes the motion of the whole out of motions of places (k, 3), the same weight each."""
    k = len(places)
    arm = places - places.mean(axis=0)
    turns = np.cross(np.eye(3)[None, :, :], arm[:, None, :]).transpose(0, 2, 1)  # (k, 3, axis)
    moves = np.concatenate([np.tile(np.eye(3), (k, 1, 1)), turns], axis=2).reshape(3 * k, 6)
    return np.asarray(np.eye(3 * k) - moves @ np.linalg.pinv(moves))


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
    shape = _keeps_shape(translations)
    growth = shape @ (translations - translations.mean(axis=0)).ravel()
    squared = float(growth @ growth)
    height = shape[2::3]
    if squared > 0.0:
        height = height - np.outer(depth_m, growth) / squared
    return np.asarray(np.sqrt(np.maximum(np.einsum("ia,ia->i", height @ world, height), 0.0)))
