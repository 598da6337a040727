"""DJI's telemetry as subtitles beside a video (.srt): position, height and gimbal angles, cue by cue.

Firmware differs. Known are the entries in square brackets of newer aircraft ("[latitude: 47.1]", "[rel_alt:
30.0 abs_alt: 450.1]", "[gb_yaw: 1 gb_pitch: -90 gb_roll: 0]") and the lines of older ones
("GPS(8.5,47.1,16)", "BAROMETER:30.0", "H 20.3m").
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from overfly.errors import SourceError
from overfly.geometry.poses import FloatArray, euler_from_rotation
from overfly.sensors.calibration_files import nadir_mount
from overfly.sensors.default_sigmas import GPS_ALTITUDE_SIGMA_M, POSITION_SIGMA_M
from overfly.sensors.dji import camera_rotation_from_gimbal
from overfly.sensors.flight import Problems
from overfly.sensors.telemetry import Telemetry, height_values, ordered
from overfly.sensors.text_files import read_text

_CUE = re.compile(r"(\d+):(\d\d):(\d\d)[,.](\d{1,3})\s*-->")
_NUMBER = r"([-+]?\d+(?:\.\d+)?)"
# Our names -> how the entry is written; the first that fits counts.
_ENTRIES = {
    "latitude": (rf"\blatitude\s*:\s*{_NUMBER}",),
    "longitude": (rf"\blong(?:i|t)tude\s*:\s*{_NUMBER}",),  # "longtitude" in older firmware
    "height": (rf"\brel_alt\s*:\s*{_NUMBER}", rf"\bBAROMETER\s*:\s*{_NUMBER}", rf"\bH\s*{_NUMBER}\s*m\b"),
    "altitude": (rf"\babs_alt\s*:\s*{_NUMBER}", rf"\[altitude\s*:\s*{_NUMBER}"),
    "yaw": (rf"\bgb_yaw\s*:\s*{_NUMBER}",),
    "pitch": (rf"\bgb_pitch\s*:\s*{_NUMBER}",),
    "roll": (rf"\bgb_roll\s*:\s*{_NUMBER}",),
    "focal": (rf"\bfocal_len\s*:\s*{_NUMBER}",),
}
_OLD_GPS = re.compile(rf"(?<![A-Z])GPS\s*\(\s*{_NUMBER}\s*,\s*{_NUMBER}")  # longitude first
_PATTERNS = {name: [re.compile(text) for text in texts] for name, texts in _ENTRIES.items()}
_FOCAL_RANGE_MM = (10.0, 200.0)


def read_subtitles(path: Path, problems: Problems) -> Telemetry:
    """Telemetry of a video's subtitles, in the video's own time.

    Raises SourceError when the file has no cue at all.
    """
    cues = _split(read_text(path))
    if not cues:
        raise SourceError(f"{path}: no subtitles in it; remove it, or give the telemetry as .csv")
    t_ns = np.array([time for time, _ in cues], dtype=np.int64)
    table = {name: _column(patterns, cues) for name, patterns in _PATTERNS.items()}
    _add_old_positions(table, cues)
    telemetry = Telemetry(
        path.name,
        attitude=ordered(t_ns, _gimbal_angles(table)),
        height=ordered(t_ns, height_values(table["height"])),
        position=ordered(t_ns, _positions(table)),
        of_gimbal=True,
        is_video_time=True,
        focal_35mm=_focal(table["focal"]),
    )
    if telemetry.first_ns is None:
        problems.report(path.name, "no position, height or angle in these subtitles; not used")
    return telemetry


def _split(text: str) -> list[tuple[int, str]]:
    """Beginning (ns) and text of each cue."""
    cues = []
    found = list(_CUE.finditer(text))
    ends = [cue.start() for cue in found[1:]] + [len(text)]
    for cue, end in zip(found, ends, strict=False):
        hours, minutes, seconds, fraction = cue.groups()
        milliseconds = ((int(hours) * 60 + int(minutes)) * 60 + int(seconds)) * 1000
        milliseconds += int(fraction.ljust(3, "0"))
        cues.append((milliseconds * 1_000_000, text[cue.end() : end]))
    return cues


def _column(patterns: list[re.Pattern[str]], cues: list[tuple[int, str]]) -> FloatArray:
    """(n,) values of one entry, NaN where a cue has none."""
    values = np.full(len(cues), np.nan)
    for n, (_, text) in enumerate(cues):
        for pattern in patterns:
            match = pattern.search(text)
            if match:
                values[n] = float(match.group(1))
                break
    return values


def _add_old_positions(table: dict[str, FloatArray], cues: list[tuple[int, str]]) -> None:
    for n, (_, text) in enumerate(cues):
        match = _OLD_GPS.search(text)
        if match and math.isnan(table["latitude"][n]):
            table["longitude"][n], table["latitude"][n] = float(match.group(1)), float(match.group(2))


def _gimbal_angles(table: dict[str, FloatArray]) -> FloatArray:
    """(n, 3) roll, pitch, unwrapped yaw of the camera's own body, which looks straight down at zero."""
    angles = np.full((len(table["yaw"]), 3), np.nan)
    turned = np.radians(np.column_stack([table["yaw"], table["pitch"], table["roll"]]))
    sound = np.flatnonzero(np.isfinite(turned).all(axis=1))
    for n in sound:
        yaw, pitch, roll = (float(angle) for angle in turned[n])
        world_from_cam = camera_rotation_from_gimbal(yaw, pitch, roll)
        angles[n] = euler_from_rotation(world_from_cam @ nadir_mount().rotation.T)
    angles[sound] = np.unwrap(angles[sound], axis=0)
    return angles


def _positions(table: dict[str, FloatArray]) -> FloatArray:
    """(n, 5) as Telemetry has them; a receiver without a fix writes zeros."""
    latitude, longitude = table["latitude"], table["longitude"]
    nowhere = (latitude == 0.0) & (longitude == 0.0)
    outside = (np.abs(latitude) > 90.0) | (np.abs(longitude) > 180.0)
    latitude = np.where(nowhere | outside, np.nan, latitude)
    known = np.isfinite(longitude)
    unwrapped = longitude.copy()
    unwrapped[known] = np.unwrap(longitude[known], period=360.0)
    altitude = table["altitude"]
    vertical = np.where(np.isfinite(altitude), GPS_ALTITUDE_SIGMA_M, np.inf)
    horizontal = np.full(len(latitude), POSITION_SIGMA_M)
    return np.column_stack([latitude, unwrapped, np.nan_to_num(altitude), horizontal, vertical])


def _focal(values: FloatArray) -> float | None:
    """Focal length as for 35 mm film; some firmware writes tenths of a millimetre."""
    known = values[np.isfinite(values) & (values > 0)]
    if not len(known):
        return None
    focal = float(np.median(known))
    focal = focal / 10.0 if focal > _FOCAL_RANGE_MM[1] else focal
    return focal if _FOCAL_RANGE_MM[0] < focal < _FOCAL_RANGE_MM[1] else None
