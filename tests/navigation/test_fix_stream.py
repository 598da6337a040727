"""Which fixes are passed on to an autopilot, and what happens between them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from overfly.geometry.levelling import NADIR_BODY_FROM_CAM
from overfly.geometry.poses import FloatArray, Pose, euler_from_rotation, rotation_from_euler
from overfly.navigation.mavlink import FixStream, StreamSettings, VehicleState
from overfly.navigation.mavlink.state import LEAST_FIX_QUALITY, MOST_GUESS_QUALITY, body_pose
from overfly.types import Attitude

PERIOD_NS = 100_000_000
BODY_FROM_CAM = Pose(NADIR_BODY_FROM_CAM, np.array([0.1, 0.0, -0.05]))


@dataclass
class Result:
    t_ns: int
    pose: Pose | None
    covariance: FloatArray | None
    n_inliers: int = 60


def fix(n: int, x: float, y: float = 0.0, yaw: float = 0.0, sigma_m: float = 0.02) -> Result:
    """A fix of frame n with the body at (x, y, 2)."""
    body = Pose(rotation_from_euler(0.0, 0.0, yaw), np.array([x, y, 2.0]))
    covariance = np.diag([sigma_m**2] * 3 + [0.005**2] * 3)
    return Result(n * PERIOD_NS, body @ BODY_FROM_CAM, covariance)


def lost(n: int) -> Result:
    return Result(n * PERIOD_NS, None, None, 0)


def stream() -> FixStream:
    return FixStream(BODY_FROM_CAM)


def flown(until: int = 10, speed_m_s: float = 1.0) -> FixStream:
    """A stream that has followed a straight flight for some frames."""
    one = stream()
    for n in range(until):
        one.observe(fix(n, speed_m_s * 0.1 * n))
    return one


def test_a_flight_begins_when_three_fixes_agree_and_then_every_fix_is_sent() -> None:
    one = stream()
    sent = [one.observe(fix(n, 0.1 * n)) for n in range(10)]
    assert [state is not None for state in sent] == [False] * 2 + [True] * 8
    for n, state in enumerate(sent):
        if state is not None:
            assert not state.is_guess
            assert state.quality >= LEAST_FIX_QUALITY
            assert state.reset_counter == 0
            np.testing.assert_allclose(state.world_from_body.translation, [0.1 * n, 0.0, 2.0], atol=1e-12)
    last = sent[-1]
    assert last is not None and last.velocity_m_s is not None
    np.testing.assert_allclose(last.velocity_m_s, [1.0, 0.0, 0.0], atol=1e-9)


def test_when_lost_guesses_fade_and_end() -> None:
    one = flown()
    guesses = [one.observe(lost(10 + k)) for k in range(15)]
    alive = [state for state in guesses if state is not None]
    assert len(alive) == 10  # a second at ten frames a second
    assert all(state.is_guess and 1 <= state.quality <= MOST_GUESS_QUALITY for state in alive)
    assert [state.quality for state in alive] == sorted((s.quality for s in alive), reverse=True)
    errors = [float(np.trace(state.covariance[:3, :3])) for state in alive]
    assert all(later > earlier for earlier, later in pairwise(errors))
    assert errors[-1] > 0.5**2
    np.testing.assert_allclose(alive[-1].world_from_body.translation[0], 0.9 + 1.0, atol=1e-6)
    assert guesses[10:] == [None] * 5


def test_after_a_short_loss_the_flight_goes_on_without_a_reset() -> None:
    one = flown()
    for n in (10, 11, 12):
        one.observe(lost(n))
    states = [one.observe(fix(n, 0.1 * n)) for n in range(13, 17)]
    assert [state is not None and state.is_guess for state in states] == [True, True, False, False]
    assert states[-1] is not None and states[-1].reset_counter == 0


def test_after_a_jump_the_counter_changes_once() -> None:
    one = flown()
    for n in range(10, 16):
        one.observe(lost(n))
    states = [one.observe(fix(n, 0.1 * n + 4.0)) for n in range(16, 22)]
    healthy = [state for state in states if state is not None and not state.is_guess]
    assert len(healthy) == 4
    assert [state.reset_counter for state in healthy] == [1] * 4
    assert healthy[-1].velocity_m_s is not None
    np.testing.assert_allclose(healthy[-1].velocity_m_s, [1.0, 0.0, 0.0], atol=1e-6)


def test_after_a_long_silence_the_counter_changes() -> None:
    one = flown(speed_m_s=0.0)
    for n in range(10, 40):
        one.observe(lost(n))
    states = [one.observe(fix(n, 0.0)) for n in range(40, 44)]
    assert states[-1] is not None and states[-1].reset_counter == 1


def test_one_wrong_fix_in_the_middle_is_never_sent_as_healthy() -> None:
    one = flown()
    wrong = one.observe(fix(10, 5.0))
    assert wrong is not None and wrong.is_guess
    assert wrong.world_from_body.translation[0] == pytest.approx(1.0, abs=0.01)
    after = [one.observe(fix(n, 0.1 * n)) for n in range(11, 16)]
    assert all(state is not None for state in after)
    assert {state.reset_counter for state in after if state is not None} == {0}
    assert one.rejected


def test_a_vehicle_does_not_fly_across_the_map_in_a_moment() -> None:
    one = flown()
    one.observe(lost(10))
    states = [one.observe(fix(n, 200.0)) for n in range(11, 20)]
    assert all(state is None or state.is_guess for state in states)
    assert "further than the vehicle can have flown" in one.rejected


@given(st.lists(st.tuples(st.floats(-40.0, 40.0), st.floats(-40.0, 40.0)), min_size=5, max_size=30))
def test_a_search_that_finds_another_place_each_time_is_not_believed(
    places: list[tuple[float, float]],
) -> None:
    """Ground that looks the same everywhere: each frame is found somewhere else."""
    one = stream()
    previous: np.ndarray | None = None
    ground = np.array([0.0, 0.0])
    for n, place in enumerate(places):
        ground = np.array(place)
        if previous is not None and np.linalg.norm(ground - previous) < 3.0:
            ground = previous + 3.0
        previous = ground
        state = one.observe(fix(n, float(ground[0]), float(ground[1])))
        assert state is None


def test_a_fix_that_the_gyroscope_contradicts_is_not_believed() -> None:
    one = stream()
    tilted = Attitude(math.radians(20.0), 0.0, math.radians(1.0))
    assert [one.observe(fix(n, 0.0), tilted) for n in range(6)] == [None] * 6
    level = Attitude(math.radians(1.5), 0.0, math.radians(1.0))
    states = [one.observe(fix(n, 0.0), level) for n in range(6, 10)]
    assert states[-1] is not None and not states[-1].is_guess


def test_an_error_that_is_not_a_number_is_no_fix() -> None:
    one = flown()
    broken = fix(10, 1.0)
    assert broken.covariance is not None
    broken.covariance[0, 0] = math.nan
    state = one.observe(broken)
    assert state is not None and state.is_guess


@given(st.integers(0, 3_000_000_000))
def test_guesses_are_never_healthy_and_never_better_than_the_fix(later_ns: int) -> None:
    one = flown()
    fixed = one.observe(fix(10, 1.0))
    assert fixed is not None
    guess = one.guess(fixed.t_ns + later_ns)
    if later_ns > StreamSettings().guess_s * 1e9:
        assert guess is None
        return
    assert guess is not None
    assert guess.is_guess and guess.quality <= MOST_GUESS_QUALITY
    excess = guess.covariance - fixed.covariance
    assert float(np.linalg.eigvalsh(excess)[0]) >= -1e-12


def test_the_body_stands_where_its_mount_puts_it() -> None:
    """The camera's errors, turned into the body: the lever arm turns angles into metres."""
    world_from_body = Pose(rotation_from_euler(0.02, -0.1, 1.0), np.array([3.0, 4.0, 5.0]))
    covariance = np.diag([0.0] * 3 + [0.01**2] * 3)
    body_from_cam = Pose(NADIR_BODY_FROM_CAM, np.array([1.0, 0.0, 0.0]))
    pose, found = body_pose(world_from_body @ body_from_cam, covariance, body_from_cam)
    np.testing.assert_allclose(pose.translation, [3.0, 4.0, 5.0], atol=1e-12)
    assert euler_from_rotation(pose.rotation) == pytest.approx((0.02, -0.1, 1.0))
    # a turn about the camera by 0.01 rad moves the body's origin, one metre away, across the arm only
    np.testing.assert_allclose(np.sqrt(np.diag(found)[:3]), [0.0, 0.01, 0.01], atol=1e-9)


def test_counters_wrap_round() -> None:
    one = FixStream(BODY_FROM_CAM, reset_counter=255)
    for n in range(5):
        one.observe(fix(n, 0.0))
    for n in range(5, 30):
        one.observe(lost(n))
    states: list[VehicleState | None] = [one.observe(fix(n, 0.0)) for n in range(30, 34)]
    assert states[-1] is not None and states[-1].reset_counter == 0
