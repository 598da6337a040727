"""Cameras as sensor_msgs/CameraInfo describes them; ROS 1 and ROS 2 differ in the case of the names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.sensors.calibration_files import fit_to_images, make_camera


def camera_of(where: Path, info: Any, size: tuple[int, int], topic: str) -> Camera | None:
    """The camera of pictures of this size; None when the message holds no calibration.

    Rectified pictures ("image_rect") have the projection's numbers and no distortion. Raises
    CalibrationError.
    """
    numbers = _field(info, "k").reshape(3, 3)
    coefficients = _field(info, "d")
    model = str(info.distortion_model) or "plumb_bob"
    if is_rectified(topic):
        projection = _field(info, "p").reshape(3, 4)
        numbers = projection[:, :3] if projection[0, 0] > 0 else numbers
        coefficients, model = np.zeros(0), "plumb_bob"
    if not numbers[0, 0] > 0:
        return None
    intrinsics = [float(numbers[0, 0]), float(numbers[1, 1]), float(numbers[0, 2]), float(numbers[1, 2])]
    calibrated_for = (int(info.width) or size[0], int(info.height) or size[1])
    camera = make_camera(where, calibrated_for, intrinsics, model, coefficients.tolist())
    return fit_to_images(where, camera, size)


def right_from_left(left: Any, right: Any, topic: str) -> Pose:
    """Where the left camera stands in the right one's frame, by rectification and projection of both.

    The projection of the right camera holds -focal length times baseline.
    """
    projection = _field(right, "p").reshape(3, 4)
    shift = np.array([float(projection[0, 3] / projection[0, 0]), 0.0, 0.0])
    if is_rectified(topic):
        return Pose(np.eye(3), shift)
    turn_left, turn_right = _rotation(left), _rotation(right)
    return Pose(turn_right.T @ turn_left, turn_right.T @ shift)


def baseline_m(right: Any) -> float:
    """Metres between the cameras, 0 when the right one's projection does not say."""
    projection = _field(right, "p").reshape(3, 4)
    return float(-projection[0, 3] / projection[0, 0]) if projection[0, 0] > 0 else 0.0


def is_rectified(topic: str) -> bool:
    return "rect" in topic.rsplit("/", maxsplit=1)[-1] or "image_rect" in topic


def _rotation(info: Any) -> FloatArray:
    rotation = _field(info, "r").reshape(3, 3)
    return rotation if abs(float(np.linalg.det(rotation)) - 1.0) < 1e-3 else np.eye(3)


def _field(info: Any, name: str) -> FloatArray:
    value = getattr(info, name, None)
    return np.asarray(getattr(info, name.upper()) if value is None else value, dtype=np.float64)
