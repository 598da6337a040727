"""What a run needs, beside the map itself, to carry on where it was broken off."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from overfly.frame_records import FrameRecord
from overfly.frame_result import FrameResult
from overfly.mapstore.content import FrameEntry
from overfly.mapstore.map import Map
from overfly.scale import ScaleKeeper
from overfly.slam import Slam
from overfly.start import Start
from overfly.types import Frame
from overfly.visual_map import VisualMap


def progress_of(slam: Slam) -> dict[str, Any]:
    """How the map began, the relief learnt, and what the keeper of the scale has seen; for JSON."""
    start, keeper = slam.start, slam._scale
    return {
        "start": None
        if start is None
        else {
            "height_m": start.height_m,
            "level_from_cam": start.level_from_cam.tolist(),
            "source": start.source,
        },
        "relief": slam._mapper._relief,
        "finished": slam.is_finished,
        "scale": None
        if keeper is None
        else {
            "source": keeper.source,
            "log_ratios": keeper._log_ratios,
            "next_check": keeper._next_check,
        },
    }


def restore(slam: Slam, known: Map, flight: int) -> None:
    """Put the map, and what was known when it was saved, into a Slam that has not seen a frame.

    flight: whose frames become the records that the slam goes on with.
    Raises ValueError, KeyError or TypeError when the progress in the file makes no sense.
    """
    fill(slam.map, known.visual)
    slam.records[:] = [
        FrameRecord(
            frame.frame_index,
            frame.t_ns,
            frame.node,
            frame.node_from_cam,
            frame.online,
            frame.piece,
        )
        for frame in known.frames
        if frame.flight == flight
        and frame.node is not None
        and frame.node_from_cam is not None
        and frame.online is not None
    ]
    progress = known.flights[flight].progress
    start, relief, keeper = progress["start"], progress["relief"], progress["scale"]
    if start is not None:
        level = np.array(start["level_from_cam"], np.float64).reshape(3, 3)
        slam._mapper.start = Start(float(start["height_m"]), level, str(start["source"]))
    if relief is not None:
        slam._mapper._relief = float(relief)
    if keeper is not None:
        slam._scale = ScaleKeeper(str(keeper["source"]))
        slam._scale._log_ratios = [float(value) for value in keeper["log_ratios"]]
        slam._scale._next_check = int(keeper["next_check"])
        _see_positions_again(slam._scale, slam, known, flight)
    slam.is_finished = bool(progress.get("finished", False))
    slam._optimiser.refresh()
    for record in slam.records[-2:]:  # the velocity
        slam._locator._motion.update(record.t_ns, slam.pose_of(record))
    if len(known.frames) and known.frames[-1].node is None and slam.records:
        slam._locator.lose()


def continue_in(slam: Slam, known: Map) -> None:
    """Put a map into a Slam whose vehicle is somewhere over it: the first frame is sought in all of it.

    Raises ValueError, KeyError or TypeError when the progress in the file makes no sense.
    """
    restore(slam, replace(known, frames=[]), len(known.flights) - 1)
    slam._scale = None  # the map's metre is settled
    slam.map.recent.clear()  # odometry has used none of these nodes yet
    slam._locator.lose()


def fill(empty: VisualMap, known: VisualMap) -> None:
    """Put a map into an empty one that others hold on to."""
    graph = known.graph
    empty.graph.add_nodes(graph.positions, graph.quaternions)
    empty.graph.add_constraints(
        graph.i,
        graph.j,
        graph.measured_positions,
        graph.measured_quaternions,
        graph.information,
        graph.kinds,
        graph.states,
    )
    empty.nodes.extend(known.nodes)
    empty.n_tracks = known.n_tracks
    empty.recent = list(range(len(known.nodes)))


def frame_entry(flight: int, frame: Frame, result: FrameResult, record: FrameRecord | None) -> FrameEntry:
    """What is kept of a frame. record: where it hangs in the graph, None when it was lost."""
    return FrameEntry(
        flight,
        frame.t_ns,
        frame.index,
        None if record is None else record.node,
        result.node is not None,
        None if record is None else record.node_from_cam,
        None if record is None else record.online,
        result.reason,
        result.detail,
        result.n_matches,
        result.n_inliers,
        result.rms_px if math.isfinite(result.rms_px) else math.nan,
        result.piece,
        frame.position,
        dict(result.timings_s),
        result.revisit,
    )


def _see_positions_again(keeper: ScaleKeeper, slam: Slam, known: Map, flight: int) -> None:
    """Positions are not kept twice: the frames have them."""
    cam_from_body = slam.rig.cam0.body_from_cam.inverse()
    poses = {record.t_ns: slam.pose_of(record) for record in slam.records}
    for entry in known.frames:
        if entry.flight == flight and entry.t_ns in poses and entry.position is not None:
            keeper.observe_position(entry.position, poses[entry.t_ns] @ cam_from_body)
