"""Aerospace axes (north-east-down and forward-right-down) and ours (z up, forward-left-up), for readers and
writers that meet them; nothing else in Overfly knows them.
"""

from __future__ import annotations

import math

import numpy as np

from overfly.geometry.poses import FloatArray, rotation_from_euler

# east, north, up <-> north, east, down; its own inverse
NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# forward, left, up <-> forward, right, down; its own inverse, for a body and for a local frame alike
FRD_FROM_FLU = np.diag([1.0, -1.0, -1.0])


def euler_from_aerospace(roll_rad: FloatArray, pitch_rad: FloatArray, yaw_rad: FloatArray) -> FloatArray:
    """(n, 3) roll, pitch, yaw of R_enu_flu = Rz Ry Rx, of those of R_ned_frd (each (n,), radians).

    Roll keeps its sign, pitch turns it round, and the heading, clockwise from north, becomes the angle
    anticlockwise from east. The yaw is not wrapped, so that unwrapped angles stay so.
    """
    roll, pitch, yaw = (np.asarray(angle, dtype=np.float64) for angle in (roll_rad, pitch_rad, yaw_rad))
    return np.column_stack([roll, -pitch, 0.5 * math.pi - yaw])


def enu_from_frd_rotation(roll_rad: float, pitch_rad: float, yaw_rad: float) -> FloatArray:
    """R_enu_frd (3, 3) of aerospace angles: from body forward-right-down to east-north-up."""
    return np.asarray(NED_FROM_ENU.T @ rotation_from_euler(roll_rad, pitch_rad, yaw_rad))


def euler_from_quaternion(quaternion_wxyz: FloatArray) -> FloatArray:
    """(n, 4) quaternions w x y z, of any length but zero -> (n, 3) roll, pitch, yaw of R = Rz Ry Rx."""
    w, x, y, z = (quaternion_wxyz / np.linalg.norm(quaternion_wxyz, axis=1, keepdims=True)).T
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.column_stack([roll, pitch, yaw])
