"""What an aircraft recorded beside its video: attitude, range, height and position, on one clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.sensors.default_sigmas import (
    AIRFRAME_SIGMA_RAD,
    ATTITUDE_SIGMA_RAD,
    HEIGHT_SIGMA_M,
    RANGE_SIGMA_M,
    RANGE_SIGMA_SHARE,
    YAW_SIGMA_RAD,
)
from overfly.sensors.euroc_sensors import AltitudeRecord, AttitudeRecord, PositionRecord
from overfly.sensors.flight import Quantity, SensorSummary
from overfly.sensors.interpolation import TimeSeries, interpolate, without_outliers
from overfly.sensors.tables import longest_increasing
from overfly.types import Altitude, AltitudeKind, Attitude, GeoPosition, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Telemetry:
    """Series of values, None where there is none.

    attitude: roll, pitch, unwrapped yaw of the body (rad), yaw NaN without a heading; of_gimbal: it is that
    of a camera on a gimbal, whose body looks straight down at roll 0, pitch 0. range, height: metres and
    their deviation; range_half_angle_rad: as of an Altitude. position: latitude, unwrapped longitude (deg),
    altitude, both deviations (m). is_video_time: the times are those of the video, not of a clock of its own.
    focal_35mm: of the lens, as for 35 mm film.
    """

    name: str
    attitude: TimeSeries | None = None
    range: TimeSeries | None = None
    height: TimeSeries | None = None
    position: TimeSeries | None = None
    of_gimbal: bool = False
    is_video_time: bool = False
    focal_35mm: float | None = None
    range_half_angle_rad: float = 0.0

    @property
    def first_ns(self) -> int | None:
        """Time of the earliest sample of all; None when there is none."""
        every = (self.attitude, self.range, self.height, self.position)
        starts = [int(series.t_ns[0]) for series in every if series is not None]
        return min(starts, default=None)

    def shifted(self, by_ns: int) -> Telemetry:
        """The same with all times that much later."""

        def later(series: TimeSeries | None) -> TimeSeries | None:
            return None if series is None else TimeSeries(series.t_ns + by_ns, series.values)

        return replace(
            self,
            attitude=later(self.attitude),
            range=later(self.range),
            height=later(self.height),
            position=later(self.position),
        )


@dataclass(frozen=True, slots=True, eq=False)
class FrameValues:
    """Values by frame, None where there is none, and what they come from. attitude_at: as of a flight."""

    attitudes: Sequence[Attitude | None]
    altitudes: Sequence[Altitude | None]
    positions: Sequence[GeoPosition | None]
    summaries: tuple[SensorSummary, ...]
    attitude_at: Callable[[IntArray], Sequence[Attitude | None]] | None = None


def values_at(
    telemetry: Telemetry | None, t_ns: IntArray, gap_s: float, tilts: AttitudeRecord | None = None
) -> FrameValues:
    """What the sensors say at the times of the frames (n,): interpolated, a range rather than a height.

    tilts: the attitude where the telemetry has none.
    """
    none = [None] * len(t_ns)
    if telemetry is None:
        return FrameValues(none, none, none, ())
    attitude = _attitude(telemetry, t_ns, gap_s) or tilts
    altitude = _altitude(telemetry, t_ns, gap_s)
    position = _position(telemetry, t_ns, gap_s)
    return FrameValues(
        attitude.at(t_ns, gap_s) if attitude else none,
        altitude.at(t_ns, gap_s) if altitude else none,
        position.at(t_ns, gap_s) if position else none,
        tuple(record.summary for record in (attitude, altitude, position) if record),
        partial(attitude.at, max_time_gap_s=gap_s) if attitude else None,
    )


def ordered(t_ns: IntArray, values: FloatArray) -> TimeSeries | None:
    """Samples (n, k) as a series: finite ones whose time increases, the most possible; None without any."""
    t_ns = np.asarray(t_ns, dtype=np.int64)
    values = np.asarray(values, dtype=np.float64).reshape(len(t_ns), -1)
    sound = np.isfinite(values[:, :2]).all(axis=1)
    t_ns, values = t_ns[sound], values[sound]
    keep = longest_increasing(t_ns)
    return TimeSeries(t_ns[keep], values[keep]) if len(keep) else None


def range_values(distance_m: FloatArray) -> FloatArray:
    """(n,) metres -> (n, 2) with the deviation that a sensor has which states none."""
    return np.column_stack([distance_m, np.hypot(RANGE_SIGMA_M, RANGE_SIGMA_SHARE * distance_m)])


def height_values(height_m: FloatArray) -> FloatArray:
    """(n,) metres above the start -> (n, 2) with the usual deviation."""
    return np.column_stack([height_m, np.full(len(height_m), HEIGHT_SIGMA_M)])


def _attitude(telemetry: Telemetry, t_ns: IntArray, gap_s: float) -> AttitudeRecord | None:
    series = telemetry.attitude
    if series is None:
        return None
    sigma_rad = ATTITUDE_SIGMA_RAD if telemetry.of_gimbal else AIRFRAME_SIGMA_RAD
    words = f"roll, pitch {math.degrees(sigma_rad):.2g} deg (default)"
    if np.isfinite(series.values[:, 2]).any():
        words += f", yaw {math.degrees(YAW_SIGMA_RAD):.2g} deg (default)"
    summary = _summary(telemetry, "attitude", Quantity.ATTITUDE, series, words, t_ns, gap_s)
    with_sigma = np.column_stack([series.values, np.full(len(series.t_ns), sigma_rad)])
    return AttitudeRecord(TimeSeries(series.t_ns, with_sigma), YAW_SIGMA_RAD, summary)


def _altitude(telemetry: Telemetry, t_ns: IntArray, gap_s: float) -> AltitudeRecord | None:
    for series, kind, quantity in (
        (telemetry.range and without_outliers(telemetry.range), AltitudeKind.RANGE, Quantity.RANGE),
        (telemetry.height, AltitudeKind.ABOVE_START, Quantity.HEIGHT),
    ):
        if series is not None:
            words = f"{np.median(series.values[:, 1]):.2g} m"
            name = "range" if kind is AltitudeKind.RANGE else "height"
            summary = _summary(telemetry, name, quantity, series, words, t_ns, gap_s)
            half_angle_rad = telemetry.range_half_angle_rad if kind is AltitudeKind.RANGE else 0.0
            return AltitudeRecord(series, kind, summary, half_angle_rad)
    return None


def _position(telemetry: Telemetry, t_ns: IntArray, gap_s: float) -> PositionRecord | None:
    series = telemetry.position
    if series is None:
        return None
    words = f"horizontal {np.median(series.values[:, 3]):.2g} m"
    summary = _summary(telemetry, "position", Quantity.POSITION, series, words, t_ns, gap_s)
    return PositionRecord(series, summary)


def _summary(
    telemetry: Telemetry,
    what: str,
    quantity: Quantity,
    series: TimeSeries,
    sigma: str,
    t_ns: IntArray,
    gap_s: float,
) -> SensorSummary:
    frames = int(np.isfinite(interpolate(series, t_ns, gap_s)[:, 0]).sum())
    rate_hz = 1.0 / series.period_s if series.period_s > 0 else 0.0
    name = f"{telemetry.name} {what}"
    return SensorSummary(name, quantity, len(series.t_ns), rate_hz, sigma, frames)
