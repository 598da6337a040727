"""What the vehicle was asked to do, one place after the other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from overfly.navigation.commands import Command, GoTo, Hold, ReturnToStart, Stop
from overfly.navigation.estimator import NS_PER_S, VehicleState
from overfly.navigation.safety import Fence

ARRIVED_M = 0.05  # of the place by the vehicle's own estimate, and slower than ARRIVED_M_S,
ARRIVED_M_S = 0.06
ARRIVED_S = 1.0  # for so long


@dataclass(frozen=True, slots=True)
class Place:
    """A place of the map's world, metres; passing: on the way only, no need to stop there."""

    x_m: float
    y_m: float
    passing: bool = False


@dataclass(slots=True)
class Mission:
    """Places to visit in order, and the last one to hold. fence: places outside it are refused."""

    fence: Fence | None = None
    start: Place | None = None  # where the mission began, once that is known
    target: Place | None = None  # None: hover anywhere
    following: tuple[Place, ...] = ()
    arrived: bool = False
    n_arrived: int = 0
    refused: str = ""  # why the last command was not obeyed
    _near_since_ns: int | None = None
    _holds_here: bool = False

    def visit(self, places: Sequence[Place]) -> None:
        """These places from now on, one after the other. Those outside the fence are left out."""
        inside = [place for place in places if self.fence is None or self.fence.holds(place.x_m, place.y_m)]
        left_out = len(places) - len(inside)
        self.refused = f"{left_out} of {len(places)} places lie outside the geofence" if left_out else ""
        if inside:
            self._head_for(inside[0], tuple(inside[1:]))

    def obey(self, command: Command) -> None:
        """What the operator asks for now."""
        self.refused = ""
        if isinstance(command, GoTo):
            if self.fence is not None and not self.fence.holds(command.x_m, command.y_m):
                self.refused = f"({command.x_m:.2f}, {command.y_m:.2f}) lies outside the geofence"
            else:
                self._head_for(Place(command.x_m, command.y_m), ())
        elif isinstance(command, Hold):
            self._head_for(None, ())
            self._holds_here = True
        elif isinstance(command, Stop):
            self._head_for(None, ())
        elif isinstance(command, ReturnToStart) and self.start is not None:
            self._head_for(self.start, ())

    def update(self, state: VehicleState, looks_ahead_m: float) -> None:
        """Note where the vehicle is: the start, an arrival, the next place."""
        here = Place(float(state.position[0]), float(state.position[1]))
        if self.start is None:
            self.start = here
        if self._holds_here:
            self._holds_here = False
            self._head_for(here, ())
        if self.target is None:
            return
        distance = math.hypot(self.target.x_m - here.x_m, self.target.y_m - here.y_m)
        if self.target.passing and self.following and distance < looks_ahead_m:
            self._head_for(self.following[0], self.following[1:])
            return
        speed = float(math.hypot(state.velocity[0], state.velocity[1]))
        if distance > ARRIVED_M or speed > ARRIVED_M_S:
            self._near_since_ns = None
            return
        if self._near_since_ns is None:
            self._near_since_ns = state.t_ns
        if not self.arrived and state.t_ns - self._near_since_ns >= ARRIVED_S * NS_PER_S:
            self.arrived = True
            self.n_arrived += 1

    def proceed(self) -> None:
        """From a place where the vehicle has arrived to the next one, if there is one."""
        if self.arrived and self.following:
            self._head_for(self.following[0], self.following[1:])

    @property
    def is_over(self) -> bool:
        """Arrived at the last place."""
        return self.arrived and not self.following

    def _head_for(self, target: Place | None, following: tuple[Place, ...]) -> None:
        self.target, self.following = target, following
        self.arrived, self._near_since_ns, self._holds_here = False, None, False
