"""Covariances of nodes from the sparse factor: exact to first order, for single nodes, pairs, or all nodes at
once.

All (6, 6), of (translation, rotation vector) applied on the right, in the node's own axes, as in
types.PoseEstimate. Nodes newer than the factor hang on it by a chain of constraints and get the chain's
covariance on top.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.cholesky import Factor
from overfly.graph.chordal import rotation_matrices
from overfly.graph.front_tree import FrontTree
from overfly.graph.linearise import Freedom
from overfly.graph.pose_graph import PoseGraph
from overfly.graph.robust import PLAIN, Robust
from overfly.graph.sparse import Pattern, factor_now, find_pattern
from overfly.graph.steps import Steps
from overfly.types import BoolArray, Constraint, IntArray

# error (translation, vector part of the quaternion) -> (translation, rotation vector)
ERROR_SCALE = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])


def tangent_information(information: FloatArray, planar: bool) -> FloatArray:
    """(..., 6, 6) information of a constraint's error -> that of (translation, rotation vector)."""
    return information if planar else information / np.outer(ERROR_SCALE, ERROR_SCALE)


def tangent_covariance(information: FloatArray, planar: bool) -> FloatArray:
    """(6, 6) covariance of a measurement as a right perturbation; directions it does not measure get zero if
    planar.
    """
    if planar:
        covariance = np.zeros_like(information)
        places = np.ix_([0, 1, 5], [0, 1, 5])
        covariance[places] = np.linalg.inv(information[places])
        return covariance
    return np.asarray(np.linalg.inv(tangent_information(information, planar)))


class ExactCovariance:
    """Marginals of the graph as it was when ``factor`` was made; later nodes are attached with
    :meth:`extend`.
    """

    def __init__(
        self, graph: PoseGraph, freedom: Freedom, factor: Factor | FrontTree, fixed: BoolArray
    ) -> None:
        """fixed (n,): nodes that hold the frame, whose covariance is zero."""
        self._graph = graph
        self._n_factored = factor.n_nodes
        self._fixed = fixed
        self._freedom = freedom
        self._factor = factor
        self._ties: list[Constraint] = []  # of the nodes newer than the factor, to older ones
        self._chains: list[tuple[int, FloatArray]] = []  # what follows from the first of these

    def __len__(self) -> int:
        """Nodes whose covariance is known."""
        return self._n_factored + len(self._ties)

    def extend(self, constraint: Constraint) -> None:
        """Attach the node ``len(self)`` by the constraint that ties it to an older one."""
        assert max(constraint.i, constraint.j) == len(self)
        self._ties.append(constraint)

    def _hold(self, node: int) -> tuple[int, FloatArray]:
        """The node in the factor that this one hangs on, and the covariance of the chain between them."""
        n = self._n_factored
        if node < n:
            return node, np.zeros((6, 6))
        for tie in self._ties[len(self._chains) : node - n + 1]:
            self._chains.append(self._chain(tie))
        return self._chains[node - n]

    def _chain(self, tie: Constraint) -> tuple[int, FloatArray]:
        old, new = min(tie.i, tie.j), max(tie.i, tie.j)
        covariance = tangent_covariance(tie.information, self._graph.planar)
        if tie.i == new:
            back = tie.i_from_j.adjoint()
            covariance = back @ covariance @ back.T
        anchor, chain = self._hold(old)
        carry = self._carry(old, new)
        return anchor, carry @ chain @ carry.T + covariance

    def _carry(self, source: int, target: int) -> FloatArray:
        """Takes a perturbation of ``source`` to that of ``target`` rigidly joined to it."""
        if source == target:
            return np.eye(6)
        return (self._graph.pose(target).inverse() @ self._graph.pose(source)).adjoint()

    def joint(self, i: int, j: int) -> FloatArray:
        """(12, 12) covariance of both nodes."""
        (anchor_i, chain_i), (anchor_j, chain_j) = self._hold(i), self._hold(j)
        carry = np.zeros((12, 12))
        carry[:6, :6], carry[6:, 6:] = self._carry(anchor_i, i), self._carry(anchor_j, j)
        covariance = carry @ self._from_factor(anchor_i, anchor_j) @ carry.T
        covariance[:6, :6] += chain_i
        covariance[6:, 6:] += chain_j
        return np.asarray(covariance)

    def marginal(self, node: int) -> FloatArray:
        """(6, 6) covariance of a node in the frame the graph is held in."""
        anchor, chain = self._hold(node)
        carry = self._carry(anchor, node)
        return np.asarray(carry @ self._from_factor(anchor) @ carry.T + chain)

    def relative(self, i: int, j: int) -> FloatArray:
        """(6, 6) covariance of X_i^-1 X_j as a right perturbation."""
        return np.asarray(self.relatives([i], j)[0])

    def relatives(self, nodes: Sequence[int], j: int) -> FloatArray:
        """(k, 6, 6) the same for several nodes i and one j, which costs little more than one of them."""
        holds = [self._hold(i) for i in nodes]
        anchor_j, chain_j = self._hold(j)
        k = len(nodes)
        known = self._from_factor(*(anchor for anchor, _ in holds), anchor_j)
        blocks = known.reshape(k + 1, 6, k + 1, 6).swapaxes(1, 2)
        j_from_world = self._graph.pose(j).inverse()
        from_i = np.array([(j_from_world @ self._graph.pose(anchor)).adjoint() for anchor, _ in holds])
        from_j = self._carry(anchor_j, j)
        across = from_i @ blocks[:k, k] @ from_j.T
        own = from_i @ blocks[np.arange(k), np.arange(k)] @ from_i.swapaxes(1, 2)
        found = own - across - across.swapaxes(1, 2) + from_j @ blocks[k, k] @ from_j.T + chain_j
        for number, (i, (anchor, chain)) in enumerate(zip(nodes, holds, strict=True)):
            if i != anchor:
                carry = self._carry(i, j)
                found[number] += carry @ chain @ carry.T
        return np.asarray(found)

    def _from_factor(self, *nodes: int) -> FloatArray:
        """(6 k, 6 k) joint covariance of nodes in the factor."""
        d, k = self._factor.block, len(nodes)
        inverse = self._factor.inverse_blocks(np.array(nodes))
        if self._freedom is Freedom.FULL and not self._fixed[list(nodes)].any():
            return inverse  # steps are in the nodes' own axes already
        spread = np.zeros((6 * k, k * d))
        for number, node in enumerate(nodes):
            if not self._fixed[node]:
                spread[6 * number : 6 * number + 6, d * number : d * number + d] = step_to_tangent(
                    self._graph.pose(node), self._freedom
                )
        return np.asarray(spread @ inverse @ spread.T)


class WholeCovariance(ExactCovariance):
    """Of a graph factored as a whole, which gives all marginals at once."""

    def __init__(self, graph: PoseGraph, pattern: Pattern, freedom: Freedom, factor: Factor) -> None:
        super().__init__(graph, freedom, factor, pattern.fixed)
        self._pattern = pattern
        self._marginals: FloatArray | None = None
        self._whole = factor

    def marginals(self) -> FloatArray:
        """(n, 6, 6) of all nodes in the factor, by selected inversion."""
        blocks = self._whole.inverse_diagonal()
        blocks[self._fixed] = 0.0
        spread = self._spread()
        return np.asarray(spread @ blocks @ spread.transpose(0, 2, 1))

    def along_constraints(self) -> Steps[FloatArray]:
        """(a, 6, 6) of the pose of j seen from i, for every active constraint, bit by bit: as
        :meth:`relative`, but by one selected inversion.
        """
        graph, pattern = self._graph, self._pattern
        blocks, pairs = yield from self._whole.selected_inverse()
        yield
        i, j = graph.i[pattern.constraints], graph.j[pattern.constraints]
        cross = pairs[pattern.slot]
        cross[pattern.flipped] = cross[pattern.flipped].transpose(0, 2, 1)
        cross[self._fixed[i] | self._fixed[j]] = 0.0
        blocks[self._fixed] = 0.0
        spread = self._spread()
        back = -_adjoints(graph, j, i) @ spread[i]  # how a step of i changes j seen from i
        own, transposed = spread[j], spread[j].transpose(0, 2, 1)
        mixed = back @ cross @ transposed
        self._marginals = spread @ blocks @ spread.transpose(0, 2, 1)
        covariance = back @ blocks[i] @ back.transpose(0, 2, 1) + own @ blocks[j] @ transposed
        return np.asarray(covariance + mixed + mixed.transpose(0, 2, 1))

    def at_most(self, i: IntArray, j: IntArray) -> FloatArray:
        """(k, 6, 6) upper bounds of the covariances of nodes j (k,) seen from nodes i (k,), whatever
        correlates them, without any walk; :meth:`along_constraints` has to be done first.
        """
        assert self._marginals is not None
        carry = _adjoints(self._graph, j, i)
        return 2.0 * (carry @ self._marginals[i] @ carry.transpose(0, 2, 1) + self._marginals[j])

    def _spread(self) -> FloatArray:
        n, d = self._n_factored, int(self._freedom)
        if self._freedom is not Freedom.LEVELLED:
            return np.broadcast_to(step_to_tangent(self._graph.pose(0), self._freedom), (n, 6, d))
        return np.stack([step_to_tangent(self._graph.pose(k), self._freedom) for k in range(n)])


def _adjoints(graph: PoseGraph, i: IntArray, j: IntArray) -> FloatArray:
    """(k, 6, 6) adjoints of the poses of nodes j (k,) seen from nodes i (k,)."""
    world_from = rotation_matrices(graph.quaternions)
    i_from_world = world_from[i].transpose(0, 2, 1)
    rotation = i_from_world @ world_from[j]
    x, y, z = (i_from_world @ (graph.positions[j] - graph.positions[i])[:, :, None])[:, :, 0].T
    zero = np.zeros_like(x)
    skew = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    adjoints = np.zeros((len(i), 6, 6))
    adjoints[:, :3, :3] = adjoints[:, 3:, 3:] = rotation
    adjoints[:, :3, 3:] = skew @ rotation
    return adjoints


def step_to_tangent(world_from_node: Pose, freedom: Freedom) -> FloatArray:
    """(6, d): what a step of the solver means as (translation, rotation vector) in the node's own axes."""
    if freedom is Freedom.FULL:
        return np.eye(6)
    spread = np.zeros((6, int(freedom)))
    if freedom is Freedom.PLANAR:
        spread[[0, 1, 5], [0, 1, 2]] = 1.0
    else:
        spread[:3, :3] = world_from_node.rotation.T
        spread[3:, 3] = world_from_node.rotation[2]
    return spread


def exact_covariance(
    graph: PoseGraph, freedom: Freedom | None = None, robust: Robust = PLAIN
) -> WholeCovariance | None:
    """Of the graph as it is now; None where its constraints do not determine it."""
    freedom = freedom or (Freedom.PLANAR if graph.planar else Freedom.FULL)
    pattern = find_pattern(graph)
    factor = factor_now(graph, pattern, freedom, robust)
    return None if factor is None else WholeCovariance(graph, pattern, freedom, factor)
