"""Whether a camera really sees the ground of an older node: registration, geometry, and agreement."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from overfly.config import RevisitSettings
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.types import (
    Attitude,
    Constraint,
    ConstraintKind,
    Correspondences,
    Features,
    IntArray,
    NotFound,
    PoseEstimate,
    Reason,
)
from overfly.vision.features import Extractor
from overfly.vision.matching import match_guided, match_mutual
from overfly.vision.odometry import Located, PooledMatches, Reference, information_of_constraint, subset
from overfly.vision.refine import HeightPrior, TiltPrior
from overfly.vision.registration import Registrar

# What a map point is wrong by beyond the noise of its features, in flying heights and radians: added to every revisit's covariance.
SHIFT_SHARE = 0.002
TURN_RAD = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    """What a camera sees and is to be found again: n features, rays (n, 2) undistorted, and what is known of the tilt."""

    features: Features
    rays: FloatArray
    attitude: Attitude | None
    tilt: TiltPrior
    height: HeightPrior | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Verifier:
    """Registers a view with older nodes and judges the outcome."""

    camera: Camera
    extractor: Extractor
    registrar: Registrar
    settings: RevisitSettings

    def register(
        self,
        query: Query,
        references: list[Reference],
        predicted: Pose | None,
        radius_px: float,
        height_range_m: tuple[float, float],
    ) -> tuple[Located | NotFound, int]:
        """The pose of a view against some nodes that see one piece of ground, and the number of matches.

        predicted: world_from_cam, with radius_px how far features may be from where it puts them; None: anywhere.
        """
        matches = self.match(query, references, predicted, radius_px)
        estimate = self.registrar.register(
            matches.correspondences, query.attitude, height_range_m, query.height
        )
        count = len(matches.correspondences)
        if isinstance(estimate, NotFound):
            return estimate, count
        problem = self.implausible(query, estimate, matches)
        return problem or Located(estimate, matches), count

    def match(
        self, query: Query, references: list[Reference], predicted: Pose | None, radius_px: float
    ) -> PooledMatches:
        """Mutual nearest neighbours with each node, pooled and sorted by descriptor distance."""
        columns = []
        for reference in references:
            usable = np.flatnonzero(np.isfinite(reference.points[:, 2]))
            descriptors = reference.features.descriptors[usable]
            metric, limit = self.extractor.metric, self.extractor.max_distance
            if predicted is None:
                a, b, distance = match_mutual(descriptors, query.features.descriptors, metric, limit)
            else:
                seen = self.camera.project(predicted.inverse().transform(reference.points[usable]))
                a, b, distance = match_guided(
                    descriptors, query.features.descriptors, metric, limit, seen, query.features.px, radius_px
                )
            rows = usable[a]
            points, spread = reference.points[rows], reference.spread[rows]
            columns.append(
                (points, query.rays[b], distance, rows, b, np.full(len(a), reference.node), spread)
            )
        points, rays, distance, map_index, frame_index, node, spread = (
            np.concatenate(column) for column in zip(*columns, strict=True)
        )
        order = np.argsort(distance, kind="stable")
        order = order[np.isfinite(rays[order, 0])]
        return PooledMatches(
            Correspondences(
                points[order],
                rays[order],
                distance[order],
                map_index[order],
                frame_index[order],
                spread[order],
            ),
            node[order],
        )

    def implausible(self, query: Query, estimate: PoseEstimate, matches: PooledMatches) -> NotFound | None:
        """What speaks against a registration, or None."""
        settings = self.settings
        correspondences = matches.correspondences
        inliers = estimate.inliers
        frame_rows = np.unique(correspondences.frame_index[inliers])
        if len(frame_rows) < settings.min_inliers:
            return NotFound(
                Reason.FEW_INLIERS, f"{len(frame_rows)} inliers of {len(correspondences)} matches"
            )
        px = query.features.px[frame_rows]
        spread = np.linalg.eigvalsh(np.cov(px.T))
        if math.sqrt(max(spread[0], 0.0)) < settings.min_spread * self.camera.width:
            return NotFound(Reason.POOR_SPREAD, f"{len(frame_rows)} inliers along a line or in a corner")
        up = query.tilt.level_from_cam @ estimate.world_from_cam.rotation[2]
        tilt = math.atan2(math.hypot(up[0], up[1]), up[2])
        if tilt > settings.tilt_sigmas * query.tilt.sigma_rad + math.radians(settings.tilt_slack_deg):
            return NotFound(
                Reason.IMPLAUSIBLE, f"tilted by {math.degrees(tilt):.1f} degrees against the sensor"
            )
        return None

    def constraint_of(
        self, located: Located, world_from_node: Pose, new_node: int, query: Query, height_m: float
    ) -> Constraint:
        """The revisit as a constraint to its main node, from that node's inliers alone if they are enough."""
        node = located.main_node
        rows = located.inliers_of(node)
        estimate = located.estimate
        own = subset(located.matches.correspondences, rows)
        if len(np.unique(own.frame_index)) >= self.settings.min_inliers:
            refined = self.registrar.refine(located.pose, own, query.tilt, None, estimate.score)
            if isinstance(refined, PoseEstimate):
                estimate = refined
        return Constraint(
            node,
            new_node,
            world_from_node.inverse() @ estimate.world_from_cam,
            information_of_constraint(estimate.covariance + map_covariance(height_m)),
            ConstraintKind.REVISIT,
        )


def map_covariance(height_m: float) -> FloatArray:
    """(6, 6) what the points of the map add to a revisit's covariance."""
    return np.diag([(SHIFT_SHARE * height_m) ** 2] * 3 + [TURN_RAD**2] * 3)


def best_matched(located: Located, count: int) -> IntArray:
    """Rows (count,) of a new node's features: those that odometry found again first, best matched first, then the others."""
    if located.px is None:
        first = located.matches.correspondences.frame_index[np.sort(located.estimate.inliers)]
    else:  # followed points are the node's first features, without an order among them
        first = np.arange(len(located.estimate.inliers))
    order = np.concatenate([first, np.arange(count)])
    _, places = np.unique(order, return_index=True)
    return np.asarray(order[np.sort(places)], np.int64)
