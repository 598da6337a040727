"""The link itself, against an autopilot on the loopback."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
import pytest

from overfly.errors import SourceError
from overfly.geometry.levelling import NADIR_BODY_FROM_CAM
from overfly.geometry.poses import FloatArray, Pose
from overfly.navigation.mavlink import Autopilot, AutopilotLink, FixStream, OdometrySender
from overfly.navigation.mavlink.clock import ClockOffset

from . import rules
from .fake_autopilot import FakeAutopilot
from .stalls import Stalls


@dataclass
class Result:
    t_ns: int
    pose: Pose | None
    covariance: FloatArray | None
    n_inliers: int = 60


def test_clocks_are_set_against_each_other_and_attitude_is_ours() -> None:
    with FakeAutopilot() as autopilot, AutopilotLink.open(autopilot.url) as link:
        assert link.wait_for_autopilot() is Autopilot.ARDUPILOT
        deadline = time.monotonic() + 5.0
        while (link.clock.state() is None or link.received["ATTITUDE"] < 20) and time.monotonic() < deadline:
            time.sleep(0.02)
        state = link.clock.state()
        assert state is not None
        truth_ns = time.monotonic_ns() - autopilot.boot_ns()
        assert abs(state.offset_ns - truth_ns) < 0.5 * state.round_trip_ns + 1_000_000
        attitude, distance = None, None
        while (attitude is None or distance is None) and time.monotonic() < deadline:
            attitude = link.attitude_at(time.monotonic_ns() - 100_000_000)
            distance = link.range_at(time.monotonic_ns() - 100_000_000)
        assert attitude is not None and attitude.yaw_rad is not None
        assert (attitude.roll_rad, attitude.pitch_rad) == pytest.approx((0.1, -0.05), abs=1e-6)
        assert attitude.yaw_rad == pytest.approx(0.5 * math.pi - 0.3, abs=1e-6)
        assert distance is not None and distance.value_m == pytest.approx(5.0)
        asked = {int(message.param1) for _, message in autopilot.of_type("COMMAND_LONG")}
        assert {30, 132} <= asked  # ATTITUDE and DISTANCE_SENSOR at rates of our own


def test_attitude_is_of_the_time_asked_for() -> None:
    """A sample after the picture is waited for; long ago and far ahead there is none."""
    with FakeAutopilot() as autopilot, AutopilotLink.open(autopilot.url) as link:
        link.wait_for_autopilot()
        time.sleep(0.5)
        now_ns = time.monotonic_ns()
        found = [link.attitude_at(time.monotonic_ns(), wait_s=0.5) is not None for _ in range(5)]
        assert any(found)
        assert link.attitude_at(now_ns + 2_000_000_000) is None
        assert link.attitude_at(now_ns - 60_000_000_000) is None


@pytest.mark.parametrize("kind", Autopilot)
def test_parameters_are_read_as_each_autopilot_sends_them(kind: Autopilot) -> None:
    known = {"WHOLE": 11, "BROKEN": 0.25}
    with FakeAutopilot(kind, known) as autopilot, AutopilotLink.open(autopilot.url) as link:
        assert link.wait_for_autopilot() is kind
        assert link.parameter("WHOLE") == 11
        assert link.parameter("BROKEN") == 0.25
        assert link.parameter("MISSING", 0.1) is None


def test_nobody_there_and_nonsense_are_one_line() -> None:
    with AutopilotLink.open("udpout:127.0.0.1:9") as link, pytest.raises(SourceError, match="no heartbeat"):
        link.wait_for_autopilot(0.2)
    for url in ("udpin:nonsense", "tcp:127.0.0.1:1", "/dev/nowhere,fast"):
        with pytest.raises(SourceError, match=r"no link|pyserial") as failure:
            AutopilotLink.open(url)
        assert "\n" not in str(failure.value)


def stream_for(seconds: float, autopilot: FakeAutopilot, lost_s: tuple[float, float]) -> OdometrySender:
    """Fixes at ten a second with some jitter, one span of them lost."""
    generator = np.random.default_rng(1)
    with AutopilotLink.open(autopilot.url) as link:
        kind = link.wait_for_autopilot()
        sender = OdometrySender(link, FixStream(Pose(NADIR_BODY_FROM_CAM, np.zeros(3))), kind)
        with sender:
            begin = time.monotonic()
            for n in range(int(seconds * 10)):
                wait = begin + 0.1 * n + generator.uniform(0.0, 0.02) - time.monotonic()
                time.sleep(max(0.0, wait))
                t_ns = time.monotonic_ns()
                time.sleep(0.01)  # a picture is looked for in the map
                if lost_s[0] <= 0.1 * n < lost_s[1]:
                    sender.observe(Result(t_ns, None, None, 0))
                    continue
                pose = Pose(NADIR_BODY_FROM_CAM, np.array([0.05 * n, 0.0, 2.0]))
                sender.observe(Result(t_ns, pose, np.eye(6) * 0.01**2))
    return sender


@pytest.mark.parametrize(("kind", "seconds"), [(Autopilot.ARDUPILOT, 10.0), (Autopilot.PX4, 5.0)])
def test_seconds_of_odometry_as_the_autopilot_sees_them(kind: Autopilot, seconds: float) -> None:
    with FakeAutopilot(kind) as autopilot, Stalls() as stalls:
        sender = stream_for(seconds, autopilot, (3.0, 3.5))
        arrived = autopilot.of_type("ODOMETRY")
    decoder = rules.ArduPilot() if kind is Autopilot.ARDUPILOT else rules.Px4()
    accepted = [decoder.take(message) for _, message in arrived]
    gaps_s = np.diff([t_ns for t_ns, _ in arrived]) * 1e-9
    assert 9.0 <= len(arrived) / (seconds - 0.2) <= 14.0
    assert gaps_s.max() < 0.2 + stalls.longest_s
    assert sender.report.longest_gap_s < 0.2 + stalls.longest_s
    assert not decoder.refused
    stamps = [message.time_usec for _, message in arrived]
    assert stamps == sorted(stamps)
    lost = [message for _, message in arrived if message.quality <= 10]
    assert 3 <= len(lost) <= 12
    assert [one is not None for one in accepted][2:] == [True] * (len(accepted) - 2)


def test_a_lost_vehicle_falls_silent_within_a_second_and_a_half() -> None:
    with FakeAutopilot() as autopilot:
        stream_for(4.0, autopilot, (1.5, 99.0))
        arrived = autopilot.of_type("ODOMETRY")
    last_fix = max(t_ns for t_ns, message in arrived if message.quality > 10)
    last = max(t_ns for t_ns, _ in arrived)
    assert 0.5 < (last - last_fix) * 1e-9 < 1.5


def test_the_quickest_answer_tells_the_offset() -> None:
    clock = ClockOffset()
    assert clock.ours(5) is None
    clock.add(0, 50_000_000, 1_000_000_000)  # slow: 25 ms either way, told unevenly
    clock.add(100_000_000, 102_000_000, 1_080_000_000)
    clock.add(200_000_000, 600_000_000, 1_000_000_000)  # so slow that it says nothing
    state = clock.state()
    assert state is not None
    assert state.offset_ns == 101_000_000 - 1_080_000_000
    assert state.round_trip_ns == 2_000_000
    assert clock.ours(1_080_000_000) == 101_000_000


def test_an_autopilot_that_began_anew_is_followed() -> None:
    clock = ClockOffset()
    clock.add(0, 1_000_000, 900_000_000_000)
    clock.add(10_000_000_000, 10_001_000_000, 5_000_000)
    assert clock.ours(5_000_000) == 10_000_500_000
