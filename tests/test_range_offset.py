"""What a range sensor reads too much all the time: found where heights vary, left alone where they do not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.evaluation import Align, evaluate
from overfly.geometry.poses import FloatArray
from overfly.range_offset import EXPECTED_SIGMA_M, RangeOffset, find_range_offset
from overfly.simulation import simulate
from overfly.simulation.paths import Route
from overfly.simulation.scenario import declared
from overfly.simulation.vehicles import MULTIROTOR, fly_route
from overfly.slam import Slam
from overfly.trajectory import Trajectory

NOISE_M = 0.015


def readings(heights: FloatArray, offset_m: float, seed: int) -> RangeOffset:
    """What is found of an offset under the sensor's noise; the map has a metre of its own."""
    read = heights + offset_m + np.random.default_rng(seed).normal(0, NOISE_M, len(heights))
    found = find_range_offset(read, np.full(len(heights), NOISE_M), 0.8 * heights)
    assert found is not None
    return found


@given(st.floats(-0.15, 0.15), st.floats(0.2, 5.0))
@settings(max_examples=30, deadline=None)
def test_exact_readings_give_the_offset(offset_m: float, metre: float) -> None:
    heights = np.linspace(0.5, 4.0, 400)
    found = find_range_offset(heights + offset_m, np.full(400, 1e-4), metre * heights)
    assert found is not None
    assert found.offset_m == pytest.approx(offset_m, abs=1e-4)


def test_the_deviation_is_what_the_offset_is_off_by() -> None:
    heights = 2.0 + np.sin(np.linspace(0, 12, 150))
    found = [readings(heights, 0.04, seed) for seed in range(60)]
    assert np.mean([one.offset_m for one in found]) == pytest.approx(0.04, abs=2e-3)
    assert 0.6 < np.mean([((one.offset_m - 0.04) / one.sigma_m) ** 2 for one in found]) < 1.5
    assert all(one.is_significant for one in found)


def test_at_one_height_nothing_is_found() -> None:
    found = [readings(2.0 + 0.005 * np.sin(np.arange(150.0)), 0.04, seed) for seed in range(10)]
    assert all(0.5 * EXPECTED_SIGMA_M < one.sigma_m <= EXPECTED_SIGMA_M for one in found)
    assert not any(one.is_significant for one in found)


def test_a_true_sensor_is_left_alone() -> None:
    heights = 2.0 + np.sin(np.linspace(0, 12, 150))
    assert sum(readings(heights, 0.0, seed).is_significant for seed in range(60)) <= 2


def test_echoes_of_something_else_hardly_count() -> None:
    heights = 2.0 + np.sin(np.linspace(0, 12, 150))
    read = heights + 0.04
    read[::12] -= 0.4
    found = find_range_offset(read, np.full(150, NOISE_M), heights)
    assert found is not None
    assert found.offset_m == pytest.approx(0.04, abs=0.012)


def test_too_few_readings_tell_nothing() -> None:
    heights = np.linspace(1, 3, 30)
    sigma = np.full(30, math.inf)
    sigma[:9] = NOISE_M
    assert find_range_offset(heights, sigma, heights) is None


def test_a_flight_that_climbs_and_descends_has_its_metre_in_spite_of_the_offset() -> None:
    base = declared("demo").build(1)
    corners = [[-4.0, -3.2], [0.0, -3.4], [4.0, -2.6], [4.6, 0.6], [3.2, 3.3], [0.0, 3.2], [-4.0, 2.0]]
    heights = [1.6, 2.4, 3.6, 4.2, 3.6, 2.8, 1.8]
    route = Route(np.column_stack([corners, heights]), 2.0, closed=True, ramp_s=1.0)
    flight = simulate(replace(base, path=fly_route(route, MULTIROTOR, 1)), seed=1)
    slam = Slam(flight.rig)
    for frame in flight:
        read = frame.altitude
        slam.process(
            frame if read is None else replace(frame, altitude=replace(read, value_m=read.value_m + 0.06))
        )
    truth = Trajectory.from_poses(flight.stamps_ns, flight.truth)

    def scale_error() -> float:
        records = slam.placed()
        found = Trajectory.from_poses([r.t_ns for r in records], [slam.pose_of(r) for r in records])
        error = evaluate(found, truth, Align.SE3).scale_error
        assert error is not None
        return error

    before = scale_error()
    slam.finish()
    assert slam.adjustment is not None
    assert slam.adjustment.range_offset is not None
    assert slam.adjustment.range_offset.offset_m == pytest.approx(0.06, abs=0.025)
    assert before > 0.012
    assert abs(scale_error()) < 0.4 * before


@pytest.mark.parametrize("seed", range(4))
def test_readings_that_err_alike_do_not_outvote_what_is_expected(seed: int) -> None:
    """Level flight: map and readings both wander slowly, so that there are few independent readings."""
    rng = np.random.default_rng(seed)
    wander = [np.convolve(rng.normal(0.0, 0.03, 520), np.ones(51) / 7.0, "valid") for _ in range(2)]
    found = find_range_offset(1.8 + wander[0], np.full(470, 0.015), 1.8 + wander[1])
    assert found is not None and not found.is_significant


def test_more_than_a_sensor_can_be_off_by_is_not_believed() -> None:
    assert RangeOffset(0.1, 0.02).is_significant and RangeOffset(-0.1, 0.02).is_significant
    assert not RangeOffset(0.8, 0.05).is_significant and not RangeOffset(0.05, 0.02).is_significant
