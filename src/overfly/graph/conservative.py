"""Conservative covariances: propagated along the spanning tree, joined by covariance intersection where
another path arrives.

Whatever the correlation between two estimates of the same pose, Sigma^-1 = w A^-1 + (1 - w) B^-1 is never
overconfident. Source: Tipaldi, Grisetti, Burgard, "Approximate covariance estimation in graphical approaches
to SLAM", IROS 2007; Julier and Uhlmann, "A non-divergent estimation algorithm in the presence of unknown
correlations", ACC 1997. Planar graphs are done with the six numbers of space, the three that do not exist
being very certain.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray
from overfly.graph.pose_graph import Column, PoseGraph
from overfly.graph.quaternions import _conjugate, _matrix_into, _multiply, _quaternion, _rotate
from overfly.types import IntArray

CERTAIN = 1e12  # information about what a planar graph cannot do
LEAST_GAIN = 0.01  # an intersection that does not shrink the volume by this part is not carried on


class ConservativeCovariance:
    """Upper bounds of all marginals, (n, 6, 6), of (translation, rotation vector) on the right; updated
    constraint by constraint.
    """

    def __init__(self, graph: PoseGraph) -> None:
        self._graph = graph
        self._covariances = Column((6, 6))
        self._first = Column(dtype=np.int64)
        self._next = Column((2,), dtype=np.int64)
        self._noise = Column((6, 6))
        self._taken = 0

    def update(self) -> None:
        """Take in the nodes and constraints that the graph has gained. A node without a path to node 0 stays
        unknown (infinite).
        """
        graph = self._graph
        for node in range(len(self._first.view), len(graph)):
            self._covariances.append(np.zeros((6, 6)) if node == 0 else np.full((6, 6), np.inf))
            self._first.append(-1)
        for number in range(self._taken, graph.n_constraints):
            information = graph.information[number].copy()
            if graph.planar:
                information[[2, 3, 4], [2, 3, 4]] = CERTAIN
            scale = np.array(
                [1.0, 1.0, 1.0, 1.0, 1.0, 1.0] if graph.planar else [1.0, 1.0, 1.0, 2.0, 2.0, 2.0]
            )
            self._noise.append(np.linalg.inv(information) * np.outer(scale, scale))
            self._next.append((-1, -1))
            for side, node in enumerate((graph.i[number], graph.j[number])):
                self._next.view[number, side], self._first.view[node] = (
                    self._first.view[node],
                    2 * number + side,
                )
        fresh = np.arange(self._taken, graph.n_constraints)
        self._taken = graph.n_constraints
        _spread(
            graph.positions, graph.quaternions, graph.i, graph.j, graph.states, self._noise.view,
            self._first.view,
            self._next.view, fresh, self._covariances.view,
        )  # fmt: skip

    def recompute(self) -> None:
        """Forget and start again, as after constraints have been voted out."""
        for name in ("_covariances", "_first", "_next", "_noise"):
            setattr(
                self, name, Column(getattr(self, name).view.shape[1:], getattr(self, name).view.dtype.type)
            )
        self._taken = 0
        self.update()

    @property
    def marginals(self) -> FloatArray:
        """(n, 6, 6)."""
        return self._covariances.view

    def marginal(self, node: int) -> FloatArray:
        return np.asarray(self._covariances.view[node].copy())


@njit(cache=True, nogil=True)
def _carried(
    positions: Any,
    quaternions: Any,
    source: int,
    target: int,
    covariance: Any,
    noise: Any,
    noise_at_target: bool,
    A: Any,
) -> Any:
    """Covariance of ``target`` by way of ``source``: the measurement's noise is in the axes of the
    constraint's second node.
    """
    total = covariance if noise_at_target else covariance + noise
    back = _conjugate(_quaternion(quaternions[target]))
    q = _multiply(back, _quaternion(quaternions[source]))
    t = _rotate(
        back,
        (
            positions[source, 0] - positions[target, 0],
            positions[source, 1] - positions[target, 1],
            positions[source, 2] - positions[target, 2],
        ),
    )
    R = np.empty((3, 3))
    _matrix_into(q, R)
    A[:3, :3] = R
    A[3:, 3:] = R
    A[3:, :3] = 0.0
    for c in range(3):
        A[0, 3 + c] = t[1] * R[2, c] - t[2] * R[1, c]
        A[1, 3 + c] = t[2] * R[0, c] - t[0] * R[2, c]
        A[2, 3 + c] = t[0] * R[1, c] - t[1] * R[0, c]
    moved = A @ total @ A.T
    return moved + noise if noise_at_target else moved


@njit(cache=True, nogil=True)
def _log_volume(weight: float, A_inverse: Any, B_inverse: Any) -> float:
    return -float(np.linalg.slogdet(weight * A_inverse + (1.0 - weight) * B_inverse)[1])


@njit(cache=True, nogil=True)
def _intersect(A: Any, B: Any) -> Any:
    """Covariance intersection of least volume (golden section over the weight), and by how much the volume of
    A shrank.
    """
    A_inverse, B_inverse = np.linalg.inv(A), np.linalg.inv(B)
    low, high = 0.0, 1.0
    ratio = 0.6180339887498949
    left, right = high - ratio, low + ratio
    f_left, f_right = _log_volume(left, A_inverse, B_inverse), _log_volume(right, A_inverse, B_inverse)
    for _ in range(12):
        if f_left < f_right:
            high, right, f_right = right, left, f_left
            left = high - ratio * (high - low)
            f_left = _log_volume(left, A_inverse, B_inverse)
        else:
            low, left, f_left = left, right, f_right
            right = low + ratio * (high - low)
            f_right = _log_volume(right, A_inverse, B_inverse)
    weight = 0.5 * (low + high)
    before = _log_volume(1.0, A_inverse, B_inverse)
    gain = before - _log_volume(weight, A_inverse, B_inverse)
    return np.linalg.inv(weight * A_inverse + (1.0 - weight) * B_inverse), gain


@njit(cache=True, nogil=True)
def _spread(
    positions: Any, quaternions: Any, i: Any, j: Any, states: Any, noise: Any, first: Any, following: Any,
    fresh: Any,
    covariances: Any,
) -> None:  # fmt: skip
    """Relax along constraints, breadth first from the fresh ones, until no node becomes noticeably more
    certain.
    """
    n = len(first)
    queue = np.empty(n + 1, np.int64)
    queued = np.zeros(n, np.bool_)
    head, count = 0, 0
    for k in range(len(fresh)):
        for node in (i[fresh[k]], j[fresh[k]]):
            if not queued[node]:
                queue[(head + count) % n] = node
                queued[node] = True
                count += 1
    A = np.empty((6, 6))
    while count > 0:
        node = queue[head % n]
        head, count = head + 1, count - 1
        queued[node] = False
        if not np.isfinite(covariances[node, 0, 0]):
            continue
        entry = first[node]
        while entry >= 0:
            c = entry // 2
            side = entry % 2
            entry = following[c, side]
            other = i[c] if side == 1 else j[c]
            if states[c] != 0 or other == 0:
                continue
            offered = _carried(positions, quaternions, node, other, covariances[node], noise[c], side == 0, A)
            if not np.isfinite(covariances[other, 0, 0]):
                covariances[other] = offered
            else:
                joined, gain = _intersect(covariances[other], offered)
                if gain < LEAST_GAIN:
                    continue
                covariances[other] = joined
            if not queued[other]:
                queue[(head + count) % n] = other
                queued[other] = True
                count += 1


def unknown_nodes(covariance: ConservativeCovariance) -> IntArray:
    """Nodes that no path of active constraints joins to node 0."""
    return np.flatnonzero(~np.isfinite(covariance.marginals[:, 0, 0]))
