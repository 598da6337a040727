"""What may be told to an autopilot: fixes that can be believed, short guesses after them, else nothing.

An estimator that is told a wrong place with a small error flies there. So a fix counts when it continues the
flight so far; after a loss, or where it contradicts the flight, only when several in a row agree with each
other, and then the reset counter says that the pose jumped. In between the last fix is carried on with its
velocity, at a quality that says so and an error that grows, for a second; then there is silence.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from overfly.geometry.poses import FloatArray, Pose, euler_from_rotation, wrap_angle
from overfly.navigation.mavlink.state import (
    LEAST_FIX_QUALITY,
    MOST_GUESS_QUALITY,
    VehicleState,
    body_pose,
)
from overfly.types import Attitude

GATE_SIGMAS = 5.0  # within so many deviations a fix continues the flight
RESET_SIGMAS = 2.0  # found again further from the guess than this, the pose is said to have jumped
ATTITUDE_SLACK_RAD = math.radians(3.0)  # of mounts and level calibrations
HALF_QUALITY_INLIERS = 25  # a fix with so many inliers is half way from the least to the best quality
VELOCITY_SPAN_S = 0.6  # fixes of this span tell the velocity
LEAST_SIGMA_M = 0.005  # nobody knows better than this where a flying body is


class Located(Protocol):
    """What Localizer and Slam say of one frame, as far as it matters here."""

    @property
    def t_ns(self) -> int: ...
    @property
    def pose(self) -> Pose | None: ...
    @property
    def covariance(self) -> FloatArray | None: ...
    @property
    def n_inliers(self) -> int: ...


@dataclass(frozen=True, slots=True)
class StreamSettings:
    """guess_s: how long the last fix is carried on. confirmations: fixes in a row that must agree after a
    loss. speed_m_s, turn_rad_s: what the vehicle can do at most. acceleration_m_s2: its usual one, a
    deviation.
    """

    guess_s: float = 1.0
    confirmations: int = 3
    speed_m_s: float = 20.0
    turn_rad_s: float = math.radians(180.0)
    acceleration_m_s2: float = 3.0


@dataclass(slots=True, eq=False)
class FixStream:
    """Frames in the order of time in, states to send out; :meth:`guess` may be asked in between."""

    body_from_cam: Pose
    settings: StreamSettings = field(default_factory=StreamSettings)
    reset_counter: int = 0
    rejected: dict[str, int] = field(default_factory=dict)  # fixes that were not believed, by reason
    _last: VehicleState | None = None  # the last fix that was believed
    _recent: deque[VehicleState] = field(default_factory=deque)  # believed fixes of the last moments
    _waiting: list[VehicleState] = field(default_factory=list)  # fixes that wait to be confirmed
    _is_following: bool = False

    def observe(self, located: Located, attitude: Attitude | None = None) -> VehicleState | None:
        """What to send for one frame: its fix, a guess in its place, or nothing.

        attitude: what the autopilot's own sensors say at the frame's time, as a check.
        """
        fix = self._as_state(located)
        if fix is not None and attitude is not None and not _agrees_with(fix, attitude):
            self._reject("another attitude than the sensor's")
            fix = None
        if fix is None:
            self._is_following = False
            self._waiting.clear()
            return self.guess(located.t_ns)
        if self._is_following and self._continues(fix, GATE_SIGMAS):
            return self._believe(fix)
        self._is_following = False
        if self._last is not None and not self._within_reach(self._last, fix):
            self._reject("further than the vehicle can have flown")
            self._waiting.clear()
        elif self._waiting and not self._within_reach(self._waiting[-1], fix):
            self._reject("fixes after a loss disagree")
            self._waiting = [fix]
        else:
            self._waiting.append(fix)
        if len(self._waiting) < self.settings.confirmations:
            return self.guess(fix.t_ns)
        if self._last is not None and not self._continues(fix, RESET_SIGMAS):
            self.reset_counter = (self.reset_counter + 1) % 256
            self._recent.clear()
        self._recent.extend(self._waiting[:-1])
        self._waiting = []
        return self._believe(fix)

    def guess(self, t_ns: int) -> VehicleState | None:
        """The last fix carried on to a time; None before the first and when it is too long ago."""
        last = self._last
        if last is None or not 0 <= t_ns - last.t_ns <= self.settings.guess_s * 1e9:
            return None
        since_s = (t_ns - last.t_ns) * 1e-9
        place, position_covariance = self._carried_on(last, since_s)
        covariance = last.covariance.copy()
        body_from_world = last.world_from_body.rotation.T
        covariance[:3, :3] += body_from_world @ position_covariance @ body_from_world.T
        covariance[3:, 3:] += np.eye(3) * (0.25 * self.settings.turn_rad_s * since_s) ** 2
        left = 1.0 - since_s / self.settings.guess_s
        return replace(
            last,
            t_ns=t_ns,
            world_from_body=Pose(last.world_from_body.rotation, place),
            covariance=covariance,
            velocity_m_s=None,  # a filter that has inertial sensors knows it better by now
            velocity_covariance=None,
            quality=max(1, round(MOST_GUESS_QUALITY * left)),
            reset_counter=self.reset_counter,
            is_guess=True,
        )

    def _as_state(self, located: Located) -> VehicleState | None:
        if located.pose is None or located.covariance is None:
            return None
        pose, covariance = body_pose(located.pose, located.covariance, self.body_from_cam)
        if not (np.isfinite(covariance).all() and np.isfinite(pose.translation).all()):
            self._reject("not a number")
            return None
        covariance = covariance + np.diag([LEAST_SIGMA_M**2] * 3 + [0.0] * 3)
        share = located.n_inliers / (located.n_inliers + HALF_QUALITY_INLIERS)
        quality = round(LEAST_FIX_QUALITY + (100 - LEAST_FIX_QUALITY) * share)
        return VehicleState(located.t_ns, pose, covariance, None, None, quality, self.reset_counter)

    def _believe(self, fix: VehicleState) -> VehicleState:
        self._recent.append(fix)
        while fix.t_ns - self._recent[0].t_ns > VELOCITY_SPAN_S * 1e9:
            self._recent.popleft()
        velocity = self._velocity()
        fix = replace(fix, reset_counter=self.reset_counter)
        if velocity is not None:
            fix = replace(fix, velocity_m_s=velocity[0], velocity_covariance=velocity[1])
        self._last = fix
        self._is_following = True
        return fix

    def _velocity(self) -> tuple[FloatArray, FloatArray] | None:
        """Slope of the recent places and its covariance: their errors, and what acceleration may have
        changed.
        """
        if len(self._recent) < 3:
            return None
        times = np.array([(fix.t_ns - self._recent[-1].t_ns) * 1e-9 for fix in self._recent])
        places = np.array([fix.world_from_body.translation for fix in self._recent])
        apart = times - times.mean()
        spread = float(apart @ apart)
        if spread < 1e-4:
            return None
        velocity = apart @ places / spread
        errors = np.mean([_position_covariance(fix) for fix in self._recent], axis=0)
        bend = (0.5 * self.settings.acceleration_m_s2 * float(-times[0])) ** 2 / 3.0
        return velocity, errors / spread + np.eye(3) * bend

    def _carried_on(self, last: VehicleState, since_s: float) -> tuple[FloatArray, FloatArray]:
        """Place (3,) after a while, and the covariance (3, 3) that this adds, in the world."""
        added = np.eye(3) * (0.5 * self.settings.acceleration_m_s2 * since_s**2) ** 2
        place = last.world_from_body.translation
        if last.velocity_m_s is None or last.velocity_covariance is None:
            return place, added + np.eye(3) * (0.25 * self.settings.speed_m_s * since_s) ** 2
        return place + since_s * last.velocity_m_s, added + since_s**2 * last.velocity_covariance

    def _continues(self, fix: VehicleState, sigmas: float) -> bool:
        """Whether a fix lies where the flight so far leads."""
        last = self._last
        if last is None or fix.t_ns - last.t_ns > self.settings.guess_s * 1e9:
            return False
        since_s = (fix.t_ns - last.t_ns) * 1e-9
        place, added = self._carried_on(last, since_s)
        sum_of_both = added + _position_covariance(last) + _position_covariance(fix)
        away = fix.world_from_body.translation - place
        return bool(away @ np.linalg.solve(sum_of_both, away) <= sigmas**2) and self._turned_within(last, fix)

    def _within_reach(self, earlier: VehicleState, fix: VehicleState) -> bool:
        """Whether the vehicle can have flown from one to the other."""
        since_s = (fix.t_ns - earlier.t_ns) * 1e-9
        away = fix.world_from_body.translation - earlier.world_from_body.translation
        errors = _position_covariance(earlier) + _position_covariance(fix)
        slack = GATE_SIGMAS * math.sqrt(float(np.linalg.eigvalsh(errors)[-1]))
        near = float(np.linalg.norm(away)) <= self.settings.speed_m_s * since_s + slack
        return near and self._turned_within(earlier, fix)

    def _turned_within(self, earlier: VehicleState, fix: VehicleState) -> bool:
        turn = earlier.world_from_body.rotation.T @ fix.world_from_body.rotation
        angle = math.acos(max(-1.0, min(1.0, 0.5 * (float(np.trace(turn)) - 1.0))))
        errors = float(np.linalg.eigvalsh(earlier.covariance[3:, 3:] + fix.covariance[3:, 3:])[-1])
        limit = self.settings.turn_rad_s * (fix.t_ns - earlier.t_ns) * 1e-9 + GATE_SIGMAS * math.sqrt(errors)
        return angle <= limit

    def _reject(self, reason: str) -> None:
        self.rejected[reason] = self.rejected.get(reason, 0) + 1


def _position_covariance(state: VehicleState) -> FloatArray:
    """(3, 3) in the world."""
    rotation = state.world_from_body.rotation
    return np.asarray(rotation @ state.covariance[:3, :3] @ rotation.T)


def _agrees_with(fix: VehicleState, attitude: Attitude) -> bool:
    """Whether roll and pitch are those that another sensor measured at the time."""
    roll, pitch, _ = euler_from_rotation(fix.world_from_body.rotation)
    own = float(np.linalg.eigvalsh(fix.covariance[3:, 3:])[-1])
    limit = ATTITUDE_SLACK_RAD + GATE_SIGMAS * math.sqrt(attitude.sigma_rad**2 + own)
    away = math.hypot(wrap_angle(roll - attitude.roll_rad), pitch - attitude.pitch_rad)
    return away <= limit
