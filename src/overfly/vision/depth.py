"""Where the features of a new node are in space: from the second camera if there is one, else
on the ground.
"""

from __future__ import annotations

import numpy as np

from overfly.geometry.poses import FloatArray, Pose
from overfly.types import Float32Array, Rig
from overfly.vision.ground import points_on_ground
from overfly.vision.observation import Observation
from overfly.vision.stereo import DepthPoints, StereoMatcher

RELIEF_SHARE = 0.02  # relief that flat ground may have, as a share of the height above it


class DepthFinder:
    """Depth of features by the means that the rig has."""

    def __init__(self, rig: Rig) -> None:
        self._stereo = StereoMatcher(rig) if rig.is_stereo else None

    @property
    def is_metric(self) -> bool:
        """Whether depth is measured (stereo), not assumed (flat ground)."""
        return self._stereo is not None

    @property
    def inverse_depth_sigma(self) -> float:
        """Standard deviation of measured inverse depths, 1/m; 1 where none are measured."""
        return self._stereo.inverse_depth_sigma if self._stereo else 1.0

    @property
    def rig_turn_rad(self) -> FloatArray:
        """(3,) by how much the second camera was found to be turned about its own axes; zero without one."""
        return self._stereo.bend.turn_rad if self._stereo else np.zeros(3)

    def measured(self, view: Observation, px: Float32Array) -> DepthPoints | None:
        """Depth that needs no pose: stereo, or None with one camera or a frame that lacks its
        second picture.
        """
        if self._stereo is None or len(view.images) < 2:
            return None
        return self._stereo.depth(view.images[0], view.images[1], px)

    def find(
        self,
        view: Observation,
        px: Float32Array,
        rays: FloatArray,
        world_from_cam: Pose,
        tilt_sigma_rad: float,
        relief_m: float,
    ) -> DepthPoints:
        """Points seen at px (n, 2) along rays (n, 2), measured where possible, else where the rays meet the
        ground z = 0.

        relief_m: standard deviation of the ground about that plane.
        """
        depth = self.measured(view, px)
        if depth is None:
            depth = points_on_ground(rays, world_from_cam, 0.0, tilt_sigma_rad, relief_m)
        return depth


def height_above_points(points_in_cam: FloatArray, level_from_cam: FloatArray) -> float:
    """Median height in metres of a camera above points (n, 3) that it measured; NaN if there are none."""
    below = -(points_in_cam @ level_from_cam[2])
    below = below[np.isfinite(below)]
    return float(np.median(below)) if len(below) else float("nan")
