"""Standard deviations, and a sonar's cone, where none is stated; docs/sources.md has the same table."""

from __future__ import annotations

import math

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.types import BoolArray

ATTITUDE_SIGMA_RAD = math.radians(1.0)
YAW_SIGMA_RAD = math.radians(5.0)  # a magnetic compass near motors
AIRFRAME_SIGMA_RAD = math.radians(2.0)  # a camera without a gimbal also flexes and is mounted by eye
RANGE_SIGMA_M = 0.03
RANGE_SIGMA_SHARE = 0.02  # of the range, added in quadrature: sonars and terrain models err in proportion
SONAR_HALF_ANGLE_RAD = math.radians(12.0)  # of its cone; the nearest echo in it counts
HEIGHT_SIGMA_M = 1.0
POSITION_SIGMA_M = 3.0
GPS_ALTITUDE_SIGMA_M = 6.0


def state_no_accuracy(sigma_m: FloatArray) -> BoolArray:
    """(n,) whether positions with sigmas (n, 2), horizontal and vertical, have both by default: no receiver
    states exactly these."""
    horizontal, vertical = sigma_m[:, 0], sigma_m[:, 1]
    usual_height = np.isclose(vertical, GPS_ALTITUDE_SIGMA_M, rtol=1e-9) | np.isinf(vertical)
    return np.asarray(np.isclose(horizontal, POSITION_SIGMA_M, rtol=1e-9) & usual_height)
