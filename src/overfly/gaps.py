"""How the map goes on from frames that are not found in it: over a short gap by the speed on both sides of
it, after a longer one with a new piece of map, where dead reckoning leads.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from overfly.bridging import Bridge, Course, course_of
from overfly.config import PieceSettings
from overfly.frame_records import FrameRecord
from overfly.mapper import Mapper
from overfly.pieces import LostWatch, Reckoned, dead_reckon
from overfly.types import ConstraintKind
from overfly.vision.features import Extractor
from overfly.vision.observation import Observation
from overfly.vision.registration import Registrar
from overfly.visual_map import VisualMap

NEWEST_RECORDS = 16  # located frames among which the one is that tells the camera's speed


class Gaps:
    """Watches the frames that are not found."""

    def __init__(
        self,
        visual_map: VisualMap,
        mapper: Mapper,
        extractor: Extractor,
        registrar: Registrar,
        settings: PieceSettings,
    ) -> None:
        self._map = visual_map
        self._mapper = mapper
        self._body_from_cam = registrar.body_from_cam
        self._lost_watch = LostWatch(settings.patience_s, settings.fewest_matches, extractor)
        self._bridge = Bridge(extractor, registrar, mapper.reference)

    def found(self) -> None:
        """The camera is in the map."""
        self._lost_watch.found()
        self._bridge.found()

    def way_on(
        self, view: Observation, records: Sequence[FrameRecord]
    ) -> tuple[Reckoned, ConstraintKind] | None:
        """Where the map goes on from a view that was not found, and how that place is tied to the last of the
        located frames, records; None while it is better to wait.
        """
        if not records:
            return None
        course, height = self._last_course(records), self._mapper.height(view)
        spanned = None if course is None else self._bridge.span(view, course, height)
        if spanned is not None:
            return spanned, ConstraintKind.BRIDGE
        if not self._lost_watch.is_over(view.frame.t_ns, view.features):
            return None
        velocity = np.zeros(3) if course is None else course.velocity_m_s
        last, body_from_cam = records[-1], self._body_from_cam
        last_pose = self._map.graph.pose(last.node) @ last.node_from_cam
        reckoned = dead_reckon(last_pose, velocity, last.t_ns, view.frame, view.tilt, height, body_from_cam)
        return reckoned, ConstraintKind.DEAD_RECKONING

    def _last_course(self, records: Sequence[FrameRecord]) -> Course | None:
        """How the camera moved when it was located last."""
        newest = [one for one in records[-NEWEST_RECORDS:] if one.piece == records[-1].piece]
        stamps = np.array([record.t_ns for record in newest], np.int64)
        return course_of(
            stamps, lambda number: self._map.graph.pose(newest[number].node) @ newest[number].node_from_cam
        )
