"""The clock of the attitude sensor: found from tilting alone, as exactly as it says, and not where there is
nothing to find."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.attitude_clock import AttitudeAt, ClockLag, find_clock_lag, set_attitude_clock
from overfly.config import Config
from overfly.geometry.poses import FloatArray
from overfly.sensors.interpolation import TimeSeries, interpolate
from overfly.simulation import simulate
from overfly.slam import Slam
from overfly.types import Attitude, IntArray, NotFound

SIGMA_RAD = 0.01
START_NS = 5_000_000_000


def says(series: TimeSeries) -> AttitudeAt:
    """What a sensor with this record of roll and pitch says."""

    def at(t_ns: IntArray) -> Sequence[Attitude | None]:
        return [
            None if np.isnan(roll) else Attitude(float(roll), float(pitch), SIGMA_RAD)
            for roll, pitch in interpolate(series, t_ns, 2.0)[:, :2]
        ]

    return at


def tilting(t_s: FloatArray, size_rad: float, seed: int) -> FloatArray:
    """Roll and pitch (n, 2) of a vehicle that sways with periods of one to ten seconds."""
    generator = np.random.default_rng(seed)
    rates, phases = generator.uniform(0.6, 6.0, (2, 8)), generator.uniform(0.0, 6.3, (2, 8))
    waves = np.sin(t_s[:, None, None] * rates + phases).sum(axis=2) / 2.0
    return np.asarray(size_rad * waves)


def flown(lag_s: float, seed: int, size_rad: float = 0.05, period_s: float = 0.1) -> ClockLag | NotFound:
    """A minute of flight: the pictures see the tilt to 0.05 degrees, the sensor to 0.5, stamped too late."""
    generator = np.random.default_rng([seed, 1])
    sensor_s = np.arange(-2.0, 62.0, 0.01) + 0.003
    angles = tilting(sensor_s, size_rad, seed) + generator.normal(0.0, 0.009, (len(sensor_s), 2))
    series = TimeSeries(START_NS + np.round((sensor_s + lag_s) * 1e9).astype(np.int64), angles)
    t_s = np.arange(0.0, 60.0, period_s)
    roll, pitch = (tilting(t_s, size_rad, seed) + generator.normal(0.0, 0.0009, (len(t_s), 2))).T
    up = np.column_stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])
    stamps = START_NS + np.round(t_s * 1e9).astype(np.int64)
    return find_clock_lag(says(series), stamps, up, np.zeros(len(stamps), np.int64))


@given(st.floats(-0.6, 0.6), st.integers(0, 1000))
@settings(max_examples=25)
def test_any_lag_is_found(lag_s: float, seed: int) -> None:
    found = flown(lag_s, seed)
    assert isinstance(found, ClockLag)
    assert found.lag_s == pytest.approx(lag_s, abs=0.006)
    assert 2e-4 < found.sigma_s < 0.003


def test_it_is_as_exact_as_it_says() -> None:
    errors = []
    for seed in range(60):
        found = flown(0.08, seed)
        assert isinstance(found, ClockLag)
        errors.append((found.lag_s - 0.08) / found.sigma_s)
    assert 0.5 < float(np.mean(np.square(errors))) < 2.2
    assert abs(float(np.mean(errors))) < 0.4


def test_a_clock_that_is_right_is_left_alone() -> None:
    for seed in range(60):
        found = flown(0.0, seed)
        assert isinstance(found, ClockLag)
        assert not found.is_significant


def test_pictures_two_seconds_apart_tell_it_too() -> None:
    found = flown(-0.12, 3, period_s=0.8)
    assert isinstance(found, ClockLag)
    assert found.lag_s == pytest.approx(-0.12, abs=5.0 * found.sigma_s)
    assert found.is_significant


def test_a_vehicle_that_does_not_tilt_tells_nothing() -> None:
    assert isinstance(flown(0.3, 4, size_rad=0.0), NotFound)


def test_too_few_frames_tell_nothing() -> None:
    stamps = START_NS + np.arange(10) * 10**8
    up = np.tile([0.0, 0.0, 1.0], (10, 1))
    silent = find_clock_lag(lambda t_ns: [None] * len(t_ns), stamps, up, np.zeros(10, np.int64))
    assert isinstance(silent, NotFound)
    stamps, up = START_NS + np.arange(200) * 10**8, np.tile([0.0, 0.0, 1.0], (200, 1))
    silent = find_clock_lag(lambda t_ns: [None] * len(t_ns), stamps, up, np.zeros(200, np.int64))
    assert isinstance(silent, NotFound)


@pytest.fixture(scope="module")
def corridor() -> tuple[Slam, TimeSeries]:
    """A map before its finish, and what the attitude sensor recorded."""
    flight = simulate("corridor", seed=5, frames=150)
    slam = Slam(flight.rig, Config())
    for frame in flight:
        slam.process(frame)
    assert flight.recorded.attitude is not None
    return slam, TimeSeries(flight.recorded.attitude.stamps_ns, flight.recorded.attitude.values)


def test_nodes_get_the_attitude_of_their_own_moment(corridor: tuple[Slam, TimeSeries]) -> None:
    slam, series = corridor
    before = [node.tilt.level_from_cam for node in slam.map.nodes]
    record, camera, prior = says(series), slam.rig.cam0, slam._registrar.tilt_prior
    lag = set_attitude_clock(slam.map, slam.records, record, camera, prior)
    assert isinstance(lag, ClockLag)
    assert not lag.is_significant
    assert all(node.tilt.level_from_cam is old for node, old in zip(slam.map.nodes, before, strict=True))
    record = says(TimeSeries(series.t_ns + 90_000_000, series.values))
    lag = set_attitude_clock(slam.map, slam.records, record, camera, prior)
    assert isinstance(lag, ClockLag)
    assert lag.lag_s == pytest.approx(0.09, abs=0.01)
    assert lag.is_significant
    after = np.array([node.tilt.level_from_cam for node in slam.map.nodes])
    assert np.isfinite(after).all()
    off = np.abs(after - np.array(before)).max(axis=(1, 2))
    assert 0.0 < np.median(off) < 0.01  # of a second 1/100 off, and of noise
    stamps = np.array([node.t_ns for node in slam.map.nodes])
    lagging = [slam._registrar.tilt_prior(attitude).level_from_cam for attitude in record(stamps)]
    worse = np.abs(np.array(lagging) - np.array(before)).max(axis=(1, 2))
    assert np.median(worse) > 1.2 * np.median(off)
