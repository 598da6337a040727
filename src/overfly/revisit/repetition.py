"""Ground that repeats itself where the map does not show it.

Whether another place fits as well can be asked of the map only where the map holds that place. The view and
those just before it tell more: if the ground about the camera looks the same some way off, then a place that
looks right may be that far from the true one, which nothing in the map shows, and dead reckoning decides.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from overfly.geometry.poses import FloatArray, Pose
from overfly.revisit.evidence import LARGEST_SHARE
from overfly.revisit.found import Found
from overfly.revisit.pool import Expectation, Pool
from overfly.revisit.uncertainty import Uncertainty, pixel_sigmas
from overfly.revisit.verification import (
    SAME_PLACE_PX,
    Query,
    Verifier,
    n_distinct,
    pool_of_nodes,
    surroundings_at,
)
from overfly.types import Constraint
from overfly.vision.odometry import Located
from overfly.visual_map import VisualMap

NEWEST = 4  # nodes, the new one among them, in which the ground is looked for again
# Dead reckoning tells places apart that look the same, when the odds are a hundred to one: as a difference of
# squared Mahalanobis distances.
ODDS = 2.0 * math.log(100.0)
# Of what older nodes show of the view at the place found: so much of another place can be compared with it.
LEAST_SHOWN = 1.0 / 3.0


def is_ambiguous(
    visual_map: VisualMap,
    uncertainty: Uncertainty,
    verifier: Verifier,
    query: Query,
    best: Found,
    constraint: Constraint,
    height_m: float,
) -> bool:
    """Whether the view of node constraint.j may be of ground that only looks like the place found.

    constraint: what comes of the place. height_m: of the new node above its ground. True when the node's
    surroundings repeat themselves so that the true pose may be another one, which neither the graph nor the
    older nodes speak clearly against: these where they show its ground and fewer features fit than that much
    ground should have. What fits there better than at the place found is no matter of odds.
    """
    index, graph = constraint.j, visual_map.graph
    own, older = graph.pose(index), graph.pose(constraint.i)
    found = older @ constraint.i_from_j
    covariance = uncertainty.relative(constraint.i, index)
    other = _where_it_looks_the_same(visual_map, verifier, query, index, own, found, covariance)
    if other is None or n_distinct(other) < verifier.settings.min_inliers:
        return False
    shift = _ground_shift(visual_map, index, other)
    least = 2.0 * SAME_PLACE_PX * verifier.px_scale / verifier.camera.focal_px * height_m
    if not np.linalg.norm(shift) > least:
        return False
    shift *= _relative_scale(visual_map, index, best.located)
    true = Pose(found.rotation, found.translation - shift)
    rival = replace(constraint, i_from_j=older.inverse() @ true)
    improbable = uncertainty.innovation(rival) >= uncertainty.innovation(constraint) + ODDS
    at_found, at_rival = (_n_inliers_at(verifier, query, best, pose) for pose in (best.located.pose, true))
    if improbable:
        return at_rival > at_found
    points = best.pool.points
    shown = verifier.n_in_view(true, points) / max(1, verifier.n_in_view(best.located.pose, points))
    comparable = shown >= LEAST_SHOWN and at_found * shown >= 2 * verifier.settings.min_inliers
    return not (comparable and at_rival < LARGEST_SHARE * at_found * shown)


def _where_it_looks_the_same(
    visual_map: VisualMap,
    verifier: Verifier,
    query: Query,
    index: int,
    own: Pose,
    found: Pose,
    covariance: FloatArray,
) -> Located | None:
    """The pose away from the own one, but as the one found is from where the camera may be, from which the
    newest nodes would look as they do from the own pose.

    covariance (6, 6) of the own pose against the node of the found one.
    """
    nodes = np.arange(max(0, index + 1 - NEWEST), index + 1)
    pool = pool_of_nodes(visual_map, nodes, verifier.extractor.metric)
    radius = _largest_shift_px(verifier, pool, own, found, covariance)
    expected = Expectation(found, np.full(len(pool.points), radius))
    change = verifier.registrar.config.registration.height_change
    around = surroundings_at(visual_map, nodes, change)
    return verifier.rival(query, pool, expected, own, around, verifier.settings.min_inliers)


def _largest_shift_px(
    verifier: Verifier, pool: Pool, own: Pose, found: Pose, covariance: FloatArray
) -> float:
    """How far from the own pose another one may be that is not clearly less probable than the one found."""
    points = own.inverse().transform(pool.points)
    shift = verifier.camera.project(points) - verifier.camera.project(found.inverse().transform(pool.points))
    sigmas = pixel_sigmas(points, covariance, verifier.camera)
    seen = np.isfinite(shift).all(axis=1) & np.isfinite(sigmas)
    if not seen.any():  # so far off that none of this ground is in the picture: it cannot show itself again
        return 0.0
    shift_px, sigma_px = np.median(np.linalg.norm(shift[seen], axis=1)), np.median(sigmas[seen])
    return float(math.hypot(shift_px, math.sqrt(ODDS) * sigma_px))


def _ground_shift(visual_map: VisualMap, index: int, other: Located) -> FloatArray:
    """(3,) metres, world: from what the view of a node shows to where the same is seen again."""
    matched = other.matches.correspondences
    here = visual_map.points_in_world(visual_map.nodes[index])[matched.frame_index]
    apart = (matched.points - here)[other.estimate.inliers]
    known = np.isfinite(apart).all(axis=1)
    return np.median(apart[known], axis=0) if known.any() else np.zeros(3)


def _relative_scale(visual_map: VisualMap, index: int, located: Located) -> float:
    """How much longer the map is about the place found than about a node, by how far off both see ground."""
    there = located.pose.inverse().transform(located.matches.correspondences.points[located.estimate.inliers])
    here = visual_map.nodes[index].points_in_cam[visual_map.nodes[index].has_point]
    return float(np.median(there[:, 2]) / np.median(here[:, 2])) if len(here) else 1.0


def _n_inliers_at(verifier: Verifier, query: Query, best: Found, pose: Pose) -> int:
    """Inliers of the view, were it seen from near a pose."""
    radius = SAME_PLACE_PX * verifier.px_scale
    expected = Expectation(pose, np.full(len(best.pool.points), radius))
    located, _ = verifier.register(query, best.pool, expected, best.around)
    return n_distinct(located) if isinstance(located, Located) else 0
