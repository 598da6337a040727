"""How map files of older versions are brought up to this one."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Sequence
from typing import Any

from overfly.mapstore import blobs, schema
from overfly.mapstore.content import FrameEntry
from overfly.mapstore.frame_log import FrameLog, revisit_from_tree
from overfly.mapstore.schema import Table, put, stored
from overfly.types import Reason

FRAMES_1 = Table(
    "frames",
    (
        "flight INTEGER NOT NULL REFERENCES flights (number)",
        "time_ns INTEGER NOT NULL",
        "frame INTEGER NOT NULL",
        "node INTEGER REFERENCES nodes (number)",
        "made_node INTEGER NOT NULL",
        "node_from_cam BLOB",
        "online BLOB",
        "covariance BLOB",
        "reason TEXT",
        "detail TEXT NOT NULL",
        "matches INTEGER NOT NULL",
        "inliers INTEGER NOT NULL",
        "rms_px REAL",
        "position BLOB",
        "report TEXT NOT NULL",
    ),
    keys=2,
)
# The tables of each version, by which a file is known to be what it says.
TABLES: dict[int, Sequence[Table]] = {
    1: (*schema.TABLES[:-1], FRAMES_1),
    schema.VERSION: schema.TABLES,
}


def _pack_frames(connection: sqlite3.Connection) -> None:
    """1 to 2: a row for each frame became a row for some frames, without the covariances."""
    entries = [_frame_1(row) for row in stored(connection, FRAMES_1)]
    connection.execute("DROP TABLE frames")
    connection.execute(schema.FRAMES.create)
    blocks = FrameLog(entries).all_blocks()
    put(connection, schema.FRAMES, (block.row(number) for number, block in enumerate(blocks)))


def _frame_1(row: tuple[Any, ...]) -> FrameEntry:
    """Raises ValueError, KeyError or TypeError for what makes no sense."""
    (
        flight, t_ns, frame, node, made_node, node_from_cam, online, _, reason, detail, matches, inliers,
        rms_px, position, text,
    ) = row  # fmt: skip
    if (node is None) != (node_from_cam is None) or (node is None) != (online is None):
        raise ValueError(f"the frame at {t_ns} ns has a place that is half known")
    report = dict(blobs.from_json(text))
    revisit = report.get("revisit")
    return FrameEntry(
        flight, t_ns, frame, node, bool(made_node),
        None if node_from_cam is None else blobs.unpack_pose(node_from_cam),
        None if online is None else blobs.unpack_pose(online),
        None if reason is None else Reason(reason), detail, matches, inliers,
        float("nan") if rms_px is None else rms_px, int(report.get("piece", 0)),
        blobs.unpack_position(position),
        {str(stage): float(seconds) for stage, seconds in report.get("seconds", {}).items()},
        None if revisit is None else revisit_from_tree(revisit),
    )  # fmt: skip


# From the version that stands as the key to the next one.
MIGRATIONS: dict[int, Callable[[sqlite3.Connection], None]] = {1: _pack_frames}


def migrate(connection: sqlite3.Connection, version: int) -> None:
    """Bring a map of an older version up to this one, each step in a transaction of its own.

    Raises ValueError, KeyError or TypeError where the older map makes no sense.
    """
    for old in range(version, schema.VERSION):
        connection.execute("BEGIN IMMEDIATE")
        try:
            MIGRATIONS[old](connection)
            connection.execute(f"PRAGMA user_version = {old + 1}")
            connection.execute("COMMIT")
        except BaseException:
            connection.execute("ROLLBACK")
            raise
