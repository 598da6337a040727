"""A Slam that was told its nodes instead of finding them: what a live view needs, without a flight."""

from __future__ import annotations

import math

import numpy as np
from tests.exports.world import BODY_FROM_CAM, CAMERA, ground_points, seen_by

from overfly.frame_result import FrameResult
from overfly.geometry.poses import Pose, rotation_from_euler
from overfly.slam import Slam
from overfly.types import Constraint, Frame, MountedCamera, Rig, UInt8Array

RIG = Rig((MountedCamera("cam0", CAMERA, BODY_FROM_CAM),))
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])
COVARIANCE = np.diag([1e-6, 4e-6, 9e-6, 1e-8, 1e-8, 1e-8])
HEIGHT_M = 4.0
FRAME_NS = 100_000_000


def above(x_m: float, y_m: float, yaw_rad: float = 0.0) -> Pose:
    """world_from_cam of a camera that looks straight down from HEIGHT_M."""
    return Pose(rotation_from_euler(0.0, 0.0, yaw_rad) @ LOOKING_DOWN, np.array([x_m, y_m, HEIGHT_M]))


def plain_picture(colour: tuple[int, int, int]) -> UInt8Array:
    return np.full((CAMERA.height, CAMERA.width, 3), colour, np.uint8)


def new_slam() -> Slam:
    return Slam(RIG)


def frame_of(number: int, picture: UInt8Array) -> Frame:
    return Frame(number, number * FRAME_NS, str(number), (picture,))


def add_node(slam: Slam, pose: Pose) -> int:
    """The next node, tied to the one before."""
    number = len(slam.map)
    node = seen_by(pose, ground_points(), number)
    slam.map.add_node(node, pose)
    if number:
        tie = slam.map.graph.pose(number - 1).inverse() @ pose
        slam.map.graph.add_constraint(Constraint(number - 1, number, tie, np.eye(6)))
    return number


def result_at(slam: Slam, number: int, pose: Pose, *, is_node: bool) -> FrameResult:
    node = add_node(slam, pose) if is_node else None
    return FrameResult(
        number * FRAME_NS, pose, covariance=COVARIANCE, n_inliers=50, node=node, rms_px=math.nan
    )
