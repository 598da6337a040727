"""Roll and pitch of a flight that has an inertial unit, but no attitude sensor.

The gyroscope carries the tilt from second to second, and the specific force, averaged over some seconds,
says where up is, as exactly as the vehicle flies steadily: its own accelerations are what that measurement
errs by. How large they are is found for each part of the flight from what they leave, so that turns and gusts
count less than calm flight (expectation and maximisation; Shumway and Stoffer 1982). An error-state Kalman
filter (Sola 2017, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508) with the
gyroscope's bias goes forward, and a smoother (Rauch, Tung and Striebel 1965) back over the whole record: an
instant knows what came after it. What flies forward and turns is pushed to the side all the time, and then a
bias and a bank look alike: the forward speed is an unknown, too, so that the deviation says so.

Nothing is said of the heading. The unit's distance from the body's origin and a misalignment of its axes are
not known here; an accelerometer's bias looks like a tilt, and is covered by the deviation that is stated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from overfly.geometry.poses import FloatArray
from overfly.geometry.rotations import rotations_from_vectors, vectors_from_rotations
from overfly.sensors.euroc_sensors import AttitudeRecord
from overfly.sensors.flight import Problems, Quantity, SensorSummary
from overfly.sensors.interpolation import TimeSeries, interpolate
from overfly.types import ImuRecord, IntArray

GRAVITY = 9.81  # m/s^2
STEP_S = 2.0  # over which specific forces are averaged: longer than a vehicle's wobble
GAP_S = 0.25  # silence after which the filter begins anew
SHORTEST_S = 5.0  # of a record that tells an attitude
SLOWEST_HZ = 20.0  # fewer samples a second miss what a small vehicle does between them
PASSES = 6  # of the smoother, each with the bias and the accelerations that the one before found
STEPS_ALIKE = 5  # neighbours in time in which a vehicle accelerates about as much
FIRST_ACCELERATION, LEAST_ACCELERATION = 1.0, 0.03  # m/s^2, mean over a step
GYRO_NOISE = 1e-3  # rad/s/sqrt(Hz), of a small gyroscope among vibrations; its bias wanders:
GYRO_WALK = 1e-4  # rad/s^2/sqrt(Hz)
FIRST_TILT, FIRST_BIAS = math.radians(20.0), 0.02  # rad, rad/s
FIRST_SPEED, SPEED_WALK = 3.0, 0.3  # m/s, m/s/sqrt(s)
LEVEL_SIGMA_RAD = math.radians(0.3)  # bias of a calibrated accelerometer, misalignment of its axes
FORCES = (8.0, 12.0)  # m/s^2, what the mean specific force of anything that flies is between
UPRIGHT = 0.7  # of the mean specific force, at least, has to point up in the body
FASTEST = 6.0  # rad/s, root mean square: nobody takes pictures while turning faster
TILT, BIAS, SPEED = slice(0, 3), slice(3, 6), 6


@dataclass(frozen=True, slots=True, eq=False)
class Tilts:
    """t_ns (n,); roll_pitch (n, 2) of the body and sigma (n,) of either, radians."""

    t_ns: IntArray
    roll_pitch: FloatArray
    sigma: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Steps:
    """Samples put together, n steps of m intervals: elapsed_s (n, m + 1) and turns (n, m + 1, 3, 3) since a
    step's beginning; force (n, 3) its mean specific force; swing (n, 3) the mean acceleration of what flies
    forward at 1 m/s; all in the body's axes at that beginning.
    """

    elapsed_s: FloatArray
    turns: FloatArray
    force: FloatArray
    swing: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Path:
    """At the n beginnings of steps: rotations (n, 3, 3) world_from_body, bias (n, 3), speed (n,) forward,
    covariance (n, 7, 7) of the errors of the three, the rotation's in world axes.
    """

    rotations: FloatArray
    bias: FloatArray
    speed: FloatArray
    covariance: FloatArray

    @staticmethod
    def empty(n: int) -> _Path:
        return _Path(np.empty((n, 3, 3)), np.empty((n, 3)), np.empty(n), np.empty((n, 7, 7)))

    def put(self, k: int, R: FloatArray, b: FloatArray, s: float, P: FloatArray) -> None:
        self.rotations[k], self.bias[k], self.speed[k], self.covariance[k] = R, b, s, P


def attitude_of_imu(
    record: ImuRecord, name: str, frames_t_ns: IntArray, gap_s: float, problems: Problems
) -> AttitudeRecord | None:
    """The attitude of a flight where nothing else measured it; None, and a problem under the unit's name that
    says why, where its samples tell none.

    frames_t_ns (n,): times of the frames; gap_s: samples further apart are not interpolated between.
    """
    fault = fault_of(record)
    tilts = tilts_of(record) if fault is None else None
    if tilts is None:
        why = fault or f"no {SHORTEST_S:g} s without a gap of more than {GAP_S:g} s"
        problems.report(name, f"{why}; no attitude is taken from it")
        return None
    unknown = np.full(len(tilts.t_ns), math.nan)
    series = TimeSeries(tilts.t_ns, np.column_stack([tilts.roll_pitch, unknown, tilts.sigma]))
    frames = int(np.isfinite(interpolate(series, frames_t_ns, gap_s)[:, 0]).sum())
    sigma = f"roll, pitch {math.degrees(float(np.median(tilts.sigma))):.2g} deg (from rate and force)"
    rate_hz = 1.0 / series.period_s
    summary = SensorSummary(name, Quantity.ATTITUDE, len(series.t_ns), rate_hz, sigma, frames)
    return AttitudeRecord(series, math.nan, summary)


def fault_of(record: ImuRecord) -> str | None:
    """What is wrong with samples that cannot be meant, in words; None where nothing is."""
    if len(record.t_ns) < 3:
        return f"{len(record.t_ns)} samples"
    rate_hz = 1e9 / float(np.median(np.diff(record.t_ns)))
    if rate_hz < SLOWEST_HZ:
        return f"{rate_hz:.3g} samples a second, where {SLOWEST_HZ:g} are needed"
    for what, values in (("angular rates", record.gyro), ("specific forces", record.accel)):
        if not np.ptp(values, axis=0).any():
            return f"{what} never change"
    turning = float(np.sqrt(np.mean(np.sum(record.gyro**2, axis=1))))
    if turning > FASTEST:
        return f"it turns by {turning:.3g} rad/s on average: values in degrees are stated as [deg/s]"
    return _fault_of_force(record.accel.mean(axis=0))


def _fault_of_force(mean: FloatArray) -> str | None:
    size = float(np.linalg.norm(mean))
    if not FORCES[0] < size < FORCES[1]:
        hint = "; values in g are stated as [g]" if 0.8 < size < 1.2 else ""
        return f"the mean specific force is {size:.3g} m/s^2, where gravity is {GRAVITY:g}{hint}"
    if mean[2] < UPRIGHT * size:
        axis = int(np.argmax(np.abs(mean)))
        seen = f"{'-' if mean[axis] < 0 else ''}{'xyz'[axis]}"
        return f"what holds it up points along {seen}, where the body's z is up: state its axes (T_BS)"
    return None


def tilts_of(record: ImuRecord) -> Tilts | None:
    """Roll and pitch at the times of the samples; None where no stretch of the record is long enough."""
    apart_s = np.diff(record.t_ns) * 1e-9
    parts = np.split(np.arange(len(record.t_ns)), np.flatnonzero(apart_s > GAP_S) + 1)
    found = [
        _smoothed_stretch(ImuRecord(record.t_ns[part], record.gyro[part], record.accel[part]))
        for part in parts
        if (record.t_ns[part[-1]] - record.t_ns[part[0]]) * 1e-9 >= SHORTEST_S
    ]
    if not found:
        return None
    return Tilts(
        np.concatenate([one.t_ns for one in found]),
        np.concatenate([one.roll_pitch for one in found]),
        np.concatenate([one.sigma for one in found]),
    )


def _smoothed_stretch(record: ImuRecord) -> Tilts:
    """One stretch without gaps."""
    bias, acceleration, first = np.zeros(3), np.full(1, FIRST_ACCELERATION), _upright(record)
    for _ in range(PASSES):
        steps = _put_together(record, bias)
        acceleration = np.broadcast_to(acceleration, len(steps.force))
        path = _backward(*_forward(steps, first, acceleration))
        bias, first = bias + path.bias.mean(axis=0), path.rotations[0]
        acceleration = _accelerations(steps, path)
    wandered = path.bias[:, None] * steps.elapsed_s[..., None]
    rotations = path.rotations[:, None] @ steps.turns @ rotations_from_vectors(-wandered)
    n, m = len(record.t_ns), steps.turns.shape[1] - 1
    up = np.append(rotations[:, :-1, 2].reshape(-1, 3), rotations[-1:, -1, 2], axis=0)[:n]
    vertical = float(np.mean(np.einsum("ni,ni->n", path.rotations[:, 2], steps.force)))
    # An accelerometer whose gravity is off by so much is as likely off across.
    constant = LEVEL_SIGMA_RAD**2 + (vertical / GRAVITY - 1.0) ** 2
    variance = constant + 0.5 * np.einsum("nii->n", path.covariance[:, :2, :2])
    sigma = np.sqrt(np.append(np.repeat(variance, m), variance[-1]))[:n]
    roll_pitch = np.column_stack([np.arctan2(up[:, 1], up[:, 2]), np.arcsin(np.clip(-up[:, 0], -1.0, 1.0))])
    return Tilts(record.t_ns, roll_pitch, sigma)


def _upright(record: ImuRecord) -> FloatArray:
    """(3, 3) in which the mean specific force of the first second points up."""
    first = record.t_ns <= record.t_ns[0] + 1_000_000_000
    up = record.accel[first].mean(axis=0)
    return np.asarray(Rotation.align_vectors([[0.0, 0.0, 1.0]], [up / np.linalg.norm(up)])[0].as_matrix())


def _put_together(record: ImuRecord, bias: FloatArray) -> _Steps:
    """The last step is filled up with intervals of no length."""
    dt = np.diff(record.t_ns) * 1e-9
    m = max(1, round(STEP_S / float(np.median(dt))))
    fill = -len(dt) % m
    between = 0.5 * (record.gyro[1:] + record.gyro[:-1]) - bias, 0.5 * (record.accel[1:] + record.accel[:-1])
    gyro, accel = (np.append(v, np.zeros((fill, 3)), axis=0).reshape(-1, m, 3) for v in between)
    dt = np.append(dt, np.zeros(fill)).reshape(-1, m)
    turns, push, swing = np.empty((len(dt), m + 1, 3, 3)), np.zeros((len(dt), 3)), np.zeros((len(dt), 3))
    turns[:, 0] = np.eye(3)
    for k in range(m):
        turn = gyro[:, k] * dt[:, k, None]
        halfway = turns[:, k] @ rotations_from_vectors(0.5 * turn)
        push += np.einsum("nij,nj->ni", halfway, accel[:, k] * dt[:, k, None])
        swing += halfway[:, :, 1] * turn[:, 2:]
        turns[:, k + 1] = turns[:, k] @ rotations_from_vectors(turn)
    elapsed_s = np.append(np.zeros((len(dt), 1)), np.cumsum(dt, axis=1), axis=1)
    return _Steps(elapsed_s, turns, push / elapsed_s[:, -1:], swing / elapsed_s[:, -1:])


def _forward(steps: _Steps, first: FloatArray, acceleration: FloatArray) -> tuple[_Path, _Path, FloatArray]:
    """The path as known at each step with its own specific force, as it was predicted there, and by what
    (n, 7, 7) errors go on to the next.
    """
    n = len(steps.force)
    known, predicted, onward = _Path.empty(n), _Path.empty(n), np.tile(np.eye(7), (n, 1, 1))
    R, b, s = first, np.zeros(3), 0.0
    P = np.diag(np.array([FIRST_TILT] * 3 + [FIRST_BIAS] * 3 + [FIRST_SPEED]) ** 2)
    noise = np.diag(np.array([GYRO_NOISE] * 3 + [GYRO_WALK] * 3 + [SPEED_WALK]) ** 2)
    for k in range(n):
        predicted.put(k, R, b, s, P)
        dt = float(steps.elapsed_s[k, -1])
        left, H = _force_left(steps, k, R, b, s)
        variance = acceleration[k] ** 2 * STEP_S / max(dt, 1e-6)  # the last step may be a short one
        gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + variance * np.eye(2))
        kept = np.eye(7) - gain @ H
        P = kept @ P @ kept.T + variance * gain @ gain.T
        R, b, s = _changed(R, b, s, -gain @ left)
        known.put(k, R, b, s, P)
        onward[k, TILT, BIAS] = -dt * R
        R = R @ steps.turns[k, -1] @ rotations_from_vectors(-b * dt)
        P = onward[k] @ P @ onward[k].T + noise * dt
    return known, predicted, onward


def _force_left(
    steps: _Steps, k: int, R: FloatArray, b: FloatArray, s: float
) -> tuple[FloatArray, FloatArray]:
    """(2,) mean horizontal force of a step in world axes, of which gravity has none, without that of turning;
    and its derivative (2, 7) by the errors.
    """
    halfway_s = 0.5 * float(steps.elapsed_s[k, -1])
    force, swing = R @ rotations_from_vectors(-b * halfway_s) @ steps.force[k], R @ steps.swing[k]
    by_tilt = np.array([[0.0, force[2], -force[1]], [-force[2], 0.0, force[0]]])
    return force[:2] - s * swing[:2], np.hstack([by_tilt, -halfway_s * by_tilt @ R, -swing[:2, None]])


def _backward(known: _Path, predicted: _Path, onward: FloatArray) -> _Path:
    """The path as the whole record knows it."""
    n = len(onward)
    path = _Path.empty(n)
    path.put(n - 1, known.rotations[-1], known.bias[-1], known.speed[-1], known.covariance[-1])
    for k in range(n - 2, -1, -1):
        back = np.linalg.solve(predicted.covariance[k + 1], onward[k] @ known.covariance[k]).T
        turn = vectors_from_rotations(path.rotations[k + 1] @ predicted.rotations[k + 1].T)
        later = np.append(path.bias[k + 1], path.speed[k + 1])
        change = np.append(turn, later - np.append(predicted.bias[k + 1], predicted.speed[k + 1]))
        P = known.covariance[k] + back @ (path.covariance[k + 1] - predicted.covariance[k + 1]) @ back.T
        path.put(k, *_changed(known.rotations[k], known.bias[k], known.speed[k], back @ change), P)
    return path


def _accelerations(steps: _Steps, path: _Path) -> FloatArray:
    """(n,) deviation of the vehicle's horizontal acceleration in each step and those about it."""
    square = np.empty(len(steps.force))
    for k in range(len(square)):
        left, H = _force_left(steps, k, path.rotations[k], path.bias[k], float(path.speed[k]))
        square[k] = 0.5 * (left @ left + np.trace(H @ path.covariance[k] @ H.T))
    return np.maximum(np.sqrt(uniform_filter1d(square, STEPS_ALIKE, mode="nearest")), LEAST_ACCELERATION)


def _changed(
    R: FloatArray, b: FloatArray, s: float, change: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    return rotations_from_vectors(change[TILT]) @ R, b + change[BIAS], s + float(change[SPEED])
