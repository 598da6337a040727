"""What speaks against believing a place that looks right: another one that fits as well, in the map or beside
it, or that too little of the picture agrees."""

from __future__ import annotations

import math

import numpy as np

from overfly.config import RevisitSettings
from overfly.revisit.found import Doubt, Found
from overfly.revisit.index import PlaceIndex
from overfly.revisit.region import on_ground
from overfly.revisit.repetition import is_ambiguous
from overfly.revisit.uncertainty import Uncertainty
from overfly.revisit.verification import SAME_PLACE_PX, Query, Verifier, n_distinct
from overfly.types import Constraint
from overfly.vision.odometry import Located
from overfly.visual_map import VisualMap


class Doubts:
    """Judges places that registration found."""

    def __init__(
        self,
        visual_map: VisualMap,
        uncertainty: Uncertainty,
        index: PlaceIndex,
        verifier: Verifier,
        settings: RevisitSettings,
    ) -> None:
        self._map = visual_map
        self._uncertainty = uncertainty
        self._index = index
        self._verifier = verifier
        self._settings = settings

    def of(self, best: Found, found: list[Found], query: Query, tie: Constraint | None) -> Doubt:
        """tie: the constraint that comes of the best of the places found, where dead reckoning tells where
        the camera may be."""
        if not self.may_mistake(best):
            return Doubt.NONE
        if self._rival_share(best, found, query) >= self._settings.rival_share:
            return Doubt.ANOTHER_FITS
        strong = self._verifier.is_strong(best.located)
        if not strong and not self._verifier.covers(query, best.pool, best.located):
            return Doubt.ONE_OBJECT
        if tie is not None and self._repeats(query, best, tie):
            return Doubt.REPEATED
        return Doubt.NONE if strong else Doubt.WEAK

    def is_wide(self, found: Found) -> bool:
        """Whether the region is so wide that all places in it have to be looked at."""
        return found.reach_px > self._settings.wide_share * self._verifier.camera.width

    def may_mistake(self, found: Found) -> bool:
        """Whether the region is so wide that ground which repeats itself could be taken for the same."""
        return found.reach_px > 2.0 * SAME_PLACE_PX * self._verifier.px_scale

    def rival(self, found: Found, query: Query, fewest: int = 0) -> Located | None:
        """The best other pose against the same nodes; None when there is none with so many inliers."""
        return self._verifier.rival(
            query, found.pool, found.expected, found.located.pose, found.around, fewest
        )

    def _repeats(self, query: Query, best: Found, tie: Constraint) -> bool:
        height = self._index.height(tie.j)
        return is_ambiguous(self._map, self._uncertainty, self._verifier, query, best, tie, height)

    def _rival_share(self, best: Found, found: list[Found], query: Query) -> float:
        """How well the best other pose in the region fits, with the same nodes or with others: its inliers as
        a share of the best one's."""
        height = float(np.median([self._index.height(int(node)) for node in best.group]))
        exclusion = SAME_PLACE_PX * self._verifier.px_scale / self._verifier.camera.focal_px * height
        place = on_ground(best.located.pose, height)
        rivals = [
            n_distinct(other.located)
            for other in found
            if np.linalg.norm(on_ground(other.located.pose, height) - place) > exclusion
        ]
        fewest = math.ceil(self._settings.rival_share * n_distinct(best.located))
        elsewhere = self.rival(best, query, fewest)
        if elsewhere is not None:
            rivals.append(n_distinct(elsewhere))
        return max(rivals, default=0) / n_distinct(best.located)
