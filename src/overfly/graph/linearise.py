"""Errors of constraints, their sum chi2, and the normal equations of one Gauss-Newton step.

Error of a constraint, as g2o files define it: e = (translation, vector part of the quaternion) of measured^-1
* predicted, predicted = X_i^-1 X_j; in planar graphs (x, y, angle). chi2 = sum e^T Omega e. Steps are
(translation, rotation vector) in the node's own axes, applied on the right (Freedom.FULL), or (x, y, z,
heading) in world axes with roll and pitch held (Freedom.LEVELLED), or (x, y, angle) in the node's own axes
(Freedom.PLANAR).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.graph.jacobians import (
    _chi2,
    _compile_blocks,
    _compile_normal_equations,
    _displaced,
    _errors,
    _move,
)
from overfly.graph.pose_graph import PoseGraph
from overfly.graph.prior_kernels import _add_attitude_priors, _add_position_priors, _attitude_errors
from overfly.types import BoolArray, IntArray


class Freedom(IntEnum):
    """Degrees of freedom of a node."""

    PLANAR = 3
    LEVELLED = 4
    FULL = 6


ERROR_ROWS = {
    Freedom.PLANAR: (0, 1, 5),
    Freedom.LEVELLED: (0, 1, 2, 3, 4, 5),
    Freedom.FULL: (0, 1, 2, 3, 4, 5),
}
_NORMAL_EQUATIONS = {
    freedom: _compile_normal_equations(int(freedom), rows) for freedom, rows in ERROR_ROWS.items()
}
_BLOCKS = {freedom: _compile_blocks(int(freedom), rows) for freedom, rows in ERROR_ROWS.items()}


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """H dx = -g in blocks of d: diagonal (n, d, d), off_diagonal (m, d, d) of (i, j) per constraint, gradient
    (n, d).
    """

    diagonal: FloatArray
    off_diagonal: FloatArray
    gradient: FloatArray


def constraint_errors(graph: PoseGraph, constraints: IntArray) -> FloatArray:
    """(k, 6) errors e of these constraints at the present estimate."""
    errors = np.empty((len(constraints), 6))
    _errors(
        graph.positions, graph.quaternions, graph.i, graph.j, graph.measured_positions,
        graph.measured_quaternions,
        constraints, graph.planar, errors,
    )  # fmt: skip
    return errors


def constraint_chi2(graph: PoseGraph, constraints: IntArray) -> FloatArray:
    """(k,) e^T Omega e of these constraints."""
    values: FloatArray = _chi2(
        graph.positions, graph.quaternions, graph.i, graph.j, graph.measured_positions,
        graph.measured_quaternions, graph.information, constraints, graph.planar,
    )  # fmt: skip
    return values


def chi2(graph: PoseGraph) -> float:
    """Sum over the active constraints and the priors, without robust kernels."""
    return float(constraint_chi2(graph, graph.active).sum() + prior_chi2(graph).sum())


def prior_chi2(graph: PoseGraph) -> FloatArray:
    """(k,) e^T Omega e of the position priors, then of the attitude priors."""
    nodes, values, information = graph.position_priors
    if len(nodes) + len(graph.attitude_priors[0]) == 0:
        return np.empty(0)
    offset = graph.positions[nodes] - values
    tilted, rotations, tilt_information = graph.attitude_priors
    errors = _attitude_errors(graph.quaternions, tilted, rotations)
    return np.concatenate(
        [np.einsum("ka,kab,kb->k", offset, information, offset), (errors**2 * tilt_information).sum(axis=1)]
    )


def normal_equations(
    graph: PoseGraph,
    constraints: IntArray,
    weights: FloatArray,
    fixed: BoolArray,
    freedom: Freedom,
    prior_weights: FloatArray | None = None,
) -> NormalEquations:
    """Linearise these constraints (k,), each weighted (k,), and all priors. Fixed nodes (n,) get a unit block
    and no step.

    prior_weights: (position priors + attitude priors,), 1 if not given.
    """
    n, d = len(graph), int(freedom)
    diagonal = np.zeros((n, d, d))
    off_diagonal = np.empty((len(constraints), d, d))
    gradient = np.zeros((n, d))
    _NORMAL_EQUATIONS[freedom](
        graph.positions, graph.quaternions, graph.i, graph.j, graph.measured_positions,
        graph.measured_quaternions,
        graph.information, constraints, weights, fixed, diagonal, off_diagonal, gradient,
    )  # fmt: skip
    nodes, values, information = graph.position_priors
    tilted, rotations, tilt_information = graph.attitude_priors
    if prior_weights is None:
        prior_weights = np.ones(len(nodes) + len(tilted))
    if len(prior_weights):
        _add_position_priors(
            graph.positions,
            graph.quaternions,
            nodes,
            values,
            information,
            prior_weights[: len(nodes)],
            diagonal,
            gradient,
        )
        _add_attitude_priors(
            graph.quaternions,
            tilted,
            rotations,
            tilt_information,
            prior_weights[len(nodes) :],
            diagonal,
            gradient,
        )
    diagonal[fixed] = np.eye(d)
    gradient[fixed] = 0.0
    return NormalEquations(diagonal, off_diagonal, gradient)


def linearise_each(
    graph: PoseGraph, freedom: Freedom, constraints: IntArray, positions: FloatArray, quaternions: FloatArray,
    blocks: FloatArray, gradients: FloatArray, values: FloatArray,
) -> None:  # fmt: skip
    """Normal equations of these constraints (k,), each by itself, with the nodes at these poses (n, 3),
    (n, 4): written to their places in blocks (m, 3, d, d) of (i, i), (i, j), (j, j), gradients (m, 2, d) and
    values (m,), their chi2.
    """
    _BLOCKS[freedom](
        positions, quaternions, graph.i, graph.j, graph.measured_positions, graph.measured_quaternions,
        graph.information, constraints, blocks, gradients, values,
    )  # fmt: skip


def move(graph: PoseGraph, step: FloatArray) -> None:
    """Apply a step (n, d) to all nodes, d telling which freedom it belongs to."""
    _move(graph.positions, graph.quaternions, step)


def displaced(
    graph: PoseGraph, positions: FloatArray, quaternions: FloatArray, least: float = 1e-6
) -> IntArray:
    """(k,) nodes that moved from these poses (n, 3), (n, 4) by more than ``least`` metres, or turned by about
    as many radians.
    """
    nodes: IntArray = _displaced(graph.positions, graph.quaternions, positions, quaternions, least)
    return nodes
