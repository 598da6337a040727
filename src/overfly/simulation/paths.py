"""Where the vehicle is at any time: smooth, twice differentiable, so that every sensor can be exact."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from overfly.geometry.poses import FloatArray, Pose

STATE_RATE_HZ = 50.0


def rotations_from_euler(euler_rad: FloatArray) -> FloatArray:
    """euler_rad (n, 3) roll, pitch, yaw -> (n, 3, 3), R_world_body = Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(euler_rad).T, np.sin(euler_rad).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), 2, 0).copy()


class Path:
    """Cubic splines through states (n, 6): x, y, z in metres and roll, pitch, yaw in radians (unwrapped) at
    times_s (n,).
    """

    def __init__(self, times_s: FloatArray, states: FloatArray) -> None:
        self.start_s, self.end_s = float(times_s[0]), float(times_s[-1])
        self._spline = CubicSpline(times_s, states)
        self._first = self._spline.derivative(1)
        self._second = self._spline.derivative(2)

    @property
    def duration_s(self) -> float:
        return self.end_s - self.start_s

    def cut(self, first_s: float, last_s: float) -> Path:
        """The piece between two times, its own time starting at zero."""
        times = np.arange(0.0, min(last_s, self.end_s) - first_s, 1.0 / STATE_RATE_HZ)
        return Path(times, self._spline(times + first_s))

    def followed_by(self, other: Path, gap_s: float) -> Path:
        """This path, then within gap_s a smooth carry to the start of ``other``, then that one."""
        first = np.arange(self.start_s, self.end_s, 1.0 / STATE_RATE_HZ)
        second = np.arange(other.start_s, other.end_s, 1.0 / STATE_RATE_HZ)
        before, after = self._spline(first), other._spline(second)
        after[:, 5] += 2.0 * math.pi * round((before[-1, 5] - after[0, 5]) / (2.0 * math.pi))
        share = np.linspace(0.0, 1.0, int(gap_s * STATE_RATE_HZ))[1:-1, None]
        between = before[-1] + (after[0] - before[-1]) * share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        states = np.vstack([before, between, after])
        return Path(self.start_s + np.arange(len(states)) / STATE_RATE_HZ, states)

    def poses(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """world_from_body at times (n,): rotations (n, 3, 3) and positions (n, 3)."""
        states = self._spline(np.clip(times_s, self.start_s, self.end_s))
        return rotations_from_euler(states[:, 3:]), states[:, :3]

    def pose(self, time_s: float) -> Pose:
        """world_from_body at one time."""
        rotations, positions = self.poses(np.array([time_s]))
        return Pose(rotations[0], positions[0])

    def euler(self, times_s: FloatArray) -> FloatArray:
        """(n, 3) roll, pitch, yaw in radians, yaw unwrapped."""
        return np.asarray(self._spline(np.clip(times_s, self.start_s, self.end_s))[:, 3:])

    def velocities(self, times_s: FloatArray) -> FloatArray:
        """(n, 3) m/s in the world frame."""
        return np.asarray(self._first(np.clip(times_s, self.start_s, self.end_s))[:, :3])

    def accelerations(self, times_s: FloatArray) -> FloatArray:
        """(n, 3) m/s^2 in the world frame, gravity not included."""
        return np.asarray(self._second(np.clip(times_s, self.start_s, self.end_s))[:, :3])

    def body_rates(self, times_s: FloatArray) -> FloatArray:
        """(n, 3) rad/s, angular velocity of the body in its own axes."""
        roll, pitch, _ = self.euler(times_s).T
        droll, dpitch, dyaw = self._first(np.clip(times_s, self.start_s, self.end_s))[:, 3:].T
        return np.column_stack(
            [
                droll - dyaw * np.sin(pitch),
                dpitch * np.cos(roll) + dyaw * np.sin(roll) * np.cos(pitch),
                -dpitch * np.sin(roll) + dyaw * np.cos(roll) * np.cos(pitch),
            ]
        )


def wobble(
    times_s: FloatArray, rms: float, band_hz: tuple[float, float], generator: np.random.Generator
) -> FloatArray:
    """(n,) smooth random motion of the given RMS with frequencies in band_hz: nine sines of random phase."""
    frequencies = np.geomspace(band_hz[0], band_hz[1], 9) * generator.uniform(0.85, 1.15, 9)
    amplitudes = generator.uniform(0.5, 1.5, 9) / np.sqrt(frequencies)
    amplitudes *= rms * math.sqrt(2.0) / float(np.linalg.norm(amplitudes))
    phases = generator.uniform(0.0, 2.0 * math.pi, 9)
    total = np.zeros_like(times_s)
    for amplitude, frequency, phase in zip(amplitudes, frequencies, phases, strict=True):
        total += amplitude * np.sin(2.0 * math.pi * frequency * times_s + phase)
    return total


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """Where to fly: points (n, 3) metres passed in order, at speed_m_s, gently started and stopped.

    yaw_rad: a fixed heading, or None to look where it goes. closed: end where it began, smoothly.
    pause_s: how long to stay at the start and at the end.
    """

    points: FloatArray
    speed_m_s: float
    yaw_rad: float | None = None
    closed: bool = False
    pause_s: float = 0.0
    ramp_s: float = 1.5

    def lasting(self, duration_s: float) -> Route:
        """The same route at the speed with which it takes duration_s."""
        _, _, lengths = self._curve()
        return replace(self, speed_m_s=lengths[-1] / (duration_s - self.ramp_s - 2.0 * self.pause_s))

    def _curve(self) -> tuple[CubicSpline, FloatArray, FloatArray]:
        """The smooth curve through the points, many values of its parameter, and its length up to each."""
        points = np.asarray(self.points, dtype=np.float64)
        if self.closed:
            points = np.vstack([points, points[:1]])
        knots = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        curve = CubicSpline(knots, points, bc_type="periodic" if self.closed else "natural")
        fine = np.linspace(0.0, knots[-1], max(200, int(20 * knots[-1])))
        steps = np.linalg.norm(np.diff(curve(fine), axis=0), axis=1)
        return curve, fine, np.concatenate([[0.0], np.cumsum(steps)])

    def sample(self, rate_hz: float = STATE_RATE_HZ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """times (n,), positions (n, 3) and headings (n,), unwrapped."""
        curve, fine, lengths = self._curve()
        ramp = min(max(self.ramp_s, 1e-3), lengths[-1] / self.speed_m_s)
        duration = lengths[-1] / self.speed_m_s + ramp
        times = np.arange(0.0, duration + 2 * self.pause_s + 1.0 / rate_hz, 1.0 / rate_hz)
        travelled = self.speed_m_s * _ramped(times - self.pause_s, duration, ramp)
        parameters = np.interp(np.clip(travelled, 0.0, lengths[-1]), lengths, fine)
        if self.yaw_rad is not None:
            headings = np.full(len(times), self.yaw_rad)
        else:
            along = curve(parameters, 1)
            headings = np.unwrap(np.arctan2(along[:, 1], along[:, 0]))
        return times, curve(parameters), headings


def lawn_mower(
    bounds_m: tuple[float, float, float, float],
    margin_m: float,
    spacing_m: float,
    height_m: float,
    *,
    cross_height_m: float | None = None,
) -> FloatArray:
    """(n, 3) way points of parallel legs along x over the bounds less a margin; then a leg across all, at its
    own height.
    """
    x0, y0, x1, y1 = bounds_m
    x0, y0, x1, y1 = x0 + margin_m, y0 + margin_m, x1 - margin_m, y1 - margin_m
    legs = max(2, math.ceil((y1 - y0) / spacing_m) + 1)
    points: list[tuple[float, float, float]] = []
    shares = np.linspace(0.0, 1.0, max(3, int((x1 - x0) / spacing_m)))
    for leg, y in enumerate(np.linspace(y0, y1, legs)):
        xs = x0 + (x1 - x0) * (shares if leg % 2 == 0 else 1.0 - shares)
        points.extend((float(x), float(y), height_m) for x in xs)
    if cross_height_m is not None:
        last_x = points[-1][0]
        middle = 0.5 * (x0 + x1)
        points.append((0.5 * (last_x + middle), y1 + 0.3 * spacing_m, 0.5 * (height_m + cross_height_m)))
        ys = np.linspace(y1, y0, max(3, int((y1 - y0) / spacing_m)))
        points.extend((middle, float(y), cross_height_m) for y in ys)
    return np.array(points)


def _ramped(times: FloatArray, duration: float, ramp: float) -> FloatArray:
    """Integral of a speed that rises smoothly from 0 to 1 in ``ramp`` seconds and falls again at the end."""

    def risen(t: FloatArray) -> FloatArray:
        # integral of the smoothstep 3u^2 - 2u^3
        u = np.clip(t / ramp, 0.0, 1.0)
        return np.asarray(ramp * (u**3 - 0.5 * u**4) + np.maximum(t - ramp, 0.0))

    return risen(times) - risen(times - (duration - ramp))


def smoothed(values: FloatArray, time_constant_s: float, rate_hz: float) -> FloatArray:
    """Values (n, k) after a second-order lag without delay: a Gaussian of the given deviation in time."""
    from scipy.ndimage import gaussian_filter1d

    return np.asarray(gaussian_filter1d(values, max(1e-3, time_constant_s * rate_hz), axis=0, mode="nearest"))
