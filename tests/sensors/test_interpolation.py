"""Interpolation: exact for straight lines, and no value where there is no record."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.lib.stride_tricks import sliding_window_view

from overfly.sensors.interpolation import NEIGHBOURS, TimeSeries, interpolate, without_outliers

SECOND = 1_000_000_000


def line(t_ns: np.ndarray, start_ns: int) -> np.ndarray:
    since_s = (t_ns - start_ns) * 1e-9
    return np.column_stack([2.0 - 0.5 * since_s, 3.0 * since_s])


@given(
    st.integers(0, 1_800_000_000 * SECOND),
    st.lists(st.integers(1_000_000, SECOND // 10), min_size=3, max_size=30),
    st.lists(st.floats(0.0, 1.0), min_size=1, max_size=10),
)
def test_a_straight_line_is_met_exactly(start_ns: int, steps: list[int], places: list[float]) -> None:
    t_ns = start_ns + np.cumsum(np.array(steps, dtype=np.int64))
    wanted = np.array([int(t_ns[0]) + int(place * int(t_ns[-1] - t_ns[0])) for place in places])
    series = TimeSeries(t_ns, line(t_ns, start_ns))
    found = interpolate(series, wanted, 2.0)
    inside_gap = np.isnan(found[:, 0])
    np.testing.assert_allclose(found[~inside_gap], line(wanted, start_ns)[~inside_gap], atol=1e-9)
    after = np.searchsorted(t_ns, wanted)
    span = t_ns[after] - t_ns[np.maximum(after - 1, 0)]
    too_far = (span > 2.5 * np.median(np.diff(t_ns))) & (t_ns[after] != wanted)
    np.testing.assert_array_equal(inside_gap, too_far)


def test_no_value_outside_the_record_or_in_a_gap() -> None:
    t_ns = np.array([0, 100, 200, 300, 900, 1000], dtype=np.int64) * 1_000_000
    series = TimeSeries(t_ns, np.arange(6.0)[:, None])
    wanted = np.array([-21, -20, 0, 250, 300, 301, 899, 900, 1020, 1021], dtype=np.int64) * 1_000_000
    found = interpolate(series, wanted, 2.0)[:, 0]
    expected = [np.nan, 0.0, 0.0, 2.5, 3.0, np.nan, np.nan, 4.0, 5.0, np.nan]
    np.testing.assert_allclose(found, expected)


def test_fast_sensors_hold_for_one_period_at_the_ends() -> None:
    series = TimeSeries(np.arange(5, dtype=np.int64) * 5_000_000, np.arange(5.0)[:, None])
    found = interpolate(series, np.array([-6, -5, 25, 26], dtype=np.int64) * 1_000_000, 2.0)[:, 0]
    np.testing.assert_allclose(found, [np.nan, 0.0, 4.0, np.nan])


def test_the_longest_gap_allowed_bounds_slow_sensors() -> None:
    series = TimeSeries(np.arange(5, dtype=np.int64) * 3 * SECOND, np.arange(5.0)[:, None])
    wanted = np.array([SECOND], dtype=np.int64)
    assert np.isnan(interpolate(series, wanted, 2.0)[0, 0])
    assert abs(interpolate(series, wanted, 4.0)[0, 0] - 1 / 3) < 1e-12


def test_one_sample_or_none() -> None:
    empty = TimeSeries(np.zeros(0, np.int64), np.zeros((0, 2)))
    assert np.isnan(interpolate(empty, np.array([5]), 2.0)).all()
    single = TimeSeries(np.array([5 * SECOND]), np.array([[7.0]]))
    found = interpolate(single, np.array([5 * SECOND, 6 * SECOND]), 2.0)[:, 0]
    assert found[0] == 7.0
    assert np.isnan(found[1])


@given(st.integers(0, 1000), st.floats(-1.5, 1.5), st.floats(0.0, 0.15))
def test_echoes_from_elsewhere_are_left_out(seed: int, climb_m_s: float, share: float) -> None:
    """Twenty seconds at 15 Hz over a step of the ground, climbing; some readings are half, double, none."""
    generator = np.random.default_rng(seed)
    t_s = np.arange(300) / 15.0
    true = 32.0 + climb_m_s * t_s - 0.7 * (t_s > 9.0)
    wrong = generator.random(300) < share
    read = np.where(
        wrong, true * generator.choice([0.05, 0.5, 2.0], 300), true + generator.normal(0, 0.02, 300)
    )
    series = TimeSeries(np.round(t_s * 1e9).astype(np.int64), np.column_stack([read, np.full(300, 0.02)]))
    kept = np.isin(series.t_ns, without_outliers(series).t_ns)
    # Where most neighbours are wrong, too, they look like ground.
    around = sliding_window_view(np.pad(wrong, NEIGHBOURS, mode="reflect"), 2 * NEIGHBOURS + 1).sum(axis=1)
    plain = wrong & (around <= NEIGHBOURS) & (np.abs(read - true) > 4.0)
    assert not np.any(plain & kept)
    assert np.count_nonzero(~wrong & ~kept) <= 6


def test_few_readings_are_all_kept() -> None:
    values = np.column_stack([[1.0, 9.0, 1.0, 1.0], np.full(4, 0.01)])
    series = TimeSeries(np.arange(4) * 10**8, values)
    assert without_outliers(series) is series
