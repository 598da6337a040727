"""Absolute constraints in a solution that is kept up to date: normal equations by node, taken anew only where
nodes are linearised anew."""

from __future__ import annotations

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.graph.linearise import Freedom
from overfly.graph.pose_graph import PoseGraph
from overfly.graph.prior_kernels import _add_attitude_priors, _add_position_priors, _attitude_errors
from overfly.types import IntArray


class AbsolutePart:
    """blocks (n, d, d), gradients (n, d) and values (n,), chi2, of the absolute constraints on each node,
    where it is linearised; all empty while the graph has none.
    """

    def __init__(self, freedom: Freedom) -> None:
        d = int(freedom)
        self.blocks, self.gradients, self.values = np.zeros((0, d, d)), np.zeros((0, d)), np.zeros(0)
        self._known: list[FloatArray] = [np.zeros((0, 13)), np.zeros((0, 13))]

    def concerns(self, graph: PoseGraph) -> bool:
        """Whether there is, or was, anything to be done here."""
        return graph.n_absolute > 0 or len(self.values) > 0

    def changed(self, graph: PoseGraph) -> IntArray:
        """Nodes whose absolute constraints are not those of the last time."""
        nodes, positions, information = graph.position_priors
        tilted, rotations, tilt_information = graph.attitude_priors
        now = [
            np.column_stack([nodes, positions, information.reshape(-1, 9)]),
            np.column_stack([tilted, rotations.reshape(-1, 9), tilt_information]),
        ]
        concerned = []
        for old, new in zip(self._known, now, strict=True):
            k = min(len(old), len(new))
            differs = (old[:k] != new[:k]).any(axis=1)
            concerned += [old[:k][differs, 0], new[:k][differs, 0], old[k:, 0], new[k:, 0]]
        self._known = now
        return np.unique(np.concatenate(concerned).astype(np.int64))

    def linearise(
        self, graph: PoseGraph, some: IntArray, positions: FloatArray, quaternions: FloatArray
    ) -> None:
        """Those of some nodes, at these poses (n, 3), (n, 4)."""
        nodes, places, information = graph.position_priors
        tilted, rotations, tilt_information = graph.attitude_priors
        more = len(positions) - len(self.values)
        self.blocks, self.gradients, self.values = (
            np.concatenate([of, np.zeros((more, *of.shape[1:]))])
            for of in (self.blocks, self.gradients, self.values)
        )
        for of in (self.blocks, self.gradients, self.values):
            of[some] = 0.0
        is_meant = np.zeros(len(positions), np.bool_)
        is_meant[some] = True
        k, t = is_meant[nodes], is_meant[tilted]
        nodes, places, information = nodes[k], places[k], information[k]
        tilted, rotations, tilt_information = tilted[t], rotations[t], tilt_information[t]
        _add_position_priors(
            positions, quaternions, nodes, places, information, np.ones(len(nodes)), self.blocks,
            self.gradients,
        )  # fmt: skip
        _add_attitude_priors(
            quaternions, tilted, rotations, tilt_information, np.ones(len(tilted)), self.blocks,
            self.gradients,
        )  # fmt: skip
        off = positions[nodes] - places
        np.add.at(self.values, nodes, np.einsum("ka,kab,kb->k", off, information, off))
        errors = _attitude_errors(quaternions, tilted, rotations)
        np.add.at(self.values, tilted, np.sum(errors**2 * tilt_information, axis=1))


def placed_nodes(graph: PoseGraph) -> IntArray:
    """(k,) nodes whose position in the world is known."""
    nodes, _, information = graph.position_priors
    return np.asarray(nodes[information[:, 0, 0] > 0])
