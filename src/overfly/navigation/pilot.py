"""The pilot: a fix or none comes in with each picture, a command goes out.

While there are fixes it flies the mission. Without one it first keeps still, holding height by the range
sensor; after a while it flies an expanding square about the place where it was last known to be. The fence is
obeyed in all of that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from overfly.geometry.levelling import height_share
from overfly.geometry.poses import FloatArray
from overfly.navigation.controller import Setpoint, steer
from overfly.navigation.estimator import NS_PER_S, Estimator, PlaceFix, VehicleState
from overfly.navigation.mission import Mission, Place
from overfly.navigation.safety import Fence, SearchPattern, guard
from overfly.navigation.vehicle import Airframe
from overfly.types import AltitudeKind, Frame, NotFound, VelocityCommand

KEEP_STILL_S = 3.0  # without a fix before the vehicle begins to look for known ground
GIVE_UP_S = 120.0  # of searching: then it keeps still for good
SEARCH_SPEED_SHARE = 0.3
SEARCH_LEG = 0.5  # of the height: about half a picture
CRUISE_PER_S = 0.4  # of the height: the ground under a picture passes in about three seconds
HOLDING_M = 0.3  # from the place; further away the vehicle flies back
LOOK_AHEAD = 0.4  # of the height: a place on the way counts as passed
LEAST_SIGMA_M = 0.02  # of the range as a height over ground that is not quite flat


class Status(StrEnum):
    """What the vehicle is doing."""

    WAITING = "waiting for a first fix"
    FLYING = "flying to its place"
    HOLDING = "at its place"
    HOVERING = "hovering, no place to seek"
    LOST = "lost, keeping still"
    SEARCHING = "lost, searching"
    GIVEN_UP = "lost, search ended, keeping still"


@dataclass(frozen=True, slots=True, eq=False)
class Situation:
    """What the pilot knows and does with one frame. state: as of the picture; lost_s: time without a fix."""

    t_ns: int
    status: Status
    state: VehicleState | None
    target: Place | None
    command: VelocityCommand
    lost_s: float
    reason: str = ""  # why there was no fix


class Pilot:
    """Flies one vehicle. Give it each frame with what became of it, and send the command that it answers."""

    def __init__(self, airframe: Airframe, height_m: float | None = None) -> None:
        """height_m: above the map's zero; None: as high as it is at the first fix."""
        self.airframe = airframe
        self.mission = Mission()
        self.estimator = Estimator(airframe)
        self.height_m = height_m
        self.yaw_rad: float | None = None
        self._ground_m = 0.0  # how high the ground lies below the last fix, by the range sensor
        self._search: SearchPattern | None = None

    @property
    def fence(self) -> Fence | None:
        return self.mission.fence

    @fence.setter
    def fence(self, fence: Fence | None) -> None:
        self.mission.fence = fence

    def look(self, frame: Frame, fix: PlaceFix | NotFound) -> bool:
        """Take in what became of a frame; False when its fix is not believed yet."""
        if isinstance(fix, NotFound):
            if (height := self._height_by_range(frame)) is None:
                self.estimator.pass_time(frame.t_ns)
            else:
                self.estimator.see_height(frame.t_ns, *height)
            return False
        believed = self.estimator.see(fix)
        range_m = range_of(frame)
        if believed and range_m is not None:
            self._ground_m = float(fix.position[2]) - range_m
        return believed

    def act(self, frame: Frame, now_ns: int, reason: str = "") -> Situation:
        """The command that takes effect at now_ns."""
        estimator = self.estimator
        state, now = estimator.state, estimator.at(now_ns)
        if state is None or now is None or estimator.last_fix_ns is None:
            command = VelocityCommand()
            estimator.commanded(now_ns, command)
            return Situation(frame.t_ns, Status.WAITING, None, None, command, 0.0, reason)
        if self.yaw_rad is None:
            self.yaw_rad = state.yaw_rad
        if self.height_m is None:
            self.height_m = float(state.position[2])
        lost_s = (frame.t_ns - estimator.last_fix_ns) / NS_PER_S
        if lost_s <= 0.0:
            self._search = None
            self.mission.update(now, LOOK_AHEAD * self.height_m)
            status, setpoint = self._fly(now)
        else:
            status, setpoint = self._seek(now, lost_s)
        command = steer(now, self._inside(setpoint), self.airframe)
        if self.fence is not None:
            command = guard(command, now, self.fence, self.airframe, range_of(frame))
        estimator.commanded(now_ns, command)
        return Situation(frame.t_ns, status, state, self.mission.target, command, lost_s, reason)

    def _fly(self, now: VehicleState) -> tuple[Status, Setpoint]:
        target = self.mission.target
        if target is None:
            return Status.HOVERING, self._still(now)
        distance = math.hypot(target.x_m - now.position[0], target.y_m - now.position[1])
        status = Status.HOLDING if self.mission.arrived and distance < HOLDING_M else Status.FLYING
        return status, self._at(target.x_m, target.y_m)

    def _seek(self, now: VehicleState, lost_s: float) -> tuple[Status, Setpoint]:
        """Without a fix: keep still, then search."""
        assert self.height_m is not None
        if lost_s < KEEP_STILL_S:
            return Status.LOST, self._still(now)
        if lost_s > KEEP_STILL_S + GIVE_UP_S:
            return Status.GIVEN_UP, self._still(now)
        if self._search is None:
            speed = SEARCH_SPEED_SHARE * self.airframe.max_speed_m_s
            speed = min(speed, SEARCH_LEG * self.height_m)
            x, y = (float(value) for value in now.position[:2])
            self._search = SearchPattern(x, y, SEARCH_LEG * self.height_m, speed)
        return Status.SEARCHING, self._at(*self._search.place(lost_s - KEEP_STILL_S))

    def _at(self, x_m: float, y_m: float) -> Setpoint:
        assert self.height_m is not None
        assert self.yaw_rad is not None
        place = np.array([x_m, y_m, self.height_m])
        return Setpoint(place, self.yaw_rad, CRUISE_PER_S * self.height_m)

    def _still(self, now: VehicleState) -> Setpoint:
        """Wherever it is now: no way to go, only speed to lose."""
        return self._at(float(now.position[0]), float(now.position[1]))

    def _inside(self, setpoint: Setpoint) -> Setpoint:
        if self.fence is None:
            return setpoint
        return Setpoint(
            self.fence.nearest_inside(setpoint.position), setpoint.yaw_rad, setpoint.max_speed_m_s
        )

    def _height_by_range(self, frame: Frame) -> tuple[float, float] | None:
        range_m = range_of(frame)
        if range_m is None or frame.altitude is None:
            return None
        return self._ground_m + range_m, math.hypot(frame.altitude.sigma_m, LEAST_SIGMA_M)


def range_of(frame: Frame) -> float | None:
    """Height above the ground by the range sensor, metres: along the vertical where the attitude is known."""
    altitude, attitude = frame.altitude, frame.attitude
    if altitude is None or altitude.kind is not AltitudeKind.RANGE:
        return None
    cos_tilt = 1.0 if attitude is None else math.cos(attitude.roll_rad) * math.cos(attitude.pitch_rad)
    return altitude.value_m * height_share(cos_tilt, altitude.half_angle_rad)


def places_of(points: FloatArray, *, passing: bool = False) -> list[Place]:
    """points (n, 2) metres; passing: all but the last are on the way only."""
    last = len(points) - 1
    return [Place(float(x), float(y), passing and n < last) for n, (x, y) in enumerate(points)]
