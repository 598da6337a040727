"""What odometry drifts beyond the noise of its features: the slow errors that its covariance knows nothing of.

The covariance of an adjustment knows the noise of features, which averages out. A wrong focal length, a lens that is not
quite as calibrated, a biased attitude sensor or ground that is not flat do not: over some nodes they err in one direction, then in another.
In flights with truth (docs/revisit.md) odometry errs by 0.2 to 1.1 % of the distance, correlated over about eight nodes; as independent errors of
single constraints that is sqrt(8) times as much, and yaw by about 0.01 rad over ten flying heights.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.covariance import tangent_covariance
from overfly.types import Constraint
from overfly.vision.odometry import information_of_constraint

DISTANCE_SHARE = 0.03  # of the distance between both nodes, in each axis of the translation
TURN_RAD_PER_HEIGHT = 0.008  # per flying height of distance


def drift_covariance(i_from_j: Pose, height_m: float) -> FloatArray:
    """(6, 6) covariance, (translation, rotation) in the camera frame, to add to that of an odometry constraint.

    height_m: of the camera above the ground, to which the distance compares.
    """
    distance = float(np.linalg.norm(i_from_j.translation))
    # Node pairs at one place still may be wrong by a little of the height.
    shift = DISTANCE_SHARE * distance
    turn = TURN_RAD_PER_HEIGHT * distance / height_m
    return np.diag([shift**2] * 3 + [turn**2] * 3)


def with_drift(constraint: Constraint, height_m: float) -> Constraint:
    """The same odometry constraint with the drift that its covariance does not know."""
    covariance = tangent_covariance(constraint.information, False) + drift_covariance(
        constraint.i_from_j, height_m
    )
    return replace(constraint, information=information_of_constraint(covariance))
