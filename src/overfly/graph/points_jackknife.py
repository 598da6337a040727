"""How sure adjusted poses are, when errors of neighbouring observations are alike.

The inverse of the normal equations takes all observations for independent. Those of one patch of ground are
not: what leads one astray, the light, the relief, a window that others share, leads its neighbours, and the
same point in the next picture. So it is asked what the map would be without a patch, for all patches in turn
(the jackknife over blocks: Kuensch 1989, "The jackknife and the bootstrap for general stationary
observations"; for least squares with what a block decides by itself taken into account: Bell and McCaffrey
2002, "Bias reduction in standard errors for linear regression with multi-stage samples"). Patches err
independently, and what else is known, of tilt, heights, positions and relative poses, as it says.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.graph.cholesky import Factor
from overfly.graph.points import (
    _add_sensors,
    _empty,
    _evaluated,
    _factor,
    _find_pattern,
    _make_room,
    _normal_equations,
    _Pattern,
    _rays_by_shared,
    _State,
    _System,
)
from overfly.graph.points_influence import ground_patches
from overfly.graph.points_kernels import _point_pairs, _reduce
from overfly.graph.points_problem import PointProblem, PointSolution
from overfly.graph.steps import to_the_end
from overfly.types import IntArray

MOST_DECIDED = 0.99  # of what a patch decides by itself, leaving it out says nothing


@dataclass(frozen=True, slots=True, eq=False)
class _Patch:
    """What the points of a patch say: nodes (q,) that see it, sorted; gradient (6 q + P,) and information
    (6 q + P, 6 q + P) of their poses and of the camera's unknowns."""

    nodes: IntArray
    gradient: FloatArray
    information: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Inverse:
    """Of the whole system: blocks (n, 6, 6) of poses and (b, 6, 6) of the pairs keys (b,), before the border;
    by_border (n, 6, B), corner (B, B): what the border's unknowns, of which n_common are no camera's, add to
    them."""

    keys: IntArray
    diagonal: FloatArray
    pairs: FloatArray
    by_border: FloatArray
    corner: FloatArray
    n_common: int

    def of(self, nodes: IntArray) -> FloatArray:
        """(6 q + P, 6 q + P) of poses q, sorted, and of the camera's unknowns."""
        q, B = len(nodes), len(self.corner)
        low, high = np.triu_indices(q, 1)
        place = np.searchsorted(self.keys, (nodes[low] << 32) | nodes[high])
        poses = np.empty((q, 6, q, 6))
        poses[np.arange(q), :, np.arange(q)] = self.diagonal[nodes]
        poses[low, :, high] = self.pairs[place]
        poses[high, :, low] = self.pairs[place].transpose(0, 2, 1)
        border = self.by_border[nodes].reshape(6 * q, B)
        across = -border @ self.corner
        camera = slice(self.n_common, B)
        return np.block(
            [
                [poses.reshape(6 * q, 6 * q) - across @ border.T, across[:, camera]],
                [across[:, camera].T, self.corner[camera, camera]],
            ]
        )


def jackknife_covariance(problem: PointProblem, solution: PointSolution, nodes: IntArray) -> FloatArray:
    """(6 k, 6 k) covariance of the poses of nodes (k,), as perturbations of translation and rotation in their
    own axes; NaN where the system does not determine them."""
    state = _evaluated(
        problem, solution.rotations, solution.translations, solution.points, solution.common, solution.shared
    )
    patches = list(_patches(problem, state, ground_patches(solution)))
    pattern = _find_pattern(problem, np.concatenate([_pairs(patch.nodes) for patch in patches]))
    system = _normal_equations(problem, pattern, state, 0.0)
    factor = _factor(pattern, system, 0.0)
    if factor is None:
        return np.full((6 * len(nodes), 6 * len(nodes)), np.nan)
    inverse = _inverse(pattern, factor, system, problem.n_common)
    influence = _influence(factor, inverse, nodes)
    moves = np.array([_move_without(patch, inverse, *influence) for patch in patches])
    return np.asarray(moves.T @ moves + _of_sensors(problem, pattern, state, *influence))


def _move_without(patch: _Patch, inverse: _Inverse, poses: FloatArray, border: FloatArray) -> FloatArray:
    """(6 k,) how the poses whose influence is given move when the patch is left out."""
    decided = patch.information @ inverse.of(patch.nodes)
    without = np.linalg.solve(np.eye(len(decided)) - MOST_DECIDED * decided, patch.gradient)
    return np.asarray(
        without[: 6 * len(patch.nodes)] @ poses[patch.nodes].reshape(-1, poses.shape[2])
        + without[6 * len(patch.nodes) :] @ border[inverse.n_common :]
    )


def _patches(problem: PointProblem, state: _State, label: IntArray) -> Iterator[_Patch]:
    """label (m,) of the points."""
    views = np.diff(problem.starts)
    order = np.argsort(label, kind="stable")
    ends = np.cumsum(views[order])
    own = np.arange(len(problem.node)) - np.repeat(ends - views[order], views[order])
    rows = np.repeat(problem.starts[:-1][order], views[order]) + own  # observations, by patch, then point
    node, rays, weight = problem.node[rows], state.rays[rows], state.weight[rows]
    inverse_depth, depth_weight = problem.inverse_depth[rows], 1.0 / problem.inverse_depth_sigma
    by_camera = _rays_by_shared(problem, state)[rows]
    begins = np.flatnonzero(np.diff(label[order], prepend=label[order[0]] - 1))
    for first, last in zip(begins, np.append(begins[1:], len(order)), strict=True):
        starts = np.concatenate([[0], np.cumsum(views[order[first:last]])])
        mine = slice(ends[last - 1] - starts[-1], ends[last - 1])
        seeing, local = np.unique(node[mine], return_inverse=True)
        q, m, P = len(seeing), last - first, by_camera.shape[2]
        pair = _point_pairs(starts, local)
        diagonal, off_diagonal = np.zeros((q, 6, 6)), np.zeros((q * q, 6, 6))
        gradient, border = np.zeros((q, 6)), np.zeros((q, 6, P))
        corner, corner_gradient = np.zeros((P, P)), np.zeros(P)
        _reduce(
            state.rotations[seeing], state.translations[seeing], state.points[order[first:last]], starts,
            local, rays[mine], weight[mine], inverse_depth[mine], depth_weight, problem.flatness, 0.0,
            by_camera[mine], (pair >> 32) * q + (pair & 0xFFFFFFFF), diagonal, off_diagonal, gradient,
            border, corner, corner_gradient, np.zeros((m, 3, 3)), np.zeros((m, 3)),
            np.zeros((len(local), 6, 3)), np.zeros((m, P, 3)),
        )  # fmt: skip
        above = off_diagonal.reshape(q, q, 6, 6).transpose(0, 2, 1, 3).reshape(6 * q, 6 * q)
        poses = above + above.T
        poses.reshape(q, 6, q, 6)[np.arange(q), :, np.arange(q)] += diagonal
        across = border.reshape(6 * q, P)
        yield _Patch(
            seeing,
            np.concatenate([gradient.ravel(), corner_gradient]),
            np.block([[poses, across], [across.T, corner]]),
        )


def _pairs(nodes: IntArray) -> IntArray:
    """Keys of all pairs of nodes (q,), sorted."""
    low, high = np.triu_indices(len(nodes), 1)
    return np.asarray((nodes[low] << 32) | nodes[high])


def _inverse(pattern: _Pattern, factor: Factor, system: _System, n_common: int) -> _Inverse:
    diagonal, pairs = to_the_end(factor.selected_inverse())
    by_border = factor.solve(system.border)
    left = system.corner - np.einsum("ndp,ndq->pq", system.border, by_border)
    return _Inverse(pattern.keys, diagonal, pairs, by_border, np.linalg.pinv(left), n_common)


def _influence(factor: Factor, inverse: _Inverse, nodes: IntArray) -> tuple[FloatArray, FloatArray]:
    """Columns of the whole inverse that belong to the poses of nodes (k,): rows of poses (n, 6, 6 k) and of
    the border's unknowns (B, 6 k)."""
    n, k = len(inverse.diagonal), len(nodes)
    unit = np.zeros((n, 6, k, 6))
    unit[nodes[:, None], np.arange(6), np.arange(k)[:, None], np.arange(6)] = 1.0
    border = -inverse.corner @ inverse.by_border[nodes].reshape(6 * k, -1).T
    return factor.solve(unit.reshape(n, 6, 6 * k)) - inverse.by_border @ border, border


def _of_sensors(
    problem: PointProblem, pattern: _Pattern, state: _State, poses: FloatArray, border: FloatArray
) -> FloatArray:
    """(6 k, 6 k) what measurements other than of points leave uncertain, by the influence of all unknowns."""
    held = _empty(problem, pattern, len(state.shared))
    _make_room(held, problem.n_common)
    _add_sensors(problem, pattern, state, held)
    told = np.einsum("npq,nqk->npk", held.diagonal, poses) + held.border @ border
    tied = np.unique(np.concatenate([pattern.relative, pattern.turns]))
    low, high = pattern.keys[tied] >> 32, pattern.keys[tied] & 0xFFFFFFFF
    block = held.off_diagonal[tied]
    np.add.at(told, low, np.einsum("bpq,bqk->bpk", block, poses[high]))
    np.add.at(told, high, np.einsum("bqp,bqk->bpk", block, poses[low]))
    told_border = np.einsum("npb,npk->bk", held.border, poses) + held.corner @ border
    size = poses.shape[2]
    return np.asarray(poses.reshape(-1, size).T @ told.reshape(-1, size) + border.T @ told_border)
