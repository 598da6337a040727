"""The choice of the scale source, from most to least trusted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from overfly.geometry.cameras import Camera
from overfly.sensors import Flight, Quantity, ScaleSource, SensorSummary, SourceKind, choose_scale_source
from overfly.sensors.calibration_files import nadir_mount
from overfly.sensors.flight import Problems
from overfly.types import MountedCamera, Rig, ScaleLandmark


def flight(
    cameras: int = 1,
    quantities: tuple[Quantity, ...] = (),
    landmark_ns: int | None = None,
    covered: int = 10,
) -> Flight:
    mounted = MountedCamera("cam0", Camera(32, 24, 30, 30, 16, 12), nadir_mount())
    corners = np.zeros((4, 2))
    return Flight(
        Path("somewhere"),
        SourceKind.EUROC,
        Rig((mounted,) * cameras),
        np.arange(10, dtype=np.int64),
        lambda _: None,
        Problems(),
        [SensorSummary(str(quantity), quantity, 10, 1.0, "", covered) for quantity in quantities],
        None if landmark_ns is None else ScaleLandmark("book", landmark_ns, "cam0", corners, corners),
    )


ALL = (Quantity.RANGE, Quantity.POSITION, Quantity.HEIGHT)


@pytest.mark.parametrize(
    ("source", "height_m", "wanted"),
    [
        (flight(2, ALL, 3), 1.0, ScaleSource.STEREO),
        (flight(1, ALL, 3), 1.0, ScaleSource.RANGE),
        (flight(1, ALL[1:], 3), 1.0, ScaleSource.LANDMARK),
        (flight(1, ALL[1:], 99), 1.0, ScaleSource.GPS),  # the landmark's frame is not among those read
        (flight(1, ALL[2:]), 1.0, ScaleSource.ALTITUDE),
        (flight(1, ALL, covered=0), 1.0, ScaleSource.GIVEN),
        (flight(1, (Quantity.ATTITUDE, Quantity.IMU)), None, ScaleSource.NONE),
    ],
)
def test_order_of_trust(source: Flight, height_m: float | None, wanted: ScaleSource) -> None:
    assert choose_scale_source(source, height_m) is wanted
