"""Two maps made one: where the newer one's nodes see ground of the older, they are tied; then both are
optimised and adjusted together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from overfly.attitude_hold import hold_attitude
from overfly.geometry.levelling import level_from_cam
from overfly.geometry.poses import FloatArray, Pose, euler_from_rotation
from overfly.geometry.similarity import align_about_vertical
from overfly.graph.batch import Start, optimise_batch
from overfly.graph.robust import Kernel, Robust
from overfly.localizer import Localizer
from overfly.mapstore.content import FlightEntry, FrameEntry
from overfly.mapstore.frame_log import FrameLog
from overfly.mapstore.joint_adjustment import adjust_both, moved_frames, take_over
from overfly.mapstore.map import Map
from overfly.revisit.verification import Query
from overfly.scale import WITHOUT_OWN_METRE
from overfly.slam import Slam
from overfly.types import Attitude, Constraint, NotFound, Reason
from overfly.vision.odometry import Located
from overfly.visual_map import Node, VisualMap

LEAST_PLACES = 3  # nodes that must be found in the older map, and agree on how the maps lie
AGREE_M = 0.1  # of the height, and of the distance between both nodes: what odometry may have drifted
AGREE_RAD = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A node of the newer map as the older map sees it."""

    node: int
    located: Located
    tie: Constraint  # from a node of the older map; j counts in the newer


def join(older: Map, slam: Slam, flight: FlightEntry, frames: Sequence[FrameEntry]) -> Map | NotFound:
    """The older map with the flight that a slam has mapped; the slam's own map then lies in the older one's
    world.

    A newer map without a metre of its own takes the older one's. NotFound, and the slam as it was, when too
    few of its nodes show ground of the older map.
    """
    seen = _find_nodes(older, slam)
    factor = _scale(slam, seen)
    poses = [slam.map.graph.pose(index).scaled(factor) for index in range(len(slam.map))]
    agreeing = _largest_agreement(seen, poses)
    if len(agreeing) < LEAST_PLACES:
        return NotFound(
            Reason.INCONSISTENT, f"{len(seen)} nodes found in the older map, {len(agreeing)} of them agree"
        )
    if factor != 1.0:
        slam.rescale(factor, "map")
    middle = agreeing[len(agreeing) // 2]
    older_from_newer = middle.located.pose @ poses[middle.node].inverse()
    joined = _append(older.visual, slam.map, [older_from_newer @ pose for pose in poses])
    for one in agreeing:
        joined.graph.add_constraint(replace(one.tie, j=len(older) + one.node))
    optimise_batch(joined.graph, robust=Robust(Kernel.DCS), start=Start.GIVEN)
    hold_attitude(joined, slam.rig.cam0.body_from_cam.rotation)
    size = adjust_both(joined, older, slam) if slam.config.adjustment.enabled else 1.0
    moved = moved_frames(joined, older, size)
    take_over(slam, joined, size)
    newer = FrameLog(replace(frame, flight=len(older.flights)) for frame in frames)
    newer.rehang(slam.records)
    return Map(
        joined,
        [*older.flights, replace(flight, number=len(older.flights), complete=True)],
        [*older.node_flights, *[len(older.flights)] * len(slam.map)],
        FrameLog([*moved, *(_of_joined(frame, len(older)) for frame in newer)]),
        older.georeference,
    )


def _find_nodes(older: Map, slam: Slam) -> list[Seen]:
    """Each node is searched for in the whole older map."""
    localizer = Localizer(older, slam.source_rig, slam.config)
    seen = []
    for node in slam.map.nodes:
        query = _query_of(node, slam)
        located = localizer.search(query, node.t_ns)
        if isinstance(located, Located):
            seen.append(Seen(node.index, located, localizer.tie(located, query, node.index)))
    return seen


def _query_of(node: Node, slam: Slam) -> Query:
    """What the node's camera saw, with the attitude that its tilt came from."""
    body_from_cam = slam.rig.cam0.body_from_cam.rotation
    roll, pitch, _ = euler_from_rotation(node.tilt.level_from_cam @ level_from_cam(None, body_from_cam).T)
    return Query(node.features, node.rays, Attitude(roll, pitch, node.tilt.sigma_rad), node.tilt)


def _scale(slam: Slam, seen: list[Seen]) -> float:
    """What the lengths of a map without a metre are to be multiplied with."""
    if slam.start is None or slam.start.source not in WITHOUT_OWN_METRE or not seen:
        return 1.0
    own = slam.map.graph.positions[[one.node for one in seen]]
    there = np.array([one.located.pose.translation for one in seen])
    aligned = align_about_vertical(own, there, 0.01 * there[:, 2])
    if aligned is not None:
        return aligned.scale
    return float(np.median(there[:, 2] / own[:, 2]))


def _largest_agreement(seen: list[Seen], poses: list[Pose]) -> list[Seen]:
    """Those that one of them foretells best: where it puts the others is where they were found."""
    best: list[Seen] = []
    for one in seen:
        older_from_newer = one.located.pose @ poses[one.node].inverse()
        agreeing = [other for other in seen if _agrees(older_from_newer @ poses[other.node], one, other)]
        if len(agreeing) > len(best):
            best = agreeing
    return best


def _agrees(foretold: Pose, one: Seen, other: Seen) -> bool:
    found = other.located.pose
    apart: FloatArray = (found.inverse() @ foretold).log()
    distance = float(np.linalg.norm(found.translation - one.located.pose.translation))
    reach = AGREE_M * (float(found.translation[2]) + distance)
    return float(np.linalg.norm(apart[:3])) < reach and float(np.linalg.norm(apart[3:])) < AGREE_RAD


def _append(older: VisualMap, newer: VisualMap, poses: list[Pose]) -> VisualMap:
    """Both maps in one, the newer one's nodes and tracks numbered on, at these poses."""
    n_nodes, n_constraints, n_tracks = len(older), older.graph.n_constraints, older.n_tracks
    graph, added = older.graph.copy(), newer.graph
    for pose in poses:
        graph.add_node(pose)
    graph.add_constraints(
        added.i + n_nodes, added.j + n_nodes, added.measured_positions, added.measured_quaternions,
        added.information, added.kinds, added.states,
    )  # fmt: skip
    nodes = [
        replace(
            node,
            index=node.index + n_nodes,
            parent=node.parent + n_nodes if node.parent >= 0 else -1,
            constraint=node.constraint + n_constraints if node.constraint >= 0 else -1,
            tracks=node.tracks + n_tracks,
            anchor=node.anchor + n_nodes,
            pyramid=None,
        )
        for node in newer.nodes
    ]
    return VisualMap(graph=graph, nodes=[*older.nodes, *nodes], n_tracks=n_tracks + newer.n_tracks)


def _of_joined(frame: FrameEntry, n_older: int) -> FrameEntry:
    return frame if frame.node is None else replace(frame, node=frame.node + n_older)
