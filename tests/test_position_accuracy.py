"""Deviation of fixes that state none, against errors that are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.geometry.poses import FloatArray
from overfly.geometry.similarity import align_about_vertical
from overfly.pipeline.position_accuracy import CORRELATION_S, accuracy_shown
from overfly.sensors.default_sigmas import GPS_ALTITUDE_SIGMA_M, POSITION_SIGMA_M, state_no_accuracy
from overfly.types import IntArray

SEEDS = range(60)


def flown(n: int, apart_s: float) -> tuple[FloatArray, IntArray]:
    """Places (n, 3) along lines of a survey, and times (n,)."""
    along = 40.0 * np.arange(n)
    line = along // 400.0
    place = np.column_stack(
        [np.where(line % 2, 400.0 - along % 400.0, along % 400.0), 80.0 * line, 0 * along]
    )
    return place, np.asarray(1e9 * apart_s * np.arange(n), np.int64)


def errors(t_ns: IntArray, sigma_m: float, tau_s: float, seed: int) -> FloatArray:
    """(n, 3) of a first-order process; tau_s = 0: independent ones."""
    generator = np.random.default_rng(seed)
    left = generator.normal(0.0, sigma_m, (len(t_ns), 3))
    step_s = 1e-9 * float(t_ns[1] - t_ns[0])
    keep = np.exp(-step_s / tau_s) if tau_s > 0 else 0.0
    for k in range(1, len(left)):
        left[k] = keep * left[k - 1] + np.sqrt(1.0 - keep**2) * left[k]
    return left


def shown(n: int, apart_s: float, sigma_m: float, tau_s: float, seed: int, d: int = 2) -> float:
    place, t_ns = flown(n, apart_s)
    fixes = place + errors(t_ns, sigma_m, tau_s, seed)
    fit = align_about_vertical(place, fixes, np.full(n, 1e-2))
    assert fit is not None
    axes, usual = (slice(0, 2), POSITION_SIGMA_M) if d == 2 else (slice(2, 3), GPS_ALTITUDE_SIGMA_M)
    return accuracy_shown(fit.residuals_m[:, axes], place, t_ns, usual)


@pytest.mark.parametrize("d", [1, 2])
@pytest.mark.parametrize("sigma_m", [0.05, 0.5, 20.0])
def test_many_fixes_tell_their_accuracy_and_that_errors_are_alike(sigma_m: float, d: int) -> None:
    """What of them goes into the fit is put right, too."""
    found = [shown(60, 4.0, sigma_m, 0.5 * CORRELATION_S, seed, d) for seed in SEEDS]
    assert 0.85 < np.exp(np.mean(np.log(found))) / sigma_m < 1.25
    assert np.std(np.log(found)) < 0.3


def test_independent_errors_are_found_too() -> None:
    found = [shown(100, 30.0, 0.3, 0.0, seed) for seed in SEEDS]
    np.testing.assert_allclose(np.mean(found), 0.3, rtol=0.07)


def test_few_fixes_leave_it_between_what_is_usual_and_what_they_show() -> None:
    """The fewer, and the faster after each other, the nearer to what is usual."""
    found = [
        np.exp(np.mean(np.log([shown(n, apart_s, 0.1, 0.5 * CORRELATION_S, seed) for seed in SEEDS])))
        for n, apart_s in ((40, 0.4), (4, 10.0), (8, 10.0), (40, 10.0))
    ]
    assert found == sorted(found, reverse=True)
    assert found[0] == pytest.approx(POSITION_SIGMA_M)
    assert 0.3 < found[1] < 2.0
    assert found[-1] < 0.13


def test_one_wrong_fix_says_little() -> None:
    place, t_ns = flown(60, 20.0)
    residual = errors(t_ns, 0.5, 0.0, 1)[:, :2]
    before = accuracy_shown(residual, place, t_ns, POSITION_SIGMA_M)
    residual[30] = [300.0, 0.0]
    assert accuracy_shown(residual, place, t_ns, POSITION_SIGMA_M) == pytest.approx(before, rel=0.1)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.02, 50.0), st.integers(0, 99))
def test_metres_are_a_matter_of_units(factor: float, seed: int) -> None:
    place, t_ns = flown(20, 5.0)
    residual = errors(t_ns, 1.0, 10.0, seed)[:, :2]
    once = accuracy_shown(residual, place, t_ns, POSITION_SIGMA_M)
    again = accuracy_shown(factor * residual, factor * place, t_ns, factor * POSITION_SIGMA_M)
    assert again == pytest.approx(factor * once, rel=1e-9)


def test_only_both_defaults_together_mean_that_nothing_was_stated() -> None:
    usual, high = POSITION_SIGMA_M, GPS_ALTITUDE_SIGMA_M
    sigma = np.array([[usual, high], [usual, np.inf], [usual, 1.5 * usual], [0.7, high], [0.7, 0.7]])
    assert state_no_accuracy(sigma).tolist() == [True, True, False, False, False]
