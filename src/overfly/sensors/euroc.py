"""Flights in the EuRoC/ASL layout: a folder mav0 with cam0, perhaps cam1, and sensors beside them.

Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016, with the additions that docs/sources.md
describes. Stamps are the recorder's own clock, in nanoseconds.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np

from overfly.errors import CalibrationError, SourceError
from overfly.sensors.calibration_files import (
    CalibratedCamera,
    fit_to_images,
    mount_from_yaml,
    nadir_mount,
    read_camera_file,
)
from overfly.sensors.euroc_sensors import (
    read_altitude,
    read_attitude,
    read_imu,
    read_landmark_clicks,
    read_position,
    read_scale_landmark,
    summarise_imu,
)
from overfly.sensors.flight import Flight, Problems, ReadOptions, SensorSummary, SourceKind
from overfly.sensors.imu_attitude import attitude_of_imu
from overfly.sensors.pictures import is_picture, picture_size, read_picture
from overfly.sensors.selection import select_frames
from overfly.sensors.tables import TEXT, TIME, Column, increasing_rows, read_table
from overfly.sensors.text_files import read_yaml
from overfly.types import (
    Altitude,
    Attitude,
    Frame,
    GeoPosition,
    ImuRecord,
    IntArray,
    MountedCamera,
    Rig,
    UInt8Array,
)


@dataclass(frozen=True, slots=True, eq=False)
class _Listing:
    """Pictures one camera lists: t_ns (n,) increasing, one path each."""

    t_ns: IntArray
    paths: list[Path]


@dataclass(frozen=True, slots=True, eq=False)
class _Sensors:
    """Values by frame, None where there is none."""

    attitudes: Sequence[Attitude | None]
    altitudes: Sequence[Altitude | None]
    positions: Sequence[GeoPosition | None]
    summaries: tuple[SensorSummary, ...]
    attitude_at: Callable[[IntArray], Sequence[Attitude | None]] | None


def find_mav0(path: Path) -> Path | None:
    """The folder with cam0 in it: path itself, or mav0 below it; None when this is not an EuRoC folder."""
    for folder in (path / "mav0", path):
        if (folder / "cam0").is_dir():
            return folder
    return None


def open_euroc(path: Path, options: ReadOptions) -> Flight:
    """path: the folder that holds mav0, or mav0 itself.

    Raises SourceError when there is no usable picture, CalibrationError when a camera's calibration is
    missing or wrong.
    """
    mav0 = find_mav0(path)
    if mav0 is None:
        raise SourceError(f"{path}: no mav0/cam0 in it; give the folder that holds mav0")
    problems = Problems()
    cameras = _camera_names(mav0, options)
    listings = [_read_listing(mav0 / name, problems) for name in cameras]
    t_ns, paths = _pair(mav0, listings, problems)
    chosen = select_frames(path, t_ns, options)
    t_ns, paths = t_ns[chosen], [paths[n] for n in chosen]
    rig = _read_rig(mav0, cameras, paths, options)
    imu = cache(lambda: read_imu(mav0 / "imu0", problems) if (mav0 / "imu0").is_dir() else None)
    sensors = _read_sensors(mav0, t_ns, options.max_time_gap_s, problems, imu)

    def read_frame(n: int) -> Frame | None:
        images = _read_images(paths[n], rig, problems)
        if images is None:
            return None
        name = paths[n][0].name
        at_n = sensors.attitudes[n], sensors.altitudes[n], sensors.positions[n]
        return Frame(n, int(t_ns[n]), name, images, *at_n)

    landmark, clicks = mav0 / "landmark0", mav0 / "landmarks0"
    return Flight(
        path,
        SourceKind.EUROC,
        rig,
        t_ns,
        read_frame,
        problems,
        sensors.summaries,
        read_scale_landmark(landmark, problems) if landmark.is_dir() else None,
        read_landmark_clicks(clicks, problems) if clicks.is_dir() else (),
        imu,
        sensors.attitude_at,
    )


def _read_sensors(
    mav0: Path,
    t_ns: IntArray,
    gap_s: float,
    problems: Problems,
    read_inertial: Callable[[], ImuRecord | None],
) -> _Sensors:
    """What the sensors beside the cameras say at the times of the frames (n,)."""
    none = [None] * len(t_ns)
    attitude = altitude = position = imu = None
    if (mav0 / "attitude0").is_dir():
        attitude = read_attitude(mav0 / "attitude0", t_ns, gap_s, problems)
    for folder in (mav0 / "altitude0", mav0 / "barometer0"):  # the second only where the first has nothing
        if altitude is None and folder.is_dir():
            altitude = read_altitude(folder, t_ns, gap_s, problems)
    if (mav0 / "gps0").is_dir():
        position = read_position(mav0 / "gps0", t_ns, gap_s, problems)
    if (mav0 / "imu0").is_dir():
        imu = summarise_imu(mav0 / "imu0", t_ns, gap_s, problems)
    if attitude is None and imu is not None and (record := read_inertial()) is not None:
        attitude = attitude_of_imu(record, "imu0", t_ns, gap_s, problems)
    summaries = [record.summary for record in (attitude, altitude, position) if record]
    return _Sensors(
        attitude.at(t_ns, gap_s) if attitude else none,
        altitude.at(t_ns, gap_s) if altitude else none,
        position.at(t_ns, gap_s) if position else none,
        (*summaries, imu) if imu else tuple(summaries),
        partial(attitude.at, max_time_gap_s=gap_s) if attitude else None,
    )


def _camera_names(mav0: Path, options: ReadOptions) -> list[str]:
    has_second = (mav0 / "cam1").is_dir()
    if options.stereo and not has_second:
        raise SourceError(f"{mav0}: stereo was asked for, but there is no cam1; leave --stereo away")
    return ["cam0", "cam1"] if has_second and options.stereo is not False else ["cam0"]


def _read_listing(folder: Path, problems: Problems) -> _Listing:
    """Pictures of data.csv; without one, those whose names are stamps."""
    listed = folder / "data.csv"
    if not listed.is_file():
        return _list_by_name(folder, problems)
    table = read_table(listed, (TIME, Column("filename", ("file", "name", "image"), TEXT)), problems)
    table = increasing_rows(listed, table, problems)
    if not len(table):
        raise SourceError(
            f"{listed}: lists no picture; each line must be a time in nanoseconds and a file name"
        )
    return _Listing(table.t_ns, [folder / "data" / name for name in table.texts["filename"]])


def _list_by_name(folder: Path, problems: Problems) -> _Listing:
    data = folder / "data"
    pictures = [file for file in data.iterdir() if is_picture(file)] if data.is_dir() else []
    stamped = sorted((int(file.stem), file) for file in pictures if file.stem.isdecimal())
    if not stamped:
        raise SourceError(f"{folder / 'data.csv'}: missing, and no picture in {data} is named by its time")
    problems.report(
        f"{folder.name}/data.csv", "file is missing; times were taken from the names of the pictures"
    )
    return _Listing(np.array([stamp for stamp, _ in stamped], np.int64), [file for _, file in stamped])


def _pair(
    mav0: Path, listings: list[_Listing], problems: Problems
) -> tuple[IntArray, list[tuple[Path, ...]]]:
    """Pictures of one instant: for stereo, those less than half a frame period apart."""
    left = listings[0]
    if len(listings) == 1:
        return left.t_ns, [(file,) for file in left.paths]
    right = listings[1]
    period_ns = float(np.median(np.diff(left.t_ns))) if len(left.t_ns) > 1 else 1e9
    nearest = _nearest(left.t_ns, right.t_ns)
    back = _nearest(right.t_ns, left.t_ns)
    apart = np.abs(right.t_ns[nearest] - left.t_ns)
    paired = (apart < 0.5 * period_ns) & (back[nearest] == np.arange(len(left.t_ns)))
    for n in np.flatnonzero(~paired):
        problems.report(f"cam0/{left.paths[n].name}", "no picture of cam1 at the same time; passed over")
    for n in np.setdiff1d(np.arange(len(right.t_ns)), nearest[paired]):
        problems.report(f"cam1/{right.paths[n].name}", "no picture of cam0 at the same time; passed over")
    if not paired.any():
        raise SourceError(
            f"{mav0}: no two pictures of cam0 and cam1 belong together; check the times, or use --mono"
        )
    chosen = np.flatnonzero(paired)
    return left.t_ns[chosen], [(left.paths[n], right.paths[nearest[n]]) for n in chosen]


def _nearest(t_ns: IntArray, others_ns: IntArray) -> IntArray:
    """Index into others_ns of the nearest stamp, for each of t_ns."""
    after = np.clip(np.searchsorted(others_ns, t_ns), 0, len(others_ns) - 1)
    before = np.maximum(after - 1, 0)
    earlier = np.abs(others_ns[before] - t_ns) <= np.abs(others_ns[after] - t_ns)
    return np.asarray(np.where(earlier, before, after), dtype=np.int64)


def _read_rig(mav0: Path, names: list[str], paths: list[tuple[Path, ...]], options: ReadOptions) -> Rig:
    """Cameras and their mounts; --camera replaces intrinsics, and mounts where it has them."""
    sizes = [_first_size(mav0, (pair[k] for pair in paths)) for k in range(len(names))]
    folders = [mav0 / name for name in names]
    if options.camera_file is None:
        calibrations = [
            _read_own(folder / "sensor.yaml", size) for folder, size in zip(folders, sizes, strict=True)
        ]
    else:
        calibrations = _read_given(options.camera_file, folders, sizes)
    mounted: list[MountedCamera] = []
    for k, (name, calibrated) in enumerate(zip(names, calibrations, strict=True)):
        mount = calibrated.body_from_cam or (nadir_mount() if k == 0 else None)
        if k > 0 and calibrated.cam_from_previous is not None:
            mount = mounted[0].body_from_cam @ calibrated.cam_from_previous.inverse()
        if mount is None:
            raise CalibrationError(
                f"{mav0 / name / 'sensor.yaml'}: no T_BS; stereo needs the place of both cameras"
            )
        mounted.append(MountedCamera(name, calibrated.camera, mount))
    if len(mounted) > 1 and _baseline_m(mounted) < 1e-6:
        raise CalibrationError(
            f"{mav0}: cam0 and cam1 are at the same place (T_BS); correct T_BS or use --mono"
        )
    return Rig(tuple(mounted))


def _read_own(path: Path, size: tuple[int, int]) -> CalibratedCamera:
    if not path.is_file():
        raise CalibrationError(f"{path}: missing; give the camera's calibration with --camera")
    calibrated = read_camera_file(path, size)[0]
    return dataclasses.replace(calibrated, camera=fit_to_images(path, calibrated.camera, size))


def _read_given(path: Path, folders: list[Path], sizes: list[tuple[int, int]]) -> list[CalibratedCamera]:
    """The cameras of --camera; the flight's own files only say where they sit, if this one does not."""
    given = read_camera_file(path, sizes[0])
    if len(given) < len(folders):
        raise CalibrationError(f"{path}: calibrates one camera of two; use --mono or calibrate both")
    calibrations = []
    for new, folder, size in zip(given, folders, sizes, strict=False):
        mount, own = new.body_from_cam, folder / "sensor.yaml"
        if mount is None and own.is_file():
            mount = mount_from_yaml(own, read_yaml(own))
        calibrations.append(
            CalibratedCamera(fit_to_images(path, new.camera, size), mount, new.cam_from_previous)
        )
    return calibrations


def _baseline_m(mounted: list[MountedCamera]) -> float:
    return float(np.linalg.norm(mounted[1].body_from_cam.translation - mounted[0].body_from_cam.translation))


def _first_size(mav0: Path, paths: Iterator[Path]) -> tuple[int, int]:
    for file in paths:
        size = picture_size(file)
        if size is not None:
            return size
    raise SourceError(f"{mav0}: none of the listed pictures can be read; check the folders cam*/data")


def _read_images(paths: tuple[Path, ...], rig: Rig, problems: Problems) -> tuple[UInt8Array, ...] | None:
    images = []
    for file, mounted in zip(paths, rig.cameras, strict=True):
        image = read_picture(file)
        name = f"{mounted.name}/data/{file.name}"
        if isinstance(image, str):
            problems.report(name, f"{image}; passed over")
            return None
        size = (mounted.camera.width, mounted.camera.height)
        if image.shape[1::-1] != size:
            seen = f"{image.shape[1]}x{image.shape[0]}"
            problems.report(name, f"{seen} pixels where the camera has {size[0]}x{size[1]}; passed over")
            return None
        images.append(image)
    return tuple(images)
