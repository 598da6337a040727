"""Relative poses as measurements beside the points: what odometry and places seen again say of two poses.

Where points are many they say next to nothing, since what slow errors odometry may have is in their
covariances. Over ground that shows little they are what is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from overfly.geometry.poses import FloatArray
from overfly.graph.covariance import tangent_information
from overfly.graph.pose_graph import KINDS, PoseGraph
from overfly.types import BoolArray, ConstraintKind, IntArray

# Not where dead reckoning or GPS put a piece of the map.
TIES = [
    KINDS.index(kind) for kind in (ConstraintKind.ODOMETRY, ConstraintKind.REVISIT, ConstraintKind.BRIDGE)
]

OUTLIER = 4.0  # standard deviations from which on one counts linearly


@dataclass(frozen=True, slots=True, eq=False)
class RelativePoses:
    """Measured i_from_j, c of them: i (c,) and j (c,) of the poses; rotations (c, 3, 3), translations (c, 3)
    metres, information (c, 6, 6) of (translation, rotation vector) applied on the right.
    """

    i: IntArray
    j: IntArray
    rotations: FloatArray
    translations: FloatArray
    information: FloatArray

    def __len__(self) -> int:
        return len(self.i)

    def pairs(self) -> IntArray:
        """(c,) keys low * 2^32 + high of both poses, as those of points_kernels."""
        return (np.minimum(self.i, self.j) << 32) | np.maximum(self.i, self.j)

    def cost(self, rotations: FloatArray, translations: FloatArray, log_size: float) -> float:
        """Of poses world_from_cam, rotations (n, 3, 3) and translations (n, 3), in a map that is larger than
        it was measured in."""
        length = np.sqrt(self.squares(rotations, translations, log_size))
        return float(np.sum(np.where(length > OUTLIER, OUTLIER * (2.0 * length - OUTLIER), length**2)))

    def squares(self, rotations: FloatArray, translations: FloatArray, log_size: float) -> FloatArray:
        """(c,) squared errors of poses, in units of the covariances."""
        return self._squares(self._errors(rotations, translations, log_size)[0])

    def add_to(
        self, rotations: FloatArray, translations: FloatArray, log_size: float, pair: IntArray,
        diagonal: FloatArray, off_diagonal: FloatArray, gradient: FloatArray,
        by_size: FloatArray, size_information: FloatArray, size_gradient: FloatArray,
    ) -> None:  # fmt: skip
        """Add to the normal equations; pair (c,): which off-diagonal block, lower pose first, takes each;
        by_size (n, 6): blocks of poses and size; those of the size itself are the first entries."""
        error, by_i, by_j, of_size = self._errors(rotations, translations, log_size)
        length = np.sqrt(self._squares(error))
        weight = np.minimum(1.0, OUTLIER / np.maximum(length, 1e-9))
        information = self.information * weight[:, None, None]
        i_information = np.einsum("cpi,cpq->ciq", by_i, information)
        j_information = by_j[:, :, None] * information
        size_row = np.einsum("cp,cpq->cq", of_size, information)
        np.add.at(diagonal, self.i, i_information @ by_i)
        np.add.at(diagonal, self.j, j_information * by_j[:, None, :])
        np.add.at(gradient, self.i, np.einsum("ciq,cq->ci", i_information, error))
        np.add.at(gradient, self.j, np.einsum("cpq,cq->cp", j_information, error))
        np.add.at(by_size, self.i, np.einsum("cq,cqi->ci", size_row, by_i))
        np.add.at(by_size, self.j, size_row * by_j)
        size_information[0] += np.sum(size_row * of_size)
        size_gradient[0] += np.sum(size_row * error)
        low_first = (self.i < self.j)[:, None, None]
        mixed = i_information * by_j[:, None, :]
        np.add.at(off_diagonal, pair, np.where(low_first, mixed, mixed.transpose(0, 2, 1)))

    def _squares(self, error: FloatArray) -> FloatArray:
        return np.asarray(np.maximum(np.einsum("cp,cpq,cq->c", error, self.information, error), 0.0))

    def _errors(
        self, rotations: FloatArray, translations: FloatArray, log_size: float
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """(c, 6) errors, translation and rotation vector, in lengths as they were measured; their derivatives
        (c, 6, 6) by pose i, (c, 6) by pose j, which are diagonal, but for what errors are not small, and
        (c, 6) by the logarithm of the size."""
        Ri, Rj = rotations[self.i], rotations[self.j]
        shrink = np.exp(-log_size)
        apart = shrink * np.einsum("cji,cj->ci", Ri, translations[self.j] - translations[self.i])
        i_from_j = np.einsum("cji,cjk->cik", Ri, Rj)
        turn = np.einsum("cji,cjk->cik", self.rotations, i_from_j)
        shift = np.einsum("cji,cj->ci", i_from_j, apart - self.translations)
        error = np.concatenate([shift, Rotation.from_matrix(turn).as_rotvec()], axis=1)
        # x_j = -Ad(j_from_i) x_i
        j_from_i = i_from_j.transpose(0, 2, 1)
        back = -np.einsum("cij,cj->ci", j_from_i, apart)
        by_i, by_j, by_size = np.zeros((len(self), 6, 6)), np.ones((len(self), 6)), np.zeros((len(self), 6))
        by_i[:, :3, :3], by_i[:, 3:, 3:] = -shrink * j_from_i, -j_from_i
        by_i[:, :3, 3:] = -_cross(back) @ j_from_i
        by_j[:, :3] = shrink
        by_size[:, :3] = back
        return error, by_i, by_j, by_size


def tied_nodes(graph: PoseGraph) -> IntArray:
    """Nodes that constraints say something about."""
    ties = _ties(graph)
    return np.unique(np.concatenate([graph.i[ties], graph.j[ties]]))


def relative_poses(graph: PoseGraph, nodes: IntArray) -> RelativePoses:
    """What constraints say, with places in nodes (n,), sorted, among which all tied ones are.

    They count with the cautious covariances that they were entered with, however exact odometry turns out to
    be: it was made of some of the same points.
    """
    return _measured(graph, nodes, _ties(graph))


def left_by_odometry(graph: PoseGraph) -> float:
    """Mean square of what odometry's constraints differ from the poses by, per degree of freedom, in units of
    their covariances; 0 without any."""
    active = graph.active
    odometry = np.asarray(active[graph.kinds[active] == KINDS.index(ConstraintKind.ODOMETRY)])
    if len(odometry) == 0:
        return 0.0
    rotations = Rotation.from_quat(graph.quaternions).as_matrix()
    squares = _measured(graph, np.arange(len(graph)), odometry).squares(rotations, graph.positions, 0.0)
    return float(np.mean(squares)) / 6.0


def _measured(graph: PoseGraph, nodes: IntArray, constraints: IntArray) -> RelativePoses:
    return RelativePoses(
        np.searchsorted(nodes, graph.i[constraints]),
        np.searchsorted(nodes, graph.j[constraints]),
        Rotation.from_quat(graph.measured_quaternions[constraints]).as_matrix(),
        graph.measured_positions[constraints],
        tangent_information(graph.information[constraints], graph.planar),
    )


def parts(n_nodes: int, node: IntArray, point: IntArray, relative: RelativePoses | None) -> IntArray:
    """(n_nodes,) number of the part of the map that hangs together by points, node (k,) seeing point (k,), or
    relative poses.
    """
    ones, others = node, n_nodes + point
    if relative is not None:
        ones, others = np.concatenate([ones, relative.i]), np.concatenate([others, relative.j])
    size = n_nodes + int(point.max()) + 1
    links = coo_array((np.ones(len(ones), np.int8), (ones, others)), shape=(size, size))
    return np.asarray(connected_components(links, directed=False)[1][:n_nodes], np.int64)


def anchors(part: IntArray, placed: BoolArray) -> BoolArray:
    """(n,) nodes whose x, y and yaw are held: the oldest of each part (n,) of the map, unless two of its
    nodes are placed (n,).
    """
    held = np.zeros(len(part), np.bool_)
    for label in np.unique(part):
        members = np.flatnonzero(part == label)
        held[members[0]] = placed[members].sum() < 2
    return held


def _ties(graph: PoseGraph) -> IntArray:
    active = graph.active
    return np.asarray(active[np.isin(graph.kinds[active], TIES)])


def _cross(v: FloatArray) -> FloatArray:
    """(c, 3, 3) matrices of the cross product with v (c, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return out - out.transpose(0, 2, 1)
