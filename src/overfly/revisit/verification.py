"""Whether a camera really sees the ground of an older node: registration, geometry, and that nothing else
fits as well."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from overfly.config import RevisitSettings
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.revisit.descriptors import comparable
from overfly.revisit.drift import revisit_drift_covariance
from overfly.types import (
    Attitude,
    BoolArray,
    Constraint,
    ConstraintKind,
    Correspondences,
    Features,
    Float32Array,
    IntArray,
    NotFound,
    PoseEstimate,
    Reason,
)
from overfly.vision.features import Extractor
from overfly.vision.features.interface import Metric
from overfly.vision.matching import distances_kernel, match_guided, match_mutual
from overfly.vision.odometry import Located, PooledMatches, Reference, information_of_constraint, subset
from overfly.vision.refine import HeightPrior, TiltPrior
from overfly.vision.registration import REFERENCE_WIDTH_PX, Registrar
from overfly.visual_map import VisualMap

# What a map point is wrong by beyond the noise of its features, in flying heights and radians; and how many
# times the errors
# of points in one picture go together instead of averaging out. Both measured against truth: see
# docs/revisit.md.
SHIFT_SHARE = 0.002
TURN_RAD = 0.001
TOGETHER = 4.0
CELLS = (4, 3)  # of the picture, in which a place has to show itself
SAME_PLACE_PX = 8.0  # in a picture 320 wide: matches further off than that speak for another pose


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    """What a camera sees: n features, rays (n, 2) undistorted, and what sensors say of tilt and height."""

    features: Features
    rays: FloatArray
    attitude: Attitude | None
    tilt: TiltPrior
    height: HeightPrior | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Expectation:
    """Where a node's points should be in the picture: world_from_cam as predicted, and radii_px (n,), one
    per feature of the node, how far from there they may be."""

    world_from_cam: Pose
    radii_px: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """What is known where some nodes are: range of heights in the world in metres; up (3,), upwards in the
    world by the nodes' own sensors, which is not quite z where the map is bent."""

    height_range_m: tuple[float, float]
    up: FloatArray


def surroundings_of(nodes: list[tuple[Pose, TiltPrior]], height_change: float) -> Surroundings:
    """nodes: world_from_cam and what the sensors said of the tilt there; the height may differ by the
    factor."""
    z = [float(pose.translation[2]) for pose, _ in nodes]
    up = np.mean([_up(tilt, pose) for pose, tilt in nodes], axis=0)
    return Surroundings((min(z) / height_change, max(z) * height_change), np.asarray(up / np.linalg.norm(up)))


def _up(tilt: TiltPrior, world_from_cam: Pose) -> FloatArray:
    """(3,) upwards by the sensor, in the world of the pose."""
    return np.asarray(world_from_cam.rotation @ tilt.level_from_cam[2])


@dataclass(frozen=True, slots=True, eq=False)
class Verifier:
    """Registers what a camera sees with older nodes and judges the outcome."""

    camera: Camera
    extractor: Extractor
    registrar: Registrar
    settings: RevisitSettings

    def register(
        self,
        query: Query,
        references: list[Reference],
        expected: list[Expectation] | None,
        surroundings: Surroundings,
    ) -> tuple[Located | NotFound, int]:
        """The pose against some nodes that see one piece of ground, and the number of matches.

        expected: one per reference; None: points may be anywhere.
        """
        return self._judge(query, self.match(query, references, expected), surroundings)

    def _judge(
        self, query: Query, matches: PooledMatches, surroundings: Surroundings
    ) -> tuple[Located | NotFound, int]:
        estimate = self.registrar.register(
            matches.correspondences, query.attitude, surroundings.height_range_m, query.height
        )
        count = len(matches.correspondences)
        if isinstance(estimate, NotFound):
            return estimate, count
        problem = self.implausible(query, estimate, matches, surroundings.up)
        return problem or Located(estimate, matches), count

    def match(
        self, query: Query, references: list[Reference], expected: list[Expectation] | None
    ) -> PooledMatches:
        """Mutual nearest neighbours with each node, pooled and sorted by descriptor distance."""
        columns = []
        metric, limit = self.extractor.metric, self.extractor.max_distance
        for number, reference in enumerate(references):
            usable = np.flatnonzero(np.isfinite(reference.points[:, 2]))
            descriptors = reference.features.descriptors[usable]
            if expected is None:
                a, b, distance = match_mutual(descriptors, query.features.descriptors, metric, limit)
            else:
                here = expected[number]
                a, b, distance = match_guided(
                    descriptors,
                    query.features.descriptors,
                    metric,
                    limit,
                    self._seen(here.world_from_cam, reference.points[usable]),
                    query.features.px,
                    here.radii_px[usable],
                )
            columns.append(_matched(reference, query, usable[a], b, distance))
        return _pooled(columns)

    def _seen(self, world_from_cam: Pose, points: FloatArray) -> FloatArray:
        return self.camera.project(world_from_cam.inverse().transform(points))

    def implausible(
        self, query: Query, estimate: PoseEstimate, matches: PooledMatches, map_up: FloatArray
    ) -> NotFound | None:
        """What speaks against a registration, or None. map_up (3,): upwards there by the sensors of the
        older nodes, world."""
        settings = self.settings
        correspondences = matches.correspondences
        rows = np.unique(correspondences.frame_index[estimate.inliers])
        if len(rows) < settings.min_inliers:
            return NotFound(Reason.FEW_INLIERS, f"{len(rows)} inliers of {len(correspondences)} matches")
        spread = np.linalg.eigvalsh(np.cov(query.features.px[rows].T))
        if math.sqrt(max(spread[0], 0.0)) < settings.min_spread * self.camera.width:
            return NotFound(Reason.POOR_SPREAD, f"{len(rows)} inliers along a line or in a corner")
        apart = float(np.linalg.norm(_up(query.tilt, estimate.world_from_cam) - map_up))
        slack = math.radians(settings.tilt_slack_deg)
        if apart > settings.tilt_sigmas * math.sqrt(2.0) * query.tilt.sigma_rad + slack:
            return NotFound(
                Reason.IMPLAUSIBLE, f"tilted by {math.degrees(apart):.1f} degrees against the sensor"
            )
        return None

    def rival(
        self,
        query: Query,
        references: list[Reference],
        expected: list[Expectation] | None,
        located: Located,
        surroundings: Surroundings,
    ) -> Located | None:
        """The best other pose, to which the same features of the picture belong elsewhere on the ground; None
        when there is none.

        On ground that repeats itself every feature has its like some way off. All pairs near the pose found
        are left out, and what matches then is registered again.
        """
        columns = []
        exclusion = SAME_PLACE_PX * self.camera.width / REFERENCE_WIDTH_PX
        binary = self.extractor.metric is Metric.HAMMING
        limit = self.extractor.max_distance if binary else self.extractor.max_distance**2
        columns_of_query = np.ascontiguousarray(
            comparable(query.features.descriptors, self.extractor.metric).T
        )
        px = np.ascontiguousarray(query.features.px.T, np.float64)
        for number, reference in enumerate(references):
            usable = np.flatnonzero(np.isfinite(reference.points[:, 2]))
            points = reference.points[usable]
            found = self._seen(located.pose, points)
            if expected is None:
                middle, radii = found, np.full(len(usable), np.inf)
            else:
                middle = self._seen(expected[number].world_from_cam, points)
                radii = expected[number].radii_px[usable]
            descriptors = comparable(reference.features.descriptors[usable], self.extractor.metric)
            nearest, distance, back = _nearest_elsewhere(
                descriptors, columns_of_query, found, exclusion, middle, radii, px
            )
            a = np.flatnonzero((nearest >= 0) & (distance <= limit))
            a = a[back[nearest[a]] == a]
            columns.append(_matched(reference, query, usable[a], nearest[a], distance[a].astype(np.float64)))
        matches = _pooled(columns)
        other = self.registrar.register(
            matches.correspondences, query.attitude, surroundings.height_range_m, query.height
        )
        if isinstance(other, NotFound) or self._shows_the_same(
            located.pose, other.world_from_cam, references, exclusion
        ):
            return None
        return Located(other, matches)

    def _shows_the_same(self, one: Pose, other: Pose, references: list[Reference], limit_px: float) -> bool:
        """Whether two poses put what the camera sees at the same places of the picture: matches far off can
        fit such a pose where the ground is not as flat as the map has it."""
        points = np.concatenate([reference.points for reference in references])
        seen = self._seen(one, points)
        inside = ((seen >= 0) & (seen < (self.camera.width, self.camera.height))).all(axis=1)
        if not inside.any():
            return False
        moved = np.linalg.norm(self._seen(other, points[inside]) - seen[inside], axis=1)
        return bool(np.nanmedian(moved) <= limit_px)

    def is_strong(self, located: Located) -> bool:
        """Whether so much agrees that no second look is needed."""
        count = n_distinct(located)
        matched = len(np.unique(located.matches.correspondences.frame_index))
        return count >= self.settings.strong_inliers and count >= self.settings.strong_share * matched

    def covers(self, query: Query, references: list[Reference], located: Located) -> bool:
        """Whether inliers lie all over the ground that both views see, and not on one object of it."""
        cells = self._cells(query.features.px)
        seen = [self._cells(self._seen(located.pose, reference.points)) for reference in references]
        both = cells & np.logical_or.reduce(seen)
        rows = located.matches.correspondences.frame_index[located.estimate.inliers]
        agreed = both & self._cells(query.features.px[rows])
        return int(agreed.sum()) >= self.settings.least_cover * int(both.sum())

    def _cells(self, px: FloatArray | Float32Array) -> BoolArray:
        """Which cells of the picture hold one of the pixels (n, 2)."""
        cell = np.floor(px / (self.camera.width, self.camera.height) * CELLS)
        inside = ((cell >= 0) & (cell < CELLS)).all(axis=1)
        held = np.zeros(CELLS, np.bool_)
        held[tuple(cell[inside].astype(np.int64).T)] = True
        return held

    def constraint_of(
        self,
        located: Located,
        world_from_node: Pose,
        new_node: int,
        query: Query,
        height_m: float,
        bend_rad: float,
        depth_is_measured: bool,
    ) -> Constraint:
        """The revisit as a constraint to its main node, from that node's inliers alone if they are enough."""
        node = located.main_node
        estimate = located.estimate
        own = subset(located.matches.correspondences, located.inliers_of(node))
        if len(np.unique(own.frame_index)) >= self.settings.min_inliers:
            refined = self.registrar.refine(located.pose, own, query.tilt, None, estimate.score)
            if isinstance(refined, PoseEstimate):
                estimate = refined
        i_from_j = world_from_node.inverse() @ estimate.world_from_cam
        covariance = revisit_covariance(estimate.covariance, height_m)
        covariance = covariance + revisit_drift_covariance(i_from_j, height_m, bend_rad, depth_is_measured)
        return Constraint(
            node,
            new_node,
            i_from_j,
            information_of_constraint(covariance),
            ConstraintKind.REVISIT,
        )


def references_of(visual_map: VisualMap, nodes: IntArray) -> list[Reference]:
    """What nodes (k,) hold for a view to be registered with."""
    references = []
    for index in nodes:
        node = visual_map.nodes[int(index)]
        points, spread = visual_map.points_in_world(node), visual_map.spread_in_world(node)
        references.append(Reference(node.index, node.features, points, spread))
    return references


def surroundings_at(visual_map: VisualMap, nodes: IntArray, height_change: float) -> Surroundings:
    """What is known where nodes (k,) are; the height may differ by the factor."""
    around = [(visual_map.graph.pose(int(index)), visual_map.nodes[int(index)].tilt) for index in nodes]
    return surroundings_of(around, height_change)


def revisit_covariance(registration: FloatArray, height_m: float) -> FloatArray:
    """(6, 6) of a revisit from that of its registration, which takes the errors of points to be independent
    and small."""
    floor = np.diag([(SHIFT_SHARE * height_m) ** 2] * 3 + [TURN_RAD**2] * 3)
    return np.asarray(TOGETHER * registration + floor)


def n_distinct(located: Located) -> int:
    """Features of the picture among the inliers; one can match points of several nodes."""
    return len(np.unique(located.matches.correspondences.frame_index[located.estimate.inliers]))


def best_matched(located: Located, count: int) -> IntArray:
    """Rows (count,) of a new node's features: those that odometry found again first, best matched first,
    then the others."""
    if located.px is None:
        first = located.matches.correspondences.frame_index[np.sort(located.estimate.inliers)]
    else:  # followed points are the node's first features, without an order among them
        first = np.arange(len(located.estimate.inliers))
    order = np.concatenate([first, np.arange(count)])
    _, places = np.unique(order, return_index=True)
    return np.asarray(order[np.sort(places)], np.int64)


def _matched(
    reference: Reference, query: Query, rows: IntArray, frame_rows: IntArray, distance: FloatArray
) -> tuple[np.ndarray, ...]:
    node = np.full(len(rows), reference.node)
    points, spread = reference.points[rows], reference.spread[rows]
    return points, query.rays[frame_rows], distance, rows, frame_rows, node, spread


def _pooled(columns: list[tuple[np.ndarray, ...]]) -> PooledMatches:
    """Matches with several nodes as one, sorted by descriptor distance."""
    points, rays, distance, map_index, frame_index, node, spread = (
        np.concatenate(column) for column in zip(*columns, strict=True)
    )
    order = np.argsort(distance, kind="stable")
    order = order[np.isfinite(rays[order, 0])]
    correspondences = Correspondences(
        points[order], rays[order], distance[order], map_index[order], frame_index[order], spread[order]
    )
    return PooledMatches(correspondences, node[order])


@njit(cache=True, nogil=True)
def _nearest_elsewhere(a, b_columns, found, exclusion, middle, radii, px):  # type: ignore[no-untyped-def]
    """For each of a (n, d) the nearest of b_columns (d, m), and back, among pairs further than the exclusion
    from where the pose found puts them and within the radii of the middle; -1 where there is none."""
    n, m = len(a), b_columns.shape[1]
    nearest_b, nearest_a = np.full(n, -1, np.int64), np.full(m, -1, np.int64)
    distance, distance_b = np.full(n, np.inf, np.float32), np.full(m, np.inf, np.float32)
    row, allowed = np.empty(m, b_columns.dtype), np.empty(m, np.float32)
    for i in range(n):
        if not np.isfinite(middle[i, 0]):
            continue
        distances_kernel(a, i, b_columns, row)
        for j in range(m):  # without branches, so that it runs along whole vectors
            near = (px[0, j] - found[i, 0]) ** 2 + (px[1, j] - found[i, 1]) ** 2
            off = (px[0, j] - middle[i, 0]) ** 2 + (px[1, j] - middle[i, 1]) ** 2
            # Points behind the camera are near nothing.
            left_out = (near <= exclusion**2) | (not off <= radii[i] ** 2)
            allowed[j] = np.float32(np.inf) if left_out else np.float32(row[j])
        for j in range(m):
            if allowed[j] < distance[i]:
                distance[i], nearest_b[i] = allowed[j], j
            if allowed[j] < distance_b[j]:
                distance_b[j], nearest_a[j] = allowed[j], i
    return nearest_b, distance, nearest_a
