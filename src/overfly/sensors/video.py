"""Videos, with the telemetry beside them: a file of the same name that ends in .srt, .csv, .ulg or .bin.

Times are the video's own, from its first frame.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from overfly.errors import SourceError, UsageError
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import rotation_from_euler
from overfly.sensors.calibration_files import fit_to_images, nadir_mount, read_camera_file
from overfly.sensors.dataflash import read_dataflash
from overfly.sensors.dji import tilt_from_nadir_rad
from overfly.sensors.flight import Flight, Problems, ReadOptions, SourceKind
from overfly.sensors.focal_length import focal_length_35mm_px
from overfly.sensors.photographs import DEFAULT_FOCAL_WIDTHS, TILT_MAX_RAD
from overfly.sensors.selection import select_frames
from overfly.sensors.subtitles import read_subtitles
from overfly.sensors.telemetry import Telemetry, values_at
from overfly.sensors.telemetry_table import read_telemetry_table
from overfly.sensors.ulog import read_ulog
from overfly.types import Attitude, Frame, IntArray, MountedCamera, Rig, UInt8Array

SUFFIXES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg", ".mts", ".ts"})


def is_video(path: Path) -> bool:
    """By its name."""
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".")


def open_video(path: Path, options: ReadOptions) -> Flight:
    """path: the video file.

    Raises SourceError when no frame of it can be read, CalibrationError for a camera file that does not fit.
    """
    problems = Problems()
    if options.stereo:
        raise SourceError(f"{path}: stereo was asked for, but a video is one camera; leave --stereo away")
    reader = VideoReader(path)
    stamps = reader.t_ns
    telemetry = find_telemetry(path, stamps, options, problems)
    chosen = select_frames(path, stamps, options)
    values = values_at(telemetry, stamps[chosen], options.max_time_gap_s)
    down = np.array([_looks_down(attitude) for attitude in values.attitudes], dtype=bool)
    if not down.all():
        chosen = chosen[down]
        what = f"{np.count_nonzero(~down)} frames look more than 35 degrees away from straight down"
        problems.report(path.name, f"{what}; passed over")
        if not len(chosen):
            raise SourceError(f"{path}: all frames look more than 35 degrees away from straight down")
        values = values_at(telemetry, stamps[chosen], options.max_time_gap_s)
    t_ns = stamps[chosen]

    def read_frame(n: int) -> Frame | None:
        image = reader.read(int(chosen[n]))
        if image is None:
            problems.report(path.name, f"frame {chosen[n]} cannot be decoded; passed over")
            return None
        at_n = values.attitudes[n], values.altitudes[n], values.positions[n]
        return Frame(n, int(t_ns[n]), f"frame {chosen[n]}", (image,), *at_n)

    rig = _make_rig(reader.size, telemetry, options)
    return Flight(
        path, SourceKind.VIDEO, rig, t_ns, read_frame, problems, values.summaries,
        attitude_at=values.attitude_at,
    )  # fmt: skip


class VideoReader:
    """Frames of a video by number, quick in order. Opens with what all frames' times are."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._next = 0
        self._lock = threading.Lock()  # frames are read ahead in a thread of their own
        self.t_ns = _packet_times(path)
        self._capture = _open(path)
        first = self.read(0)
        if first is None:
            raise SourceError(f"{path}: its first frame cannot be decoded; convert it with another program")
        self.size = (first.shape[1], first.shape[0])

    def read(self, number: int) -> UInt8Array | None:
        """(H, W, 3) RGB as recorded, not turned by metadata; None when it cannot be decoded."""
        with self._lock:
            image = self._decode(number)
        if image is None:
            return None
        colours = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        return np.ascontiguousarray(colours, dtype=np.uint8)

    def _decode(self, number: int) -> Any | None:
        """The frame as OpenCV has it: decoded in order, from the beginning again for an earlier one.

        Seeking is not used: it lands beside the frame in some files.
        """
        if number < self._next:
            self._capture.release()
            self._capture = _open(self._path)
            self._next = 0
        while self._next < number:
            self._next += 1
            if not self._capture.grab():
                return None
        self._next += 1
        is_read, image = self._capture.read()
        return image if is_read else None


def find_telemetry(
    path: Path, stamps: IntArray, options: ReadOptions, problems: Problems
) -> Telemetry | None:
    """The telemetry beside a video, in the video's time; None when there is none.

    Subtitles are in the video's time; so is a table that begins within the video. Other records begin with
    the video, or time_offset_s later than they do.
    """
    readers: dict[str, Callable[[Path], Telemetry]] = {
        ".srt": lambda file: read_subtitles(file, problems),
        ".csv": lambda file: read_telemetry_table(file, problems),
        ".ulg": read_ulog,
        ".bin": read_dataflash,
    }
    for suffix, read in readers.items():
        for file in sorted(path.parent.glob(f"{_escaped(path.stem)}.*")):
            if file.suffix.lower() == suffix:
                return _in_video_time(read(file), file, stamps, options, problems)
    if options.time_offset_s is not None:
        raise UsageError(f"{path}: a time offset was given, but there is no telemetry beside it")
    return None


def _in_video_time(
    telemetry: Telemetry, file: Path, stamps: IntArray, options: ReadOptions, problems: Problems
) -> Telemetry:
    first_ns = telemetry.first_ns
    if first_ns is None:
        return telemetry
    offset_ns = round((options.time_offset_s or 0.0) * 1e9)
    is_within = file.suffix.lower() == ".csv" and 0 <= first_ns <= int(stamps[-1])
    if telemetry.is_video_time or is_within:
        return telemetry.shifted(-offset_ns)
    if options.time_offset_s is None:
        what = "has a clock of its own; taken to begin with the video (--time-offset says otherwise)"
        problems.report(file.name, what)
    return telemetry.shifted(-first_ns - offset_ns)


def _escaped(stem: str) -> str:
    """A name as glob patterns have it."""
    return "".join(f"[{letter}]" if letter in "[]*?" else letter for letter in stem)


def _open(path: Path, *parameters: int) -> Any:
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, list(parameters))
    if not capture.isOpened():
        raise SourceError(f"{path}: not readable as a video; convert it, or give its frames as pictures")
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture


def _packet_times(path: Path) -> IntArray:
    """Times (n,) of the frames from the first, by the packets, without decoding them.

    A file that has no times for its packets is taken to have its stated rate.
    """
    capture = _open(path, cv2.CAP_PROP_FORMAT, -1)
    rate_hz = capture.get(cv2.CAP_PROP_FPS)
    times = []
    while capture.grab():
        times.append(capture.get(cv2.CAP_PROP_POS_MSEC))
    capture.release()
    if not times:
        raise SourceError(f"{path}: no frame in it; the recording may not have been finished")
    shown = np.sort(np.array(times))  # packets come in the order of decoding
    if len(shown) > 1 and not np.all(np.diff(shown) > 0):
        if not 1.0 <= rate_hz <= 1000.0:
            raise SourceError(f"{path}: its frames have no times; convert it with another program")
        shown = np.arange(len(shown)) * 1e3 / rate_hz
    return np.asarray(np.round((shown - shown[0]) * 1e6), dtype=np.int64)


def _looks_down(attitude: Attitude | None) -> bool:
    if attitude is None:
        return True
    body = rotation_from_euler(attitude.roll_rad, attitude.pitch_rad, 0.0)
    return tilt_from_nadir_rad(body @ nadir_mount().rotation) <= TILT_MAX_RAD


def _make_rig(size: tuple[int, int], telemetry: Telemetry | None, options: ReadOptions) -> Rig:
    """The calibration that is given, else what the telemetry says of the lens, else a guess."""
    mount = nadir_mount()
    if options.camera_file is not None:
        calibrated = read_camera_file(options.camera_file, size)[0]
        camera = fit_to_images(options.camera_file, calibrated.camera, size)
        is_mounted = calibrated.body_from_cam is not None and not (telemetry and telemetry.of_gimbal)
        mount = calibrated.body_from_cam if is_mounted and calibrated.body_from_cam else mount
        return Rig((MountedCamera("video", camera, mount),), "given")
    focal_35mm = telemetry.focal_35mm if telemetry else None
    focal_px = focal_length_35mm_px(focal_35mm, *size) if focal_35mm else DEFAULT_FOCAL_WIDTHS * max(size)
    centre = 0.5 * (size[0] - 1), 0.5 * (size[1] - 1)
    camera = Camera(*size, focal_px, focal_px, *centre)
    return Rig((MountedCamera("video", camera, mount),), "exif" if focal_35mm else "default")
