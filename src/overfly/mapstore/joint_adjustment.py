"""The adjustment of two maps that were joined, and what follows the nodes that it moves."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from overfly.adjustment import adjust_map
from overfly.frame_records import FrameRecord, settle
from overfly.geometry.poses import Pose, rotation_z
from overfly.geometry.similarity import align_about_vertical
from overfly.mapstore.content import FrameEntry
from overfly.mapstore.map import Map
from overfly.slam import Slam
from overfly.vision.observation import working_rig
from overfly.visual_map import VisualMap

EVEN_M = 1e-3  # all nodes count alike where a map is laid onto where it was


def adjust_both(joined: VisualMap, older: Map, slam: Slam) -> float:
    """All poses and points of both maps adjusted together: nodes of both that look at the same ground are
    compared. The older nodes lie as before on the whole, with their metre.

    joined: the older map's nodes, then those of the slam. Returns by what lengths were multiplied.
    """
    rigs = [working_rig(flight.rig, flight.config.features.max_width_px) for flight in older.flights]
    cameras = [rigs[number].cam0.camera for number in older.node_flights]
    cameras += [slam.rig.cam0.camera] * len(slam.map)
    instruments = slam.instruments
    measured = any(np.isfinite(node.inverse_depth).any() for node in older.visual.nodes)
    instruments = replace(
        instruments,
        comparison=replace(instruments.comparison, cameras=tuple(cameras)),
        measures_depth=instruments.measures_depth or measured,
    )
    before = joined.graph.positions[: len(older)].copy()
    report = adjust_map(joined, instruments)
    if report is None:
        return 1.0
    same = align_about_vertical(joined.graph.positions[: len(older)], before, np.full(len(older), EVEN_M))
    if same is None:
        return report.growth
    back = Pose(rotation_z(same.rotation_rad), same.translation_m)
    joined.lay(np.ones(len(joined), np.bool_), same.scale, back, heights_are_measured=True)
    return report.growth * same.scale


def moved_frames(joined: VisualMap, older: Map, size: float) -> Iterator[FrameEntry]:
    """Frames of the older map where its nodes have taken them. size: by what lengths were multiplied."""
    before = [older.visual.graph.pose(index).scaled(size) for index in range(len(older))]
    flights = np.array(older.node_flights)
    flown = [np.flatnonzero(flights == flight.number) for flight in older.flights]
    for frame in older.frames:
        if frame.node is None or frame.node_from_cam is None or frame.online is None:
            yield frame
            continue
        hanging = frame.node_from_cam.scaled(size)
        record = FrameRecord(frame.frame_index, frame.t_ns, frame.node, hanging, frame.online)
        (moved,) = settle(joined, [record], before, 0.0, flown[frame.flight])
        yield replace(frame, node_from_cam=moved.node_from_cam)


def take_over(slam: Slam, joined: VisualMap, size: float) -> None:
    """The slam's own map, and the frames on it, as they are in the joined one, of which it is the end."""
    if slam.start is not None and size != 1.0:
        slam.rescale(size, slam.start.source)
    before = [slam.map.graph.pose(index) for index in range(len(slam.map))]
    first = len(joined) - len(slam.map)
    slam.map.graph.positions[:] = joined.graph.positions[first:]
    slam.map.graph.quaternions[:] = joined.graph.quaternions[first:]
    for node, twin in zip(slam.map.nodes, joined.nodes[first:], strict=True):
        node.points_in_cam, node.depth_sigma_m = twin.points_in_cam, twin.depth_sigma_m
    slam.records = settle(slam.map, slam.records, before, slam.ray_sigma)
