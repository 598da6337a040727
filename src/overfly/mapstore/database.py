"""Connections to map files: opened with suspicion, written durably, every failure one line that names the
file."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

from overfly.errors import MapFileError, OutputError
from overfly.mapstore.migrations import TABLES, migrate
from overfly.mapstore.schema import APPLICATION_ID, VERSION, Table, create_tables, stored

LARGEST_VALUE = 64 * 1024 * 1024  # bytes of one blob or text; a node of 20,000 features has 3 MB
WAIT_S = 5.0
NOT_A_MAP = (ValueError, KeyError, TypeError, OverflowError, RecursionError)


def connect_to_read(path: Path) -> sqlite3.Connection:
    """Open a map that stays as it is. A file of an older version is brought up to date in memory.

    Raises MapFileError for anything that is not a sound map.
    """
    if not path.is_file():
        raise MapFileError(f"{path}: no such map file")
    with reading(path):
        _finish_what_was_broken_off(path)
        connection = _connect(path, "ro")
        version = check_identity(connection, path)
        if version < VERSION:
            copy = sqlite3.connect(":memory:", isolation_level=None)
            connection.backup(copy)
            connection.close()
            with making_sense(path, "what an older version wrote"):
                migrate(copy, version)
            connection = copy
        return connection


def connect_to_write(path: Path) -> sqlite3.Connection:
    """Open an existing map to carry on with it. Raises MapFileError, OutputError."""
    if not path.is_file():
        raise MapFileError(f"{path}: no such map file")
    with reading(path):
        connection = _connect(path, "rw")
        version = check_identity(connection, path)
    with writing(path), making_sense(path, "what an older version wrote"):
        migrate(connection, version)
        _make_durable(connection)
    return connection


def create(path: Path) -> sqlite3.Connection:
    """A new file with empty tables, not yet a map. Raises OutputError."""
    with writing(path):
        connection = _connect(path, "rwc")
        _make_durable(connection)
    with transaction(connection, path):
        create_tables(connection)
    return connection


def close_whole(connection: sqlite3.Connection, path: Path) -> None:
    """Close a map that was written: everything goes into the one file. Raises OutputError."""
    with writing(path):
        try:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            connection.execute("PRAGMA journal_mode = DELETE")
        finally:
            connection.close()


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Whatever SQLite says in the block becomes MapFileError."""
    try:
        yield
    except (sqlite3.Error, UnicodeDecodeError) as error:
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise MapFileError(f"{path}: cannot be read as a map: {said}") from error
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read: {error.strerror or error}") from error


@contextmanager
def making_sense(path: Path, what: str) -> Iterator[None]:
    """Values that cannot be what they should be become MapFileError."""
    try:
        yield
    except MapFileError as error:
        raise error if str(path) in str(error) else MapFileError(f"{path}: {what}: {error}") from error
    except NOT_A_MAP as error:
        raise MapFileError(f"{path}: {what} makes no sense: {error}") from error


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Whatever SQLite says in the block becomes OutputError."""
    try:
        yield
    except sqlite3.Error as error:
        raise OutputError(f"cannot write {path}: {error}") from error
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from error


@contextmanager
def transaction(connection: sqlite3.Connection, path: Path) -> Iterator[None]:
    """All that the block writes, or nothing. Raises OutputError."""
    with writing(path):
        connection.execute("BEGIN IMMEDIATE")
        try:
            yield
            connection.execute("COMMIT")
        except BaseException:
            if connection.in_transaction:
                connection.execute("ROLLBACK")
            raise


def check_identity(connection: sqlite3.Connection, path: Path) -> int:
    """The version of a map whose tables are those of an Overfly map to the letter. Raises MapFileError.

    Views, triggers, indices and tables of others are refused, so that nothing in the file can act on what
    is read from it.
    """
    application = connection.execute("PRAGMA application_id").fetchone()[0]
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if application != APPLICATION_ID:
        raise MapFileError(f"{path} is not an Overfly map")
    if version > VERSION:
        raise MapFileError(
            f"{path} was written by a newer Overfly (format {version}, this one knows {VERSION})"
        )
    found = set(connection.execute("SELECT type, sql FROM sqlite_schema WHERE sql IS NOT NULL"))
    if found != {("table", table.create) for table in TABLES.get(version, ())}:
        raise MapFileError(f"{path}: its tables are not those of a map; it is damaged or was changed")
    return int(version)


def rows_of(connection: sqlite3.Connection, table: Table, path: Path) -> Iterator[tuple[Any, ...]]:
    """All rows by key. Raises MapFileError for a row that does not fit its checksum."""
    with reading(path):
        try:
            yield from stored(connection, table)
        except ValueError as error:
            raise MapFileError(f"{path}: {error}") from error


def _finish_what_was_broken_off(path: Path) -> None:
    """A run killed while SQLite changed its journal leaves one to roll back, which is writing."""
    if path.with_name(path.name + "-journal").exists():
        connection = _connect(path, "rw")
        connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()  # rolls back
        connection.close()


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    """A connection that trusts nothing in the file."""
    address = f"file:{quote(str(path.resolve()))}?mode={mode}"
    connection = sqlite3.connect(address, uri=True, isolation_level=None, timeout=WAIT_S)
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_VALUE)
    connection.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute("PRAGMA cell_size_check = ON")
    connection.execute("PRAGMA foreign_keys = ON")
    return connection


def _make_durable(connection: sqlite3.Connection) -> None:
    """A write-ahead log that is flushed at every commit: what was committed survives a kill and a power cut.

    In this mode a commit costs one flush, where a rollback journal needs three.
    """
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = FULL")
