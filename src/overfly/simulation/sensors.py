"""What the other sensors of the vehicle say: attitude, IMU, sonar, barometer, GPS, each with its errors and
its clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.simulation.paths import Path
from overfly.simulation.relief import HeightField
from overfly.simulation.vehicles import GRAVITY
from overfly.types import IntArray


@dataclass(frozen=True, slots=True)
class Clock:
    """How a sensor's stamps differ from true time: constant offset and white jitter, seconds."""

    offset_s: float = 0.0
    jitter_s: float = 0.0


@dataclass(frozen=True, slots=True)
class AttitudeSensor:
    """Roll and pitch (and yaw) with white noise and a bias that wanders with time constant bias_tau_s
    (Gauss-Markov).
    """

    rate_hz: float = 100.0
    sigma_rad: float = math.radians(0.5)
    bias_sigma_rad: float = math.radians(0.25)
    bias_tau_s: float = 60.0
    yaw_sigma_rad: float | None = None
    clock: Clock = Clock()


@dataclass(frozen=True, slots=True)
class Imu:
    """Gyroscope and accelerometer: noise densities (per square root of Hz) and random walks of the biases."""

    rate_hz: float = 200.0
    gyroscope_noise: float = 1.2e-3
    gyroscope_walk: float = 2e-5
    accelerometer_noise: float = 2e-3
    accelerometer_walk: float = 3e-4
    clock: Clock = Clock()


@dataclass(frozen=True, slots=True)
class Sonar:
    """Range along the body's down axis: nearest echo within the cone, noise, and drop-outs (no row)."""

    rate_hz: float = 15.0
    sigma_m: float = 0.015
    cone_half_angle_rad: float = math.radians(12.0)
    max_range_m: float = 8.0
    dropout: float = 0.02
    clock: Clock = Clock()


@dataclass(frozen=True, slots=True)
class Barometer:
    """Height above the start, with noise and slow drift of the air pressure."""

    rate_hz: float = 10.0
    sigma_m: float = 0.15
    drift_m: float = 0.5
    drift_tau_s: float = 120.0
    clock: Clock = Clock()


@dataclass(frozen=True, slots=True)
class Gps:
    """Position with white noise and a slowly wandering bias; world origin at origin_lat_lon_alt."""

    rate_hz: float = 5.0
    sigma_horizontal_m: float = 0.6
    sigma_vertical_m: float = 1.0
    bias_horizontal_m: float = 1.2
    bias_vertical_m: float = 2.0
    bias_tau_s: float = 300.0
    clock: Clock = Clock()


@dataclass(frozen=True, slots=True)
class SensorSuite:
    """What the vehicle carries besides cameras; None: not there."""

    attitude: AttitudeSensor | None = None
    imu: Imu | None = None
    sonar: Sonar | None = None
    barometer: Barometer | None = None
    gps: Gps | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """stamps_ns (n,) as the sensor wrote them; values (n, k) in the sensor's own units, see each function."""

    stamps_ns: IntArray
    values: FloatArray

    def at(self, t_ns: int) -> FloatArray | None:
        """Values (k,) linearly interpolated to t_ns; None outside the record or across a gap of more than
        half a second.
        """
        after = int(np.searchsorted(self.stamps_ns, t_ns))
        if after == 0 or after >= len(self.stamps_ns):
            exact = after < len(self.stamps_ns) and self.stamps_ns[after] == t_ns
            return np.asarray(self.values[after]) if exact else None
        t0, t1 = int(self.stamps_ns[after - 1]), int(self.stamps_ns[after])
        if t1 - t0 > 500_000_000:
            return None
        share = (t_ns - t0) / (t1 - t0)
        return np.asarray((1.0 - share) * self.values[after - 1] + share * self.values[after])


def attitude_readings(sensor: AttitudeSensor, path: Path, t0_ns: int, seed: int) -> Readings:
    """values (n, 3): roll, pitch, yaw in radians, yaw wrapped."""
    generator = np.random.default_rng([seed, 21])
    times = _times(path, sensor.rate_hz)
    euler = path.euler(times)
    euler[:, :2] += _gauss_markov(
        len(times), 2, sensor.bias_sigma_rad, sensor.bias_tau_s, sensor.rate_hz, generator
    )
    euler[:, :2] += generator.normal(0.0, sensor.sigma_rad, (len(times), 2))
    euler[:, 2] += generator.normal(0.0, sensor.yaw_sigma_rad or 0.0, len(times))
    euler[:, 2] = math.pi - (math.pi - euler[:, 2]) % (2.0 * math.pi)
    return Readings(_stamps(times, t0_ns, sensor.clock, generator), euler)


def imu_readings(sensor: Imu, path: Path, t0_ns: int, seed: int) -> Readings:
    """values (n, 6): angular rate rad/s and specific force m/s^2, both in the body's axes."""
    generator = np.random.default_rng([seed, 22])
    times = _times(path, sensor.rate_hz)
    rotations, _ = path.poses(times)
    force = path.accelerations(times) + np.array([0.0, 0.0, GRAVITY])
    values = np.column_stack([path.body_rates(times), np.einsum("nij,ni->nj", rotations, force)])
    step = math.sqrt(1.0 / sensor.rate_hz)
    scale = np.array([sensor.gyroscope_noise] * 3 + [sensor.accelerometer_noise] * 3) / step
    walk = np.array([sensor.gyroscope_walk] * 3 + [sensor.accelerometer_walk] * 3) * step
    values += generator.normal(0.0, 1.0, values.shape) * scale
    values += np.cumsum(generator.normal(0.0, 1.0, values.shape) * walk, axis=0)
    return Readings(_stamps(times, t0_ns, sensor.clock, generator), values)


def sonar_readings(sensor: Sonar, path: Path, relief: HeightField, t0_ns: int, seed: int) -> Readings:
    """values (n, 1): range in metres."""
    generator = np.random.default_rng([seed, 23])
    times = _times(path, sensor.rate_hz)
    rotations, positions = path.poses(times)
    ranges = np.full(len(times), np.inf)
    for direction in cone_directions(sensor.cone_half_angle_rad):
        np.minimum(ranges, relief.ranges(positions, rotations @ direction), out=ranges)
    ranges += generator.normal(0.0, sensor.sigma_m, len(times))
    heard = (ranges < sensor.max_range_m) & (generator.random(len(times)) >= sensor.dropout)
    stamps = _stamps(times, t0_ns, sensor.clock, generator)
    return Readings(stamps[heard], ranges[heard, None])


def barometer_readings(sensor: Barometer, path: Path, t0_ns: int, seed: int) -> Readings:
    """values (n, 1): metres above the start."""
    generator = np.random.default_rng([seed, 24])
    times = _times(path, sensor.rate_hz)
    _, positions = path.poses(times)
    height = positions[:, 2:] - positions[0, 2]
    height = height + _gauss_markov(
        len(times), 1, sensor.drift_m, sensor.drift_tau_s, sensor.rate_hz, generator
    )
    height += generator.normal(0.0, sensor.sigma_m, height.shape)
    return Readings(_stamps(times, t0_ns, sensor.clock, generator), height)


def gps_readings(sensor: Gps, path: Path, t0_ns: int, seed: int) -> Readings:
    """values (n, 3): east, north, up in metres from the world's origin."""
    generator = np.random.default_rng([seed, 25])
    times = _times(path, sensor.rate_hz)
    _, positions = path.poses(times)
    scale = np.array([sensor.bias_horizontal_m, sensor.bias_horizontal_m, sensor.bias_vertical_m])
    bias = _gauss_markov(len(times), 3, 1.0, sensor.bias_tau_s, sensor.rate_hz, generator) * scale
    noise = np.array([sensor.sigma_horizontal_m, sensor.sigma_horizontal_m, sensor.sigma_vertical_m])
    values = positions + bias + generator.normal(0.0, 1.0, positions.shape) * noise
    return Readings(_stamps(times, t0_ns, sensor.clock, generator), values)


def _times(path: Path, rate_hz: float) -> FloatArray:
    """The sensor's own beat, not in step with the cameras."""
    return np.arange(path.start_s + 0.3 / rate_hz, path.end_s, 1.0 / rate_hz)


def _stamps(times: FloatArray, t0_ns: int, clock: Clock, generator: np.random.Generator) -> IntArray:
    stamped = times + clock.offset_s
    if clock.jitter_s:
        stamped = np.maximum.accumulate(stamped + np.abs(generator.normal(0.0, clock.jitter_s, len(times))))
        stamped += 1e-9 * np.arange(len(times))  # stamps stay in order and distinct
    return np.asarray(t0_ns + np.round(stamped * 1e9), dtype=np.int64)


def _gauss_markov(
    count: int, channels: int, sigma: float, tau_s: float, rate_hz: float, generator: np.random.Generator
) -> FloatArray:
    """(count, channels) first-order Gauss-Markov process of deviation sigma."""
    from scipy.signal import lfilter

    keep = math.exp(-1.0 / (rate_hz * tau_s))
    drive = generator.normal(0.0, sigma * math.sqrt(1.0 - keep * keep), (count, channels))
    drive[0] = generator.normal(0.0, sigma, channels)
    return np.asarray(lfilter([1.0], [1.0, -keep], drive, axis=0))


def cone_directions(half_angle_rad: float) -> FloatArray:
    """(9, 3) unit directions in the body: straight down and on two rings."""
    directions = [np.array([0.0, 0.0, -1.0])]
    for k in range(8):
        tilt = half_angle_rad * (0.5 if k % 2 else 1.0)
        turn = k * math.pi / 4.0
        directions.append(
            np.array([math.sin(tilt) * math.cos(turn), math.sin(tilt) * math.sin(turn), -math.cos(tilt)])
        )
    return np.array(directions)
