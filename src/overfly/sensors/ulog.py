"""PX4's logs (.ulg): attitude, downward range, height and GPS. Times are those of the
autopilot, since boot.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from overfly.errors import SourceError
from overfly.geometry.aerospace import euler_from_aerospace, euler_from_quaternion
from overfly.geometry.poses import FloatArray
from overfly.sensors.default_sigmas import GPS_ALTITUDE_SIGMA_M, POSITION_SIGMA_M, SONAR_HALF_ANGLE_RAD
from overfly.sensors.interpolation import TimeSeries
from overfly.sensors.telemetry import Telemetry, height_values, ordered, range_values
from overfly.types import BoolArray, IntArray

TOPICS = [
    "vehicle_attitude",
    "distance_sensor",
    "vehicle_local_position",
    "vehicle_gps_position",
    "sensor_gps",
]
_LOOKS_DOWN = 25
_ULTRASOUND = 1  # type of a distance_sensor
_FIX_3D = 3


def read_ulog(path: Path) -> Telemetry:
    """Telemetry of a ULog file. Raises SourceError when it is not one, or has nothing of use."""
    from pyulog import ULog

    try:
        log = ULog(str(path), TOPICS)
    except Exception as error:  # pyulog lets struct, index, type and key errors through on damage
        raise SourceError(
            f"{path}: not readable as a PX4 log ({type(error).__name__}); copy it again from the aircraft"
        ) from error
    topics = {entry.name: entry.data for entry in reversed(log.data_list)}  # the first instance of each
    ranger = next((one.data for one in log.data_list if _measures_down(one)), None)
    telemetry = Telemetry(
        path.name,
        attitude=_attitude(topics.get("vehicle_attitude")),
        range=None if ranger is None else _range(ranger),
        range_half_angle_rad=0.0 if ranger is None else _half_angle_rad(ranger),
        height=_height(topics.get("vehicle_local_position")),
        position=_position(topics.get("vehicle_gps_position") or topics.get("sensor_gps")),
    )
    if telemetry.first_ns is None:
        raise SourceError(f"{path}: neither attitude, range, height nor GPS in this log; log more topics")
    return telemetry


def _times(data: dict[str, Any]) -> IntArray:
    """Of the sample where the message names it, else of the message; nanoseconds."""
    stamps = data.get("timestamp_sample")
    if stamps is None or not np.any(stamps):
        stamps = data["timestamp"]
    return np.asarray(stamps, dtype=np.int64) * 1000


def _attitude(data: dict[str, Any] | None) -> TimeSeries | None:
    if data is None or "q[0]" not in data:
        return None
    quaternions = np.column_stack([data[f"q[{k}]"] for k in range(4)]).astype(np.float64)
    sound = np.linalg.norm(quaternions, axis=1) > 0.5
    angles = np.unwrap(euler_from_quaternion(quaternions[sound]), axis=0)
    return ordered(_times(data)[sound], euler_from_aerospace(*angles.T))


def _measures_down(entry: Any) -> bool:
    """Whether it is a range sensor that looks down and measured something."""
    return entry.name == "distance_sensor" and bool(_usable(entry.data).any())


def _usable(data: dict[str, Any]) -> BoolArray:
    """(n,) readings downwards within the sensor's limits."""
    distance = np.asarray(data["current_distance"], dtype=np.float64)
    down = np.asarray(data.get("orientation", np.full(len(distance), _LOOKS_DOWN))) == _LOOKS_DOWN
    good = down & (distance > data["min_distance"]) & (distance < data["max_distance"])
    if "signal_quality" in data:
        good &= np.asarray(data["signal_quality"]) != 0  # -1 unknown, 0 invalid
    return np.asarray(good)


def _range(data: dict[str, Any]) -> TimeSeries | None:
    good = _usable(data)
    distance = np.asarray(data["current_distance"], dtype=np.float64)
    return ordered(_times(data)[good], range_values(distance[good]))


def _half_angle_rad(data: dict[str, Any]) -> float:
    """Of a sonar's cone, in which the nearest echo counts; 0 of anything else."""
    if "type" not in data or int(data["type"][0]) != _ULTRASOUND:
        return 0.0
    views = [float(data[name][0]) for name in ("h_fov", "v_fov") if name in data]
    stated = min((view for view in views if 0.0 < view < math.pi), default=0.0)
    return 0.5 * stated if stated else SONAR_HALF_ANGLE_RAD


def _height(data: dict[str, Any] | None) -> TimeSeries | None:
    """Height above where the filter began."""
    if data is None:
        return None
    height = -np.asarray(data["z"], dtype=np.float64)
    valid = np.asarray(data.get("z_valid", np.ones(len(height))), dtype=bool)
    return ordered(_times(data)[valid], height_values(height[valid]))


def _position(data: dict[str, Any] | None) -> TimeSeries | None:
    if data is None:
        return None
    fixed = np.asarray(data["fix_type"]) >= _FIX_3D
    if "latitude_deg" in data:
        place = [data["latitude_deg"], data["longitude_deg"], data["altitude_msl_m"]]
    else:
        place = [data["lat"] * 1e-7, data["lon"] * 1e-7, data["alt"] * 1e-3]
    latitude, longitude, altitude = (np.asarray(column, dtype=np.float64)[fixed] for column in place)
    values = np.column_stack(
        [
            latitude,
            np.unwrap(longitude, period=360.0),
            altitude,
            _deviation(data.get("eph"), fixed, POSITION_SIGMA_M),
            _deviation(data.get("epv"), fixed, GPS_ALTITUDE_SIGMA_M),
        ]
    )
    return ordered(_times(data)[fixed], values)


def _deviation(column: Any, fixed: BoolArray, default_m: float) -> FloatArray:
    """(n,) metres; the default where the receiver states none."""
    if column is None:
        return np.full(int(np.count_nonzero(fixed)), default_m)
    stated = np.asarray(column, dtype=np.float64)[fixed]
    return np.where(np.isfinite(stated) & (stated > 0.0), stated, default_m)
