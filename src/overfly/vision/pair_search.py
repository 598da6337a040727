"""Which pair of correspondences gives the best camera pose (paper, sections IV-B and IV-C).

Correspondences come sorted by descriptor distance. Pairs are tried in the order of Eq. 2: (1,2) (1,3) (2,3)
(1,4) (2,4) (3,4) ... Each pair gives a pose by the two-point solver; the pose is scored by Eq. 3 and 4 over
all other correspondences. The search is deterministic: its budget is counted in pairs, not read from a clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from overfly.geometry.levelling import level_rays, world_from_cam_rotation
from overfly.geometry.poses import FloatArray, Pose
from overfly.types import Correspondences
from overfly.vision.two_point import two_point_kernel


@dataclass(frozen=True, slots=True)
class SearchSettings:
    """Limits of the search; symbols of the paper in brackets."""

    image_limit: float  # largest reprojection distance that counts, in units of the focal length [d_img_max]
    image_sigma: float  # standard deviation of a feature's place, in units of the focal length
    descriptor_limit: float  # largest descriptor distance that counts [d_desc_max]
    blend: float = 0.5  # weight of the descriptor distance against the reprojection distance [alpha]
    smallest_separation: float = 0.05  # of the two rays, in units of the focal length
    max_pairs: int = 20_000
    pairs_without_gain: int = 300
    satisfying: float = 0.9  # stop at this share of the score that perfect agreement would give
    height_range_m: tuple[float, float] = (0.0, math.inf)  # of the camera in the world


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """Best pose of the search: its score (Eq. 3), the pair (rows) it came from and how many
    pairs were tried.
    """

    world_from_cam: Pose
    score: float
    pair: tuple[int, int]
    pairs_tried: int


def search_pairs(
    correspondences: Correspondences, level_from_cam: FloatArray, settings: SearchSettings
) -> Hypothesis | None:
    """The best-scoring pose of all pairs tried; None when no pair gives a pose.

    level_from_cam: (3, 3) rotation measured by the attitude sensor, taken as truth here.
    """
    if len(correspondences) < 2:
        return None
    levelled = level_rays(correspondences.rays, level_from_cam)
    best, pair, tried = _search(
        np.ascontiguousarray(correspondences.points, dtype=np.float64),
        np.ascontiguousarray(correspondences.rays, dtype=np.float64),
        levelled,
        np.ascontiguousarray(correspondences.distance, dtype=np.float64),
        spread_of(correspondences),
        np.ascontiguousarray(level_from_cam.T),
        settings.image_sigma,
        settings.image_limit,
        settings.descriptor_limit,
        settings.blend,
        settings.smallest_separation,
        settings.max_pairs,
        settings.pairs_without_gain,
        settings.satisfying,
        settings.height_range_m[0],
        settings.height_range_m[1],
    )
    if pair[0] < 0:
        return None
    rotation = world_from_cam_rotation(math.atan2(best[1], best[0]), level_from_cam)
    return Hypothesis(
        Pose(rotation, best[2:5].copy()), float(best[5]), (int(pair[0]), int(pair[1])), int(tried)
    )


def spread_of(correspondences: Correspondences) -> FloatArray:
    """(n, 3) spread of the points, zeros where none is given."""
    if correspondences.spread is None:
        return np.zeros((len(correspondences), 3))
    return np.ascontiguousarray(correspondences.spread, dtype=np.float64)


@njit(cache=True, nogil=True)
def _search(  # type: ignore[no-untyped-def]
    points,
    rays,
    levelled,
    distance,
    spread,
    cam_from_level,
    image_sigma,
    image_limit,
    descriptor_limit,
    blend,
    smallest_separation,
    max_pairs,
    pairs_without_gain,
    satisfying,
    lowest,
    highest,
):
    n = points.shape[0]
    # The most that correspondence k can add (Eq. 4 at zero image distance), and what all from k on can still
    # add.
    most = np.zeros(n)
    still = np.zeros(n + 1)
    for k in range(n - 1, -1, -1):
        if distance[k] < descriptor_limit:
            most[k] = 1.0 - blend * distance[k] / descriptor_limit
        still[k] = still[k + 1] + most[k]
    best = np.zeros(6)
    best[5] = -1.0
    pair = np.full(2, -1)
    solutions = np.empty((2, 5))
    tried = 0
    last_gain = 0
    separation2 = smallest_separation * smallest_separation
    for b in range(1, n):
        for a in range(b):
            tried += 1
            if tried > max_pairs or (best[5] >= 0.0 and tried - last_gain > pairs_without_gain):
                return best, pair, tried
            dx, dy = rays[a, 0] - rays[b, 0], rays[a, 1] - rays[b, 1]
            if not dx * dx + dy * dy >= separation2:  # also leaves out rays above the horizon, which are NaN
                continue
            count = two_point_kernel(points[a], points[b], levelled[a], levelled[b], solutions)
            for s in range(count):
                if not lowest <= solutions[s, 4] <= highest:
                    continue
                score = _score(
                    solutions[s],
                    points,
                    rays,
                    spread,
                    cam_from_level,
                    most,
                    still,
                    image_sigma,
                    image_limit,
                    blend,
                    a,
                    b,
                    best[5],
                )
                if score > best[5]:
                    best[:5] = solutions[s]
                    best[5] = score
                    pair[0], pair[1] = a, b
                    last_gain = tried
                    if score >= satisfying * (still[0] - most[a] - most[b]):
                        return best, pair, tried
    return best, pair, tried


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _score(  # type: ignore[no-untyped-def]
    pose, points, rays, spread, cam_from_level, most, still, image_sigma, image_limit, blend, a, b, to_beat
):
    """Eq. 3; gives up (returns a score below to_beat) once it cannot be beaten any more.

    The image distance is taken in the metric of the feature's and the point's uncertainty together: along the
    line on which an uncertain depth moves the point in the image, it counts less.
    """
    c, s = pose[0], pose[1]
    # cam_from_world = cam_from_level Rz(-psi)
    r00, r01 = (
        cam_from_level[0, 0] * c - cam_from_level[0, 1] * s,
        cam_from_level[0, 0] * s + cam_from_level[0, 1] * c,
    )
    r10, r11 = (
        cam_from_level[1, 0] * c - cam_from_level[1, 1] * s,
        cam_from_level[1, 0] * s + cam_from_level[1, 1] * c,
    )
    r20, r21 = (
        cam_from_level[2, 0] * c - cam_from_level[2, 1] * s,
        cam_from_level[2, 0] * s + cam_from_level[2, 1] * c,
    )
    r02, r12, r22 = cam_from_level[0, 2], cam_from_level[1, 2], cam_from_level[2, 2]
    limit2 = image_limit * image_limit
    sigma2 = image_sigma * image_sigma
    slope = (1.0 - blend) / image_limit
    score = 0.0
    n = points.shape[0]
    for k in range(n):
        if k % 16 == 0 and score + still[k] <= to_beat:
            return -1.0
        if k in (a, b) or most[k] == 0.0:
            continue
        x, y, z = points[k, 0] - pose[2], points[k, 1] - pose[3], points[k, 2] - pose[4]
        depth = r20 * x + r21 * y + r22 * z
        if depth <= 0.0:
            continue
        du = (r00 * x + r01 * y + r02 * z) / depth - rays[k, 0]
        dv = (r10 * x + r11 * y + r12 * z) / depth - rays[k, 1]
        distance2 = du * du + dv * dv
        sx, sy, sz = spread[k, 0], spread[k, 1], spread[k, 2]
        if distance2 >= limit2 and (sx != 0.0 or sy != 0.0 or sz != 0.0):
            along = r20 * sx + r21 * sy + r22 * sz
            eu = (r00 * sx + r01 * sy + r02 * sz - (du + rays[k, 0]) * along) / depth
            ev = (r10 * sx + r11 * sy + r12 * sz - (dv + rays[k, 1]) * along) / depth
            dot = du * eu + dv * ev
            distance2 -= dot * dot / (sigma2 + eu * eu + ev * ev)
        if distance2 < limit2:
            score += most[k] - slope * math.sqrt(distance2)
    return score
