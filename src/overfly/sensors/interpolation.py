"""Sensor samples at the time of a frame: between the two samples around it, or not at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from overfly.geometry.poses import FloatArray
from overfly.types import IntArray

PERIODS_OF_A_GAP = 2.5  # a sensor that is silent for longer than this many of its own periods has a gap
# A frame this little before the first or after the last sample gets that sample's value: sensors start when
# they do, and the first frame is the one that needs them most.
EDGE_S = 0.02
NEIGHBOURS = 3  # on either side of a sample, which tell whether it can be meant
OUTLIER_SIGMAS = 4.0
MAD_OF_NORMAL = 0.6745  # median size of a normal deviate


@dataclass(frozen=True, slots=True, eq=False)
class TimeSeries:
    """Samples of one sensor: t_ns (n,) strictly increasing; values (n, k), angles unwrapped."""

    t_ns: IntArray
    values: FloatArray

    @property
    def period_s(self) -> float:
        """Median time between samples; 0 for fewer than two."""
        return float(np.median(np.diff(self.t_ns))) * 1e-9 if len(self.t_ns) > 1 else 0.0


def interpolate(series: TimeSeries, t_ns: IntArray, max_time_gap_s: float) -> FloatArray:
    """Values (m, k) at times t_ns (m,), linear in time; NaN outside the record and inside gaps.

    At the ends of the record a sample holds for its own period, 20 ms at most. A gap is longer than
    max_time_gap_s or than 2.5 of the sensor's own periods, whichever is less.
    """
    n = len(series.t_ns)
    t_ns = np.asarray(t_ns, dtype=np.int64)
    result = np.full((len(t_ns), series.values.shape[1]), np.nan)
    if n == 0:
        return result
    edge_ns = int(1e9 * min(EDGE_S, series.period_s))
    inside = (t_ns >= series.t_ns[0] - edge_ns) & (t_ns <= series.t_ns[-1] + edge_ns)
    at = np.clip(t_ns, series.t_ns[0], series.t_ns[-1])
    after = np.clip(np.searchsorted(series.t_ns, at, side="left"), 0, n - 1)
    before = np.where(series.t_ns[after] == at, after, after - 1)  # on a sample: that sample alone
    span_ns = series.t_ns[after] - series.t_ns[before]
    limit_s = max_time_gap_s if n < 3 else min(max_time_gap_s, PERIODS_OF_A_GAP * series.period_s)
    good = inside & (span_ns <= limit_s * 1e9)
    fraction = ((at - series.t_ns[before]) / np.maximum(span_ns, 1))[:, None]
    earlier, later = series.values[before], series.values[after]
    with np.errstate(invalid="ignore"):  # deviations may be infinite, and stay so
        values = np.where(earlier == later, earlier, (1.0 - fraction) * earlier + fraction * later)
    result[good] = values[good]
    return result


def without_outliers(series: TimeSeries) -> TimeSeries:
    """The samples of a range sensor without those that are far from the middle of their neighbours: echoes
    from elsewhere, or of a multiple of the way. values (n, 2): metres and their deviation.

    Hampel's filter: further than four deviations, of the sensor and of the neighbours themselves. Steps of
    the ground and climbs stay, since the middle of the neighbours follows them.
    """
    width = 2 * NEIGHBOURS + 1
    if len(series.t_ns) < width:
        return series
    distance, sigma = series.values[:, 0], series.values[:, 1]
    around = sliding_window_view(np.pad(distance, NEIGHBOURS, mode="reflect"), width)
    middle = np.median(around, axis=1)
    scatter = np.median(np.abs(around - middle[:, None]), axis=1) / MAD_OF_NORMAL
    kept = np.abs(distance - middle) <= OUTLIER_SIGMAS * np.maximum(sigma, scatter)
    return TimeSeries(series.t_ns[kept], series.values[kept])
