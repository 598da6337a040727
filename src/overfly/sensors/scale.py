"""Where the metre of a map comes from."""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from overfly.sensors.flight import Flight, Quantity


class ScaleSource(StrEnum):
    """In order of trust."""

    STEREO = "stereo"
    RANGE = "range"
    LANDMARK = "landmark"
    GPS = "gps"
    ALTITUDE = "altitude"
    GIVEN = "given"
    NONE = "none"


def choose_scale_source(flight: Flight, height_m: float | None = None) -> ScaleSource:
    """The most trusted source of scale the flight has; height_m: of the first frame, as the user gave it."""
    covered = {sensor.quantity: sensor.frames for sensor in flight.sensors}
    if flight.rig.is_stereo:
        return ScaleSource.STEREO
    if covered.get(Quantity.RANGE, 0) > 0:
        return ScaleSource.RANGE
    landmark = flight.scale_landmark
    if landmark is not None and bool(np.any(flight.t_ns == landmark.t_ns)):
        return ScaleSource.LANDMARK  # its corners are known in that frame only
    if covered.get(Quantity.POSITION, 0) > 1:
        return ScaleSource.GPS
    if covered.get(Quantity.HEIGHT, 0) > 0:
        return ScaleSource.ALTITUDE
    return ScaleSource.NONE if height_m is None else ScaleSource.GIVEN
