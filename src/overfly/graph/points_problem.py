"""What the adjustment of a whole map is given, and what it gives back."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from overfly.geometry.poses import FloatArray
from overfly.graph.points_relative import RelativePoses
from overfly.graph.points_turns import N_FAULTS, Turns
from overfly.types import BoolArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Shared:
    """Unknowns that move all rays: what is expected of them (P,), with standard deviations (P,), and rays_of,
    which gives for such values the rays (k, 2) of all observations, and by how much (k,) their deviations
    grow: pixels stay as exact as they are, so a longer focal length makes rays more exact. start: where to
    begin, if elsewhere.
    """

    expected: FloatArray
    sigma: FloatArray
    rays_of: Callable[[FloatArray], tuple[FloatArray, FloatArray]]
    start: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PointProblem:
    """Poses n, points m, observations k, sorted by point, a point at most once from each pose. Arrays:

    rotations (n, 3, 3), translations (n, 3): world_from_cam; anchors (n,) bool: poses whose x, y and yaw
    stay, because nothing else holds them; points (m, 3) world; starts (m + 1,): observations of point m are
    starts[m] to starts[m + 1]; node (k,) who sees it; rays (k, 2) undistorted image coordinates; sigma (k,)
    their standard deviation; inverse_depth (k,) 1/m, NaN where not measured; inverse_depth_sigma.
    level_from_cam (n, 3, 3), tilt_sigma (n,) infinite where not measured; height (n,), height_sigma (n,)
    and position (n, 3), position_sigma (n, 3) of the camera, metres, likewise.
    relief: standard deviation of the points' z as a share of the height above them, infinite for none.
    tilt_bias_sigma: of what the attitude sensor's roll and pitch are off by all the time, radians;
    size_sigma: of the logarithm of how much longer the map is than relative poses have it; level_sigma: of
    what positions are too high by, metres; each 0 where it is known to be nothing.
    relative: poses against each other, as odometry and places seen again have them; turns: as a gyroscope
    has them.
    """

    rotations: FloatArray
    translations: FloatArray
    anchors: BoolArray
    points: FloatArray
    starts: IntArray
    node: IntArray
    rays: FloatArray
    sigma: FloatArray
    inverse_depth: FloatArray
    inverse_depth_sigma: float
    level_from_cam: FloatArray
    tilt_sigma: FloatArray
    height: FloatArray
    height_sigma: FloatArray
    position: FloatArray
    position_sigma: FloatArray
    relief: float
    tilt_bias_sigma: float = 0.0
    size_sigma: float = 0.0
    level_sigma: float = 0.0
    shared: Shared | None = None
    relative: RelativePoses | None = None
    turns: Turns | None = None

    @property
    def n_common(self) -> int:
        """Unknowns that all of the map has in common, those of points_priors."""
        return 4 if self.turns is None else 4 + N_FAULTS

    @property
    def flatness(self) -> float:
        return 0.0 if math.isinf(self.relief) else 1.0 / self.relief


@dataclass(frozen=True, slots=True, eq=False)
class PointSolution:
    """Poses and points after the adjustment; point_covariance (m, 3, 3) given the poses; error (k,)
    reprojection errors in sigmas; common (4 or 16,) unknowns of points_priors; shared (P,)
    with covariance (P, P) if all observations are independent; cost before and after.
    """

    rotations: FloatArray
    translations: FloatArray
    points: FloatArray
    point_covariance: FloatArray
    error: FloatArray
    common: FloatArray
    shared: FloatArray
    shared_covariance: FloatArray
    cost: tuple[float, float]
    iterations: int

    @property
    def tilt_bias(self) -> FloatArray:
        """(2,) of roll and pitch, radians, in levelled axes."""
        return self.common[:2]
