"""Standard deviations, and a sonar's cone, where none is stated; docs/sources.md has the same table."""

from __future__ import annotations

import math

ATTITUDE_SIGMA_RAD = math.radians(1.0)
YAW_SIGMA_RAD = math.radians(5.0)  # a magnetic compass near motors
AIRFRAME_SIGMA_RAD = math.radians(2.0)  # a camera without a gimbal also flexes and is mounted by eye
RANGE_SIGMA_M = 0.03
RANGE_SIGMA_SHARE = 0.02  # of the range, added in quadrature: sonars and terrain models err in proportion
SONAR_HALF_ANGLE_RAD = math.radians(12.0)  # of its cone; the nearest echo in it counts
HEIGHT_SIGMA_M = 1.0
POSITION_SIGMA_M = 3.0
GPS_ALTITUDE_SIGMA_M = 6.0
