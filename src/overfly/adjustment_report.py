"""What came of adjusting a whole map."""

from __future__ import annotations

import math
from dataclasses import dataclass

from overfly.geometry.poses import FloatArray
from overfly.graph.shape import ShapeCovariance
from overfly.range_offset import RangeOffset


@dataclass(frozen=True, slots=True, eq=False)
class AdjustmentReport:
    """What was adjusted: nodes, points, observations, pairs of nodes that got points in common; RMS
    reprojection error in pixels of the working picture; deviations that were found: of followed, described
    and joined points in such pixels, of the tilt sensor's bias in radians, of the ground in shares of the
    height. camera_changes (5,), as in self_calibration.py, with covariance (5, 5): empty if not asked for.
    growth: what all lengths of the map were multiplied with, those that took no part among them.
    range_offset: of the range sensor, None where it does not show. gyro_density: of the gyroscope's noise,
    rad/s/sqrt(Hz), at most; infinite where none was heard.
    odometry_variance: of the constraints of the graph, as a part of what their covariances say: what has
    been learnt from the flight of how exact they are.
    ground_sigma_m (n,): deviation of the ground's height below each node, in the map's own shape; shape: how
    sure some of the nodes are in it.
    """

    nodes: int
    points: int
    observations: int
    joined_pairs: int
    rms_px: float
    iterations: int
    sigma_px: tuple[float, ...]
    tilt_bias_rad: tuple[float, float]
    relief: float
    camera_changes: FloatArray
    camera_covariance: FloatArray
    growth: float
    ground_sigma_m: FloatArray
    shape: ShapeCovariance
    odometry_variance: float
    range_offset: RangeOffset | None = None
    gyro_density: float = math.inf
