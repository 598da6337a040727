"""The other sensors say what the path says, with the errors they were given."""

from __future__ import annotations

import math

import numpy as np
import pytest

from overfly.geometry.poses import rotation_from_vector
from overfly.simulation.flight import geographic
from overfly.simulation.paths import Route
from overfly.simulation.relief import build_relief, flat_relief
from overfly.simulation.sensors import (
    AttitudeSensor,
    Barometer,
    Clock,
    Gps,
    Imu,
    Readings,
    Sonar,
    attitude_readings,
    barometer_readings,
    gps_readings,
    imu_readings,
    sonar_readings,
)
from overfly.simulation.vehicles import MULTIROTOR, fly_route

from .scenes import still

ROUTE = Route(np.array([[0.0, 0.0, 2.0], [6.0, 1.0, 2.2], [8.0, 6.0, 2.4], [1.0, 7.0, 2.0]]), 1.5)
PATH = fly_route(ROUTE, MULTIROTOR, 3)
LEVEL = still(np.array([0.0, 0.0, 2.0]), np.zeros(3), 400.0)


def test_attitude_noise_and_bias_have_the_stated_size() -> None:
    sensor = AttitudeSensor(sigma_rad=0.01, bias_sigma_rad=0.02, bias_tau_s=5.0)
    values = attitude_readings(sensor, LEVEL, 0, 1).values[:, :2]
    steps = np.diff(values, axis=0).std() / math.sqrt(2.0)
    assert math.isclose(steps, 0.01, rel_tol=0.1)
    slow = values[: len(values) // 100 * 100].reshape(-1, 100, 2).mean(axis=1)
    assert 0.013 < slow.std() < 0.027


def test_attitude_clock_is_late_and_jitters() -> None:
    on_time = attitude_readings(AttitudeSensor(), PATH, 0, 1)
    late = attitude_readings(AttitudeSensor(clock=Clock(0.08)), PATH, 0, 1)
    assert set(np.diff([on_time.stamps_ns, late.stamps_ns], axis=0).ravel().tolist()) == {80_000_000}
    assert np.array_equal(on_time.values, late.values)
    shaky = attitude_readings(AttitudeSensor(clock=Clock(0.0, 0.004)), PATH, 0, 1)
    assert (np.diff(shaky.stamps_ns) > 0).all()
    assert np.diff(shaky.stamps_ns).std() > 1e6


def test_imu_integrates_to_the_path() -> None:
    silent = Imu(gyroscope_noise=0.0, gyroscope_walk=0.0, accelerometer_noise=0.0, accelerometer_walk=0.0)
    readings = imu_readings(silent, PATH, 0, 1)
    times = readings.stamps_ns * 1e-9
    step = 1.0 / silent.rate_hz
    rotations, _ = PATH.poses(times)
    R, velocity = rotations[0], PATH.velocities(times[:1])[0]
    for row in readings.values:
        velocity = velocity + step * (R @ row[3:] - np.array([0.0, 0.0, 9.80665]))
        R = R @ rotation_from_vector(step * row[:3])
    end = PATH.poses(times[-1:] + step)[0][0]
    assert math.acos(min(1.0, 0.5 * (np.trace(R.T @ end) - 1.0))) < 0.01
    assert np.linalg.norm(velocity - PATH.velocities(times[-1:])[0]) < 0.15


def test_sonar_ranges_drop_outs_and_nearest_echo() -> None:
    sonar = Sonar(sigma_m=0.01, dropout=0.1)
    readings = sonar_readings(sonar, LEVEL, flat_relief(), 0, 1)
    assert math.isclose(readings.values.mean(), 2.0, abs_tol=0.002)
    assert math.isclose(readings.values.std(), 0.01, rel_tol=0.1)
    assert math.isclose(len(readings.values) / (400.0 * sonar.rate_hz), 0.9, abs_tol=0.02)
    z = np.zeros((81, 81))
    z[:, 46:] = 0.5  # a step 0.3 m to the side, inside the cone
    beside = build_relief(z, -2.0, -2.0, 0.05)
    assert sonar_readings(sonar, LEVEL, beside, 0, 1).values.mean() < 1.7
    assert len(sonar_readings(Sonar(max_range_m=1.0), LEVEL, flat_relief(), 0, 1).values) == 0


def test_barometer_starts_near_zero_and_follows_the_height() -> None:
    readings = barometer_readings(Barometer(sigma_m=0.01, drift_m=0.01), PATH, 0, 1)
    _, positions = PATH.poses(readings.stamps_ns * 1e-9)
    assert np.abs(readings.values[:, 0] - (positions[:, 2] - positions[0, 2])).max() < 0.1


def test_gps_is_near_the_path_with_a_bias_of_its_own() -> None:
    readings = gps_readings(Gps(), LEVEL, 0, 5)
    error = readings.values - np.array([0.0, 0.0, 2.0])
    assert math.isclose(np.diff(error[:, 0]).std() / math.sqrt(2.0), 0.6, rel_tol=0.1)
    assert np.abs(error.mean(axis=0)).max() > 0.2


def test_geographic_agrees_with_the_ellipsoid() -> None:
    origin = (48.0, 8.0, 300.0)
    found = geographic(np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [0.0, 100.0, 5.0]]), origin)
    assert np.allclose(found[0], origin, atol=1e-9)
    # radii of curvature of WGS 84 at this latitude
    a, e2 = 6378137.0, 6.69437999014e-3
    w = math.sqrt(1.0 - e2 * math.sin(math.radians(48.0)) ** 2)
    east, north = a / w, a * (1.0 - e2) / w**3
    assert math.isclose(
        found[1, 1] - 8.0, math.degrees(100.0 / ((east + 300.0) * math.cos(math.radians(48.0)))), rel_tol=1e-6
    )
    assert math.isclose(found[2, 0] - 48.0, math.degrees(100.0 / (north + 300.0)), rel_tol=1e-4)
    assert math.isclose(found[2, 2], 305.0, abs_tol=0.01)


def test_readings_interpolate_and_stop_at_gaps() -> None:
    readings = Readings(np.array([0, 10, 2_000_000_000], dtype=np.int64), np.array([[0.0], [1.0], [9.0]]))
    assert readings.at(5) == pytest.approx([0.5])
    assert readings.at(10) == pytest.approx([1.0])
    assert readings.at(1_000_000_000) is None
    assert readings.at(-1) is None
    assert readings.at(2_000_000_001) is None
