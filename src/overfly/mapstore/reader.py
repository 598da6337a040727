"""From the rows of a map file to a visual map, with everything checked that a hostile or damaged file could
say."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import ValidationError

from overfly.config import Config
from overfly.errors import MapFileError
from overfly.graph.pose_graph import KINDS, State
from overfly.mapstore import blobs, schema
from overfly.mapstore.content import FlightEntry
from overfly.mapstore.database import making_sense, rows_of
from overfly.mapstore.frame_log import FrameBlock, FrameLog
from overfly.types import Features
from overfly.vision.refine import HeightPrior, TiltPrior
from overfly.visual_map import Node, VisualMap

MOST_FEATURES = 100_000  # of one node
DESCRIPTOR_TYPES = {"u1": "|u1", "f4": "<f4"}
LONGEST_DESCRIPTOR = 512  # elements


def read_facts(connection: sqlite3.Connection, path: Path) -> dict[str, Any]:
    """What is said of the map as a whole."""
    facts = {}
    for name, text in rows_of(connection, schema.FACTS, path):
        with making_sense(path, f"fact {name!r}"):
            facts[name] = blobs.from_json(text)
    for name in ("counts", "tracks"):
        if name not in facts:
            raise MapFileError(f"{path}: fact {name!r} is missing; the map is damaged")
    return facts


def read_flights(connection: sqlite3.Connection, path: Path) -> list[FlightEntry]:
    flights: list[FlightEntry] = []
    for number, source, created, software, rig, config, progress, complete in rows_of(
        connection, schema.FLIGHTS, path
    ):
        with making_sense(path, f"flight {number}"):
            in_order(number, len(flights))
            flights.append(
                FlightEntry(
                    number, source, created, software, blobs.rig_from_json(rig), _config(config),
                    dict(blobs.from_json(progress)), bool(complete),
                )
            )  # fmt: skip
    if not flights:
        raise MapFileError(f"{path}: names no flight; the map is damaged")
    return flights


def read_visual_map(
    connection: sqlite3.Connection, path: Path, n_tracks: int, n_flights: int
) -> tuple[VisualMap, list[int]]:
    """The map, and the flight that each of its nodes comes from."""
    visual_map = VisualMap(n_tracks=n_tracks)
    _read_poses(connection, path, visual_map)
    _read_constraints(connection, path, visual_map)
    flights: list[int] = []
    columns = zip(
        rows_of(connection, schema.NODES, path),
        rows_of(connection, schema.FEATURES, path),
        rows_of(connection, schema.POINTS, path),
        strict=True,
    )
    with making_sense(path, "the list of nodes"):
        for node, features, points in columns:
            number = len(visual_map.nodes)
            with making_sense(path, f"node {number}"):
                for row in (node, features, points):
                    in_order(row[0], number)
                inside(node[1], n_flights)
                visual_map.nodes.append(_node(node, features, points, visual_map))
                flights.append(int(node[1]))
        if len(visual_map.nodes) != len(visual_map.graph):
            raise ValueError("as many poses as nodes belong in a map")
    return visual_map, flights


def read_frames(connection: sqlite3.Connection, path: Path, n_flights: int, n_nodes: int) -> FrameLog:
    log = FrameLog()
    for number, *columns in rows_of(connection, schema.FRAMES, path):
        with making_sense(path, f"block {number} of frames"):
            in_order(number, len(log.blocks))
            block = FrameBlock(*columns)
            block.check(n_flights, n_nodes)
            log.add_block(block)
    return log


def in_order(number: int, expected: int) -> None:
    if number != expected:
        raise ValueError(f"number {number} stands where {expected} belongs")


def _read_poses(connection: sqlite3.Connection, path: Path, visual_map: VisualMap) -> None:
    table: list[Any] = []
    for number, blob in rows_of(connection, schema.POSES, path):
        with making_sense(path, f"the pose of node {number}"):
            in_order(number, len(table))
            table.append(blobs.unpack_quaternion_pose(blob))
    poses = np.array(table, np.float64).reshape(-1, 7)
    visual_map.graph.add_nodes(poses[:, :3], poses[:, 3:])


def _read_constraints(connection: sqlite3.Connection, path: Path, visual_map: VisualMap) -> None:
    rows: list[tuple[Any, ...]] = []
    for number, i, j, kind, state, measured, information in rows_of(connection, schema.CONSTRAINTS, path):
        with making_sense(path, f"constraint {number}"):
            in_order(number, len(rows))
            inside(i, len(visual_map.graph))
            inside(j, len(visual_map.graph))
            inside(kind, len(KINDS))
            State(state)
            matrix = blobs.unpack(information, "<f8", (6, 6))
            rows.append((i, j, blobs.unpack_quaternion_pose(measured), matrix, kind, state))
    if not rows:
        return
    i, j, measured, information, kinds, states = (np.array(column) for column in zip(*rows, strict=True))
    visual_map.graph.add_constraints(
        i.astype(np.int64), j.astype(np.int64), measured[:, :3], measured[:, 3:], information,
        kinds.astype(np.uint8), states.astype(np.uint8),
    )  # fmt: skip


def _node(
    node: tuple[Any, ...], features: tuple[Any, ...], points: tuple[Any, ...], visual_map: VisualMap
) -> Node:
    number, _, frame, t_ns, parent, constraint, continued, tilt, height, count = node
    if not 0 <= count <= MOST_FEATURES:
        raise ValueError(f"{count} features")
    if not -1 <= parent < number or not -1 <= constraint < visual_map.graph.n_constraints:
        raise ValueError("a parent that is none")
    if parent >= 0 > constraint:
        raise ValueError("no constraint to its parent")
    level = blobs.unpack(tilt, "<f8", (10,))
    held = None if height is None else blobs.unpack(height, "<f8", (2,))
    described = _features(features, count)
    tracks = blobs.unpack(points[3], "<i8", (count,))
    anchor = blobs.unpack(points[4], "<i4", (count,)).astype(np.int64)
    anchor_row = blobs.unpack(points[5], "<i4", (count,)).astype(np.int64)
    if count:
        inside(int(tracks.min()), visual_map.n_tracks)
        inside(int(tracks.max()), visual_map.n_tracks)
        inside(int(anchor.min()), number + 1)
        inside(int(anchor.max()), number + 1)
    for origin in np.unique(anchor):
        size = count if origin == number else len(visual_map.nodes[origin].features)
        rows = anchor_row[anchor == origin]
        inside(int(rows.min()), size)
        inside(int(rows.max()), size)
    return Node(
        index=number,
        frame_index=frame,
        t_ns=t_ns,
        features=described,
        rays=blobs.unpack(features[7], "<f8", (count, 2), unknown=True),
        points_in_cam=blobs.unpack(points[1], "<f8", (count, 3), unknown=True),
        depth_sigma_m=blobs.unpack(points[2], "<f8", (count,), unknown=True),
        inverse_depth=blobs.unpack(features[9], "<f8", (count,), unknown=True),
        ray_sigma=blobs.unpack(features[8], "<f8", (count,)),
        tracks=tracks,
        anchor=anchor,
        anchor_row=anchor_row,
        tilt=TiltPrior(level[:9].reshape(3, 3).copy(), float(level[9])),
        height=None if held is None else HeightPrior(float(held[0]), float(held[1])),
        parent=parent,
        constraint=constraint,
        n_continued=continued,
    )


def _features(row: tuple[Any, ...], count: int) -> Features:
    _, kind, descriptors, px, size_px, angle_rad, response, *_ = row
    name, _, elements = kind.partition(":")
    dtype, width = DESCRIPTOR_TYPES[name], int(elements)
    if not 0 < width <= LONGEST_DESCRIPTOR:
        raise ValueError(f"descriptors of {width} elements")
    return Features(
        blobs.unpack(px, "<f4", (count, 2)),
        blobs.unpack(descriptors, dtype, (count, width)),
        blobs.unpack(size_px, "<f4", (count,)),
        blobs.unpack(angle_rad, "<f4", (count,)),
        blobs.unpack(response, "<f4", (count,)),
    )


def inside(number: int, end: int) -> None:
    if not 0 <= number < end:
        raise ValueError(f"{number} where 0 to {end - 1} can be")


def _config(text: str) -> Config:
    if len(text) > blobs.LONGEST_TEXT:
        raise ValueError("settings that are too long")
    try:
        return Config.model_validate(yaml.safe_load(text))
    except (yaml.YAMLError, ValidationError) as error:
        raise ValueError(f"settings: {str(error).splitlines()[0]}") from error
