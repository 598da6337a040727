"""Focal length in pixels from what Exif says of lens and sensor."""

from __future__ import annotations

import math

from overfly.sensors.exif import Exif

# Width of the sensor's image area in millimetres, from the makers' data sheets: 1/2.3 inch 6.17, 1 inch 13.2,
# four thirds 17.3. By the camera model as Exif names it.
SENSOR_WIDTH_MM = {
    "FC300C": 6.17,  # Phantom 3
    "FC300S": 6.17,
    "FC300X": 6.17,
    "FC330": 6.17,  # Phantom 4
    "FC220": 6.17,  # Mavic Pro
    "FC350": 6.17,  # Zenmuse X3
    "FC550": 17.3,  # Zenmuse X5
    "FC6310": 13.2,  # Phantom 4 Pro, Advanced
    "FC6310S": 13.2,
    "FC6310R": 13.2,  # Phantom 4 RTK
    "FC6520": 17.3,  # Zenmuse X5S
    "FC3411": 13.2,  # Air 2S
    "L1D-20c": 13.2,  # Mavic 2 Pro
    "L2D-20c": 17.3,  # Mavic 3
    "M3E": 17.3,  # Mavic 3 Enterprise
    "Canon PowerShot SX260 HS": 6.17,
}
_SENSOR_WIDTH_RANGE_MM = (2.0, 60.0)  # anything else is a mistake in the tags
_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)


def focal_length_px(exif: Exif) -> float | None:
    """Focal length in pixels of the picture as it is, or None when Exif does not say enough.

    In order: pixels per millimetre of the sensor, a known sensor's width, the equivalent for 35 mm film
    (rounded to whole millimetres by most cameras, hence last; CIPA DC-008 defines it by the diagonal).
    """
    long_px = max(exif.width, exif.height)
    if exif.focal_mm and exif.pixels_per_mm and exif.stated_width:
        stated_px = exif.stated_width
        sensor_mm = stated_px / exif.pixels_per_mm
        if _SENSOR_WIDTH_RANGE_MM[0] < sensor_mm < _SENSOR_WIDTH_RANGE_MM[1]:
            return exif.focal_mm * exif.pixels_per_mm * exif.width / stated_px
    sensor_mm = SENSOR_WIDTH_MM.get(exif.model, 0.0)
    if exif.focal_mm and sensor_mm:
        return exif.focal_mm * long_px / sensor_mm
    if exif.focal_35mm:
        return focal_length_35mm_px(exif.focal_35mm, exif.width, exif.height)
    return None


def focal_length_35mm_px(focal_35mm: float, width: int, height: int) -> float:
    """Focal length in pixels from the equivalent for 35 mm film, of a picture of width x height pixels."""
    return focal_35mm * _diagonal_px(max(width, height), min(width, height)) / _FILM_DIAGONAL_MM


def _diagonal_px(long_px: int, short_px: int) -> float:
    """Diagonal of the whole sensor: pictures wider than 3:2 are cut from one of 4:3."""
    aspect = long_px / short_px
    return math.hypot(long_px, 0.75 * long_px) if aspect > 1.6 else math.hypot(long_px, short_px)
