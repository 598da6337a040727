"""Depth of features where there is only one camera: their rays meet the ground (flat-ground assumption)."""

from __future__ import annotations

import math

import numpy as np

from overfly.geometry.poses import FloatArray, Pose
from overfly.vision.stereo import DepthPoints

STEEPEST_RAY_RAD = math.radians(65.0)  # rays flatter than this meet the ground too far away to be of use


def points_on_ground(
    rays: FloatArray, world_from_cam: Pose, ground_z_m: float, tilt_sigma_rad: float, relief_sigma_m: float
) -> DepthPoints:
    """Where rays (n, 2) meet the plane z = ground_z_m; NaN for rays at or above 65 degrees from the vertical.

    The depth's standard deviation comes from the uncertain tilt and from the relief of the ground about the
    plane.
    """
    directions = np.column_stack([rays, np.ones(len(rays))])
    down = -(directions @ world_from_cam.rotation[2])  # per metre of depth
    length = np.linalg.norm(directions, axis=1)
    cosine = np.where(down > length * math.cos(STEEPEST_RAY_RAD), down / length, np.nan)
    depth = (world_from_cam.translation[2] - ground_z_m) / (cosine * length)
    depth = np.where(depth > 0, depth, np.nan)
    tangent = np.sqrt(1.0 / cosine**2 - 1.0)
    sigma = np.hypot(depth * tangent * tilt_sigma_rad, relief_sigma_m / cosine)
    return DepthPoints(directions * depth[:, None], sigma, is_measured=False)
