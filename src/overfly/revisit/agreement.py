"""Revisits that nobody believes alone, until others, over other ground, say the same."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from overfly.config import RevisitSettings
from overfly.revisit.index import PlaceIndex
from overfly.revisit.region import ground_places
from overfly.revisit.uncertainty import Uncertainty, region_bound
from overfly.types import Constraint
from overfly.visual_map import VisualMap


@dataclass(frozen=True, slots=True, eq=False)
class Waiting:
    """A revisit that others have to confirm, and how many inliers it has."""

    constraint: Constraint
    inliers: int


class WaitingRoom:
    """Keeps the newest unconfirmed revisits."""

    def __init__(
        self,
        visual_map: VisualMap,
        uncertainty: Uncertainty,
        index: PlaceIndex,
        settings: RevisitSettings,
    ) -> None:
        self._map = visual_map
        self._uncertainty = uncertainty
        self._index = index
        self._settings = settings
        self._bound = region_bound(settings.sigmas)
        self._waiting: list[Waiting] = []

    def clear(self) -> None:
        """Forget all that waits."""
        self._waiting = []

    def confirming(self, new: Waiting) -> list[Waiting] | None:
        """Those that agree with a new one and are believed together with it, taken out; None where that is
        not enough, and the new one waits, too."""
        agreeing = self._agreeing(new.constraint)
        evidence = new.inliers + sum(waiting.inliers for waiting in agreeing)
        if evidence < 2 * self._settings.strong_inliers or not self._are_apart(agreeing, new.constraint):
            self._waiting.append(new)
            del self._waiting[: -self._settings.most_waiting]
            return None
        self._waiting = [waiting for waiting in self._waiting if waiting not in agreeing]
        return agreeing

    def _agreeing(self, b: Constraint) -> list[Waiting]:
        piece = self._map.pieces()
        comparable = [
            waiting
            for waiting in self._waiting
            if piece[waiting.constraint.i] == piece[b.i] and piece[waiting.constraint.j] == piece[b.j]
        ]
        apart = self._uncertainty.disagreements([waiting.constraint for waiting in comparable], b)
        return [waiting for waiting, far in zip(comparable, apart, strict=True) if far <= self._bound]

    def _are_apart(self, agreeing: list[Waiting], constraint: Constraint) -> bool:
        """Whether revisits rest on different ground: one thing that is there twice is seen in many
        pictures."""
        nodes = np.array([constraint.j, *(waiting.constraint.j for waiting in agreeing)])
        heights = np.array([self._index.height(int(node)) for node in nodes])
        places = ground_places(self._map.graph, nodes, heights)
        apart = np.linalg.norm(places - places[0], axis=1).max()
        return bool(apart >= self._settings.least_apart * heights[0])
