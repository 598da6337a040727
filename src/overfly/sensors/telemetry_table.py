"""Telemetry as a table beside a video (.csv), with the columns of the EuRoC layout's sensors, any of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from overfly.errors import SourceError
from overfly.geometry.poses import FloatArray
from overfly.sensors.default_sigmas import GPS_ALTITUDE_SIGMA_M, POSITION_SIGMA_M
from overfly.sensors.flight import Problems
from overfly.sensors.tables import TIME, Column, Table, increasing_rows, read_table
from overfly.sensors.telemetry import Telemetry, height_values, ordered, range_values

_COLUMNS = (
    TIME,
    Column("roll", (), "rad", required=False),
    Column("pitch", (), "rad", required=False),
    Column("yaw", ("heading",), "rad", required=False),
    Column("range", ("distance",), "m", required=False),
    Column("height", ("above_start", "relative_altitude", "rel_alt"), "m", required=False),
    Column("latitude", ("lat",), "deg", required=False),
    Column("longitude", ("lon", "lng", "long"), "deg", required=False),
    Column("altitude", ("alt",), "m", required=False),
)


def read_telemetry_table(path: Path, problems: Problems) -> Telemetry:
    """Attitude is the body's, as the conventions have it; units as the columns' brackets say.

    Raises SourceError when the table has no time, no row, or no column of use.
    """
    table = increasing_rows(path, _read(path, problems), problems)
    columns = table.numbers
    attitude = _attitude(table) if {"roll", "pitch"} <= set(columns) else None
    position = _position(table) if {"latitude", "longitude"} <= set(columns) else None
    telemetry = Telemetry(path.name, position=None if position is None else ordered(table.t_ns, position))
    if attitude is not None:
        telemetry = replace(telemetry, attitude=ordered(table.t_ns, attitude))
    if "range" in columns:
        telemetry = replace(telemetry, range=ordered(table.t_ns, range_values(columns["range"])))
    if "height" in columns:
        telemetry = replace(telemetry, height=ordered(table.t_ns, height_values(columns["height"])))
    if telemetry.first_ns is None:
        raise SourceError(
            f"{path}: nothing of use; name columns roll, pitch, yaw, range, height, latitude, longitude"
        )
    return telemetry


def _read(path: Path, problems: Problems) -> Table:
    return read_table(path, _COLUMNS, problems)


def _attitude(table: Table) -> FloatArray:
    yaw = table.numbers.get("yaw", np.full(len(table), np.nan))
    angles = np.column_stack([table.numbers["roll"], table.numbers["pitch"], yaw])
    angles[:, :2] = np.unwrap(angles[:, :2], axis=0)
    if np.isfinite(yaw).all():
        angles[:, 2] = np.unwrap(yaw)
    return angles


def _position(table: Table) -> FloatArray:
    n = len(table)
    altitude = table.numbers.get("altitude")
    return np.column_stack(
        [
            table.numbers["latitude"],
            np.unwrap(table.numbers["longitude"], period=360.0),
            np.zeros(n) if altitude is None else altitude,
            np.full(n, POSITION_SIGMA_M),
            np.full(n, np.inf if altitude is None else GPS_ALTITUDE_SIGMA_M),
        ]
    )
