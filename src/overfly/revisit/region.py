"""Where the camera may be: footprints on the ground, their spatial index, and how far covariances reach."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import KDTree

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose, skew
from overfly.graph.pose_graph import PoseGraph
from overfly.types import IntArray

REBUILD_SHARE = 0.1  # the tree is rebuilt when this share of the nodes is not in it, or has moved
FEWEST_OUTSIDE = 32


def footprint_radius(camera: Camera, height_m: float) -> float:
    """Radius in metres of the circle around the camera's view of flat ground."""
    corners = np.array([[0.0, 0.0], [camera.width, 0.0], [0.0, camera.height], [camera.width, camera.height]])
    rays = camera.rays_from_pixels(corners)
    return height_m * 0.5 * float(max(np.linalg.norm(rays[3] - rays[0]), np.linalg.norm(rays[2] - rays[1])))


def on_ground(pose: Pose, height_m: float) -> FloatArray:
    """(2,) where the optical axis of world_from_cam meets the ground height_m below, as if the camera hung
    level."""
    return np.asarray(pose.translation[:2] + height_m * pose.rotation[:2, 2])


def ground_sigma(covariance: FloatArray, rotation: FloatArray, height_m: float) -> float:
    """Largest horizontal standard deviation in metres of the middle of the view.

    covariance (6, 6) of (translation, rotation) on the right; rotation (3, 3) takes the camera frame to the
    world's axes.
    """
    arm = np.array([0.0, 0.0, height_m])
    spread = rotation @ np.hstack([np.eye(3), -skew(arm)])
    horizontal = (spread @ covariance @ spread.T)[:2, :2]
    return math.sqrt(max(float(np.linalg.eigvalsh(horizontal)[-1]), 0.0))


class FootprintIndex:
    """Middles of the views of nodes on the ground, searchable by place. Nodes enter in their order.

    The tree holds the places of some time ago; nodes that came later or moved since are looked at one by
    one, and the tree is rebuilt when they become many.
    """

    def __init__(self) -> None:
        self._centres = np.empty((64, 2))
        self._radii = np.empty(64)
        self._sigmas = np.empty(64)
        self._count = 0
        self._tree: KDTree | None = None
        self._n_in_tree = 0
        self._stale = np.zeros(64, np.bool_)  # in the tree, but not where they are

    def __len__(self) -> int:
        return self._count

    def add(self, centre: FloatArray, radius_m: float, sigma_m: float) -> None:
        """Append the next node: middle of its view (2,), radius of its view, standard deviation of its
        place."""
        if self._count == len(self._radii):
            for name in ("_centres", "_radii", "_sigmas", "_stale"):
                old = getattr(self, name)
                grown = np.zeros((2 * len(old), *old.shape[1:]), old.dtype)
                grown[: len(old)] = old
                setattr(self, name, grown)
        n = self._count
        self._centres[n], self._radii[n], self._sigmas[n] = centre, radius_m, sigma_m
        self._count += 1

    def move(self, nodes: IntArray, centres: FloatArray) -> None:
        """Nodes (k,) have new places (k, 2)."""
        here = nodes < self._count
        self._centres[nodes[here]] = centres[here]
        self._stale[nodes[here]] = True

    def within(self, centre: FloatArray, radius_m: float, sigma_m: float, sigmas: float) -> IntArray:
        """Nodes, nearest first, whose views may touch a view of radius_m at centre (2,), both places being
        uncertain.

        sigma_m: of the centre; sigmas: how many of them count. The standard deviation of the difference of
        two places is at most the sum of theirs.
        """
        n = self._count
        if n == 0:
            return np.empty(0, np.int64)
        self._refresh()
        reach = radius_m + self._radii[:n].max() + sigmas * (sigma_m + self._sigmas[:n].max())
        tail = np.concatenate([np.flatnonzero(self._stale[: self._n_in_tree]), np.arange(self._n_in_tree, n)])
        found = tail
        if self._tree is not None:
            inside = np.array(self._tree.query_ball_point(centre, reach), np.int64)
            found = np.concatenate([inside[~self._stale[inside]], tail])
        distance = np.linalg.norm(self._centres[found] - centre, axis=1)
        near = distance < radius_m + self._radii[found] + sigmas * (sigma_m + self._sigmas[found])
        found, distance = found[near], distance[near]
        return np.asarray(found[np.lexsort((found, distance))])

    def _refresh(self) -> None:
        n_outside = self._count - self._n_in_tree + int(self._stale[: self._n_in_tree].sum())
        if n_outside > max(FEWEST_OUTSIDE, REBUILD_SHARE * self._count):
            self._tree = KDTree(self._centres[: self._count])
            self._n_in_tree = self._count
            self._stale[: self._count] = False


def ground_places(graph: PoseGraph, nodes: IntArray, heights_m: FloatArray) -> FloatArray:
    """(k, 2) middles of the views of nodes, heights_m (k,) above their ground."""
    x, y, z, w = graph.quaternions[nodes].T
    axis = np.column_stack([2.0 * (x * z + y * w), 2.0 * (y * z - x * w)])  # the third column of the rotation
    return np.asarray(graph.positions[nodes, :2] + heights_m[:, None] * axis)
