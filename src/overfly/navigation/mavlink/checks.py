"""What an autopilot must be set to so that it uses what it is told; docs/autopilots.md says why."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum

from overfly.navigation.mavlink.dialect import Autopilot
from overfly.navigation.mavlink.link import AutopilotLink

LISTEN_S = 3.0
LEAST_ATTITUDE_HZ = 10.0
LONGEST_ROUND_TRIP_MS = 50.0
LARGEST_DRIFT_PPM = 200.0  # a quartz is ten times better; more is a clock that is being set


class Verdict(StrEnum):
    """How serious a finding is."""

    GOOD = "good"
    NOTE = "note"  # works, may be wanted otherwise
    WRONG = "wrong"  # what is sent will not be used, or harms


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at: what is there, and what to do if that is not right."""

    what: str
    verdict: Verdict
    found: str
    advice: str = ""


@dataclass(frozen=True, slots=True)
class Setting:
    """A parameter: which values are right, how bad others are, and what to set."""

    name: str
    is_right: Callable[[float], bool]
    advice: str
    otherwise: Verdict = Verdict.WRONG


def _one_of(*values: float) -> Callable[[float], bool]:
    return lambda value: value in values


def _has_bits(bits: int) -> Callable[[float], bool]:
    return lambda value: int(value) & bits == bits


SETTINGS: dict[Autopilot, tuple[Setting, ...]] = {
    Autopilot.ARDUPILOT: (
        Setting("VISO_TYPE", _one_of(1, 3), "set 1 (MAVLink) and reboot: ODOMETRY is passed over otherwise"),
        Setting("AHRS_EKF_TYPE", _one_of(3), "set 3: only EKF3 takes external positions"),
        Setting("EK3_ENABLE", _one_of(1), "set 1"),
        Setting("EK3_SRC1_POSXY", _one_of(6), "set 6 (ExternalNav), or 3 and GPS1_TYPE 14 for GPS_INPUT"),
        Setting("EK3_SRC1_VELXY", _one_of(0, 6), "set 6 (ExternalNav), or 0", Verdict.NOTE),
        Setting("EK3_SRC1_YAW", _one_of(1, 6), "set 6 (ExternalNav), or 1 with a compass", Verdict.NOTE),
        Setting(
            "VISO_QUAL_MIN",
            lambda value: 10 < value <= 40,
            "set 20: guesses, of quality 10 and less, count as fixes otherwise",
            Verdict.NOTE,
        ),
        Setting(
            "VISO_POS_M_NSE",
            lambda value: 0.0 < value <= 0.2,
            "set 0.1: fixes are believed less than they deserve otherwise",
            Verdict.NOTE,
        ),
        Setting(
            "VISO_DELAY_MS",
            lambda value: 0 <= value <= 250,
            "set the latency that overfly fly reports",
            Verdict.NOTE,
        ),
    ),
    Autopilot.PX4: (
        Setting("EKF2_EN", _one_of(1), "set 1: no other estimator takes ODOMETRY so"),
        Setting("EKF2_EV_CTRL", _has_bits(1), "set bit 0 (horizontal position), as in 9: position and yaw"),
        Setting("EKF2_EV_CTRL", _has_bits(8), "set bit 3 too, unless there is a compass", Verdict.NOTE),
        Setting("EKF2_EV_NOISE_MD", _one_of(0), "set 0: errors are taken from the parameters otherwise"),
        Setting(
            "EKF2_EV_QMIN",
            lambda value: 10 < value <= 40,
            "set 20: guesses, of quality 10 and less, count as fixes otherwise",
            Verdict.NOTE,
        ),
        Setting(
            "EKF2_EV_DELAY",
            lambda value: 0 <= value <= 20,
            "set 0: the stamps are those of the pictures already",
            Verdict.NOTE,
        ),
        Setting(
            "EKF2_EVP_NOISE",
            lambda value: 0 < value <= 0.2,
            "set 0.05: fixes are believed less than they deserve otherwise",
            Verdict.NOTE,
        ),
    ),
}


def check_autopilot(link: AutopilotLink) -> list[Finding]:
    """Parameters, rates and clock of the autopilot at the other end. Raises SourceError when none answers."""
    kind = link.wait_for_autopilot()
    before = link.received.copy()
    begin = time.monotonic()
    findings = [Finding("autopilot", Verdict.GOOD, str(kind))]
    findings += check_settings(SETTINGS[kind], link.parameter)
    time.sleep(max(0.0, LISTEN_S - (time.monotonic() - begin)))
    listened_s = time.monotonic() - begin
    rates = {name: (link.received[name] - before[name]) / listened_s for name in link.received}
    return [*findings, *_check_rates(rates), *_check_clock(link)]


def check_settings(settings: Iterable[Setting], parameter: Callable[[str], float | None]) -> list[Finding]:
    """Each parameter against its list; parameter: its value, None where the autopilot has none."""
    findings = []
    for setting in settings:
        value = parameter(setting.name)
        if value is None:
            verdict, words = setting.otherwise, "no answer, or no such parameter"
        else:
            verdict = Verdict.GOOD if setting.is_right(value) else setting.otherwise
            words = f"{value:g}"
        advice = "" if verdict is Verdict.GOOD else setting.advice
        findings.append(Finding(setting.name, verdict, words, advice))
    return findings


def _check_rates(rates_hz: dict[str, float]) -> list[Finding]:
    attitude = rates_hz.get("ATTITUDE", 0.0)
    distance = rates_hz.get("DISTANCE_SENSOR", 0.0)
    return [
        Finding(
            "ATTITUDE",
            Verdict.GOOD if attitude >= LEAST_ATTITUDE_HZ else Verdict.WRONG,
            f"{attitude:.0f} Hz",
            ""
            if attitude >= LEAST_ATTITUDE_HZ
            else "50 Hz were asked for: raise the baud rate or SRx_EXTRA1",
        ),
        Finding(
            "DISTANCE_SENSOR",
            Verdict.GOOD if distance > 0.0 else Verdict.NOTE,
            f"{distance:.0f} Hz",
            "" if distance > 0.0 else "a new map has no metre of its own without a range sensor",
        ),
    ]


def _check_clock(link: AutopilotLink) -> list[Finding]:
    state = link.clock.state()
    if state is None:
        advice = "TIMESYNC is not answered: attitude cannot be set against the pictures"
        return [Finding("clock", Verdict.WRONG, "no answer", advice)]
    round_trip_ms = state.round_trip_ns * 1e-6
    words = f"round trip {round_trip_ms:.1f} ms, {state.n_round_trips} of them"
    is_quick = round_trip_ms <= LONGEST_ROUND_TRIP_MS
    advice = "" if is_quick else "attitude may be wrong by half of that in time: use a quicker link"
    findings = [Finding("clock", Verdict.GOOD if is_quick else Verdict.NOTE, words, advice)]
    if state.drift_ppm is not None and abs(state.drift_ppm) > LARGEST_DRIFT_PPM:
        advice = "one of the clocks is being set while it runs; turn that off in flight"
        findings.append(Finding("clock drift", Verdict.NOTE, f"{state.drift_ppm:.0f} ppm", advice))
    return findings
