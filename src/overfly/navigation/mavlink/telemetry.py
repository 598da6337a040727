"""What an autopilot's sensors said lately, on our clock and in our axes."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from overfly.geometry.aerospace import euler_from_aerospace
from overfly.navigation.mavlink.dialect import messages
from overfly.sensors.default_sigmas import (
    ATTITUDE_SIGMA_RAD,
    RANGE_SIGMA_M,
    RANGE_SIGMA_SHARE,
    SONAR_HALF_ANGLE_RAD,
    YAW_SIGMA_RAD,
)
from overfly.sensors.interpolation import TimeSeries, interpolate
from overfly.types import Altitude, AltitudeKind, Attitude, IntArray

KEPT = 200  # samples of each sensor
LONGEST_GAP_S = 0.5
_UNKNOWN_COVARIANCE = 255
_LOOKS_DOWN = messages.MAV_SENSOR_ROTATION_PITCH_270
_POSITION_KEPT_S = 1.0


@dataclass(frozen=True, slots=True)
class LocalPosition:
    """Where the autopilot believes it is, in its own local frame: metres north, east, down."""

    t_ns: int
    north_m: float
    east_m: float
    down_m: float


@dataclass(slots=True, eq=False)
class Telemetry:
    """Fed by the link, asked by whoever needs a value at a time."""

    _attitudes: deque[tuple[int, float, float, float]] = field(default_factory=lambda: deque(maxlen=KEPT))
    _ranges: deque[tuple[int, float, float, float]] = field(default_factory=lambda: deque(maxlen=KEPT))
    local_position: LocalPosition | None = None

    def take(self, message: Any, t_ns: int) -> None:
        """One message of the autopilot, taken at t_ns of our clock."""
        kind = message.get_type()
        if kind == "ATTITUDE":
            _append(self._attitudes, (t_ns, message.roll, message.pitch, message.yaw))
        elif kind == "DISTANCE_SENSOR" and message.orientation == _LOOKS_DOWN:
            measured = _range_of(message)
            if measured is not None:
                _append(self._ranges, (t_ns, *measured))
        elif kind == "LOCAL_POSITION_NED":
            self.local_position = LocalPosition(t_ns, message.x, message.y, message.z)

    @property
    def newest_attitude_ns(self) -> int | None:
        return self._attitudes[-1][0] if self._attitudes else None

    def attitude_at(self, t_ns: int) -> Attitude | None:
        """Between the samples around the time, None where there are none near enough."""
        rows = list(self._attitudes)
        if not rows:
            return None
        angles = np.unwrap(np.array([row[1:] for row in rows]), axis=0)
        series = TimeSeries(_stamps(rows), euler_from_aerospace(*angles.T))
        roll, pitch, yaw = interpolate(series, np.array([t_ns]), LONGEST_GAP_S)[0]
        if math.isnan(roll):
            return None
        yaw = math.remainder(float(yaw), 2.0 * math.pi)
        return Attitude(float(roll), float(pitch), ATTITUDE_SIGMA_RAD, yaw, YAW_SIGMA_RAD)

    def range_at(self, t_ns: int) -> Altitude | None:
        """Distance to the ground below the body, None where there is none near enough."""
        rows = list(self._ranges)
        if not rows:
            return None
        series = TimeSeries(_stamps(rows), np.array([row[1:] for row in rows]))
        value, sigma, cone_rad = (
            float(one) for one in interpolate(series, np.array([t_ns]), LONGEST_GAP_S)[0]
        )
        return None if math.isnan(value) else Altitude(value, sigma, AltitudeKind.RANGE, cone_rad)

    def position_now(self, now_ns: int) -> LocalPosition | None:
        """The autopilot's own position, if it is not too old."""
        position = self.local_position
        fresh = position is not None and now_ns - position.t_ns < _POSITION_KEPT_S * 1e9
        return position if fresh else None


def _append(kept: deque[Any], row: tuple[Any, ...]) -> None:
    """In the order of time: what repeats or goes back is left out."""
    if not kept or row[0] > kept[-1][0]:
        kept.append(row)


def _stamps(rows: list[Any]) -> IntArray:
    return np.array([row[0] for row in rows], dtype=np.int64)


def _range_of(message: Any) -> tuple[float, float, float] | None:
    """Metres, their deviation, and half the angle of a sonar's cone, 0 of a beam; None outside what the
    sensor can measure.
    """
    centimetres = message.current_distance
    if not message.min_distance < centimetres < message.max_distance:
        return None
    value, cone_rad = 0.01 * centimetres, 0.0
    if message.type == messages.MAV_DISTANCE_SENSOR_ULTRASOUND:
        views = [view for view in (message.horizontal_fov, message.vertical_fov) if 0.0 < view < math.pi]
        cone_rad = 0.5 * min(views) if views else SONAR_HALF_ANGLE_RAD
    stated = message.covariance
    if 0 < stated < _UNKNOWN_COVARIANCE:
        return value, 0.01 * math.sqrt(stated), cone_rad
    return value, math.hypot(RANGE_SIGMA_M, RANGE_SIGMA_SHARE * value), cone_rad
