"""Pieces of the map. Where the camera sees the ground but cannot be found, a new piece begins, tied to the
last one by dead reckoning alone; a revisit ties both, and the newer one is laid onto the older.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from overfly.geometry.levelling import split_yaw, world_from_cam_rotation
from overfly.geometry.poses import FloatArray, Pose, rotation_z
from overfly.graph.pose_graph import KINDS, PoseGraph
from overfly.types import BoolArray, ConstraintKind, Features, Frame, IntArray
from overfly.vision.features import Extractor
from overfly.vision.matching import match_mutual
from overfly.vision.refine import HeightPrior, TiltPrior

NS_PER_S = 1e9
DEAD_RECKONING = KINDS.index(ConstraintKind.DEAD_RECKONING)

# What a vehicle may have done unseen, one standard deviation: its speed when it was lost, or this one in
# flying heights per second, in any direction; but first it goes on as it flew, for about so long.
DRIFT_HEIGHTS_PER_S = 0.5
GOES_ON_S = 1.0
CLIMB_SHARE_PER_S = 0.1
TURN_RAD_PER_S = 0.3
COMPASS_SIGMA_RAD = 0.2
LONGEST_TURN_RAD = math.pi / math.sqrt(3.0)  # of a heading of which nothing is known
FEWEST_LOST = 3  # frames; one or two may only be blurred


def find_pieces(graph: PoseGraph) -> IntArray:
    """(n,) the piece of each node, named by its oldest node: what is tied by more than dead reckoning.

    All is one piece while nothing was ever reckoned.
    """
    if not (graph.kinds == DEAD_RECKONING).any():
        return np.zeros(len(graph), np.int64)
    ties = graph.active[graph.kinds[graph.active] != DEAD_RECKONING]
    n = len(graph)
    links = coo_array((np.ones(len(ties), np.bool_), (graph.i[ties], graph.j[ties])), shape=(n, n))
    count, label = connected_components(links, directed=False)
    oldest = np.full(count, n, np.int64)
    np.minimum.at(oldest, label, np.arange(n))
    return oldest[label]


def main_piece(graph: PoseGraph, located: IntArray) -> BoolArray:
    """(n,) whether a node belongs to the piece in which most frames were located; located: their nodes."""
    piece = find_pieces(graph)
    names, counts = np.unique(piece[located], return_counts=True)
    return np.asarray(piece == names[np.argmax(counts)]) if len(names) else np.ones(len(piece), np.bool_)


def lay_onto(graph: PoseGraph, nodes: IntArray, world_from_found: Pose, world_from_now: Pose) -> None:
    """Move a piece, its nodes (k,), so that a camera of it comes to stand where it was found.

    About the vertical and along the axes only: what is level in the piece stays so.
    """
    between = world_from_found.rotation @ world_from_now.rotation.T
    turn = rotation_z(math.atan2(between[1, 0] - between[0, 1], between[0, 0] + between[1, 1]))
    new_from_old = Pose(turn, world_from_found.translation - turn @ world_from_now.translation)
    for node in nodes:
        graph.set_pose(int(node), new_from_old @ graph.pose(int(node)))


@dataclass(frozen=True, slots=True, eq=False)
class Reckoned:
    """Where a camera that was lost may be: world_from_cam, and covariance (6, 6) of (translation, rotation)
    against where it was lost, on the right."""

    pose: Pose
    covariance: FloatArray


def dead_reckon(
    last: Pose,
    velocity_m_s: FloatArray,
    last_ns: int,
    frame: Frame,
    tilt: TiltPrior,
    height: HeightPrior | None,
    body_from_cam: FloatArray,
) -> Reckoned:
    """From where the camera was lost; height and tilt as the sensors say, the heading where they know it.

    last: world_from_cam at last_ns, with velocity_m_s (3,) in the world; body_from_cam (3, 3): mounting of
    the camera. The covariance grows with the time since: a camera that stopped at once, and one that kept its
    speed all the time, are both about a standard deviation away.
    """
    gap_s = (frame.t_ns - last_ns) / NS_PER_S
    z = float(last.translation[2])
    z_sigma = CLIMB_SHARE_PER_S * gap_s * abs(z)
    going_on_s = gap_s * GOES_ON_S / (gap_s + GOES_ON_S)
    speed = math.hypot(DRIFT_HEIGHTS_PER_S * abs(z), float(np.linalg.norm(velocity_m_s[:2])))
    xy_sigma = speed * (gap_s - going_on_s)
    xy = last.translation[:2] + going_on_s * velocity_m_s[:2]
    if height is not None:
        z, z_sigma = height.z_m, height.sigma_m
    yaw, _ = split_yaw(last.rotation, body_from_cam)
    yaw_sigma = min(TURN_RAD_PER_S * gap_s, LONGEST_TURN_RAD)
    attitude = frame.attitude
    if attitude is not None and attitude.yaw_rad is not None:  # then the map began with the sensor's heading
        yaw, yaw_sigma = attitude.yaw_rad, attitude.yaw_sigma_rad or COMPASS_SIGMA_RAD
    rotation = world_from_cam_rotation(yaw, tilt.level_from_cam)
    shift = np.diag([xy_sigma**2, xy_sigma**2, z_sigma**2])
    turn = np.diag([tilt.sigma_rad**2, tilt.sigma_rad**2, yaw_sigma**2])
    covariance = np.zeros((6, 6))
    covariance[:3, :3], covariance[3:, 3:] = rotation.T @ shift @ rotation, rotation.T @ turn @ rotation
    return Reckoned(Pose(rotation, np.array([*xy, z])), covariance)


class LostWatch:
    """Counts frames that saw ground but were not found."""

    def __init__(self, patience_s: float, fewest_matches: int, extractor: Extractor) -> None:
        self._patience_ns = patience_s * NS_PER_S
        self._fewest = fewest_matches
        self._extractor = extractor
        self._since_ns: int | None = None
        self._count = 0
        self._last: Features | None = None

    def found(self) -> None:
        """The camera is somewhere in the map."""
        self._since_ns, self._count, self._last = None, 0, None

    def is_over(self, t_ns: int, features: Features) -> bool:
        """One more frame was not found: whether waiting for the old map is over, and this frame can begin a
        new piece.

        Only frames that show what the one before them showed count: not the noise of a dark picture.
        """
        n_alike = 0
        if self._last is not None:
            metric, limit = self._extractor.metric, self._extractor.max_distance
            n_alike = len(match_mutual(self._last.descriptors, features.descriptors, metric, limit)[0])
        self._last = features
        if n_alike < self._fewest:
            return False
        if self._since_ns is None:
            self._since_ns = t_ns
        self._count += 1
        return self._count >= FEWEST_LOST and t_ns - self._since_ns >= self._patience_ns
