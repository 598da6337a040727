"""Where located frames hang in the graph, and how those between nodes follow when the map is adjusted."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.covariance import tangent_covariance
from overfly.packed import Packed
from overfly.types import BoolArray, Float32Array, IntArray
from overfly.vision.odometry import Located
from overfly.vision.refine import TiltPrior, refine_pose
from overfly.visual_map import VisualMap

MOST_SEEN = 80  # points that are remembered of a frame
MOST_SEEN_OF_ALL = 1_000_000  # of all frames; of more each keeps fewer: 16 bytes each
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


@dataclass(slots=True, eq=False)
class RecordBlock:
    """Some records as arrays, n of them.

    numbers (n, 4): frame, time, node, piece; poses (n, 24): node_from_cam and online; seen: what they saw,
    one frame after the other; counts (n,): how much of that is whose, -1 for None.
    """

    numbers: IntArray
    poses: FloatArray
    counts: IntArray
    seen: Seen

    @staticmethod
    def pack(records: list[FrameRecord]) -> RecordBlock:
        saw = [record.seen for record in records if record.seen is not None]
        return RecordBlock(
            np.array([(one.frame_index, one.t_ns, one.node, one.piece) for one in records], np.int64),
            np.array([(*_flat(one.node_from_cam), *_flat(one.online)) for one in records]),
            np.array([-1 if one.seen is None else len(one.seen.row) for one in records], np.int64),
            Seen(
                np.concatenate([np.empty(0, np.int32), *(one.node for one in saw)]),
                np.concatenate([np.empty(0, np.int32), *(one.row for one in saw)]),
                np.concatenate([np.empty((0, 2), np.float32), *(one.rays for one in saw)]),
            ),
        )

    def __len__(self) -> int:
        return len(self.numbers)

    def unpack(self) -> list[FrameRecord]:
        ends = np.cumsum(np.maximum(self.counts, 0))
        records = []
        for (frame, t_ns, node, piece), numbers, count, end in zip(
            self.numbers.tolist(), self.poses, self.counts.tolist(), ends.tolist(), strict=True
        ):
            rows = slice(end - count, end)
            seen = (
                Seen(self.seen.node[rows], self.seen.row[rows], self.seen.rays[rows]) if count >= 0 else None
            )
            hanging, online = _unflat(numbers[:12]), _unflat(numbers[12:])
            records.append(FrameRecord(frame, t_ns, node, hanging, online, piece, seen))
        return records

    def _seen(self, rows: slice | IntArray) -> Seen:
        return Seen(self.seen.node[rows], self.seen.row[rows], self.seen.rays[rows])

    def thin(self, most: int) -> None:
        """Keep so many points of a frame at most, spread evenly over their order."""
        ends = np.cumsum(np.maximum(self.counts, 0))
        kept = [
            np.arange(end - count, end)
            if count <= most
            else end - count + np.linspace(0, count - 1, most).astype(np.int64)
            for count, end in zip(np.maximum(self.counts, 0).tolist(), ends.tolist(), strict=True)
        ]
        self.seen = self._seen(np.concatenate(kept))
        self.counts = np.minimum(self.counts, most)


class FrameRecords(Packed[FrameRecord]):
    """All records of a flight, in little memory: hours over one place must not fill it."""

    def __init__(self, records: Iterable[FrameRecord] = ()) -> None:
        self._most_seen = MOST_SEEN
        super().__init__(RecordBlock.pack, records)

    def add_block(self, block: RecordBlock) -> None:
        block.thin(self._most_seen)
        super().add_block(block)
        while sum(len(one.seen.row) for one in self.blocks) > MOST_SEEN_OF_ALL:
            half = self._most_seen // 2
            self._most_seen = half if half >= FEWEST_SEEN else 0
            for one in self.blocks:
                one.thin(self._most_seen)


def _flat(pose: Pose) -> FloatArray:
    return np.concatenate([pose.rotation.ravel(), pose.translation])


def _unflat(numbers: FloatArray) -> Pose:
    return Pose(numbers[:9].reshape(3, 3), numbers[9:])


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


def scaled(records: Sequence[FrameRecord], factor: float, of_node: BoolArray) -> FrameRecords:
    """The records with their lengths multiplied where that was done to their node, of_node (n,)."""
    return FrameRecords(
        replace(record, node_from_cam=record.node_from_cam.scaled(factor)) if of_node[record.node] else record
        for record in records
    )


def seen_by_another(records: Sequence[FrameRecord], old: Camera, new: Camera) -> FrameRecords:
    """The records with rays of another calibration of the same camera."""

    def turned(seen: Seen) -> Seen:
        px = old.pixels_from_rays(seen.rays.astype(np.float64))
        return replace(seen, rays=new.rays_from_pixels(px).astype(np.float32))

    return FrameRecords(
        record if record.seen is None else replace(record, seen=turned(record.seen)) for record in records
    )


def settle(
    visual_map: VisualMap,
    records: Sequence[FrameRecord],
    before: Sequence[Pose],
    ray_sigma: float,
    flown: IntArray | None = None,
) -> FrameRecords:
    """The records with every frame between nodes found again from the points it saw, which have moved.

    before: poses of the nodes before they moved; ray_sigma: standard deviation of a followed point's ray;
    flown: nodes of the flight that the records are of, in the order of time, all by default. Frames whose
    points are not at hand move as the nodes before and after them do.
    """
    points: dict[int, tuple[FloatArray, FloatArray]] = {}
    flown = np.arange(len(visual_map)) if flown is None else flown
    settled = FrameRecords()
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
        settled.append(found or _moved_along(visual_map, record, before, flown))
    return settled


def _moved_along(
    visual_map: VisualMap, record: FrameRecord, before: Sequence[Pose], flown: IntArray
) -> FrameRecord:
    """The record moved as its node and the other neighbour in time, by the time between them."""
    own_ns = visual_map.nodes[record.node].t_ns
    if own_ns == record.t_ns:
        return record
    after = bisect_left(flown, record.t_ns, key=lambda index: visual_map.nodes[index].t_ns)
    beside = [int(index) for index in flown[max(after - 1, 0) : after + 1]]
    if len(beside) < 2 or record.node not in beside:
        return record
    other = beside[0] if beside[1] == record.node else beside[1]
    old = before[record.node] @ record.node_from_cam
    own, theirs = (
        visual_map.graph.pose(index) @ before[index].inverse() @ old for index in (record.node, other)
    )
    share = (record.t_ns - own_ns) / (visual_map.nodes[other].t_ns - own_ns)
    pose = own @ Pose.exp(share * (own.inverse() @ theirs).log())
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
