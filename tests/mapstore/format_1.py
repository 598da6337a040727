"""Map files as format 1 had them: one row for each frame, with its covariance."""

from __future__ import annotations

import math
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np

from overfly.mapstore import FrameEntry, Map, blobs
from overfly.mapstore.schema import checksum
from overfly.mapstore.writer import write_whole

CREATE_FRAMES = (
    "CREATE TABLE frames (flight INTEGER NOT NULL REFERENCES flights (number), time_ns INTEGER NOT NULL, "
    "frame INTEGER NOT NULL, node INTEGER REFERENCES nodes (number), made_node INTEGER NOT NULL, "
    "node_from_cam BLOB, online BLOB, covariance BLOB, reason TEXT, detail TEXT NOT NULL, "
    "matches INTEGER NOT NULL, inliers INTEGER NOT NULL, rms_px REAL, position BLOB, report TEXT NOT NULL, "
    "checksum INTEGER NOT NULL, PRIMARY KEY (flight, time_ns)) STRICT"
)


def write_format_1(path: Path, known: Map) -> None:
    """The map as an older version wrote it."""
    write_whole(path, known)
    with sqlite3.connect(path) as connection:
        connection.execute("DROP TABLE frames")
        connection.execute(CREATE_FRAMES)
        rows = map(_row, known.frames)
        marks = ", ".join("?" * 16)
        connection.executemany(
            f"INSERT INTO frames VALUES ({marks})", ((*row, checksum(row)) for row in rows)
        )
        connection.execute("PRAGMA user_version = 1")
    connection.close()


def _row(frame: FrameEntry) -> tuple[Any, ...]:
    report: dict[str, Any] = {"seconds": frame.seconds}
    if frame.revisit is not None:
        report["revisit"] = {
            "status": "accepted", "candidates": 3, "node": 1, "matches": 0, "inliers": 0, "reason": None,
            "detail": "", "constraint": None, "confirmed": [[0, 2]], "moved": False, "seconds": 0.0,
        }  # fmt: skip
    if frame.piece:
        report["piece"] = frame.piece
    lost = frame.node is None
    return (
        frame.flight,
        frame.t_ns,
        frame.frame_index,
        frame.node,
        int(frame.made_node),
        None if frame.node_from_cam is None else blobs.pack_pose(frame.node_from_cam),
        None if frame.online is None else blobs.pack_pose(frame.online),
        None if lost else blobs.pack(np.eye(6), "<f8"),
        None if frame.reason is None else str(frame.reason),
        frame.detail,
        frame.n_matches,
        frame.n_inliers,
        None if math.isnan(frame.rms_px) else frame.rms_px,
        blobs.pack_position(frame.position),
        blobs.to_json(report),
    )
