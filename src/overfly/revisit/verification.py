"""Whether a camera really sees the ground of an older node: registration, geometry, and that nothing else
fits as well."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from overfly.config import RevisitSettings
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.revisit.drift import revisit_drift_covariance
from overfly.revisit.pool import Expectation, Pool, match_pool, pool_of
from overfly.types import (
    Attitude,
    BoolArray,
    Constraint,
    ConstraintKind,
    Features,
    Float32Array,
    IntArray,
    NotFound,
    PoseEstimate,
    Reason,
)
from overfly.vision.features import Extractor
from overfly.vision.features.interface import Metric
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

    @property
    def px_scale(self) -> float:
        """Pixels of this camera's pictures that are one of a picture 320 wide."""
        return self.camera.width / REFERENCE_WIDTH_PX

    def register(
        self,
        query: Query,
        pool: Pool,
        expected: Expectation | None,
        surroundings: Surroundings,
    ) -> tuple[Located | NotFound, int]:
        """The pose against some nodes that see one piece of ground, and the number of matches.

        expected: None where points may be anywhere.
        """
        return self._judge(query, self.match(query, pool, expected), surroundings)

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

    def match(self, query: Query, pool: Pool, expected: Expectation | None) -> PooledMatches:
        """Mutual nearest neighbours with each node, pooled and sorted by descriptor distance."""
        metric, limit = self.extractor.metric, self.extractor.max_distance
        if expected is None:
            return match_pool(pool, query.features, query.rays, metric, limit)
        middle = self._seen(expected.world_from_cam, pool.points)
        return match_pool(pool, query.features, query.rays, metric, limit, middle, expected.radii_px)

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
        if _least_spread(query.features.px[rows]) < settings.min_spread * self.camera.width:
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
        pool: Pool,
        expected: Expectation | None,
        known: Pose,
        surroundings: Surroundings,
        fewest: int = 0,
    ) -> Located | None:
        """The best pose other than the known one, to which the same features of the picture belong elsewhere
        on the ground; None when there is none, or none with as many inliers as fewest.

        On ground that repeats itself every feature has its like some way off. All pairs near the known pose
        are left out, and what matches then is registered again.
        """
        exclusion = SAME_PLACE_PX * self.px_scale
        metric, limit = self.extractor.metric, self.extractor.max_distance
        seen = self._seen(known, pool.points)
        middle = None if expected is None else self._seen(expected.world_from_cam, pool.points)
        radii = None if expected is None else expected.radii_px
        matches = match_pool(pool, query.features, query.rays, metric, limit, middle, radii, seen, exclusion)
        if count_distinct(matches.correspondences.frame_index) < fewest:
            return None
        other = self.registrar.register(
            matches.correspondences, query.attitude, surroundings.height_range_m, query.height
        )
        if isinstance(other, NotFound) or self._shows_the_same(seen, other.world_from_cam, pool, exclusion):
            return None
        return Located(other, matches)

    def n_in_view(self, world_from_cam: Pose, points: FloatArray) -> int:
        """How many of points (n, 3), metres, world, a camera sees."""
        return int(self._is_inside(self._seen(world_from_cam, points)).sum())

    def _is_inside(self, px: FloatArray) -> BoolArray:
        return np.asarray(((px >= 0) & (px < (self.camera.width, self.camera.height))).all(axis=1))

    def _shows_the_same(self, seen: FloatArray, other: Pose, pool: Pool, limit_px: float) -> bool:
        """Whether another pose puts what the camera sees at the same places (n, 2) of the picture: matches
        far off can fit such a pose where the ground is not as flat as the map has it."""
        inside = self._is_inside(seen)
        if not inside.any():
            return False
        moved = np.linalg.norm(self._seen(other, pool.points[inside]) - seen[inside], axis=1)
        return bool(np.nanmedian(moved) <= limit_px)

    def is_strong(self, located: Located) -> bool:
        """Whether so much agrees that no second look is needed."""
        count = n_distinct(located)
        matched = count_distinct(located.matches.correspondences.frame_index)
        return count >= self.settings.strong_inliers and count >= self.settings.strong_share * matched

    def covers(self, query: Query, pool: Pool, located: Located) -> bool:
        """Whether inliers lie all over the ground that both views see, and not on one object of it."""
        cells = self._cells(query.features.px)
        both = cells & self._cells(self._seen(located.pose, pool.points))
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
        if count_distinct(own.frame_index) >= self.settings.min_inliers:
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


def pool_of_nodes(visual_map: VisualMap, nodes: IntArray, metric: Metric) -> Pool:
    """What nodes (k,) hold for a view to be registered with."""
    references = []
    for index in nodes:
        node = visual_map.nodes[int(index)]
        points, spread = visual_map.points_in_world(node), visual_map.spread_in_world(node)
        references.append(Reference(node.index, node.features, points, spread))
    return pool_of(references, metric)


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
    return count_distinct(located.matches.correspondences.frame_index[located.estimate.inliers])


def count_distinct(rows: IntArray) -> int:
    """How many different rows there are among some (n,)."""
    return int(np.count_nonzero(np.bincount(rows)))


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


def _least_spread(px: Float32Array) -> float:
    """Standard deviation of pixels (n, 2) from their middle, in the direction in which it is least."""
    x, y = (px.astype(np.float64) - px.mean(axis=0, dtype=np.float64)).T
    xx, xy, yy = (float(product) / (len(px) - 1) for product in (x @ x, x @ y, y @ y))
    return math.sqrt(max(0.5 * (xx + yy) - math.hypot(0.5 * (xx - yy), xy), 0.0))
