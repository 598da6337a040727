"""The sensors beside the cameras of an EuRoC folder: attitude0, altitude0, gps0, imu0, landmark0, landmarks0.

Each reader takes a folder and the times of the frames (n,), and returns None when there is no usable row in
it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from overfly.errors import CalibrationError
from overfly.geometry.poses import FloatArray, Pose
from overfly.sensors.calibration_files import mount_from_yaml
from overfly.sensors.default_sigmas import (
    ATTITUDE_SIGMA_RAD,
    GPS_ALTITUDE_SIGMA_M,
    HEIGHT_SIGMA_M,
    POSITION_SIGMA_M,
    RANGE_SIGMA_M,
    RANGE_SIGMA_SHARE,
    SONAR_HALF_ANGLE_RAD,
    YAW_SIGMA_RAD,
)
from overfly.sensors.flight import Problems, Quantity, SensorSummary
from overfly.sensors.interpolation import TimeSeries, interpolate, without_outliers
from overfly.sensors.tables import TEXT, TIME, Column, Table, increasing_rows, read_table
from overfly.sensors.text_files import read_yaml
from overfly.types import (
    Altitude,
    AltitudeKind,
    Attitude,
    GeoPosition,
    ImuRecord,
    IntArray,
    LandmarkClick,
    ScaleLandmark,
)

_NO_LEVER_ARM_M = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeRecord:
    """values of series: roll, pitch, unwrapped yaw (NaN without a heading), and the deviation of roll and of
    pitch, all radians.
    """

    series: TimeSeries
    yaw_sigma_rad: float
    summary: SensorSummary

    def at(self, t_ns: IntArray, max_time_gap_s: float) -> list[Attitude | None]:
        """Attitude at each time (n,), None where there is none near enough."""
        result: list[Attitude | None] = []
        for roll, pitch, yaw, sigma in interpolate(self.series, t_ns, max_time_gap_s).tolist():
            if math.isnan(roll):
                result.append(None)
            elif math.isnan(yaw):
                result.append(Attitude(roll, pitch, sigma))
            else:
                wrapped = math.remainder(yaw, 2.0 * math.pi)
                result.append(Attitude(roll, pitch, sigma, wrapped, self.yaw_sigma_rad))
        return result


@dataclass(frozen=True, slots=True, eq=False)
class AltitudeRecord:
    """values of series: metres, sigma in metres. half_angle_rad: as of an Altitude."""

    series: TimeSeries
    kind: AltitudeKind
    summary: SensorSummary
    half_angle_rad: float = 0.0

    def at(self, t_ns: IntArray, max_time_gap_s: float) -> list[Altitude | None]:
        """Altitude at each time (n,), None where there is none near enough."""
        return [
            None
            if math.isnan(value)
            else Altitude(float(value), float(sigma), self.kind, self.half_angle_rad)
            for value, sigma in interpolate(self.series, t_ns, max_time_gap_s)
        ]


@dataclass(frozen=True, slots=True, eq=False)
class PositionRecord:
    """values of series: latitude, unwrapped longitude (degrees), altitude, both sigmas (metres)."""

    series: TimeSeries
    summary: SensorSummary

    def at(self, t_ns: IntArray, max_time_gap_s: float) -> list[GeoPosition | None]:
        """Position at each time (n,), None where there is none near enough."""
        return [
            None
            if math.isnan(row[0])
            else GeoPosition(float(row[0]), math.remainder(float(row[1]), 360.0), *map(float, row[2:]))
            for row in interpolate(self.series, t_ns, max_time_gap_s)
        ]


def read_attitude(
    folder: Path, frames_t_ns: IntArray, gap_s: float, problems: Problems
) -> AttitudeRecord | None:
    """attitude0: R_world_body from R_world_sensor and the sensor's mount on the body."""
    columns = (
        TIME,
        Column("roll", (), "rad"),
        Column("pitch", (), "rad"),
        Column("yaw", ("heading",), "rad", required=False),
    )
    table, info = _read_sensor_folder(folder, columns, problems)
    if not len(table):
        return None
    has_yaw = "yaw" in table.numbers
    yaw = table.numbers["yaw"] if has_yaw else np.zeros(len(table))
    angles = np.column_stack([table.numbers["roll"], table.numbers["pitch"], yaw])
    mount = mount_from_yaml(folder / "sensor.yaml", info)
    if mount is not None and not np.array_equal(mount.rotation, np.eye(3)):
        angles = _turn_angles(angles, mount.rotation)
    angles = np.unwrap(angles, axis=0)
    if not has_yaw:
        angles[:, 2] = np.nan
    stated = _angle_sigma_rad(folder, info, "sigma", "bias_sigma")
    yaw_stated = _angle_sigma_rad(folder, info, "yaw_sigma", "sigma_yaw")
    sigma_rad = ATTITUDE_SIGMA_RAD if stated is None else stated
    yaw_sigma_rad = YAW_SIGMA_RAD if yaw_stated is None else yaw_stated
    series = TimeSeries(table.t_ns, np.column_stack([angles, np.full(len(table), sigma_rad)]))
    words = f"roll, pitch {math.degrees(sigma_rad):.2g} deg ({_origin(stated)})"
    if has_yaw:
        words += f", yaw {math.degrees(yaw_sigma_rad):.2g} deg ({_origin(yaw_stated)})"
    summary = _summary(folder, Quantity.ATTITUDE, series, words, frames_t_ns, gap_s)
    return AttitudeRecord(series, yaw_sigma_rad, summary)


def _turn_angles(angles: FloatArray, body_from_sensor: FloatArray) -> FloatArray:
    """Roll, pitch, yaw (n, 3) of the sensor -> those of the body, R_world_sensor @ body_from_sensor.T."""
    (sin_r, sin_p, sin_y), (cos_r, cos_p, cos_y) = np.sin(angles).T, np.cos(angles).T
    forward, left, up = body_from_sensor  # each body axis, in sensor axes
    up_row = np.column_stack([-sin_p, cos_p * sin_r, cos_p * cos_r])
    east_row = np.column_stack(
        [cos_y * cos_p, cos_y * sin_p * sin_r - sin_y * cos_r, cos_y * sin_p * cos_r + sin_y * sin_r]
    )
    north_row = np.column_stack(
        [sin_y * cos_p, sin_y * sin_p * sin_r + cos_y * cos_r, sin_y * sin_p * cos_r - cos_y * sin_r]
    )
    roll = np.arctan2(up_row @ left, up_row @ up)
    pitch = np.arcsin(np.clip(-(up_row @ forward), -1.0, 1.0))
    yaw = np.arctan2(north_row @ forward, east_row @ forward)
    return np.column_stack([roll, pitch, yaw])


def read_altitude(
    folder: Path, frames_t_ns: IntArray, gap_s: float, problems: Problems
) -> AltitudeRecord | None:
    """altitude0 or barometer0: range along the body's down axis, or height above start, by the column."""
    columns = (
        TIME,
        Column("range", ("distance",), "m", required=False),
        Column("height", ("above_start", "altitude", "relative_altitude"), "m", required=False),
        Column("sigma", ("sigma_m",), "m", required=False),
    )
    table, info = _read_sensor_folder(folder, columns, problems)
    if not len(table):
        return None
    kind = AltitudeKind.RANGE if "range" in table.numbers else AltitudeKind.ABOVE_START
    name = "range" if kind is AltitudeKind.RANGE else "height"
    if name not in table.numbers:
        raise CalibrationError(
            f"{folder / 'data.csv'}: no column named range or height; name the columns in the first line"
        )
    values = table.numbers[name]
    mount = mount_from_yaml(folder / "sensor.yaml", info)
    if mount is not None and kind is AltitudeKind.RANGE:
        values = values - mount.translation[2]  # a sensor below the body's origin is nearer to the ground
    stated = _sigma(folder, info, "sigma_m", "bias_sigma_m")
    default = np.full(len(table), HEIGHT_SIGMA_M)
    if kind is AltitudeKind.RANGE:
        default = np.hypot(RANGE_SIGMA_M, RANGE_SIGMA_SHARE * values)
    sigma = table.numbers.get("sigma", default if stated is None else np.full(len(table), stated))
    series = TimeSeries(table.t_ns, np.column_stack([values, sigma]))
    if kind is AltitudeKind.RANGE:
        series = without_outliers(series)
    origin = "data.csv" if "sigma" in table.numbers else _origin(stated)
    quantity = Quantity.RANGE if kind is AltitudeKind.RANGE else Quantity.HEIGHT
    words = f"{np.median(sigma):.2g} m ({origin})"
    half_angle_rad = _half_angle_rad(folder, info) if kind is AltitudeKind.RANGE else 0.0
    if half_angle_rad:
        words += f", nearest echo within {math.degrees(half_angle_rad):.3g} deg"
    summary = _summary(folder, quantity, series, words, frames_t_ns, gap_s)
    return AltitudeRecord(series, kind, summary, half_angle_rad)


def _half_angle_rad(folder: Path, info: Mapping[str, Any]) -> float:
    """Of the range sensor's cone: as sensor.yaml states it, else the usual of a sonar if it is one."""
    stated = _angle_sigma_rad(folder, info, "cone_half_angle")
    if stated is not None:
        return stated
    kind = str(info.get("sensor_type", "")).lower()
    return SONAR_HALF_ANGLE_RAD if any(word in kind for word in ("sonar", "ultraso")) else 0.0


def read_position(
    folder: Path, frames_t_ns: IntArray, gap_s: float, problems: Problems
) -> PositionRecord | None:
    """gps0: WGS 84; sigmas from its columns, else sensor.yaml (noise and bias together), else defaults."""
    columns = (
        TIME,
        Column("latitude", ("lat",), "deg"),
        Column("longitude", ("lon", "lng", "long"), "deg"),
        Column("altitude", ("alt", "height"), "m"),
        Column("sigma_horizontal", ("sigma_h", "sigma_horizontal_m", "eph"), "m", required=False),
        Column("sigma_vertical", ("sigma_v", "sigma_vertical_m", "epv"), "m", required=False),
    )
    table, info = _read_sensor_folder(folder, columns, problems)
    if not len(table):
        return None
    mount = mount_from_yaml(folder / "sensor.yaml", info)
    if mount is not None and float(np.abs(mount.translation).max()) > _NO_LEVER_ARM_M:
        problems.report(f"{folder.name}/sensor.yaml", "the antenna's place on the body (T_BS) is not used")
    columns_of_sigma = []
    words = []
    for way, default in (("horizontal", POSITION_SIGMA_M), ("vertical", GPS_ALTITUDE_SIGMA_M)):
        stated = _sigma(folder, info, f"sigma_{way}_m", f"bias_{way}_m")
        column = table.numbers.get(f"sigma_{way}")
        sigma = np.full(len(table), default if stated is None else stated) if column is None else column
        columns_of_sigma.append(sigma)
        words.append(f"{way} {np.median(sigma):.2g} m ({_origin(stated) if column is None else 'data.csv'})")
    longitude = np.unwrap(table.numbers["longitude"], period=360.0)
    values = np.column_stack(
        [table.numbers["latitude"], longitude, table.numbers["altitude"], *columns_of_sigma]
    )
    series = TimeSeries(table.t_ns, values)
    return PositionRecord(
        series, _summary(folder, Quantity.POSITION, series, ", ".join(words), frames_t_ns, gap_s)
    )


_IMU_COLUMNS = (
    TIME,
    *(Column(f"w_RS_S_{axis}", (f"gyro_{axis}", f"w_{axis}"), "rad/s") for axis in "xyz"),
    *(Column(f"a_RS_S_{axis}", (f"accel_{axis}", f"a_{axis}"), "m/s^2") for axis in "xyz"),
)


def read_imu(folder: Path, problems: Problems) -> ImuRecord | None:
    """imu0, turned into the body frame by T_BS; its lever arm is not taken out of the specific force."""
    table, info = _read_sensor_folder(folder, _IMU_COLUMNS, problems)
    if not len(table):
        return None
    mount = mount_from_yaml(folder / "sensor.yaml", info) or Pose.identity()
    gyro = table.stack(*(f"w_RS_S_{axis}" for axis in "xyz")) @ mount.rotation.T
    accel = table.stack(*(f"a_RS_S_{axis}" for axis in "xyz")) @ mount.rotation.T
    return ImuRecord(table.t_ns, gyro, accel)


def summarise_imu(
    folder: Path, frames_t_ns: IntArray, gap_s: float, problems: Problems
) -> SensorSummary | None:
    """Count and rate of imu0 without reading its values."""
    table, info = _read_sensor_folder(folder, (TIME,), problems)
    if not len(table):
        return None
    densities = [
        f"{name} {info[key]:.2g}"
        for name, key in (
            ("gyro rad/s/√Hz", "gyroscope_noise_density"),
            ("accel m/s²/√Hz", "accelerometer_noise_density"),
        )
        if isinstance(info.get(key), int | float)
    ]
    series = TimeSeries(table.t_ns, np.zeros((len(table), 1)))
    return _summary(folder, Quantity.IMU, series, ", ".join(densities) or "not stated", frames_t_ns, gap_s)


def read_scale_landmark(folder: Path, problems: Problems) -> ScaleLandmark | None:
    """landmark0: the first object named in it, with three corners or more in one frame."""
    columns = (
        Column("name", (), TEXT),
        Column("x_local", (), "m"),
        Column("y_local", (), "m"),
        TIME,
        Column("camera", (), TEXT),
        Column("u", (), "px"),
        Column("v", (), "px"),
    )
    table = _read_data(folder, columns, problems)
    if not len(table):
        return None
    names, cameras = table.texts["name"], table.texts["camera"]
    first = (names[0], cameras[0], table.t_ns[0])
    rows = np.array(
        [row for row in range(len(table)) if (names[row], cameras[row], table.t_ns[row]) == first]
    )
    if len(rows) < 3:
        problems.report(f"{folder.name}/data.csv", f"{names[0]} has {len(rows)} corners; 3 are needed")
        return None
    return ScaleLandmark(
        names[0],
        int(table.t_ns[0]),
        cameras[0],
        table.stack("x_local", "y_local")[rows],
        table.stack("u", "v")[rows],
    )


def read_landmark_clicks(folder: Path, problems: Problems) -> tuple[LandmarkClick, ...]:
    """landmarks0: named points as somebody clicked them."""
    columns = (
        Column("name", (), TEXT),
        TIME,
        Column("camera", (), TEXT),
        Column("u", (), "px"),
        Column("v", (), "px"),
    )
    table = _read_data(folder, columns, problems)
    return tuple(
        LandmarkClick(name, int(t), camera, (float(u), float(v)))
        for name, t, camera, u, v in zip(
            table.texts.get("name", []),
            table.t_ns,
            table.texts.get("camera", []),
            table.numbers.get("u", []),
            table.numbers.get("v", []),
            strict=True,
        )
    )


def _read_data(folder: Path, columns: tuple[Column, ...], problems: Problems) -> Table:
    """Rows of the folder's data.csv; an empty table, and a problem, when there are none."""
    path = folder / "data.csv"
    empty = Table(np.zeros(0, np.int64), {}, {}, np.zeros(0, np.int64))
    if not path.is_file():
        problems.report(f"{folder.name}/data.csv", "file is missing; this sensor is not used")
        return empty
    if path.stat().st_size < 64 and not path.read_bytes().strip():
        problems.report(f"{folder.name}/data.csv", "empty file; this sensor is not used")
        return empty
    table = read_table(path, columns, problems)
    if not len(table):
        problems.report(f"{folder.name}/data.csv", "no usable row; this sensor is not used")
    return table


def _read_sensor_folder(
    folder: Path, columns: tuple[Column, ...], problems: Problems
) -> tuple[Table, Mapping[str, Any]]:
    """Rows in order of time, and sensor.yaml (empty when there is none: it only refines)."""
    table = _read_data(folder, columns, problems)
    table = increasing_rows(folder / "data.csv", table, problems)
    path = folder / "sensor.yaml"
    return table, read_yaml(path) if path.is_file() and path.stat().st_size else {}


def _sigma(folder: Path, info: Mapping[str, Any], *keys: str) -> float | None:
    """Root of the summed squares of these entries of sensor.yaml, None when there is none of them."""
    found = [info[key] for key in keys if info.get(key) is not None]
    if not found:
        return None
    if not all(isinstance(value, int | float) and math.isfinite(value) and value >= 0 for value in found):
        raise CalibrationError(f"{folder / 'sensor.yaml'}: {keys[0]} is not a positive number")
    return math.hypot(*found) or None


def _angle_sigma_rad(folder: Path, info: Mapping[str, Any], *names: str) -> float | None:
    """The same for angles, whose entries end in _deg or in _rad."""
    in_degrees = _sigma(folder, info, *(f"{name}_deg" for name in names))
    if in_degrees is not None:
        return math.radians(in_degrees)
    return _sigma(folder, info, *(f"{name}_rad" for name in names))


def _origin(stated: float | None) -> str:
    return "default" if stated is None else "sensor.yaml"


def _summary(
    folder: Path,
    quantity: Quantity,
    series: TimeSeries,
    sigma: str,
    frames_t_ns: IntArray,
    gap_s: float,
) -> SensorSummary:
    frames = int(np.isfinite(interpolate(series, frames_t_ns, gap_s)[:, 0]).sum())
    rate_hz = 1.0 / series.period_s if series.period_s > 0 else 0.0
    return SensorSummary(folder.name, quantity, len(series.t_ns), rate_hz, sigma, frames)
