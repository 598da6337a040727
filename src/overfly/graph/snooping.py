"""Loops against a settled estimate: which of the believed ones all the others contradict, and which of the
rejected ones fit it after all.

Source: Baarda, "A testing procedure for use in geodetic networks", 1968 (data snooping), with bounds at the
scale that the distances themselves show.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.covariance import tangent_information
from overfly.graph.gate import Gate
from overfly.graph.pose_graph import PoseGraph, State
from overfly.graph.sparse import REVISIT
from overfly.types import Constraint, IntArray

FEW_LOOPS = 10  # fewer cannot tell which of them is wrong
LINEAR_RAD = 1.0  # a loop that disagrees by more lies outside what a linear covariance can tell


def contradicted(
    graph: PoseGraph, gate: Gate, relative_covariance: Callable[[int, int], FloatArray]
) -> tuple[IntArray, float]:
    """Numbers of accepted loops whose residual is too large for what the others leave open, and the bound of
    the squared distance. relative_covariance: (6, 6) of the pose of j seen from i.
    """
    revisits = graph.active
    revisits = revisits[graph.kinds[revisits] == REVISIT]
    if len(revisits) < FEW_LOOPS:
        return np.empty(0, np.int64), 0.0
    distances = np.array([_distance_from_others(graph, int(k), relative_covariance) for k in revisits])
    bound = gate.bound_for_all(distances)
    return np.asarray(revisits[distances > bound]), bound


def _distance_from_others(
    graph: PoseGraph, number: int, relative_covariance: Callable[[int, int], FloatArray]
) -> float:
    """r^T (Omega^-1 - Sigma_ij)^-1 r: Sigma_ij includes the loop itself, whose part is thus taken out
    again.
    """
    constraint = graph.constraint(number)
    information = tangent_information(constraint.information, graph.planar)
    residual = innovation_vector(graph, constraint)
    open_part = np.eye(6) - information @ relative_covariance(constraint.i, constraint.j)
    if np.linalg.eigvals(open_part).real.min() < 1e-6:  # nothing but this loop determines it
        return 0.0
    return float(residual @ np.linalg.solve(open_part, information @ residual))


def best_within(
    graph: PoseGraph, bound: float, but: IntArray, innovation: Callable[[Constraint], float]
) -> IntArray:
    """Of the rejected loops whose innovation lies within the bound, but those named, the better half: what
    they hold may show which of the others are wrong.
    """
    rejected = np.setdiff1d(np.flatnonzero(graph.states == State.REJECTED), but)
    constraints = [graph.constraint(int(number)) for number in rejected]
    turns = np.array([np.linalg.norm(innovation_vector(graph, constraint)[3:]) for constraint in constraints])
    near = np.flatnonzero(turns < LINEAR_RAD)
    distances = np.array([innovation(constraints[k]) for k in near])
    fitting = np.flatnonzero(distances <= bound)
    best = fitting[np.argsort(distances[fitting], kind="stable")[: (len(fitting) + 1) // 2]]
    return np.asarray(rejected[near[best]], np.int64)


def innovation_vector(graph: PoseGraph, constraint: Constraint) -> FloatArray:
    """(6,) measured^-1 * predicted as (translation, rotation vector)."""
    predicted: Pose = graph.pose(constraint.i).inverse() @ graph.pose(constraint.j)
    return (constraint.i_from_j.inverse() @ predicted).log()
