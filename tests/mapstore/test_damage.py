"""A file that is damaged, foreign or hostile is refused in one line, or read as what it was."""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.damage import damaged
from tests.mapstore.maps import assert_same, make_map

from overfly.errors import MapFileError
from overfly.mapstore import Map, MapWriter, blobs
from overfly.mapstore.frame_log import COLUMNS
from overfly.mapstore.schema import checksum

CASES = 1000


@pytest.fixture(scope="module")
def known() -> Map:
    return make_map(0, 4, 8)


@pytest.fixture(scope="module")
def sound(known: Map, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("sound") / "map.overfly"
    writer = MapWriter.begin(path, known.flights[0])
    writer.save(known.visual, known.frames, known.flights[0].progress)
    writer.close()
    return path.read_bytes()


def test_a_thousand_damaged_files(known: Map, sound: bytes, tmp_path: Path) -> None:
    path = tmp_path / "map.overfly"
    refused = 0
    for case in range(CASES):
        path.write_bytes(damaged(sound, np.random.default_rng(case)))
        try:
            found = Map.open(path)
        except MapFileError as error:
            refused += 1
            assert str(path) in str(error)
            assert "\n" not in str(error)
        else:
            assert_same(found, known)
    assert refused > 0.7 * CASES
    assert refused < CASES, "some bytes of a database mean nothing; no file was read at all"


@pytest.mark.parametrize("content", [b"", b"SQLite format 3\0", b"{}", bytes(5000)])
def test_files_of_others_are_no_maps(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "other.overfly"
    path.write_bytes(content)
    with pytest.raises(MapFileError, match=r"other\.overfly"):
        Map.open(path)


def test_there_may_be_no_file(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match="no such map file"):
        Map.open(tmp_path / "nothing.overfly")
    assert list(tmp_path.iterdir()) == []


def test_a_newer_format_is_named(tmp_path: Path, sound: bytes) -> None:
    path = tmp_path / "map.overfly"
    path.write_bytes(sound)
    alter(path, "PRAGMA user_version = 99")
    with pytest.raises(MapFileError, match="newer Overfly"):
        Map.open(path)


@pytest.mark.parametrize(
    "statement",
    [
        "CREATE VIEW everything AS SELECT * FROM nodes",
        "CREATE TRIGGER late AFTER INSERT ON nodes BEGIN DELETE FROM facts; END",
        "CREATE TABLE more (x)",
        "CREATE INDEX quick ON nodes (time_ns)",
        "DROP TABLE points",
        "ALTER TABLE nodes ADD COLUMN more INTEGER",
    ],
)
def test_nothing_else_may_be_in_the_file(tmp_path: Path, sound: bytes, statement: str) -> None:
    path = tmp_path / "map.overfly"
    path.write_bytes(sound)
    alter(path, statement)
    with pytest.raises(MapFileError, match="tables are not those of a map"):
        Map.open(path)


def alter(path: Path, statement: str, values: tuple[Any, ...] = ()) -> None:
    connection = sqlite3.connect(path)
    with connection:
        connection.execute(statement, values)
    connection.close()


def forge(path: Path, table: str, key: str, column: str, change: Callable[[Any], Any]) -> None:
    """Change one value of the last row, and make its checksum fit, as somebody would who means it."""
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA foreign_keys = OFF")
    cursor = connection.execute(f"SELECT * FROM {table} ORDER BY {key} DESC LIMIT 1")
    names = [description[0] for description in cursor.description]
    row = dict(zip(names, cursor.fetchone(), strict=True))
    place = row[key]
    row[column] = change(row[column])
    row["checksum"] = checksum(tuple(row[name] for name in names[:-1]))
    with connection:
        assignments = ", ".join(f"{name} = ?" for name in names)
        connection.execute(f"UPDATE {table} SET {assignments} WHERE {key} = ?", (*row.values(), place))
    connection.close()


def nan_first(blob: bytes) -> bytes:
    return blobs.pack(np.array([np.nan]), "<f8") + blob[8:]


def infinite_first(blob: bytes) -> bytes:
    return blobs.pack(np.array([np.inf]), "<f8") + blob[8:]


def changed_number(blob: bytes, column: str, value: float) -> bytes:
    """The first number of a column of all frames of the block (8 of them) with another value."""
    content, at = bytearray(zlib.decompress(blob)), 0
    for name, kind, numbers in COLUMNS:
        if name == column:
            changed = np.array([value], kind).tobytes()
            content[at : at + len(changed)] = changed
        at += 8 * numbers * np.dtype(kind).itemsize
    return zlib.compress(bytes(content))


FORGERIES: list[tuple[str, str, str, Callable[[Any], Any]]] = [
    ("nodes", "number", "features", lambda _: 9),
    ("nodes", "number", "features", lambda _: -1),
    ("nodes", "number", "features", lambda _: 2**62),
    ("nodes", "number", "parent", lambda _: 3),
    ("nodes", "number", "parent", lambda _: -7),
    ("nodes", "number", "parent_constraint", lambda _: 2**40),
    ("nodes", "number", "parent_constraint", lambda _: -1),
    ("nodes", "number", "number", lambda _: 77),
    ("nodes", "number", "tilt", nan_first),
    ("nodes", "number", "height", lambda _: b"12"),
    ("nodes", "number", "flight", lambda _: 5),
    ("poses", "node", "world_from_cam", nan_first),
    ("poses", "node", "world_from_cam", lambda blob: bytes(len(blob))),
    ("poses", "node", "node", lambda _: 77),
    ("features", "node", "descriptor_type", lambda _: "O:32"),
    ("features", "node", "descriptor_type", lambda _: "f8:32"),
    ("features", "node", "descriptors", lambda blob: blob[:-1]),
    ("features", "node", "descriptors", lambda _: b""),
    ("features", "node", "px", lambda blob: blob + bytes(8)),
    ("features", "node", "px", lambda blob: blobs.pack(np.array([np.nan]), "<f4") + blob[4:]),
    ("features", "node", "rays", infinite_first),
    ("features", "node", "ray_sigma", nan_first),
    ("points", "node", "in_cam_m", infinite_first),
    ("points", "node", "track", lambda blob: bytes([255] * len(blob))),
    ("points", "node", "anchor", lambda _: blobs.pack(np.full(8, 4), "<i4")),
    ("points", "node", "anchor_row", lambda _: blobs.pack(np.full(8, 8), "<i4")),
    ("points", "node", "anchor_row", lambda _: blobs.pack(np.full(8, -1), "<i4")),
    ("constraints", "number", "i", lambda _: 44),
    ("constraints", "number", "kind", lambda _: 99),
    ("constraints", "number", "state", lambda _: 7),
    ("constraints", "number", "information", nan_first),
    ("constraints", "number", "i_from_j", lambda blob: bytes(len(blob))),
    ("frames", "number", "number", lambda _: 7),
    ("frames", "number", "count", lambda count: count + 1),
    ("frames", "number", "count", lambda _: 0),
    ("frames", "number", "count", lambda _: -1),
    ("frames", "number", "count", lambda _: 2**40),
    ("frames", "number", "stages", lambda _: "[" * 5000),
    ("frames", "number", "stages", lambda _: "7"),
    ("frames", "number", "stages", lambda _: "[]"),
    ("frames", "number", "numbers", lambda _: b"short"),
    ("frames", "number", "numbers", lambda blob: blob[:-8]),
    ("frames", "number", "numbers", lambda _: zlib.compress(bytes(10_000_000))),
    ("frames", "number", "numbers", lambda blob: changed_number(blob, "flight", 5)),
    ("frames", "number", "numbers", lambda blob: changed_number(blob, "node", 99)),
    ("frames", "number", "numbers", lambda blob: changed_number(blob, "node", -2)),
    ("frames", "number", "numbers", lambda blob: changed_number(blob, "online", np.nan)),
    ("frames", "number", "numbers", lambda blob: changed_number(blob, "node_from_cam", np.inf)),
    ("frames", "number", "positions", lambda _: b"short"),
    ("frames", "number", "positions", lambda _: zlib.compress(bytes(39))),
    ("frames", "number", "notes", lambda _: zlib.compress(b"[]x")),
    ("frames", "number", "notes", lambda _: zlib.compress(b" " * 10_000_000 + b"{}")),
    ("frames", "number", "notes", lambda _: zlib.compress(b'{"0": ["no such reason", "", null]}')),
    ("frames", "number", "notes", lambda _: zlib.compress(b'{"0": [null, "", {"status": 7}]}')),
    ("flights", "number", "rig", lambda _: "{}"),
    ("flights", "number", "rig", lambda text: text.replace("equidistant", "mirror")),
    ("flights", "number", "rig", lambda text: text.replace('"width":320', '"width":-320')),
    ("flights", "number", "config", lambda _: "!!python/object/apply:os.system ['true']"),
    ("flights", "number", "config", lambda _: "features: {count: 1}"),
    ("flights", "number", "config", lambda _: "nonsense: 1"),
    ("flights", "number", "progress", lambda _: "7"),
    ("facts", "name", "value", lambda _: "NaN"),
    ("facts", "name", "value", lambda _: "null"),
]


@pytest.mark.parametrize(
    ("table", "key", "column", "change"),
    FORGERIES,
    ids=[f"{table}.{column}-{number}" for number, (table, _, column, _) in enumerate(FORGERIES)],
)
def test_forged_values_are_refused(
    tmp_path: Path, sound: bytes, table: str, key: str, column: str, change: Callable[[Any], Any]
) -> None:
    """With the checksum right, what a value says is judged by itself."""
    path = tmp_path / "map.overfly"
    path.write_bytes(sound)
    forge(path, table, key, column, change)
    with pytest.raises(MapFileError, match=r"map\.overfly"):
        Map.open(path)


def test_a_missing_row_is_noticed(tmp_path: Path, sound: bytes) -> None:
    for table, key in (
        ("frames", "number"),
        ("constraints", "number"),
        ("points", "node"),
        ("facts", "name"),
    ):
        path = tmp_path / "map.overfly"
        path.write_bytes(sound)
        alter(path, f"DELETE FROM {table} WHERE {key} = (SELECT max({key}) FROM {table})")
        with pytest.raises(MapFileError):
            Map.open(path)
