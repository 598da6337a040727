"""What a map file holds besides the map itself: where it comes from, and every frame of its flights."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from overfly.config import Config
from overfly.geometry.poses import Pose
from overfly.revisit.outcome import Revisit
from overfly.types import GeoPosition, Reason, Rig


@dataclass(frozen=True, slots=True, eq=False)
class FlightEntry:
    """One flight that the map was made from.

    source: what was mapped, in words; created: UTC, ISO 8601; software: version that wrote it; rig: as
    recorded, before pictures were reduced; progress: what a run needs to carry on (see
    overfly.mapstore.progress).
    """

    number: int
    source: str
    created: str
    software: str
    rig: Rig
    config: Config
    progress: dict[str, Any] = field(default_factory=dict)
    complete: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class FrameEntry:
    """What became of one frame. Lost ones have a reason and neither node nor poses.

    node: the node it hangs on, by node_from_cam; made_node: it became that node; online: world_from_cam as
    it was known when the frame had just been processed; piece: of the map, that it was located in at the
    time; seconds: by stage; revisit: if a place was sought.
    """

    flight: int
    t_ns: int
    frame_index: int
    node: int | None = None
    made_node: bool = False
    node_from_cam: Pose | None = None
    online: Pose | None = None
    reason: Reason | None = None
    detail: str = ""
    n_matches: int = 0
    n_inliers: int = 0
    rms_px: float = math.nan
    piece: int = 0
    position: GeoPosition | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    revisit: Revisit | None = None
