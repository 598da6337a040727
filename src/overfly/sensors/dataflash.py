"""ArduPilot's logs (.bin): attitude, downward range, height and GPS. Times are the
autopilot's, since boot.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from overfly.errors import SourceError
from overfly.geometry.aerospace import euler_from_aerospace
from overfly.geometry.poses import FloatArray
from overfly.sensors.default_sigmas import GPS_ALTITUDE_SIGMA_M, POSITION_SIGMA_M
from overfly.sensors.interpolation import TimeSeries
from overfly.sensors.telemetry import Telemetry, height_values, ordered, range_values

_LOOKS_DOWN = 25
_FIX_3D = 3
_RANGE_GOOD = 4
# Message, and the columns of it that are used; TimeUS comes first.
_COLUMNS = {
    "ATT": ("TimeUS", "Roll", "Pitch", "Yaw"),
    "RFND": ("TimeUS", "Dist"),
    "POS": ("TimeUS", "RelHomeAlt"),
    "BARO": ("TimeUS", "Alt"),
    "GPS": ("TimeUS", "Lat", "Lng", "Alt"),
    "GPA": ("TimeUS", "HAcc", "VAcc"),
}


def read_dataflash(path: Path) -> Telemetry:
    """Telemetry of an ArduPilot log. Raises SourceError when it is not one, or has nothing of use."""
    rows = _read(path)
    tables = {name: np.array(entries, dtype=np.float64) for name, entries in rows.items() if entries}
    height = tables.get("POS", tables.get("BARO"))
    telemetry = Telemetry(
        path.name,
        attitude=_attitude(tables.get("ATT")),
        range=_series(tables.get("RFND"), lambda table: range_values(table[:, 1])),
        height=_series(height, lambda table: height_values(table[:, 1])),
        position=_position(tables.get("GPS"), tables.get("GPA")),
    )
    if telemetry.first_ns is None:
        raise SourceError(f"{path}: neither attitude, range, height nor GPS in this ArduPilot log")
    return telemetry


def _read(path: Path) -> dict[str, list[tuple[float, ...]]]:
    """Rows of the messages that are used, those of the first sensor of a kind."""
    from pymavlink import DFReader

    rows: dict[str, list[tuple[float, ...]]] = defaultdict(list)
    try:
        log = DFReader.DFReader_binary(str(path))
        while (message := log.recv_match(type=list(_COLUMNS))) is not None:
            kind = message.get_type()
            if _is_used(kind, message):
                rows[kind].append(tuple(float(getattr(message, name)) for name in _COLUMNS[kind]))
        log.filehandle.close()
    except Exception as error:  # the reader lets struct, index, value and key errors through on damage
        raise SourceError(
            f"{path}: not readable as an ArduPilot log ({type(error).__name__}); copy it again"
        ) from error
    return rows


def _is_used(kind: str, message: Any) -> bool:
    if getattr(message, "I", 0) != 0:  # further sensors of the kind
        return False
    if kind == "RFND":
        looks_down = getattr(message, "Orient", _LOOKS_DOWN) == _LOOKS_DOWN
        return bool(looks_down and getattr(message, "Stat", _RANGE_GOOD) == _RANGE_GOOD)
    return bool(kind != "GPS" or message.Status >= _FIX_3D)


def _series(table: FloatArray | None, values: Any) -> TimeSeries | None:
    return None if table is None else ordered((table[:, 0] * 1000).astype(np.int64), values(table))


def _attitude(table: FloatArray | None) -> TimeSeries | None:
    if table is None:
        return None
    angles = np.unwrap(np.radians(table[:, 1:4]), axis=0)
    return ordered((table[:, 0] * 1000).astype(np.int64), euler_from_aerospace(*angles.T))


def _position(fixes: FloatArray | None, accuracy: FloatArray | None) -> TimeSeries | None:
    """GPS, with the accuracies of the message that comes with it."""
    if fixes is None:
        return None
    horizontal = np.full(len(fixes), POSITION_SIGMA_M)
    vertical = np.full(len(fixes), GPS_ALTITUDE_SIGMA_M)
    if accuracy is not None:
        at = np.clip(np.searchsorted(accuracy[:, 0], fixes[:, 0]), 0, len(accuracy) - 1)
        horizontal = np.where(accuracy[at, 1] > 0, accuracy[at, 1], horizontal)
        vertical = np.where(accuracy[at, 2] > 0, accuracy[at, 2], vertical)
    longitude = np.unwrap(fixes[:, 2], period=360.0)
    values = np.column_stack([fixes[:, 1], longitude, fixes[:, 3], horizontal, vertical])
    return ordered((fixes[:, 0] * 1000).astype(np.int64), values)
