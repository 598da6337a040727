"""Loops against a settled estimate: which of the believed ones all the others contradict, and which of the
rejected ones fit it after all.

Source: Baarda, "A testing procedure for use in geodetic networks", 1968 (data snooping), with bounds at the
scale that the distances themselves show.
"""

from __future__ import annotations

import numpy as np

from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.covariance import WholeCovariance, tangent_information
from overfly.graph.gate import Gate
from overfly.graph.linearise import constraint_chi2, constraint_errors
from overfly.graph.pose_graph import PoseGraph, State
from overfly.graph.sparse import REVISIT
from overfly.graph.steps import Steps
from overfly.types import Constraint, IntArray

FEW_LOOPS = 10  # fewer cannot tell which of them is wrong
IN_ONE_STEP = 10  # rejected loops that are tried in one step
LINEAR_RAD = 1.0  # a loop that disagrees by more lies outside what a linear covariance can tell


def contradicted(graph: PoseGraph, gate: Gate, relative: FloatArray) -> tuple[IntArray, float]:
    """Numbers of accepted loops whose residual is too large for what the others leave open, and the bound of
    the squared distance. relative (a, 6, 6): covariance of the pose of j seen from i, per active constraint.
    """
    active = graph.active
    is_revisit = graph.kinds[active] == REVISIT
    revisits = active[is_revisit]
    if len(revisits) < FEW_LOOPS:
        return np.empty(0, np.int64), gate.stated
    distances = _distances_from_others(graph, revisits, relative[is_revisit])
    bound = gate.bound_for_all(distances)
    return np.asarray(revisits[distances > bound]), bound


def _distances_from_others(graph: PoseGraph, numbers: IntArray, relative: FloatArray) -> FloatArray:
    """(k,) r^T (Omega^-1 - Sigma_ij)^-1 r: Sigma_ij includes the loop itself, whose part is thus taken out
    again.
    """
    information = tangent_information(graph.information[numbers], graph.planar)
    residual = innovation_vectors(graph, numbers)[:, :, None]
    open_part = np.eye(6) - information @ relative
    alone = np.linalg.eigvals(open_part).real.min(axis=1) < 1e-6  # nothing but this loop determines it
    open_part[alone] = np.eye(6)
    distances = residual.transpose(0, 2, 1) @ np.linalg.solve(open_part, information @ residual)
    return np.where(alone, 0.0, distances[:, 0, 0])


def best_within(
    graph: PoseGraph, bound: float, but: IntArray, covariance: WholeCovariance, most_gain: float
) -> Steps[IntArray]:
    """Of the rejected loops whose innovation lies within the bound, but those named, the better half: what
    they hold may show which of the others are wrong. covariance: whose along_constraints has been done.
    most_gain: chi2 that believing a loop may let the others be bent for.
    """
    rejected = np.setdiff1d(np.flatnonzero(graph.states == State.REJECTED), but)
    residuals = innovation_vectors(graph, rejected)
    near = np.flatnonzero(np.linalg.norm(residuals[:, 3:], axis=1) < LINEAR_RAD)
    information = tangent_information(graph.information[rejected], graph.planar)
    i, j = graph.i[rejected], graph.j[rejected]
    at_least = squared_distances(residuals[near], information[near], covariance.at_most(i[near], j[near]))
    near = near[at_least <= bound]
    distances = np.empty(len(near))
    for k, loop in enumerate(near):
        relative = covariance.relative(int(i[loop]), int(j[loop]))
        distances[k] = squared_distances(residuals[loop], information[loop], relative)
        if k % IN_ONE_STEP == IN_ONE_STEP - 1:
            yield
    gains = constraint_chi2(graph, rejected[near]) - distances
    fitting = np.flatnonzero((distances <= bound) & (gains <= most_gain))
    best = fitting[np.argsort(distances[fitting], kind="stable")[: (len(fitting) + 1) // 2]]
    return np.asarray(rejected[near[best]], np.int64)


def squared_distances(residuals: FloatArray, information: FloatArray, relative: FloatArray) -> FloatArray:
    """(...,) r^T (Sigma + Omega^-1)^-1 r of measurements with information Omega (..., 6, 6) and residuals r
    (..., 6) from an estimate of covariance Sigma (..., 6, 6).
    """
    columns = residuals[..., None]
    gains = np.linalg.solve(np.eye(6) + information @ relative, information @ columns)
    return np.asarray((columns * gains).sum(axis=(-2, -1)))


def innovation_vectors(graph: PoseGraph, numbers: IntArray) -> FloatArray:
    """(k, 6) measured^-1 * predicted of these constraints as (translation, rotation vector)."""
    vectors = constraint_errors(graph, numbers)
    if not graph.planar:
        sine = np.linalg.norm(vectors[:, 3:], axis=1)  # of half the angle
        angle = 2.0 * np.arcsin(np.minimum(sine, 1.0))
        vectors[:, 3:] *= np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 0.0)[:, None]
    return vectors


def innovation_vector(graph: PoseGraph, constraint: Constraint) -> FloatArray:
    """(6,) measured^-1 * predicted as (translation, rotation vector)."""
    predicted: Pose = graph.pose(constraint.i).inverse() @ graph.pose(constraint.j)
    return (constraint.i_from_j.inverse() @ predicted).log()
