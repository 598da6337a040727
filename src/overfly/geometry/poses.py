"""Rigid transforms. Named ``b_from_a`` so that neighbours cancel:
``world_from_cam = world_from_node @ node_from_cam``.

Quaternions are ``xyzw`` everywhere in Overfly (as in TUM and g2o files and in scipy). Tangent vectors are
``(translation, rotation vector)``, metres and radians, applied on the right: ``pose @ Pose.exp(tangent)``
moves the pose in its own axes, and covariances of poses refer to that perturbation.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """x_b = rotation @ x_a + translation.

    rotation: (3, 3), orthonormal. translation: (3,), metres, in frame b (the place of a's origin in b).
    """

    rotation: FloatArray
    translation: FloatArray

    @staticmethod
    def identity() -> Pose:
        return Pose(np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(matrix: FloatArray) -> Pose:
        """matrix: (4, 4) or (3, 4) homogeneous transform."""
        return Pose(np.array(matrix[:3, :3], dtype=np.float64), np.array(matrix[:3, 3], dtype=np.float64))

    @staticmethod
    def from_quaternion(quaternion_xyzw: FloatArray, translation: FloatArray) -> Pose:
        return Pose(
            rotation_from_quaternion(quaternion_xyzw), np.asarray(translation, dtype=np.float64).reshape(3)
        )

    @staticmethod
    def exp(tangent: FloatArray) -> Pose:
        """Pose of the tangent (6,) = (translation, rotation vector); translation and rotation are not
        coupled.
        """
        return Pose(rotation_from_vector(tangent[3:]), np.array(tangent[:3], dtype=np.float64))

    def log(self) -> FloatArray:
        """Inverse of :meth:`exp`: (6,) = (translation, rotation vector)."""
        return np.concatenate([self.translation, vector_from_rotation(self.rotation)])

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def inverse(self) -> Pose:
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)

    def transform(self, points: FloatArray) -> FloatArray:
        """points: (..., 3) in frame a -> the same in frame b."""
        return np.asarray(points @ self.rotation.T + self.translation)

    def scaled(self, factor: float) -> Pose:
        """The same pose with all lengths multiplied."""
        return Pose(self.rotation, self.translation * factor)

    def quaternion(self) -> FloatArray:
        """(4,) xyzw with w >= 0."""
        return quaternion_from_rotation(self.rotation)

    def matrix(self) -> FloatArray:
        """(4, 4) homogeneous transform."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    def adjoint(self) -> FloatArray:
        """(6, 6) matrix A with ``self @ exp(x) @ self.inverse() ~ exp(A x)`` to first order, in (translation,
        rotation).
        """
        adjoint = np.zeros((6, 6))
        adjoint[:3, :3] = self.rotation
        adjoint[3:, 3:] = self.rotation
        adjoint[:3, 3:] = skew(self.translation) @ self.rotation
        return adjoint


def skew(vector: FloatArray) -> FloatArray:
    """(3, 3) matrix S with S @ x = cross(vector, x)."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_from_vector(vector: FloatArray) -> FloatArray:
    """Rodrigues' formula: rotation (3, 3) about ``vector`` (3,) by its length in radians."""
    angle = math.sqrt(float(vector @ vector))
    K = skew(vector)
    if angle < 1e-6:  # series: the quotients below lose their digits
        return np.asarray(np.eye(3) + K + 0.5 * K @ K)
    return np.asarray(
        np.eye(3) + (math.sin(angle) / angle) * K + ((1.0 - math.cos(angle)) / angle**2) * (K @ K)
    )


def vector_from_rotation(rotation: FloatArray) -> FloatArray:
    """Rotation vector (3,) with an angle in [0, pi]; by the quaternion, which is well conditioned at both
    ends.
    """
    x, y, z, w = _quaternion_of(np.asarray(rotation, dtype=np.float64).tolist())
    length = math.sqrt(x * x + y * y + z * z)
    factor = 2.0 if length < 1e-10 else 2.0 * math.atan2(length, w) / length
    return np.array([factor * x, factor * y, factor * z])


# Four or nine numbers are combined faster as Python's own than as arrays, and every frame does so many times.


def rotation_from_quaternion(quaternion_xyzw: FloatArray) -> FloatArray:
    """(4,) xyzw, any length but zero -> (3, 3)."""
    x, y, z, w = np.asarray(quaternion_xyzw, dtype=np.float64).tolist()
    square = x * x + y * y + z * z + w * w
    s = 2.0 / square if square > 0.0 else math.nan
    xx, yy, zz = s * x * x, s * y * y, s * z * z
    xy, xz, yz = s * x * y, s * x * z, s * y * z
    xw, yw, zw = s * x * w, s * y * w, s * z * w
    return np.array(
        [
            [1.0 - (yy + zz), xy - zw, xz + yw],
            [xy + zw, 1.0 - (xx + zz), yz - xw],
            [xz - yw, yz + xw, 1.0 - (xx + yy)],
        ]
    )


def quaternion_from_rotation(rotation: FloatArray) -> FloatArray:
    """(3, 3) -> (4,) xyzw with w >= 0; divides by the largest component (Shepperd 1978)."""
    return np.array(_quaternion_of(np.asarray(rotation, dtype=np.float64).tolist()))


def _quaternion_of(rotation: list[list[float]]) -> tuple[float, float, float, float]:
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    trace = xx + yy + zz
    largest = max(xx, yy, zz, trace)
    if largest == trace:
        x, y, z, w = zy - yz, xz - zx, yx - xy, 1.0 + trace
    elif largest == xx:
        x, y, z, w = 1.0 - trace + 2.0 * xx, yx + xy, zx + xz, zy - yz
    elif largest == yy:
        x, y, z, w = yx + xy, 1.0 - trace + 2.0 * yy, zy + yz, xz - zx
    else:
        x, y, z, w = zx + xz, zy + yz, 1.0 - trace + 2.0 * zz, yx - xy
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if w < 0.0:
        length = -length
    return x / length, y / length, z / length, w / length


def rotation_x(angle_rad: float) -> FloatArray:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_y(angle_rad: float) -> FloatArray:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rotation_z(angle_rad: float) -> FloatArray:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> FloatArray:
    """R_world_body = Rz(yaw) Ry(pitch) Rx(roll), body x forward, y left, z up."""
    return rotation_z(yaw_rad) @ rotation_y(pitch_rad) @ rotation_x(roll_rad)


def euler_from_rotation(rotation: FloatArray) -> tuple[float, float, float]:
    """(roll, pitch, yaw) in radians of R = Rz(yaw) Ry(pitch) Rx(roll); pitch in [-pi/2, pi/2]."""
    pitch = math.asin(max(-1.0, min(1.0, -float(rotation[2, 0]))))
    roll = math.atan2(float(rotation[2, 1]), float(rotation[2, 2]))
    yaw = math.atan2(float(rotation[1, 0]), float(rotation[0, 0]))
    return roll, pitch, yaw


def wrap_angle(angle_rad: float) -> float:
    """The same angle in (-pi, pi]."""
    return math.pi - (math.pi - angle_rad) % (2.0 * math.pi)


def interpolate(first: Pose, second: Pose, fraction: float) -> Pose:
    """Pose between two poses: straight line and slerp; fraction 0 gives the first, 1 the second."""
    turn = vector_from_rotation(first.rotation.T @ second.rotation)
    return Pose(
        first.rotation @ rotation_from_vector(fraction * turn),
        (1.0 - fraction) * first.translation + fraction * second.translation,
    )


def stack_translations(poses: Iterable[Pose]) -> FloatArray:
    """(n, 3) translations of the poses."""
    return np.array([pose.translation for pose in poses], dtype=np.float64).reshape(-1, 3)
