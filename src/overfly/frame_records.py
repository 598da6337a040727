"""Where located frames hang in the graph, and how those between nodes follow when the map is adjusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.covariance import tangent_covariance
from overfly.types import BoolArray, Float32Array, IntArray
from overfly.vision.odometry import Located
from overfly.vision.refine import TiltPrior, refine_pose
from overfly.visual_map import VisualMap

MOST_SEEN = 80  # points that are remembered of a frame
FEWEST_SEEN = 12  # points that find a frame again
LIMITS_SIGMA = (20.0, 5.0)  # largest residuals, at first and at last
FREE_TILT_RAD = 0.5  # the picture alone decides


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Map points that a frame saw, n of them: features node (n,), row (n,) int32, rays (n, 2) float32."""

    node: np.ndarray
    row: np.ndarray
    rays: Float32Array


@dataclass(frozen=True, slots=True, eq=False)
class FrameRecord:
    """Where a located frame hangs in the graph, so that its pose follows when the graph is optimised.

    online: world_from_cam as it was known when the frame had just been processed; never rewritten. piece: of
    the map, that it was located in at the time. seen: by what it was located, where it is no node and this is
    still at hand.
    """

    frame_index: int
    t_ns: int
    node: int
    node_from_cam: Pose
    online: Pose
    piece: int = 0
    seen: Seen | None = None


def seen_by(located: Located) -> Seen:
    """Inliers of a located frame, spread evenly over their order."""
    inliers = located.estimate.inliers
    if len(inliers) > MOST_SEEN:
        inliers = inliers[np.linspace(0, len(inliers) - 1, MOST_SEEN).astype(np.int64)]
    correspondences = located.matches.correspondences
    return Seen(
        located.matches.node[inliers].astype(np.int32),
        correspondences.map_index[inliers].astype(np.int32),
        correspondences.rays[inliers].astype(np.float32),
    )


def gap_covariance(visual_map: VisualMap, record: FrameRecord) -> FloatArray:
    """(6, 6) what dead reckoning leaves open of the frame's pose; zero in the first piece."""
    if record.piece == 0:
        return np.zeros((6, 6))
    graph, constraint = visual_map.graph, visual_map.nodes[record.piece].constraint
    first_from_cam = graph.pose(record.piece).inverse() @ record.online
    carry = first_from_cam.inverse().adjoint()
    return np.asarray(carry @ tangent_covariance(graph.information[constraint], False) @ carry.T)


def scaled(records: Sequence[FrameRecord], factor: float, of_node: BoolArray) -> list[FrameRecord]:
    """The records with their lengths multiplied where that was done to their node, of_node (n,)."""
    return [
        replace(record, node_from_cam=record.node_from_cam.scaled(factor)) if of_node[record.node] else record
        for record in records
    ]


def seen_by_another(records: Sequence[FrameRecord], old: Camera, new: Camera) -> list[FrameRecord]:
    """The records with rays of another calibration of the same camera."""

    def turned(seen: Seen) -> Seen:
        px = old.pixels_from_rays(seen.rays.astype(np.float64))
        return replace(seen, rays=new.rays_from_pixels(px).astype(np.float32))

    return [
        record if record.seen is None else replace(record, seen=turned(record.seen)) for record in records
    ]


def settle(
    visual_map: VisualMap, records: Sequence[FrameRecord], before: Sequence[Pose], ray_sigma: float
) -> list[FrameRecord]:
    """The records with every frame between nodes found again from the points it saw, which have moved.

    before: poses of the nodes before they moved; ray_sigma: standard deviation of a followed point's ray.
    Frames whose points are not at hand move as the nodes before and after them do.
    """
    points: dict[int, tuple[FloatArray, FloatArray]] = {}
    node_ns = np.array([node.t_ns for node in visual_map.nodes])
    settled = []
    for record in records:
        found = None
        if record.seen is not None and len(record.seen.row) >= FEWEST_SEEN:
            for index in np.unique(record.seen.node).tolist():
                if index not in points:
                    node = visual_map.nodes[index]
                    points[index] = visual_map.points_in_world(node), visual_map.spread_in_world(node)
            world = _gathered(record.seen, [points[int(index)][0] for index in record.seen.node])
            spread = _gathered(record.seen, [points[int(index)][1] for index in record.seen.node])
            found = _found_again(visual_map, record, world, spread, ray_sigma)
        settled.append(found or _moved_along(visual_map, record, before, node_ns))
    return settled


def _moved_along(
    visual_map: VisualMap, record: FrameRecord, before: Sequence[Pose], node_ns: IntArray
) -> FrameRecord:
    """The record moved as its node and the other neighbour in time, by the time between them."""
    if visual_map.nodes[record.node].t_ns == record.t_ns:
        return record
    after = int(np.searchsorted(node_ns, record.t_ns))
    other = after - 1 if record.node == after else after
    if record.node not in (after - 1, after) or not 0 <= other < len(node_ns):
        return record
    old = before[record.node] @ record.node_from_cam
    own, theirs = (
        visual_map.graph.pose(index) @ before[index].inverse() @ old for index in (record.node, other)
    )
    share = (record.t_ns - node_ns[record.node]) / (node_ns[other] - node_ns[record.node])
    pose = own @ Pose.exp(float(share) * (own.inverse() @ theirs).log())
    return replace(record, node_from_cam=visual_map.graph.pose(record.node).inverse() @ pose)


def _gathered(seen: Seen, tables: list[FloatArray]) -> FloatArray:
    return np.array([table[row] for table, row in zip(tables, seen.row, strict=True)])


def _found_again(
    visual_map: VisualMap, record: FrameRecord, world: FloatArray, spread: FloatArray, ray_sigma: float
) -> FrameRecord | None:
    """None where too few points agree."""
    assert record.seen is not None
    known = np.isfinite(np.hstack([world, spread, record.seen.rays])).all(axis=1)
    if known.sum() < FEWEST_SEEN:
        return None
    node = visual_map.graph.pose(record.node)
    start = node @ record.node_from_cam
    tilt = TiltPrior(start.rotation, FREE_TILT_RAD)
    limits = (LIMITS_SIGMA[0] * ray_sigma, LIMITS_SIGMA[1] * ray_sigma)
    rays = record.seen.rays[known].astype(np.float64)
    found = refine_pose(start, world[known], rays, ray_sigma, limits, tilt, None, spread[known])
    if found is None or found.inliers.sum() < FEWEST_SEEN:
        return None
    return replace(record, node_from_cam=node.inverse() @ found.world_from_cam)
