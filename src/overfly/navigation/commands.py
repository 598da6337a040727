"""What an operator asks of a vehicle that flies over its map. Frozen, without behaviour: the ground station
puts them into a queue, the control loop takes them out.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class GoTo:
    """Fly to the place (x_m, y_m) of the map's world, at the present height, and hold there."""

    x_m: float
    y_m: float


@dataclass(frozen=True, slots=True)
class Hold:
    """Keep the present place; a flight to another place ends here."""


@dataclass(frozen=True, slots=True)
class Stop:
    """Brake and end the mission: hover where that happens, and seek no place until the next command."""


@dataclass(frozen=True, slots=True)
class ReturnToStart:
    """Fly back to where the mission began, and hold there."""


Command = GoTo | Hold | Stop | ReturnToStart
