"""What odometry is wrong by beyond the noise of its features: the slow errors that its covariance knows
nothing of.

The covariance of an adjustment knows the noise of features, which averages out. A focal length that is not
quite right, a biased attitude sensor, or ground that is not as flat as assumed do not: over some nodes they
err in one direction, then in another. In flights with truth (docs/revisit.md) odometry errs by 0.2 to 1.1 %
of the distance, in the same direction over about eight nodes; as independent errors of single constraints
that is sqrt(8) times as much. How far the map is bent shows in flight: attitude sensors that have no drift
disagree with it by more than their noise.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.covariance import tangent_covariance
from overfly.graph.pose_graph import KINDS, PoseGraph
from overfly.types import Constraint, ConstraintKind
from overfly.vision.odometry import information_of_constraint
from overfly.visual_map import VisualMap

DISTANCE_SHARE = 0.03  # of the distance between both nodes, in each axis of the translation
TURN_RAD_PER_HEIGHT = 0.008  # per flying height of distance
GROUND_SHARE = 0.04  # the same for one registration whose points were assumed to lie on flat ground
TOGETHER = 8  # nodes over which these errors have one direction
ODOMETRY, BRIDGE = KINDS.index(ConstraintKind.ODOMETRY), KINDS.index(ConstraintKind.BRIDGE)
DEGREES_OF_FREEDOM = 6.0
OBSERVED_NODES = 16  # newest nodes that tell how far the map is bent


def drift_covariance(i_from_j: Pose, height_m: float, bend_rad: float) -> FloatArray:
    """(6, 6) covariance, (translation, rotation) in the camera frame, to add to that of an odometry
    constraint.

    height_m: of the camera above the ground, to which the distance compares; bend_rad: see map_bend.
    """
    distance = float(np.linalg.norm(i_from_j.translation))
    shift = math.hypot(DISTANCE_SHARE, bend_rad) * distance
    turn = math.hypot(TURN_RAD_PER_HEIGHT * distance / height_m, bend_rad / math.sqrt(0.5 * TOGETHER))
    return np.diag([shift**2] * 3 + [turn**2] * 3)


def revisit_drift_covariance(
    i_from_j: Pose, height_m: float, bend_rad: float, depth_is_measured: bool
) -> FloatArray:
    """The same for a revisit, which measures once and not over many nodes.

    depth_is_measured: whether the points' depths were, or the ground was assumed to be flat; its relief then
    makes distances too long or too short.
    """
    distance = float(np.linalg.norm(i_from_j.translation))
    share = DISTANCE_SHARE / math.sqrt(TOGETHER) if depth_is_measured else GROUND_SHARE
    shift = math.hypot(share, bend_rad) * distance
    turn = math.hypot(TURN_RAD_PER_HEIGHT / math.sqrt(TOGETHER), bend_rad) * distance / height_m
    return np.diag([shift**2] * 3 + [turn**2] * 3)


def with_drift(constraint: Constraint, height_m: float, bend_rad: float) -> Constraint:
    """The same odometry constraint with the drift that its covariance does not know."""
    covariance = tangent_covariance(constraint.information, False)
    covariance = covariance + drift_covariance(constraint.i_from_j, height_m, bend_rad)
    return replace(constraint, information=information_of_constraint(covariance))


def believe_more_drift(graph: PoseGraph, revisit: Constraint, innovation: float) -> None:
    """State the odometry between both ends of a revisit as inexact as the revisit shows it to be.

    innovation: squared Mahalanobis distance of the revisit from the estimate, larger than the six that it
    should be on average; the covariances grow by that factor (the variance factor of geodesy).
    """
    first, last = min(revisit.i, revisit.j), max(revisit.i, revisit.j)
    lower, upper = np.minimum(graph.i, graph.j), np.maximum(graph.i, graph.j)
    between = np.isin(graph.kinds, (ODOMETRY, BRIDGE)) & (lower >= first) & (upper <= last)
    graph.information[between] *= DEGREES_OF_FREEDOM / innovation


def map_bend(visual_map: VisualMap) -> float:
    """How far the newest nodes are tilted against their attitude sensors beyond the sensors' noise, rad per
    axis."""
    squares = 0.0
    nodes = visual_map.nodes[-OBSERVED_NODES:]
    for node in nodes:
        up = node.tilt.level_from_cam @ visual_map.graph.pose(node.index).rotation[2]
        squares += 0.5 * float(up[0] ** 2 + up[1] ** 2) - node.tilt.sigma_rad**2
    return math.sqrt(max(squares / len(nodes), 0.0)) if nodes else 0.0
