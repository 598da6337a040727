"""What an autopilot's messages say of the range to the ground."""

from __future__ import annotations

import math

import pytest

from overfly.navigation.mavlink.dialect import messages
from overfly.navigation.mavlink.telemetry import Telemetry
from overfly.sensors.default_sigmas import SONAR_HALF_ANGLE_RAD


@pytest.mark.parametrize(
    ("kind", "views_rad", "half_angle_rad"),
    [
        (messages.MAV_DISTANCE_SENSOR_ULTRASOUND, (0.6, 0.4), 0.2),
        (messages.MAV_DISTANCE_SENSOR_ULTRASOUND, (0.0, 0.0), SONAR_HALF_ANGLE_RAD),
        (messages.MAV_DISTANCE_SENSOR_LASER, (0.05, 0.05), 0.0),
    ],
)
def test_a_sonar_has_a_cone(kind: int, views_rad: tuple[float, float], half_angle_rad: float) -> None:
    telemetry = Telemetry()
    for n in range(3):
        message = messages.MAVLink_distance_sensor_message(
            100 * n, 10, 4000, 250, kind, 0, messages.MAV_SENSOR_ROTATION_PITCH_270, 4, *views_rad
        )
        telemetry.take(message, n * 100_000_000)
    altitude = telemetry.range_at(150_000_000)
    assert altitude is not None
    assert altitude.value_m == pytest.approx(2.5)
    assert altitude.sigma_m == pytest.approx(0.02)
    assert math.isclose(altitude.half_angle_rad, half_angle_rad)
