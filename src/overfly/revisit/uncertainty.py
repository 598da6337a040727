"""How well the graph knows where nodes are against each other, and whether a new constraint fits that."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chdtri

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.covariance import tangent_covariance
from overfly.graph.online import OnlineOptimiser
from overfly.graph.pose_graph import PoseGraph
from overfly.types import Constraint


class Uncertainty:
    """Covariances (6, 6) of (translation, rotation), applied on the right, of the poses of a graph whose
    node 0 is held."""

    def __init__(self, graph: PoseGraph, optimiser: OnlineOptimiser) -> None:
        self._graph = graph
        self._optimiser = optimiser
        self._known: dict[tuple[int, int], FloatArray] = {}  # relative covariances since the last refresh

    def refresh(self) -> None:
        """The graph has changed: nothing known of it holds any more."""
        self._known.clear()

    def place(self, node: int) -> FloatArray:
        """Of world_from_node; the first node holds the world."""
        return np.zeros((6, 6)) if node == 0 else self._optimiser.covariance(node)

    def relative(self, i: int, j: int) -> FloatArray:
        """Of i_from_j."""
        if (i, j) not in self._known:
            self._known[i, j] = self._relative(i, j)
        return self._known[i, j]

    def _relative(self, i: int, j: int) -> FloatArray:
        if i == j:
            return np.zeros((6, 6))
        if i == 0:
            return self.place(j)
        if j == 0:
            carry = (self._graph.pose(0).inverse() @ self._graph.pose(i)).adjoint()
            return np.asarray(carry @ self.place(i) @ carry.T)
        return self._optimiser.relative_covariance(i, j)

    def innovation(self, constraint: Constraint) -> float:
        """Squared Mahalanobis distance of a measurement from the estimate."""
        i, j = constraint.i, constraint.j
        predicted = self._graph.pose(i).inverse() @ self._graph.pose(j)
        covariance = self.relative(i, j) + tangent_covariance(constraint.information, False)
        return _squared_distance(constraint.i_from_j, predicted, covariance)

    def disagreement(self, a: Constraint, b: Constraint) -> float:
        """Squared Mahalanobis distance of what is left over around the loop i_a, j_a, j_b, i_b (Mangelsson
        et al. 2018)."""
        graph = self._graph
        ib_from_ia = graph.pose(b.i).inverse() @ graph.pose(a.i)
        ja_from_jb = graph.pose(a.j).inverse() @ graph.pose(b.j)
        predicted = ib_from_ia @ a.i_from_j @ ja_from_jb
        through_a = ja_from_jb.inverse().adjoint()
        through_i = (predicted.inverse() @ ib_from_ia).adjoint()
        covariance = (
            tangent_covariance(b.information, False)
            + through_a @ tangent_covariance(a.information, False) @ through_a.T
            + self.relative(a.j, b.j)
            + through_i @ self.relative(b.i, a.i) @ through_i.T
        )
        return _squared_distance(b.i_from_j, predicted, covariance)

    def gain(self, constraint: Constraint) -> float:
        """How many times better the constraint knows the direction that it teaches the map most about."""
        measured = tangent_covariance(constraint.information, False)
        known = self.relative(constraint.i, constraint.j)
        ratio = np.linalg.eigvals(np.linalg.solve(measured, known)).real.max()
        return float(np.sqrt(max(ratio, 0.0)))


def region_bound(sigmas: float) -> float:
    """Squared Mahalanobis distance in six dimensions within which a normal variable is as often as within
    +-sigmas in one."""
    return float(chdtri(6, math.erfc(sigmas / math.sqrt(2.0))))


def _squared_distance(measured: Pose, predicted: Pose, covariance: FloatArray) -> float:
    residual = (measured.inverse() @ predicted).log()
    return float(residual @ np.linalg.solve(covariance, residual))


def pixel_sigmas(points_in_cam: FloatArray, covariance: FloatArray, camera: Camera) -> FloatArray:
    """(n,) largest standard deviation in pixels of where points (n, 3), metres, in the camera frame, are
    seen.

    covariance (6, 6) of the camera's pose against the points. NaN for points behind the camera.
    """
    x, y, z = points_in_cam.T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v, inverse = x / z, y / z, np.where(z > 0, 1.0 / z, np.nan)
    zero = np.zeros_like(u)
    Ju = np.array([-inverse, zero, u * inverse, u * v, -(1.0 + u * u), v])
    Jv = np.array([zero, -inverse, v * inverse, 1.0 + v * v, -u * v, -u])
    uu, uv, vv = (
        (Ju * (covariance @ Ju)).sum(0),
        (Ju * (covariance @ Jv)).sum(0),
        (Jv * (covariance @ Jv)).sum(0),
    )
    largest = 0.5 * (uu + vv) + np.hypot(0.5 * (uu - vv), uv)
    return np.asarray(camera.focal_px * np.sqrt(np.maximum(largest, 0.0)))
