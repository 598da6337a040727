"""What a range sensor reads too long or too short all the time: mounted a little higher than was measured, or
a sonar that hears its echo late.

Heights above the ground under each node, which the pictures give up to the metre, against what the sensor
read: a line, whose slope is the metre and whose beginning is the offset. Where all heights are alike the two
cannot be told apart, and the offset stays what was expected, nothing.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from overfly.frame_records import FrameRecord
from overfly.geometry.poses import FloatArray
from overfly.types import IntArray

EXPECTED_SIGMA_M = 0.05  # of the offset, before anything was read
SIGNIFICANT = 4.0  # standard deviations: a smaller offset may be relief, or a map that wanders
LARGEST_M = 2.0 * EXPECTED_SIGMA_M  # over boards, maps that wandered looked like 0.11 and 0.13 m
FEWEST_READINGS = 10
LEAST_CLIMB = 1.5  # highest to lowest height: what the map's heights are wrong by counts h / (h - h') times
HUBER = 1.5  # deviations from which on a reading counts linearly: echoes of something else
MEDIAN_SIZE = 0.6745  # of a residual of deviation 1
ROUNDS = 20


@dataclass(frozen=True, slots=True, eq=False)
class RangeReadings:
    """Readings of all located frames, k of them in the order of time: node (k,) that the frame hangs by and
    node_from_cam (k, 3) its place there, metres; height_m (k,) of the camera above the ground as the sensor
    has it, with sigma_m (k,).
    """

    node: IntArray
    node_from_cam: FloatArray
    height_m: FloatArray
    sigma_m: FloatArray

    def above(
        self, ground_m: FloatArray, rotations: FloatArray, translations: FloatArray, grown: float
    ) -> FloatArray:
        """(k,) heights above the ground (n,) under the nodes, NaN for none, whose poses world_from_cam are
        rotations (n, 3, 3) and translations (n, 3), in a map so many times larger than that of the frames.
        """
        z = grown * np.einsum("kj,kj->k", rotations[self.node, 2], self.node_from_cam)
        return np.asarray(translations[self.node, 2] + z - ground_m[self.node])


class RangeLog:
    """What the range sensor read at located frames, as heights above the ground: 24 bytes each."""

    def __init__(self) -> None:
        self._t_ns, self._height_m, self._sigma_m = array("q"), array("d"), array("d")

    def add(self, t_ns: int, height_m: float, sigma_m: float) -> None:
        """Frames come in the order of time."""
        self._t_ns.append(t_ns)
        self._height_m.append(height_m)
        self._sigma_m.append(sigma_m)

    def readings(self, records: Sequence[FrameRecord]) -> RangeReadings | None:
        """With where the frames hang now; None where nothing was read at any of them."""
        t_ns = np.array([record.t_ns for record in records], np.int64)
        _, at, which = np.intersect1d(t_ns, np.array(self._t_ns, np.int64), return_indices=True)
        if len(at) == 0:
            return None
        read = [records[int(row)] for row in at]
        return RangeReadings(
            np.array([record.node for record in read]),
            np.array([record.node_from_cam.translation for record in read]),
            np.array(self._height_m)[which],
            np.array(self._sigma_m)[which],
        )


@dataclass(frozen=True, slots=True)
class RangeOffset:
    """What the sensor reads too much, and its standard deviation, metres."""

    offset_m: float
    sigma_m: float

    @property
    def is_significant(self) -> bool:
        """Whether it shows. More than can be expected of a sensor is the map's: heights that wander over poor
        ground look like it."""
        return SIGNIFICANT * self.sigma_m < abs(self.offset_m) <= LARGEST_M


def find_range_offset(read_m: FloatArray, sigma_m: FloatArray, height: FloatArray) -> RangeOffset | None:
    """The offset of readings (n,) with deviations (n,), in the order of time, against heights (n,) above the
    ground in any unit; None for fewer than ten.
    """
    known = np.isfinite(sigma_m) & np.isfinite(height) & (height > 0) & (read_m > 0)
    if known.sum() < FEWEST_READINGS:
        return None
    found, covariance = fit_line(read_m[known], sigma_m[known], height[known], EXPECTED_SIGMA_M)
    return RangeOffset(float(found[1]), math.sqrt(covariance[1, 1]))


def fit_line(
    read_m: FloatArray, sigma_m: FloatArray, height: FloatArray, offset_sigma_m: float
) -> tuple[FloatArray, FloatArray]:
    """Metre and offset (2,) of read = metre * height + offset, with covariance (2, 2), from readings (n,) in
    the order of time; offset_sigma_m: of the offset, about nothing.

    By Huber's estimator, with the deviation of what it leaves where that is larger than the sensor's own;
    readings over the same relief err alike, which shows in how each residual follows the one before.
    """
    A = np.column_stack([height, np.ones(len(height))])
    expected = np.diag([0.0, offset_sigma_m**-2.0])
    found = np.array([float(np.median(read_m / height)), 0.0])
    for _ in range(ROUNDS):
        left = read_m - A @ found
        noise = np.maximum(sigma_m, float(np.median(np.abs(left))) / MEDIAN_SIZE)
        weight = np.minimum(1.0, HUBER * noise / np.maximum(np.abs(left), 1e-12)) / noise**2
        information = (A * weight[:, None]).T @ A
        found = np.linalg.solve(information + expected, (A * weight[:, None]).T @ read_m)
    left = np.clip((read_m - A @ found) / noise, -HUBER, HUBER)
    alike = float(np.sum(left[1:] * left[:-1]) / max(np.sum(left**2), 1e-12))
    alike = min(max(alike, 0.0), 0.95)
    # What is expected counts against as many readings as there are independent ones.
    worth = (1.0 - alike) / (1.0 + alike)
    found = np.linalg.solve(worth * information + expected, worth * (A * weight[:, None]).T @ read_m)
    return found, np.asarray(np.linalg.inv(worth * information + expected))
