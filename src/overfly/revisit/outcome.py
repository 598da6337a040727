"""What became of looking for a place seen before, one value per new node."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from overfly.types import Reason


class RevisitStatus(StrEnum):
    NONE_NEAR = "none near"  # no older node can show the same ground: nothing was tried
    ACCEPTED = "accepted"
    REJECTED = "rejected"
    WAITING = "waiting"  # found, but another place might look alike: others have to agree


@dataclass(frozen=True, slots=True)
class Revisit:
    """The search for a place seen before, from one new node.

    node: the older node that shows the same ground. candidates: nodes within the three-sigma region;
    matches, inliers: of the registration; seconds: of the whole search. constraint: its number in the
    graph, None when the map knew it nearly as well before. confirmed: earlier ones, until then waiting,
    that this one agrees with: (older node, new node) of each.
    """

    status: RevisitStatus
    candidates: int = 0
    node: int | None = None
    matches: int = 0
    inliers: int = 0
    reason: Reason | None = None
    detail: str = ""
    constraint: int | None = None
    confirmed: tuple[tuple[int, int], ...] = ()
    moved: bool = False  # poses of the graph changed
    seconds: float = 0.0
