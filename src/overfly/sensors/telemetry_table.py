"""Telemetry as a table beside a video (.csv), with the columns of the EuRoC layout's sensors, any of them."""

from __future__ import annotations

import math
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
    Column("roll", (), "rad", required=False, may_be_empty=True),
    Column("pitch", (), "rad", required=False, may_be_empty=True),
    Column("yaw", ("heading",), "rad", required=False, may_be_empty=True),
    Column("range", ("distance",), "m", required=False, may_be_empty=True),
    Column("height", ("above_start", "relative_altitude", "rel_alt"), "m", required=False, may_be_empty=True),
    Column("latitude", ("lat",), "deg", required=False, may_be_empty=True),
    Column("longitude", ("lon", "lng", "long"), "deg", required=False, may_be_empty=True),
    Column("altitude", ("alt",), "m", required=False, may_be_empty=True),
)


def read_telemetry_table(path: Path, problems: Problems) -> Telemetry:
    """Attitude is the body's, as the conventions have it; units as the columns' brackets say.

    Raises SourceError when the table has no time, no row, or no column of use.
    """
    table = increasing_rows(path, read_table(path, _COLUMNS, problems), problems)
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


def _attitude(table: Table) -> FloatArray:
    yaw = table.numbers.get("yaw", np.full(len(table), np.nan))
    angles = np.column_stack([table.numbers["roll"], table.numbers["pitch"], yaw])
    return np.column_stack([_unwrapped(column, 2.0 * math.pi) for column in angles.T])


def _position(table: Table) -> FloatArray:
    n = len(table)
    altitude = table.numbers.get("altitude", np.full(n, np.nan))
    return np.column_stack(
        [
            table.numbers["latitude"],
            _unwrapped(table.numbers["longitude"], 360.0),
            np.nan_to_num(altitude),
            np.full(n, POSITION_SIGMA_M),
            np.where(np.isnan(altitude), np.inf, GPS_ALTITUDE_SIGMA_M),
        ]
    )


def _unwrapped(angles: FloatArray, period: float) -> FloatArray:
    """(n,) without jumps of a period; empty cells stay empty."""
    known = np.isfinite(angles)
    result = angles.copy()
    result[known] = np.unwrap(angles[known], period=period)
    return result
