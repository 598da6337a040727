"""From a run to the rows of its map file."""

from __future__ import annotations

from typing import Any

import numpy as np

from overfly.graph.pose_graph import PoseGraph
from overfly.mapstore import blobs
from overfly.mapstore.content import FlightEntry
from overfly.types import IntArray
from overfly.visual_map import Node

Row = tuple[Any, ...]


def flight_row(flight: FlightEntry) -> Row:
    return (
        flight.number,
        flight.source,
        flight.created,
        flight.software,
        blobs.rig_to_json(flight.rig),
        flight.config.to_yaml(),
        blobs.to_json(flight.progress),
        int(flight.complete),
    )


def node_row(node: Node, flight: int) -> Row:
    tilt = np.append(node.tilt.level_from_cam.ravel(), node.tilt.sigma_rad)
    height = node.height
    return (
        node.index,
        flight,
        node.frame_index,
        node.t_ns,
        node.parent,
        node.constraint,
        node.n_continued,
        blobs.pack(tilt, "<f8"),
        None if height is None else blobs.pack(np.array([height.z_m, height.sigma_m]), "<f8"),
        len(node.features),
    )


def features_row(node: Node) -> Row:
    features = node.features
    kind = "u1" if features.descriptors.dtype == np.uint8 else "f4"
    return (
        node.index,
        f"{kind}:{features.descriptors.shape[1]}",
        blobs.pack(features.descriptors, "|u1" if kind == "u1" else "<f4"),
        blobs.pack(features.px, "<f4"),
        blobs.pack(features.size_px, "<f4"),
        blobs.pack(features.angle_rad, "<f4"),
        blobs.pack(features.response, "<f4"),
        blobs.pack(node.rays, "<f8"),
        blobs.pack(node.ray_sigma, "<f8"),
        blobs.pack(node.inverse_depth, "<f8"),
    )


def points_row(node: Node) -> Row:
    return (
        node.index,
        blobs.pack(node.points_in_cam, "<f8"),
        blobs.pack(node.depth_sigma_m, "<f8"),
        blobs.pack(node.tracks, "<i8"),
        blobs.pack(node.anchor, "<i4"),
        blobs.pack(node.anchor_row, "<i4"),
    )


def pose_table(graph: PoseGraph) -> np.ndarray:
    """(n, 7) positions and quaternions of the nodes."""
    return np.hstack([graph.positions, graph.quaternions])


def pose_rows(table: np.ndarray, numbers: IntArray) -> list[Row]:
    return [(int(number), blobs.pack(table[number], "<f8")) for number in numbers]


def constraint_table(graph: PoseGraph) -> np.ndarray:
    """(m, 47) of the constraints: what of them changes, their state and measured pose and information, then
    their ends and kind."""
    return np.column_stack(
        [
            graph.measured_positions,
            graph.measured_quaternions,
            graph.information.reshape(-1, 36),
            graph.states,
            graph.kinds,
            graph.i,
            graph.j,
        ]
    )


def constraint_rows(table: np.ndarray, numbers: IntArray) -> list[Row]:
    rows = []
    for number in numbers:
        state, kind, i, j = (int(value) for value in table[number, 43:])
        rows.append(
            (
                int(number),
                i,
                j,
                kind,
                state,
                blobs.pack(table[number, :7], "<f8"),
                blobs.pack(table[number, 7:43], "<f8"),
            )
        )
    return rows
