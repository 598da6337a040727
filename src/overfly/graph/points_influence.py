"""How exact the unknowns are that all rays share, when errors of neighbouring observations are alike.

The inverse of the normal equations takes every observation for independent. A point is off in all its views
by what its patch was off in the first, and neighbours on the ground err alike with the light, the relief and
the blur in which they were seen. What a group of observations moves an unknown by is its influence; that of
independent groups adds up in squares, so groups that agree within show in the sum (the jackknife's
infinitesimal form, clustered: Huber 1967; Liang and Zeger 1986, "Longitudinal data analysis using generalized
linear models").
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from overfly.geometry.poses import FloatArray
from overfly.graph.points import _evaluated, _factor, _find_pattern, _normal_equations
from overfly.graph.points_kernels import HUBER, _move_points
from overfly.graph.points_problem import PointProblem, PointSolution
from overfly.types import IntArray

NUDGE = 1e-2  # standard deviations of an unknown, for derivatives
STRETCH = 3  # nodes whose new points count as seen in the same light
PATCH = 0.3  # of the flying height: ground of which the points may err alike


def correlated_covariance(problem: PointProblem, solution: PointSolution) -> FloatArray:
    """(P, P) covariance of the shared unknowns: the solution's, its deviations grown to what the most alike
    of several groupings of the observations shows.

    What is left of errors after the solution is less than they were, by the redundancy of the points.
    """
    covariance = solution.shared_covariance
    influence = None if problem.shared is None else shared_influence(problem, solution)
    if influence is None:
        return covariance
    views = np.diff(problem.starts)
    redundancy = 1.0 - 1.5 * len(views) / float(views.sum())
    spread = np.max([_spread(influence, group) for group in _groupings(problem, solution)], axis=0)
    growth = np.maximum(1.0, spread / math.sqrt(max(redundancy, 0.1)))
    return np.asarray(covariance * growth[:, None] * growth[None, :])


def shared_influence(problem: PointProblem, solution: PointSolution) -> FloatArray | None:
    """(P, k) by how many of its standard deviations each observation moves each shared unknown away from
    where it would be without that observation's residual; None where the system does not determine them."""
    pattern = _find_pattern(problem)
    state = _evaluated(
        problem, solution.rotations, solution.translations, solution.points, solution.common,
        solution.shared,
    )  # fmt: skip
    system = _normal_equations(problem, pattern, state, 0.0)
    factor = _factor(pattern, system, 0.0)
    if factor is None:
        return None
    by_border = factor.solve(system.border)
    covariance = np.linalg.inv(system.corner - np.einsum("ndp,ndq->pq", system.border, by_border))
    weight = HUBER / np.maximum(state.error, HUBER)
    influence, n_common = np.empty((len(state.shared), len(problem.node))), problem.n_common
    for p in range(len(state.shared)):
        border = covariance[:, p + n_common] / math.sqrt(covariance[p + n_common, p + n_common])
        step = -by_border @ border
        moved = _move_points(
            np.zeros_like(state.points), problem.starts, problem.node, system.V_inverse,
            np.zeros_like(system.Vg), system.cross, system.point_border, step, border[n_common:],
        )  # fmt: skip
        ahead, behind = (
            _evaluated(
                problem,
                state.rotations @ Rotation.from_rotvec(nudge * step[:, 3:]).as_matrix(),
                state.translations + nudge * np.einsum("nij,nj->ni", state.rotations, step[:, :3]),
                state.points + nudge * moved,
                state.common + nudge * border[:n_common],
                state.shared + nudge * border[n_common:],
            ).error
            for nudge in (NUDGE, -NUDGE)
        )
        influence[p] = -weight * (ahead**2 - behind**2) / (4.0 * NUDGE)
    return influence


def _groupings(problem: PointProblem, solution: PointSolution) -> list[IntArray]:
    """Labels (k,) of observations that may err alike: of one point; of points first seen from one node; of
    points seen in the same stretch of the flight; of points on the same patch of ground."""
    views = np.diff(problem.starts)
    point = np.repeat(np.arange(len(views)), views)
    middle = (np.add.reduceat(problem.node, problem.starts[:-1]) / views).astype(np.int64) // STRETCH
    return [point, problem.node[problem.starts[:-1]][point], middle[point], ground_patches(solution)[point]]


def ground_patches(solution: PointSolution) -> IntArray:
    """(m,) label of the patch of ground that each point lies on."""
    height = float(np.median(solution.translations[:, 2] - np.median(solution.points[:, 2])))
    patch = np.floor(solution.points[:, :2] / (PATCH * abs(height))).astype(np.int64)
    patch -= patch.min(axis=0)
    return np.asarray(patch[:, 0] * (patch[:, 1].max() + 1) + patch[:, 1])


def _spread(influence: FloatArray, group: IntArray) -> FloatArray:
    """(P,) root of the sum of squares of the influence (P, k) of each group."""
    _, label = np.unique(group, return_inverse=True)
    sums = np.array([np.bincount(label, weights=row) for row in influence])
    return np.asarray(np.sqrt(np.sum(sums**2, axis=1)))
