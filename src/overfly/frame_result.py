"""What became of one frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from overfly.geometry.poses import FloatArray, Pose
from overfly.revisit.outcome import Revisit
from overfly.types import Reason


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """What became of one frame: its pose world_from_cam with covariance (6, 6), or the reason why there is
    none.
    """

    t_ns: int
    pose: Pose | None
    reason: Reason | None = None
    detail: str = ""
    covariance: FloatArray | None = None
    n_matches: int = 0
    n_inliers: int = 0
    rms_px: float = math.nan
    node: int | None = None  # set when the frame became a node
    revisit: Revisit | None = (
        None  # of a node, or when lost: whether the place was known, and what came of it
    )
    piece: int = 0  # of the map, see VisualMap.pieces; in any but the first the pose is dead reckoned only
    timings_s: dict[str, float] = field(default_factory=dict)
