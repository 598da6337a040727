"""What a photograph's own metadata says: Exif tags, and the text of its XMP packet.

Exif 2.32 (CIPA DC-008), XMP specification part 3 for where the packet stands in a file.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

from PIL import Image

_EXIF, _GPS = 0x8769, 0x8825  # the two directories below the first
_MODEL, _XMP_IN_TIFF = 0x0110, 700
_XMP_HEAD = b"http://ns.adobe.com/xap/1.0/\x00"
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_POSITION_SIGMA_MAX_M = 1000.0  # a stated positioning error beyond this says nothing
_WRITING_TAKES_NS = 5_000_000_000  # a camera may be this slow to write the file


@dataclass(frozen=True, slots=True)
class Exif:
    """Metadata of one photograph; None where it does not say.

    width, height: pixels in the file. stated_width: pixels the tags state, which a resizing program may have
    left behind. pixels_per_mm: on the sensor, for the stated width. t_ns: UTC, or the camera's clock taken as
    UTC when it states no time zone. xmp: the packet as text. changed_by: the program that wrote the file
    again after the picture was taken.
    """

    width: int
    height: int
    model: str
    stated_width: int | None
    focal_mm: float | None
    focal_35mm: float | None
    pixels_per_mm: float | None
    t_ns: int | None
    latitude_deg: float | None
    longitude_deg: float | None
    altitude_m: float | None
    position_sigma_m: float | None
    xmp: str
    changed_by: str | None


def read_exif(path: Path) -> Exif | str:
    """Metadata of the file, or what is wrong with it in a few words. Damaged tags read as absent."""
    try:
        if path.stat().st_size == 0:
            return "empty file"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as picture:
                return _from_picture(picture)
    except (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError):
        return "not a picture, or damaged from its first bytes"


def _from_picture(picture: Image.Image) -> Exif:
    first: Mapping[int, Any] = {}
    tags: Mapping[int, Any] = {}
    gps: Mapping[int, Any] = {}
    try:
        directory = picture.getexif()
        first, tags, gps = directory, directory.get_ifd(_EXIF), directory.get_ifd(_GPS)
    except Exception:  # Pillow raises whatever the damage leads to; the picture itself may still be good
        first = {}
    unit = _MM_PER_UNIT.get(int(_number(tags.get(41488)) or 2), 25.4)
    per_unit = _number(tags.get(41486))
    latitude, longitude = _angle(gps, 2, 1, "S"), _angle(gps, 4, 3, "W")
    altitude = _number(gps.get(6))
    below = gps.get(5) in (1, b"\x01")
    sigma = _number(gps.get(31))
    return Exif(
        width=picture.width,
        height=picture.height,
        model=str(first.get(_MODEL, "")).strip("\x00 "),
        stated_width=_whole(tags.get(40962)),
        focal_mm=_positive(tags.get(37386)),
        focal_35mm=_positive(tags.get(41989)),
        pixels_per_mm=per_unit / unit if per_unit and per_unit > 0 else None,
        t_ns=_time(first, tags, gps),
        latitude_deg=latitude if longitude is not None else None,
        longitude_deg=longitude if latitude is not None else None,
        altitude_m=None if altitude is None else -abs(altitude) if below else altitude,
        position_sigma_m=sigma if sigma and 0 < sigma < _POSITION_SIGMA_MAX_M else None,
        xmp=_xmp(picture, first),
        changed_by=_changed_by(first, tags),
    )


def _xmp(picture: Image.Image, first: Mapping[int, Any]) -> str:
    """The packet from an APP1 segment of a JPEG, tag 700 of a TIFF, or where Pillow leaves it; else empty."""
    for marker, content in getattr(picture, "applist", []):
        if marker == "APP1" and content.startswith(_XMP_HEAD):
            return str(content[len(_XMP_HEAD) :].decode("utf-8", errors="replace"))
    packet = first.get(_XMP_IN_TIFF, picture.info.get("xmp", b""))
    return packet.decode("utf-8", errors="replace") if isinstance(packet, bytes) else str(packet)


def _changed_by(first: Mapping[int, Any], tags: Mapping[int, Any]) -> str | None:
    written, taken = _moment(first.get(306), None), _moment(tags.get(36867), None)
    if written is None or taken is None or written - taken <= _WRITING_TAKES_NS:
        return None
    return str(first.get(305, "")).strip("\x00 ") or "an unnamed program"


def _time(first: Mapping[int, Any], tags: Mapping[int, Any], gps: Mapping[int, Any]) -> int | None:
    """When the picture was taken; the GPS receiver's stamp when the camera's clock says nothing."""
    for directory, date, fraction, offset in (
        (tags, 36867, 37521, 36881),
        (tags, 36868, 37522, 36882),
        (first, 306, 0, 0),
    ):
        moment = _moment(directory.get(date), directory.get(offset))
        if moment is not None:
            digits = "".join(c for c in str(directory.get(fraction, "")) if c.isdigit())[:9]
            return moment + int(digits.ljust(9, "0") or 0)
    clock = gps.get(7)
    if not isinstance(clock, tuple) or len(clock) != 3:
        return None
    hours, minutes, seconds = (_number(part) for part in clock)
    day = _moment(f"{gps.get(29, '')} 00:00:00", None)
    if day is None or hours is None or minutes is None or seconds is None:
        return None
    return day + round((hours * 3600 + minutes * 60 + seconds) * 1e9)


def _moment(text: object, offset: object) -> int | None:
    """Nanoseconds since 1970 of "2016:06:23 16:31:59" with a time zone as "+02:00"."""
    try:
        naive = datetime.strptime(str(text).strip("\x00 "), "%Y:%m:%d %H:%M:%S")
        zone: timezone = UTC
        if isinstance(offset, str) and len(offset) >= 6 and offset[0] in "+-":
            sign = -1 if offset[0] == "-" else 1
            zone = timezone(sign * timedelta(hours=int(offset[1:3]), minutes=int(offset[4:6])))
    except ValueError:
        return None
    return int(naive.replace(tzinfo=zone).timestamp()) * 1_000_000_000


def _number(value: object) -> float | None:
    """A finite float, from Exif's rationals (0/0 among them) too."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _positive(value: object) -> float | None:
    number = _number(value)
    return number if number is not None and number > 0 else None


def _whole(value: object) -> int | None:
    number = _positive(value)
    return None if number is None else int(number)


def _angle(gps: Mapping[int, Any], tag: int, side: int, negative: str) -> float | None:
    """Degrees from (degrees, minutes, seconds) and the letter of the hemisphere."""
    parts = gps.get(tag)
    if not isinstance(parts, tuple) or len(parts) != 3:
        return None
    numbers = [_number(part) for part in parts]
    if None in numbers:
        return None
    degrees, minutes, seconds = (number or 0.0 for number in numbers)
    angle = degrees + minutes / 60.0 + seconds / 3600.0
    if (degrees, minutes, seconds) == (0.0, 0.0, 0.0) and not gps.get(side):
        return None
    return -angle if str(gps.get(side, "")).strip("\x00 ").upper().startswith(negative) else angle
