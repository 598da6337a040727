"""Writing a map while it grows: one transaction brings the file from one moment of the flight to a later
one."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from overfly.errors import OutputError
from overfly.files import atomic_path
from overfly.mapstore import blobs, rows, schema
from overfly.mapstore.content import FlightEntry, FrameEntry
from overfly.mapstore.database import close_whole, connect_to_write, create, transaction, writing
from overfly.mapstore.frame_log import FrameBlock, FrameLog
from overfly.mapstore.map import Map
from overfly.mapstore.schema import put
from overfly.products.georeference import GeoReference
from overfly.types import IntArray
from overfly.visual_map import Node, VisualMap

SAVE_EVERY_NS = 500_000_000  # of flight: less than a second is ever lost


class MapWriter:
    """Holds a map file open and knows what is in it already.

    Poses and constraints are compared with what was written last; of the nodes the newest are looked at,
    because only the sliding window changes nodes, and all when lengths were rescaled.
    """

    def __init__(
        self, path: Path, connection: sqlite3.Connection, flight: FlightEntry, node_flights: list[int]
    ) -> None:
        self.path = path
        self.flight = flight
        self._connection = connection
        self._poses = np.empty((0, 7))
        self._constraints = np.empty((0, 47))
        self._points: list[np.ndarray] = []  # the arrays as they were written: rescaling replaces them
        self._written: dict[int, tuple[rows.Row, rows.Row]] = {}  # of the newest nodes
        self._node_flights = node_flights  # of the nodes that were there before this flight went on
        self._blocks: list[FrameBlock] = []  # of frames, as they were written
        self._last_save_ns: int | None = None
        self._is_closed = False

    @staticmethod
    def begin(path: Path, flight: FlightEntry) -> MapWriter:
        """A new map file. Raises OutputError, also when there is one already."""
        if path.exists():
            raise OutputError(f"{path} exists already")
        write_whole(path, Map(VisualMap(), [flight]))  # so that the file is a map from its first moment
        return MapWriter(path, connect_to_write(path), flight, [])

    @staticmethod
    def carry_on(path: Path, known: Map) -> MapWriter:
        """The file of a map that was just read, to continue its newest flight. Raises MapFileError,
        OutputError."""
        writer = MapWriter(path, connect_to_write(path), known.flights[-1], known.node_flights)
        graph = known.visual.graph
        writer._poses = rows.pose_table(graph)
        writer._constraints = rows.constraint_table(graph)
        writer._points = [node.points_in_cam for node in known.visual.nodes]
        writer._blocks = [*FrameLog.of(known.frames).all_blocks()]
        return writer

    def is_due(self, t_ns: int) -> bool:
        """Whether so much was flown since the last time that it should be saved now."""
        return self._last_save_ns is None or t_ns - self._last_save_ns >= SAVE_EVERY_NS

    def save(
        self,
        visual_map: VisualMap,
        frames: Sequence[FrameEntry],
        progress: dict[str, Any],
        *,
        complete: bool = False,
        georeference: GeoReference | None = None,
    ) -> None:
        """Write what is new or has changed, all or nothing.

        frames: all of them, older flights' first. Raises OutputError.
        """
        self.flight = replace(self.flight, progress=progress, complete=complete)
        poses, constraints = rows.pose_table(visual_map.graph), rows.constraint_table(visual_map.graph)
        with transaction(self._connection, self.path):
            put(self._connection, schema.FLIGHTS, [rows.flight_row(self.flight)])
            self._put_nodes(visual_map)
            put(self._connection, schema.POSES, rows.pose_rows(poses, _changed(poses, self._poses)))
            changed = _changed(constraints, self._constraints)
            put(self._connection, schema.CONSTRAINTS, rows.constraint_rows(constraints, changed))
            blocks = FrameLog.of(frames).all_blocks()
            written = [*self._blocks, *[None] * len(blocks)]
            fresh = (number for number, block in enumerate(blocks) if block is not written[number])
            put(self._connection, schema.FRAMES, (blocks[number].row(number) for number in fresh))
            self._connection.execute(f"DELETE FROM {schema.FRAMES.name} WHERE number >= ?", (len(blocks),))
            facts: dict[str, Any] = {
                "counts": [len(visual_map), len(constraints), len(frames)],
                "tracks": visual_map.n_tracks,
            }
            if georeference is not None:
                facts["georeference"] = {
                    "crs": georeference.crs,
                    "scale": georeference.scale,
                    "rotation_rad": georeference.rotation_rad,
                    "translation_m": list(georeference.translation_m),
                }
            put(
                self._connection,
                schema.FACTS,
                [(name, blobs.to_json(value)) for name, value in facts.items()],
            )
        self._poses, self._constraints, self._blocks = poses, constraints, blocks
        if len(frames):
            self._last_save_ns = frames[-1].t_ns

    def close(self) -> None:
        """Everything into the one file; a second time does nothing. Raises OutputError."""
        if not self._is_closed:
            self._is_closed = True
            close_whole(self._connection, self.path)

    def _put_nodes(self, visual_map: VisualMap) -> None:
        """New nodes whole; of older ones what changed."""
        known = len(self._points)
        rescaled = [
            node
            for node, points in zip(visual_map.nodes, self._points, strict=False)
            if node.points_in_cam is not points
        ]
        whole = rescaled + visual_map.nodes[known:]
        settings = self.flight.config
        recent = visual_map.nodes[-(settings.window.nodes + settings.nodes.previous + 1) :]
        written = {
            node.index: (rows.node_row(node, self._flight_of(node)), rows.points_row(node)) for node in recent
        }
        changed = {index: pair for index, pair in written.items() if self._written.get(index) != pair}
        for node in whole:
            changed[node.index] = rows.node_row(node, self._flight_of(node)), rows.points_row(node)
        put(self._connection, schema.NODES, [pair[0] for pair in changed.values()])
        put(self._connection, schema.FEATURES, map(rows.features_row, whole))
        put(self._connection, schema.POINTS, [pair[1] for pair in changed.values()])
        self._points = [node.points_in_cam for node in visual_map.nodes]
        self._written = written

    def _flight_of(self, node: Node) -> int:
        known = self._node_flights
        return known[node.index] if node.index < len(known) else self.flight.number


def write_whole(path: Path, known: Map) -> None:
    """A map file of one flight or several, whole or not at all. Raises OutputError."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        temporary.unlink(missing_ok=True)
        newest = known.flights[-1]
        writer = MapWriter(path, create(temporary), newest, known.node_flights)
        with transaction(writer._connection, path):
            put(writer._connection, schema.FLIGHTS, map(rows.flight_row, known.flights))
        writer.save(
            known.visual,
            known.frames,
            newest.progress,
            complete=newest.complete,
            georeference=known.georeference,
        )
        writer.close()


def _changed(now: np.ndarray, before: np.ndarray) -> IntArray:
    """Rows that are new or differ."""
    differs = (now[: len(before)] != before).any(axis=1)
    return np.concatenate([np.flatnonzero(differs), np.arange(len(before), len(now))])
