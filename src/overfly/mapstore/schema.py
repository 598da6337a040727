"""The tables of a map file, and their version.

Every row ends with a checksum (CRC-32) of its other columns. Arrays are blobs of little-endian numbers, row
by row, without a header: what they hold is fixed by their column and their length by the row's counts.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any
from zlib import crc32

APPLICATION_ID = 0x4F564659  # "OVFY"
VERSION = 2


@dataclass(frozen=True, slots=True)
class Table:
    """name, columns with their types as SQL has them, and how many of them, from the first, are the key."""

    name: str
    columns: tuple[str, ...]
    keys: int = 1

    @property
    def create(self) -> str:
        key = ", ".join(column.split()[0] for column in self.columns[: self.keys])
        columns = ", ".join((*self.columns, "checksum INTEGER NOT NULL"))
        return f"CREATE TABLE {self.name} ({columns}, PRIMARY KEY ({key})) STRICT"

    @property
    def insert(self) -> str:
        """A row in the place of one with the same key.

        Not INSERT OR REPLACE: that deletes the old row first, and all tables are searched for what refers
        to it.
        """
        names = [column.split()[0] for column in self.columns]
        marks = ", ".join("?" * (len(self.columns) + 1))
        key = ", ".join(names[: self.keys])
        changes = ", ".join(f"{name} = excluded.{name}" for name in (*names[self.keys :], "checksum"))
        return f"INSERT INTO {self.name} VALUES ({marks}) ON CONFLICT ({key}) DO UPDATE SET {changes}"

    @property
    def select(self) -> str:
        names = ", ".join(column.split()[0] for column in self.columns)
        order = ", ".join(column.split()[0] for column in self.columns[: self.keys])
        return f"SELECT {names}, checksum FROM {self.name} ORDER BY {order}"


FACTS = Table("facts", ("name TEXT NOT NULL", "value TEXT NOT NULL"))
FLIGHTS = Table(
    "flights",
    (
        "number INTEGER NOT NULL",
        "source TEXT NOT NULL",
        "created TEXT NOT NULL",
        "software TEXT NOT NULL",
        "rig TEXT NOT NULL",
        "config TEXT NOT NULL",
        "progress TEXT NOT NULL",
        "complete INTEGER NOT NULL",
    ),
)
NODES = Table(
    "nodes",
    (
        "number INTEGER NOT NULL",
        "flight INTEGER NOT NULL REFERENCES flights (number)",
        "frame INTEGER NOT NULL",
        "time_ns INTEGER NOT NULL",
        "parent INTEGER NOT NULL",
        "parent_constraint INTEGER NOT NULL",
        "continued INTEGER NOT NULL",
        "tilt BLOB NOT NULL",
        "height BLOB",
        "features INTEGER NOT NULL",
    ),
)
POSES = Table("poses", ("node INTEGER NOT NULL REFERENCES nodes (number)", "world_from_cam BLOB NOT NULL"))
FEATURES = Table(
    "features",
    (
        "node INTEGER NOT NULL REFERENCES nodes (number)",
        "descriptor_type TEXT NOT NULL",
        "descriptors BLOB NOT NULL",
        "px BLOB NOT NULL",
        "size_px BLOB NOT NULL",
        "angle_rad BLOB NOT NULL",
        "response BLOB NOT NULL",
        "rays BLOB NOT NULL",
        "ray_sigma BLOB NOT NULL",
        "inverse_depth BLOB NOT NULL",
    ),
)
POINTS = Table(
    "points",
    (
        "node INTEGER NOT NULL REFERENCES nodes (number)",
        "in_cam_m BLOB NOT NULL",
        "depth_sigma_m BLOB NOT NULL",
        "track BLOB NOT NULL",
        "anchor BLOB NOT NULL",
        "anchor_row BLOB NOT NULL",
    ),
)
CONSTRAINTS = Table(
    "constraints",
    (
        "number INTEGER NOT NULL",
        "i INTEGER NOT NULL REFERENCES nodes (number)",
        "j INTEGER NOT NULL REFERENCES nodes (number)",
        "kind INTEGER NOT NULL",
        "state INTEGER NOT NULL",
        "i_from_j BLOB NOT NULL",
        "information BLOB NOT NULL",
    ),
)
FRAMES = Table(
    "frames",
    (
        "number INTEGER NOT NULL",
        "count INTEGER NOT NULL",
        "stages TEXT NOT NULL",
        "numbers BLOB NOT NULL",
        "positions BLOB",
        "notes BLOB NOT NULL",
    ),
)
TABLES = (FACTS, FLIGHTS, NODES, POSES, FEATURES, POINTS, CONSTRAINTS, FRAMES)


def create_tables(connection: sqlite3.Connection) -> None:
    """Lay out an empty map, inside the transaction of the caller."""
    for table in TABLES:
        connection.execute(table.create)
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.execute(f"PRAGMA user_version = {VERSION}")


def put(connection: sqlite3.Connection, table: Table, rows: Iterable[tuple[Any, ...]]) -> None:
    """Write rows, replacing those with the same key."""
    connection.executemany(table.insert, ((*row, checksum(row)) for row in rows))


def stored(connection: sqlite3.Connection, table: Table) -> Iterator[tuple[Any, ...]]:
    """All rows by key. Raises ValueError for a row that does not fit its checksum."""
    for row in connection.execute(table.select):
        if checksum(row[:-1]) != row[-1]:
            raise ValueError(f"table {table.name}, row {row[0]!r} is damaged")
        yield row[:-1]


def checksum(row: tuple[Any, ...]) -> int:
    """CRC-32 over the values of a row."""
    sum_ = 0
    for value in row:
        if isinstance(value, bytes):
            sum_ = crc32(value, sum_)
        elif isinstance(value, str):
            sum_ = crc32(value.encode(), sum_)
        elif isinstance(value, float):
            sum_ = crc32(struct.pack("<d", value), sum_)
        elif isinstance(value, int):
            sum_ = crc32(struct.pack("<q", value), sum_)
        else:
            sum_ = crc32(b"null", sum_)
    return sum_
