"""Where the camera will probably be, and whether it has moved enough to make a node."""

from __future__ import annotations

import math

import numpy as np

from overfly.config import NodeSettings
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import Pose, vector_from_rotation

LONGEST_GAP_S = 1.0  # beyond this gap between frames the last velocity says nothing any more
NS_PER_S = 1e9
# Over ground of an earlier visit a node serves that is so many times further off than the next one would be:
# dense nodes are for what is new.
KNOWN_REACH = 1.5
CALM_S = 0.3
# How a vehicle changes its speed, and how exactly that is known: flying heights per second squared and per
# second, one standard deviation.
ACCELERATION = 0.5
SPEED_SIGMA = 0.03


class ConstantVelocity:
    """Prediction from the last two poses."""

    def __init__(self) -> None:
        self._t_ns = 0
        self._pose: Pose | None = None
        self._velocity: np.ndarray | None = None  # (6,) tangent per second, in the camera frame
        self._calm: np.ndarray | None = None  # the same, as a mean over CALM_S

    @property
    def last_pose(self) -> Pose | None:
        """world_from_cam of the last located frame, however long ago."""
        return self._pose

    def predict(self, t_ns: int) -> Pose | None:
        """world_from_cam at t_ns; None when nothing recent is known."""
        gap_s = (t_ns - self._t_ns) / NS_PER_S
        if self._pose is None or not 0 < gap_s <= LONGEST_GAP_S:
            return None
        if self._velocity is None:
            return self._pose
        return self._pose @ Pose.exp(self._velocity * gap_s)

    def predict_calmly(self, t_ns: int) -> Pose | None:
        """The same by the mean velocity of late: where poses are uncertain their differences are more so, and
        what goes on from each of them runs away.
        """
        gap_s = (t_ns - self._t_ns) / NS_PER_S
        if self._pose is None or not 0 < gap_s <= LONGEST_GAP_S:
            return None
        return self._pose if self._calm is None else self._pose @ Pose.exp(self._calm * gap_s)

    def update(self, t_ns: int, pose: Pose) -> None:
        gap_s = (t_ns - self._t_ns) / NS_PER_S
        if self._pose is not None and 0 < gap_s <= LONGEST_GAP_S:
            self._velocity = (self._pose.inverse() @ pose).log() / gap_s
            weight = 1.0 if self._calm is None else 1.0 - math.exp(-gap_s / CALM_S)
            calm = self._velocity if self._calm is None else self._calm
            self._calm = calm + weight * (self._velocity - calm)
        else:
            self._velocity = self._calm = None
        self._t_ns, self._pose = t_ns, pose

    def move(self, world_from_old: Pose) -> None:
        """The map was optimised and what surrounds the camera moved with it; velocities, in the camera frame,
        stay.
        """
        if self._pose is not None:
            self._pose = world_from_old @ self._pose

    def rescale(self, factor: float) -> None:
        """All lengths of the map were multiplied."""
        if self._pose is not None:
            self._pose = self._pose.scaled(factor)
        if self._velocity is not None:
            self._velocity = np.concatenate([self._velocity[:3] * factor, self._velocity[3:]])
        if self._calm is not None:
            self._calm = np.concatenate([self._calm[:3] * factor, self._calm[3:]])

    def lose(self) -> None:
        """A frame was not located: the velocity is no longer trusted."""
        self._velocity = None


def moved_enough(
    world_from_node: Pose,
    world_from_cam: Pose,
    height_above_ground_m: tuple[float, float],
    camera: Camera,
    settings: NodeSettings,
    *,
    is_known: bool = False,
) -> bool:
    """Whether the view has shifted, turned or zoomed enough against the node's; heights of the node and of
    now. is_known: the node is of an earlier visit.
    """
    node_height, height = height_above_ground_m
    ratio = height / node_height
    if max(ratio, 1.0 / ratio) > settings.height_ratio:
        return True
    turn = vector_from_rotation(world_from_node.rotation.T @ world_from_cam.rotation)
    if math.degrees(float(np.linalg.norm(turn))) > settings.turn_deg:
        return True
    # The middle of the node's view, on the ground, as the camera sees it now.
    middle = world_from_node.transform(np.array([[0.0, 0.0, node_height]]))
    seen = camera.project(world_from_cam.inverse().transform(middle))[0]
    shift = np.hypot(*(seen - np.array([camera.cx, camera.cy])))
    displacement = (KNOWN_REACH if is_known else 1.0) * settings.displacement
    return not shift < displacement * min(camera.width, camera.height)
