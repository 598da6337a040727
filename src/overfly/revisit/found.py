"""A place that looks right, and what speaks against believing it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from overfly.revisit.pool import Expectation, Pool
from overfly.revisit.verification import Surroundings
from overfly.types import IntArray
from overfly.vision.odometry import Located


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """Where a lost camera may be: not believed until a second one agrees."""

    t_ns: int
    located: Located


class Doubt(StrEnum):
    """Why a place that looks right might be another one."""

    NONE = "none"
    WEAK = "little of the picture agrees"
    ANOTHER_FITS = "another pose fits too well"
    REPEATED = "the ground here repeats itself"
    ONE_OBJECT = "one object alone looks alike"


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """A place that the camera may see: the registration with a group of nodes, what these hold, and how
    uncertain it was before.

    reach_px: how far most points of the most uncertain of the nodes may be from where they were expected.
    """

    group: IntArray
    pool: Pool
    around: Surroundings
    expected: Expectation | None
    reach_px: float
    located: Located
