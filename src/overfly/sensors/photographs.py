"""Folders of photographs: camera, time, place, angles and height from what is written in each file.

Time is UTC, or the camera's own clock where it names no time zone. Nothing has to be configured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from overfly.errors import SourceError
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import rotation_from_euler
from overfly.sensors.calibration_files import fit_to_images, nadir_mount, read_camera_file
from overfly.sensors.default_sigmas import (
    GPS_ALTITUDE_SIGMA_M,
    HEIGHT_SIGMA_M,
    POSITION_SIGMA_M,
    state_no_accuracy,
)
from overfly.sensors.dji import DjiTags, factory_camera, parse_dji, read_attitude, tilt_from_nadir_rad
from overfly.sensors.exif import Exif, read_exif
from overfly.sensors.flight import Flight, Problems, Quantity, ReadOptions, SensorSummary, SourceKind
from overfly.sensors.focal_length import focal_length_px
from overfly.sensors.pictures import is_picture, read_picture
from overfly.sensors.selection import select_frames
from overfly.types import (
    Altitude,
    AltitudeKind,
    Attitude,
    Frame,
    GeoPosition,
    IntArray,
    MountedCamera,
    Problem,
    Rig,
)

TILT_MAX_RAD = math.radians(35.0)
SECOND_NS = 1_000_000_000
# focal length over image width of a common wide lens (24 mm on 35 mm film is 0.67, 35 mm is 0.97)
DEFAULT_FOCAL_WIDTHS = 0.85


@dataclass(frozen=True, slots=True)
class _Photograph:
    path: Path
    exif: Exif
    dji: DjiTags
    attitude: Attitude | None


def open_photographs(path: Path, options: ReadOptions) -> Flight:
    """path: a folder with pictures in it, or with a folder ``images`` that has them.

    Raises SourceError when no picture in it can be used, CalibrationError for a camera file that does not
    fit.
    """
    problems = Problems()
    folder = find_pictures(path)
    if folder is None:
        raise SourceError(f"{path}: no pictures in it (jpg, png, tif, pgm)")
    if options.stereo:
        raise SourceError(
            f"{path}: stereo was asked for, but these are single photographs; leave --stereo away"
        )
    photographs = _one_size(_read_all(folder, problems), problems)
    if not photographs:
        reason = f"; {problems[0].where}: {problems[0].what}" if problems else ""
        raise SourceError(f"{folder}: no photograph can be used{reason}")
    photographs, t_ns = _in_order(photographs, folder, problems)
    chosen = select_frames(path, t_ns, options)
    photographs, t_ns = [photographs[n] for n in chosen], t_ns[chosen]
    rig = _make_rig(photographs[0], options)
    altitudes = [_altitude(photograph.dji) for photograph in photographs]
    positions = [_position(photograph) for photograph in photographs]

    def read_frame(n: int) -> Frame | None:
        photograph = photographs[n]
        image = read_picture(photograph.path)
        if isinstance(image, str):
            problems.report(photograph.path.name, f"{image}; passed over")
            return None
        name = photograph.path.name
        return Frame(n, int(t_ns[n]), name, (image,), photograph.attitude, altitudes[n], positions[n])

    sensors = _summaries(photographs, t_ns, altitudes, positions)
    return Flight(path, SourceKind.PHOTOGRAPHS, rig, t_ns, read_frame, problems, sensors)


def find_pictures(path: Path) -> Path | None:
    """The folder itself or ``images`` in it, whichever holds pictures."""
    for folder in (path, path / "images"):
        if folder.is_dir() and any(is_picture(file) for file in folder.iterdir()):
            return folder
    return None


def _read_all(folder: Path, problems: Problems) -> list[_Photograph]:
    """Photographs that look down, or do not say where they look, by name."""
    photographs = []
    for file in sorted(file for file in folder.iterdir() if is_picture(file)):
        exif = read_exif(file)
        if isinstance(exif, str):
            problems.report(file.name, f"{exif}; passed over")
            continue
        dji = parse_dji(exif.xmp)
        attitude = _attitude(file, exif, dji, problems)
        if attitude is not None:
            body = rotation_from_euler(attitude.roll_rad, attitude.pitch_rad, 0.0)
            tilt_rad = tilt_from_nadir_rad(body @ nadir_mount().rotation)
            if tilt_rad > TILT_MAX_RAD:
                tilt_deg = math.degrees(tilt_rad)
                problems.report(
                    file.name, f"looks {tilt_deg:.0f} degrees away from straight down; passed over"
                )
                continue
        photographs.append(_Photograph(file, exif, dji, attitude))
    return photographs


def _attitude(file: Path, exif: Exif, dji: DjiTags, problems: Problems) -> Attitude | None:
    """Attitude of a photograph; without a heading where the picture may have been turned since it was taken.

    Viewers turn the pixels and leave the angles in the file as they were. The tilt is small, and known in
    size.
    """
    attitude = read_attitude(dji)
    if attitude is None or exif.changed_by is None:
        return attitude
    problems.report(file.name, f"changed by {exif.changed_by} after it was taken; its heading is not used")
    tilt_rad = math.hypot(attitude.roll_rad, attitude.pitch_rad)
    return Attitude(attitude.roll_rad, attitude.pitch_rad, attitude.sigma_rad + 2.0 * tilt_rad)


def _one_size(photographs: list[_Photograph], problems: Problems) -> list[_Photograph]:
    """Those of the first one's size: one camera, one calibration."""
    kept = []
    for photograph in photographs:
        first, size = photographs[0].exif, (photograph.exif.width, photograph.exif.height)
        if size == (first.width, first.height):
            kept.append(photograph)
            continue
        what = f"{size[0]}x{size[1]} pixels where the first has {first.width}x{first.height}; passed over"
        problems.report(photograph.path.name, what)
    return kept


def _in_order(
    photographs: list[_Photograph], folder: Path, problems: Problems
) -> tuple[list[_Photograph], IntArray]:
    """By time, then name, with times that increase; by name, a second apart, when one of them has no time."""
    timeless = [photograph.path.name for photograph in photographs if photograph.exif.t_ns is None]
    if timeless:
        what = (
            f"{len(timeless)} of {len(photographs)} photographs have no time ({timeless[0]}); taken by name"
        )
        problems.append(Problem(folder.name, f"{what}, one a second"))
        return photographs, np.arange(len(photographs), dtype=np.int64) * SECOND_NS
    ordered = sorted(photographs, key=lambda photograph: (photograph.exif.t_ns or 0, photograph.path.name))
    t_ns = np.array([photograph.exif.t_ns for photograph in ordered], dtype=np.int64)
    return ordered, _spread_equal(t_ns)


def _spread_equal(t_ns: IntArray) -> IntArray:
    """Times (n,), sorted: equal ones, as clocks of whole seconds give them, evenly spread up to the next."""
    _, first, count = np.unique(t_ns, return_index=True, return_counts=True)
    following = np.append(t_ns[first[1:]], t_ns[-1] + SECOND_NS)
    room_ns = np.minimum(following - t_ns[first], SECOND_NS)
    rank = np.arange(len(t_ns)) - np.repeat(first, count)
    return np.asarray(t_ns + rank * np.repeat(room_ns // count, count), dtype=np.int64)


def _make_rig(photograph: _Photograph, options: ReadOptions) -> Rig:
    """Camera of the first photograph, on a body of its own that looks straight down."""
    exif = photograph.exif
    size = (exif.width, exif.height)
    if options.camera_file is not None:
        given = read_camera_file(options.camera_file, size)[0].camera
        camera, origin = fit_to_images(options.camera_file, given, size), "given"
    else:
        factory = factory_camera(photograph.dji, exif.width, exif.height, exif.stated_width)
        focal_px = focal_length_px(exif)
        origin = "exif" if factory or focal_px else "default"
        focal_px = focal_px or DEFAULT_FOCAL_WIDTHS * max(size)
        centre = 0.5 * (exif.width - 1), 0.5 * (exif.height - 1)
        camera = factory or Camera(*size, focal_px, focal_px, *centre)
    return Rig((MountedCamera("cam0", camera, nadir_mount()),), origin)


def _altitude(dji: DjiTags) -> Altitude | None:
    """Height above the start; never the height above the sea, whose zero is anywhere."""
    height_m = dji.number("RelativeAltitude")
    return None if height_m is None else Altitude(height_m, HEIGHT_SIGMA_M, AltitudeKind.ABOVE_START)


def _position(photograph: _Photograph) -> GeoPosition | None:
    """From the drone's entries, which have more digits, else from Exif."""
    exif, dji = photograph.exif, photograph.dji
    latitude = dji.number("GpsLatitude", "Latitude")
    longitude = dji.number(
        "GpsLongitude", "GpsLongtitude", "Longitude"
    )  # the misspelling is in older firmware
    if latitude is None or longitude is None or (latitude, longitude) == (0.0, 0.0):
        latitude, longitude = exif.latitude_deg, exif.longitude_deg
    if latitude is None or longitude is None or (latitude, longitude) == (0.0, 0.0):
        return None
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
        return None
    altitude = dji.number("AbsoluteAltitude")
    altitude = altitude if altitude is not None else exif.altitude_m
    north, east, up = (dji.number(f"RtkStd{axis}") for axis in ("Lat", "Lon", "Hgt"))
    horizontal = math.hypot(north, east) / math.sqrt(2.0) if north and east else exif.position_sigma_m
    return GeoPosition(
        latitude,
        longitude,
        altitude or 0.0,
        horizontal or POSITION_SIGMA_M,
        math.inf if altitude is None else up or GPS_ALTITUDE_SIGMA_M,
    )


def _accuracy(position: GeoPosition) -> str:
    sigma_m = np.array([[position.sigma_horizontal_m, position.sigma_vertical_m]])
    assumed = ", assumed: none is stated" if state_no_accuracy(sigma_m)[0] else ""
    return f"{position.sigma_horizontal_m:.2g} m horizontal{assumed}"


def _summaries(
    photographs: list[_Photograph],
    t_ns: IntArray,
    altitudes: list[Altitude | None],
    positions: list[GeoPosition | None],
) -> tuple[SensorSummary, ...]:
    rate_hz = 1e9 / float(np.median(np.diff(t_ns))) if len(t_ns) > 1 else 0.0
    attitudes = [photograph.attitude for photograph in photographs]
    sigmas = [
        (Quantity.ATTITUDE, "gimbal", [f"{math.degrees(a.sigma_rad):.2g} deg" for a in attitudes if a]),
        (Quantity.HEIGHT, "RelativeAltitude", [f"{a.sigma_m:.2g} m" for a in altitudes if a]),
        (Quantity.POSITION, "GPS", [_accuracy(position) for position in positions if position]),
    ]
    return tuple(
        SensorSummary(name, quantity, len(values), rate_hz, values[0], len(values))
        for quantity, name, values in sigmas
        if values
    )
