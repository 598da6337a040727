"""Levelling: what a perfectly downward-looking camera would have seen (paper, section IV-A).

The level frame has its origin in the camera, z up, and is turned against the world by the yaw alone:
``world_from_level = Rz(yaw)``. A levelled ray is scaled to (a, b, -1); its first two components are the q of
the two-point solver.
"""

from __future__ import annotations

import math

import numpy as np

from overfly.geometry.poses import FloatArray, rotation_from_euler, rotation_z
from overfly.types import Attitude

# Optical axis straight down, top of the image forward: how a camera hangs when nothing else is known.
NADIR_BODY_FROM_CAM = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def level_from_cam(attitude: Attitude | None, body_from_cam: FloatArray) -> FloatArray:
    """Rotation (3, 3) from the optical frame to the level frame, R_level_cam = Ry(pitch) Rx(roll) R_body_cam.

    Without an attitude the body is taken to be level (the paper's blimp and helicopter).
    """
    if attitude is None:
        return np.array(body_from_cam)
    return rotation_from_euler(attitude.roll_rad, attitude.pitch_rad, 0.0) @ body_from_cam


def level_rays(rays: FloatArray, level_from_cam_rotation: FloatArray) -> FloatArray:
    """rays (n, 2) undistorted image coordinates -> (n, 2) q = (a, b) of the levelled rays (a, b, -1).

    NaN where a ray does not point below the horizon.
    """
    directions = np.column_stack([rays, np.ones(len(rays))]) @ level_from_cam_rotation.T
    depth = np.where(directions[:, 2] < -1e-3, -directions[:, 2], np.nan)
    return np.asarray(directions[:, :2] / depth[:, None])


def world_from_cam_rotation(yaw_rad: float, level_from_cam_rotation: FloatArray) -> FloatArray:
    """Rotation (3, 3) of a camera whose level frame is turned by the yaw."""
    return rotation_z(yaw_rad) @ level_from_cam_rotation


def height_share(cos_tilt: float, half_angle_rad: float) -> float:
    """Height above flat ground as a share of what a tilted range sensor measures: the nearest echo within its
    cone, which is straight below while the cone reaches there.
    """
    return math.cos(max(0.0, math.acos(min(1.0, cos_tilt)) - half_angle_rad))


def split_yaw(world_from_cam: FloatArray, body_from_cam: FloatArray) -> tuple[float, FloatArray]:
    """Yaw of the body in radians, and the rotation (3, 3) level_from_cam that is left when it
    is taken away.
    """
    world_from_body = world_from_cam @ body_from_cam.T
    yaw = float(np.arctan2(world_from_body[1, 0], world_from_body[0, 0]))
    return yaw, rotation_z(-yaw) @ world_from_cam
