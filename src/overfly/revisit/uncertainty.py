"""How well the graph knows where nodes are against each other, and whether a new constraint fits that."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit
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
        # Since the last refresh: relative covariances, and poses.
        self._known: dict[tuple[int, int], FloatArray] = {}
        self._poses: dict[int, Pose] = {}

    def refresh(self) -> None:
        """The graph has changed: nothing known of it holds any more."""
        self._known.clear()
        self._poses.clear()

    def _pose(self, node: int) -> Pose:
        if node not in self._poses:
            self._poses[node] = self._graph.pose(node)
        return self._poses[node]

    def place(self, node: int) -> FloatArray:
        """Of world_from_node; the first node holds the world."""
        if (node, node) not in self._known:
            known = np.zeros((6, 6)) if node == 0 else self._optimiser.covariance(node)
            self._known[node, node] = known
        return self._known[node, node]

    def relative(self, i: int, j: int) -> FloatArray:
        """Of i_from_j."""
        return np.zeros((6, 6)) if i == j else self.relatives([i], j)[0]

    def relatives(self, nodes: Sequence[int], j: int) -> list[FloatArray]:
        """Of i_from_j for each of some nodes i, none of them j; those not known yet are asked for at once."""
        new = sorted({i for i in nodes if (i, j) not in self._known})
        if new:
            self._known.update(
                ((i, j), known)
                for i, known in zip(new, self._optimiser.relative_covariances(new, j), strict=True)
            )
        return [self._known[i, j] for i in nodes]

    def _reversed(self, i: int, j: int) -> FloatArray:
        """Of i_from_j, by that of j_from_i."""
        if i == j:
            return np.zeros((6, 6))
        carry = (self._pose(j).inverse() @ self._pose(i)).adjoint()
        return np.asarray(carry @ self.relative(j, i) @ carry.T)

    def innovation(self, constraint: Constraint) -> float:
        """Squared Mahalanobis distance of a measurement from the estimate."""
        i, j = constraint.i, constraint.j
        predicted = self._pose(i).inverse() @ self._pose(j)
        covariance = self.relative(i, j) + tangent_covariance(constraint.information, False)
        return _squared_distance(constraint.i_from_j, predicted, covariance)

    def disagreements(self, several: Sequence[Constraint], b: Constraint) -> list[float]:
        """Disagreement of each with b."""
        self.relatives([a.j for a in several if a.j != b.j], b.j)
        self.relatives([a.i for a in several if a.i != b.i], b.i)
        return [self.disagreement(a, b) for a in several]

    def disagreement(self, a: Constraint, b: Constraint) -> float:
        """Squared Mahalanobis distance of what is left over around the loop i_a, j_a, j_b, i_b (Mangelsson
        et al. 2018)."""
        ib_from_ia = self._pose(b.i).inverse() @ self._pose(a.i)
        ja_from_jb = self._pose(a.j).inverse() @ self._pose(b.j)
        predicted = ib_from_ia @ a.i_from_j @ ja_from_jb
        through_a = ja_from_jb.inverse().adjoint()
        through_i = (predicted.inverse() @ ib_from_ia).adjoint()
        covariance = (
            tangent_covariance(b.information, False)
            + through_a @ tangent_covariance(a.information, False) @ through_a.T
            + self.relative(a.j, b.j)
            + through_i @ self._reversed(b.i, a.i) @ through_i.T
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
    points = np.ascontiguousarray(points_in_cam, np.float64)
    return np.asarray(camera.focal_px * _image_sigmas(points, np.ascontiguousarray(covariance)))


@njit(cache=True, nogil=True)
def _image_sigmas(points, covariance):  # type: ignore[no-untyped-def]
    """The same in units of the focal length: the larger axis of J covariance J^T, point by point."""
    sigmas = np.full(len(points), np.nan)
    for k in range(len(points)):
        x, y, z = points[k]
        if not z > 0.0:
            continue
        u, v, w = x / z, y / z, 1.0 / z
        ju = (-w, 0.0, u * w, u * v, -(1.0 + u * u), v)
        jv = (0.0, -w, v * w, 1.0 + v * v, -u * v, -u)
        uu, uv, vv = 0.0, 0.0, 0.0
        for p in range(6):
            cu, cv = 0.0, 0.0
            for q in range(6):
                cu += covariance[p, q] * ju[q]
                cv += covariance[p, q] * jv[q]
            uu, uv, vv = uu + ju[p] * cu, uv + ju[p] * cv, vv + jv[p] * cv
        half = 0.5 * (uu - vv)
        largest = 0.5 * (uu + vv) + math.sqrt(half * half + uv * uv)
        sigmas[k] = math.sqrt(max(largest, 0.0))
    return sigmas
