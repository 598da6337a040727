"""Roll and pitch from rates and forces alone: right within what is stated, refused where they tell none."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.geometry.poses import FloatArray, rotation_from_euler
from overfly.sensors import open_flight
from overfly.sensors.euroc_sensors import read_imu
from overfly.sensors.flight import Problems
from overfly.sensors.imu_attitude import GRAVITY, Tilts, attitude_of_imu, fault_of, tilts_of
from overfly.simulation.paths import Path as FlownPath
from overfly.simulation.paths import Route, lawn_mower
from overfly.simulation.sensors import Imu, imu_readings
from overfly.simulation.vehicles import MULTIROTOR, fly_route
from overfly.trajectory import read_tum
from overfly.types import ImuRecord

ROUND = np.array([[0.0, 0.0, 2.0], [9.0, 1.0, 2.2], [9.0, 9.0, 2.4], [0.0, 9.0, 2.0], [0.0, 0.0, 2.0]])


def at_rest(roll_rad: float, pitch_rad: float, seconds: float = 20.0) -> ImuRecord:
    """A body that hangs still, its samples with the noise of small sensors."""
    noise = np.random.default_rng(3).normal(0.0, 1.0, (round(100 * seconds), 6))
    up = rotation_from_euler(roll_rad, pitch_rad, 0.4)[2]
    t_ns = 5_000_000_000 + 10_000_000 * np.arange(len(noise))
    return ImuRecord(t_ns, 0.005 * noise[:, :3], GRAVITY * up + 0.02 * noise[:, 3:])


def flown(path: FlownPath, seed: int, gyroscope_noise: float = 1.2e-3) -> ImuRecord:
    values = imu_readings(Imu(gyroscope_noise=gyroscope_noise), path, 0, seed)
    bias = np.random.default_rng(seed).normal(0.0, 0.02, 3)
    return ImuRecord(values.stamps_ns, values.values[:, :3] + bias, values.values[:, 3:])


def errors(tilts: Tilts, up_in_body: FloatArray) -> FloatArray:
    """(n, 2) radians."""
    roll, pitch = np.arctan2(up_in_body[:, 1], up_in_body[:, 2]), np.arcsin(-up_in_body[:, 0])
    return tilts.roll_pitch - np.column_stack([roll, pitch])


@settings(max_examples=15, deadline=None)
@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-0.03, 0.03))
def test_what_hangs_still_shows_its_tilt_whatever_the_bias(roll: float, pitch: float, bias: float) -> None:
    record = at_rest(roll, pitch)
    tilts = tilts_of(replace(record, gyro=record.gyro + np.array([bias, -bias, 0.5 * bias])))
    assert tilts is not None
    assert np.array_equal(tilts.t_ns, record.t_ns)
    np.testing.assert_allclose(tilts.roll_pitch, np.tile([roll, pitch], (len(record.t_ns), 1)), atol=0.01)
    assert (tilts.sigma < math.radians(0.8)).all()


@pytest.mark.parametrize("yaw_rad", [None, 0.3])
def test_errors_over_flights_are_as_large_as_stated(yaw_rad: float | None) -> None:
    """Normalised squares of five flights: 1 is honest; what is stated allows for a bias of the accelerometer,
    which these have not.
    """
    squares = []
    for seed in range(5):
        path = fly_route(Route(ROUND, 1.5, yaw_rad), MULTIROTOR, seed)
        record = flown(path, seed)
        tilts = tilts_of(record)
        assert tilts is not None
        error = errors(tilts, path.poses(record.t_ns * 1e-9)[0][:, 2])
        assert np.sqrt(np.mean(error**2)) < math.radians(1.5)
        squares.append(np.mean((error / tilts.sigma[:, None]) ** 2))
    assert 0.1 < np.mean(squares) < 1.5


def test_a_better_gyroscope_and_a_calmer_vehicle_make_it_surer() -> None:
    path = fly_route(Route(lawn_mower((0.0, 0.0, 20.0, 12.0), 1.0, 4.0, 6.0), 2.0), MULTIROTOR, 4)
    worse, better = tilts_of(flown(path, 4, 5e-3)), tilts_of(flown(path, 4, 1e-4))
    still = tilts_of(at_rest(0.05, 0.02, 60.0))
    assert worse is not None and better is not None and still is not None
    up = path.poses(better.t_ns * 1e-9)[0][:, 2]
    assert np.mean(errors(better, up) ** 2) < np.mean(errors(worse, up) ** 2)
    assert np.median(still.sigma) < np.median(better.sigma)


def test_an_accelerometer_that_measures_another_gravity_is_believed_less() -> None:
    record = at_rest(0.1, -0.05)
    right, wrong = tilts_of(record), tilts_of(replace(record, accel=1.05 * record.accel))
    assert right is not None and wrong is not None
    assert np.median(wrong.sigma) == pytest.approx(math.hypot(float(np.median(right.sigma)), 0.05), rel=0.02)


def test_silence_divides_the_record() -> None:
    record = at_rest(0.1, 0.2, 30.0)
    heard = (
        (np.arange(3000) < 1000)
        | ((np.arange(3000) > 1300) & (np.arange(3000) < 1500))
        | (np.arange(3000) > 1900)
    )
    tilts = tilts_of(ImuRecord(record.t_ns[heard], record.gyro[heard], record.accel[heard]))
    assert tilts is not None
    long_enough = np.append(record.t_ns[:1000], record.t_ns[1901:])  # 2 s in the middle tell nothing
    assert np.array_equal(tilts.t_ns, long_enough)
    attitude = attitude_of_imu(
        ImuRecord(record.t_ns[heard], record.gyro[heard], record.accel[heard]),
        "imu0", record.t_ns, 2.0, Problems(),
    )  # fmt: skip
    assert attitude is not None
    moments = record.t_ns[[500, 1150, 2500]] + 3_000_000
    first, between, last = attitude.at(moments, 2.0)
    assert between is None
    for one in (first, last):
        assert one is not None
        assert one.yaw_rad is None
        assert (one.roll_rad, one.pitch_rad) == pytest.approx((0.1, 0.2), abs=0.01)


AXES = np.diag([1.0, -1.0, -1.0])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r: replace(r, accel=r.accel / GRAVITY), "in g are stated"),
        (lambda r: replace(r, accel=0.3 * r.accel), "where gravity is 9.81"),
        (lambda r: replace(r, accel=r.accel @ AXES, gyro=r.gyro @ AXES), "along -z"),
        (lambda r: replace(r, accel=np.roll(r.accel, 1, axis=1)), "along x"),
        (lambda r: replace(r, gyro=r.gyro + 30.0), "deg/s"),
        (lambda r: replace(r, gyro=np.ones_like(r.gyro)), "angular rates never change"),
        (lambda r: replace(r, accel=np.tile(r.accel[0], (len(r.t_ns), 1))), "specific forces never change"),
        (lambda r: ImuRecord(r.t_ns[::10], r.gyro[::10], r.accel[::10]), "10 samples a second"),
        (lambda r: ImuRecord(r.t_ns[:200], r.gyro[:200], r.accel[:200]), "no 5 s without a gap"),
        (lambda r: ImuRecord(r.t_ns[:2], r.gyro[:2], r.accel[:2]), "2 samples"),
    ],
)  # fmt: skip
def test_what_cannot_be_meant_is_refused_in_one_line(change, words: str) -> None:  # type: ignore[no-untyped-def]
    record, problems = at_rest(0.05, -0.02), Problems()
    assert fault_of(record) is None
    assert attitude_of_imu(change(record), "imu0", record.t_ns, 2.0, problems) is None
    (problem,) = problems
    assert problem.where == "imu0"
    assert words in problem.what
    assert "no attitude is taken from it" in problem.what


@pytest.mark.data
@pytest.mark.parametrize("name", ["corridor", "outdoor", "survey"])
def test_flights_of_another_simulator(data_dir: Path, tmp_path: Path, name: str) -> None:
    """Their attitude sensors are off by 0.5 degrees and a bias of 0.25."""
    flight = data_dir / "flights" / name
    (tmp_path / "mav0").mkdir()
    for sensor in ("cam0", "imu0"):
        (tmp_path / "mav0" / sensor).symlink_to(flight / "mav0" / sensor)
    assert open_flight(flight).attitude_at is not None
    opened = open_flight(tmp_path)
    assert opened.attitude_at is not None
    assert not opened.problems
    truth = read_tum(flight / "truth" / "groundtruth.tum")
    up = np.array([truth.pose(n).rotation[2] for n in range(len(truth))])
    record = read_imu(flight / "mav0" / "imu0", Problems())
    assert record is not None
    inside = (truth.t_ns > record.t_ns[0]) & (truth.t_ns < record.t_ns[-1])
    said = [one for one in opened.attitude_at(truth.t_ns[inside]) if one is not None]
    assert len(said) == inside.sum()
    tilts = Tilts(
        truth.t_ns[inside],
        np.array([(one.roll_rad, one.pitch_rad) for one in said]),
        np.array([one.sigma_rad for one in said]),
    )
    error = errors(tilts, up[inside])
    assert np.sqrt(np.mean(error**2)) < math.radians(0.6)
    assert 0.05 < np.mean((error / tilts.sigma[:, None]) ** 2) < 1.5
