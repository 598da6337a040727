"""What navigation knows of a vehicle: how it follows commands, and the two calls that close the loop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from overfly.types import Frame, Rig, VelocityCommand


@dataclass(frozen=True, slots=True)
class Airframe:
    """How a vehicle follows velocity commands.

    response_s: time constant with which its velocity follows; pull_lag_s: with which its pull builds up.
    """

    name: str
    max_speed_m_s: float
    max_acceleration_m_s2: float
    max_climb_m_s: float
    max_yaw_rate_rad_s: float
    response_s: float
    pull_lag_s: float


class Vehicle(Protocol):
    """Something that flies: it shows what it sees and does what it is told."""

    @property
    def rig(self) -> Rig: ...

    @property
    def airframe(self) -> Airframe: ...

    @property
    def now_ns(self) -> int:
        """The clock of the frames' stamps, now: when a command that is given now takes effect."""

    def sense(self) -> Frame | None:
        """The next frame, with attitude and range where there are sensors; None when the flight is over."""

    def command(self, velocity: VelocityCommand) -> None:
        """Fly like that until the next command."""
