"""What the drawing thread gets to know: values that nobody changes any more, taken between two frames."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from overfly.frame_result import FrameResult
from overfly.geometry.poses import FloatArray, Pose
from overfly.localizer import Fix
from overfly.slam import Slam
from overfly.types import Frame, UInt8Array
from overfly.viewer.drape import reduced
from overfly.viewer.scene import GraphState
from overfly.visual_map import Node, VisualMap


@dataclass(frozen=True, slots=True, eq=False)
class NewNode:
    """A frame that became a node. ground_m: height of the ground that it shows, world; scale: of the map
    then, against its beginning.
    """

    index: int
    picture: UInt8Array
    world_from_cam: Pose
    ground_m: float
    scale: float


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One frame and the map about it.

    pose: world_from_cam, None when lost, then reason says why; points (n, 3) metres, world, that the picture
    should show; region (2, 2) m^2 covariance of the place in the map's plane, if known; graph: None when it
    was sent a moment ago; scale: of the map against its beginning.
    """

    t_ns: int
    picture: UInt8Array
    pose: Pose | None
    reason: str
    sigma_m: float | None
    n_inliers: int
    points: FloatArray
    region: FloatArray | None
    graph: GraphState | None
    n_frames: int
    n_nodes: int
    scale: float


def sigma_of(covariance: FloatArray | None) -> float | None:
    """Largest standard deviation of the place, metres, from covariance (6, 6)."""
    if covariance is None:
        return None
    return math.sqrt(max(float(np.linalg.eigvalsh(covariance[:3, :3])[-1]), 0.0))


def reason_of(result: FrameResult | Fix) -> str:
    """Why there is no pose, in words."""
    return "" if result.pose is not None else ": ".join(filter(None, (str(result.reason), result.detail)))


def ground_below(node: Node, visual_map: VisualMap) -> float:
    """Height of the ground that a node shows, world, metres: the median of its points."""
    z = visual_map.points_in_world(node)[node.has_point, 2]
    return float(np.median(z)) if len(z) else 0.0


def region_of(slam: Slam) -> FloatArray | None:
    """(2, 2) m^2: how well the newest node's place is known in the map's plane, if that is at hand."""
    node = len(slam.map) - 1
    covariance = slam.covariance_at_hand(node) if node > 0 else None
    if covariance is None:
        return None
    rotation = slam.map.graph.pose(node).rotation
    return np.asarray((rotation @ covariance[:3, :3] @ rotation.T)[:2, :2])


def new_node(frame: Frame, index: int, slam: Slam, scale: float) -> NewNode:
    """A frame that has just become a node; of a large picture a small copy, for many may wait."""
    node = slam.map.nodes[index]
    pose = slam.map.graph.pose(index)
    return NewNode(index, reduced(frame.images[0]), pose, ground_below(node, slam.map), scale)
