"""The clock of the attitude sensor against that of the pictures.

A flight controller and a camera seldom share a clock; a tenth of a second between them is common, and a
vehicle that tilts by 15 degrees a second is then 1.5 degrees away from what its sensor says. From frame to
frame the picture knows the tilt an order better than the sensor does, so the lag is found by shifting the
sensor's tilt until its changes agree with those of the pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from overfly.frame_records import FrameRecord
from overfly.geometry.poses import FloatArray
from overfly.types import Attitude, IntArray, MountedCamera, NotFound, Reason
from overfly.vision.refine import TiltPrior
from overfly.visual_map import VisualMap

AttitudeAt = Callable[[IntArray], Sequence[Attitude | None]]

LARGEST_LAG_S = 1.0  # clocks further apart are not looked for
STEP_S = 0.01  # of the sensor's smoothed record
SMOOTHING_S = 0.03  # less than the period of any tilting, more than that of quick sensors' noise
COARSE_STEP_S = 0.02
BLOCK_S = 3.0  # the sensor's wandering bias and the map's slow bend are taken out over so long
FRAMES_PER_BLOCK = 10  # or over so many frames, where these are further apart
FEWEST_IN_BLOCK, FEWEST_BLOCKS = 6, 4
NEAR_S = 0.25  # lags that differ by less are the same minimum
DISTINCT = 0.5  # the best lag must leave less than this share of what any other leaves
SIGNIFICANT = 4.0  # standard deviations
LEAST_LAG_S = 0.01  # what less does to the tilt is below the sensor's noise
ROUNDS = 4


@dataclass(frozen=True, slots=True)
class ClockLag:
    """How much later the attitude sensor stamps a moment than the camera does, and its standard deviation."""

    lag_s: float
    sigma_s: float

    def __str__(self) -> str:
        how = "lags behind" if self.lag_s > 0 else "runs ahead of"
        return f"{how} the pictures by {1e3 * abs(self.lag_s):.0f} +- {max(1e3 * self.sigma_s, 1.0):.0f} ms"

    @property
    def is_significant(self) -> bool:
        """Whether it is worth being corrected."""
        return abs(self.lag_s) > max(LEAST_LAG_S, SIGNIFICANT * self.sigma_s)


@dataclass(frozen=True, slots=True, eq=False)
class _Blocks:
    """Frames in stretches: starts (b,) of each stretch in the frames; t_s (n,) about the stretch's mean."""

    starts: IntArray
    counts: IntArray
    t_s: FloatArray

    def sums(self, values: FloatArray) -> FloatArray:
        return np.asarray(np.add.reduceat(values, self.starts, axis=0))

    def changes(self, values: FloatArray) -> FloatArray:
        """values (n, k) without each stretch's mean and trend."""
        t_s = self.t_s[:, None]
        mean = self.sums(values) / self.counts[:, None]
        slope = self.sums(values * t_s) / self.sums(t_s**2)
        return np.asarray(values - np.repeat(mean, self.counts, axis=0) - t_s * self._each(slope))

    def _each(self, values: FloatArray) -> FloatArray:
        return np.repeat(values, self.counts, axis=0)


def set_attitude_clock(
    visual_map: VisualMap,
    records: Sequence[FrameRecord],
    attitude_at: AttitudeAt,
    mounted: MountedCamera,
    tilt_prior: Callable[[Attitude | None], TiltPrior],
) -> ClockLag | NotFound:
    """Give every node the attitude of its own moment, where the sensor's clock is not the camera's.

    records: of the frames that were located with this sensor; mounted: the camera that located them.
    """
    graph, turn = visual_map.graph, mounted.body_from_cam.rotation
    up = np.array([turn @ (graph.pose(r.node) @ r.node_from_cam).rotation[2] for r in records])
    t_ns = np.array([record.t_ns for record in records])
    piece = visual_map.pieces()[[record.node for record in records]]
    lag = find_clock_lag(attitude_at, t_ns, up, piece)
    if isinstance(lag, ClockLag) and lag.is_significant:
        flown = set(t_ns.tolist())  # nodes of an older map have clocks of their own
        own = [node for node in visual_map.nodes if node.t_ns in flown]
        moments = np.array([node.t_ns for node in own]) + round(lag.lag_s * 1e9)
        for node, attitude in zip(own, attitude_at(moments), strict=True):
            if attitude is not None:
                node.tilt = tilt_prior(attitude)
    return lag


def find_clock_lag(
    attitude_at: AttitudeAt, t_ns: IntArray, up_in_body: FloatArray, piece: IntArray
) -> ClockLag | NotFound:
    """The sensor's lag behind the pictures.

    attitude_at: what the sensor says at any times of its own clock; t_ns (n,) increasing, up_in_body (n, 3)
    the world's up axis in the body as the pictures have it, piece (n,) of the map that each frame was located
    in, by number.
    """
    if len(t_ns) < FEWEST_BLOCKS * FEWEST_IN_BLOCK:
        return NotFound(Reason.FEW_MATCHES, f"{len(t_ns)} frames")
    begin_ns = int(t_ns[0])
    t_s: FloatArray = np.asarray((t_ns - begin_ns) * 1e-9, np.float64)
    record_s: FloatArray = np.arange(-LARGEST_LAG_S, float(t_s[-1]) + LARGEST_LAG_S, STEP_S)
    record = _smoothed(attitude_at, begin_ns, record_s)
    rate = np.asarray(np.gradient(record, STEP_S, axis=0), np.float64)
    # The same frames at all lags: those around which the sensor was heard all the time.
    unheard = np.cumsum(np.append(0, np.isnan(rate).any(axis=1)))
    first, last = (np.searchsorted(record_s, t_s + end) for end in (-LARGEST_LAG_S, LARGEST_LAG_S))
    heard = unheard[np.minimum(last, len(record_s))] == unheard[first]
    blocks, chosen = _stretches(t_s, piece, heard)
    if len(blocks.starts) < FEWEST_BLOCKS:
        return NotFound(Reason.FEW_MATCHES, "too few frames with attitude")
    t_s, seen = t_s[chosen], blocks.changes(up_in_body[chosen, :2])

    def left(lag_s: float) -> FloatArray:
        return blocks.changes(_at(record_s, record, t_s + lag_s)) - seen

    lags = np.arange(-LARGEST_LAG_S, LARGEST_LAG_S + 0.5 * COARSE_STEP_S, COARSE_STEP_S)[1:-1]
    squares = np.array([float((left(lag) ** 2).sum()) for lag in lags])
    lag_s = float(lags[squares.argmin()])
    if squares.min() > DISTINCT * squares[np.abs(lags - lag_s) > NEAR_S].min():
        return NotFound(Reason.NO_HYPOTHESIS, "the vehicle tilted too little")

    def slope(lag_s: float) -> FloatArray:
        """Of half the squares left, by stretch."""
        by_lag = blocks.changes(_at(record_s, rate, t_s + lag_s))
        return blocks.sums((by_lag * left(lag_s)).sum(axis=1))

    for _ in range(ROUNDS):
        # The squared rate would do for a sensor without noise, and count its noise as knowledge.
        curvature = float((slope(lag_s + COARSE_STEP_S) - slope(lag_s - COARSE_STEP_S)).sum())
        curvature /= 2.0 * COARSE_STEP_S
        step_s = float(slope(lag_s).sum()) / curvature
        lag_s = min(max(lag_s - step_s, -LARGEST_LAG_S), LARGEST_LAG_S)
    # Errors within a stretch are alike; between stretches they are not.
    count = len(blocks.starts)
    spread = float((slope(lag_s) ** 2).sum()) * count / (count - 1.0)
    return ClockLag(lag_s, float(np.sqrt(spread)) / abs(curvature))


def _smoothed(attitude_at: AttitudeAt, begin_ns: int, record_s: FloatArray) -> FloatArray:
    """The sensor's up axis in the body, x and y (m, 2), at these times; NaN where it is silent."""
    stamps = begin_ns + np.round(record_s * 1e9).astype(np.int64)
    said = attitude_at(stamps)
    angles = np.array([(a.roll_rad, a.pitch_rad) if a is not None else (np.nan, np.nan) for a in said])
    roll, pitch = angles.T
    up = np.column_stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll)])
    return np.asarray(gaussian_filter1d(up, SMOOTHING_S / STEP_S, axis=0, mode="nearest"))


def _at(record_s: FloatArray, record: FloatArray, t_s: FloatArray) -> FloatArray:
    return np.column_stack([np.interp(t_s, record_s, column) for column in record.T])


def _stretches(t_s: FloatArray, piece: IntArray, heard: np.ndarray) -> tuple[_Blocks, IntArray]:
    """Stretches of frames that can be compared, and the frames (k,) in them."""
    length_s = max(BLOCK_S, FRAMES_PER_BLOCK * float(np.median(np.diff(t_s))))
    number = (t_s // length_s).astype(np.int64)
    begins = np.append(True, (np.diff(number) != 0) | (np.diff(piece) != 0))
    label = np.cumsum(begins) - 1
    counts = np.bincount(label[heard], minlength=int(label[-1]) + 1)
    chosen = np.flatnonzero(heard & (counts[label] >= FEWEST_IN_BLOCK))
    _, starts, counts = np.unique(label[chosen], return_index=True, return_counts=True)
    middle = np.add.reduceat(t_s[chosen], starts) / counts if len(starts) else t_s[:0]
    return _Blocks(starts, counts, t_s[chosen] - np.repeat(middle, counts)), chosen
