"""Where a camera is in a map that exists (contract: overfly locate). The map is not changed.

The first frame is searched for in the whole map, without a prior; from then on the nodes below the place
where the motion so far puts the camera are matched first. What is not certain is "lost", with the reason.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from overfly.config import Config
from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.online import OnlineOptimiser
from overfly.mapstore import Map
from overfly.revisit.drift import map_bend, revisit_drift_covariance
from overfly.revisit.places import Places
from overfly.revisit.pool import Expectation
from overfly.revisit.region import ground_places, on_ground
from overfly.revisit.verification import (
    Query,
    Verifier,
    n_distinct,
    pool_of_nodes,
    revisit_covariance,
    surroundings_at,
)
from overfly.types import Constraint, Frame, IntArray, NotFound, Reason, Rig
from overfly.vision.features import create_extractor
from overfly.vision.motion import ConstantVelocity
from overfly.vision.observation import Observation, feature_count, working_rig
from overfly.vision.odometry import GUIDED_RADIUS, Located
from overfly.vision.registration import create_registrar
from overfly.visual_map import Node

HEIGHT_CHANGE = 2.5  # factor by which the height above ground may differ from that of the map
NEAREST = 3  # nodes that a frame is matched with where it is expected


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """Where one frame was taken, or why that is not known.

    pose: world_from_cam in the map; covariance (6, 6) of the perturbation world_from_cam @ Pose.exp(x), x =
    (translation, rotation) in the camera frame, against the nodes of the map about it; node: the one that
    most inliers come from; searched: found anywhere in the map, not followed from the frame before.
    """

    t_ns: int
    pose: Pose | None
    covariance: FloatArray | None = None
    reason: Reason | None = None
    detail: str = ""
    node: int | None = None
    n_inliers: int = 0
    searched: bool = False
    latency_ms: float = 0.0


class SettledGraph(OnlineOptimiser):
    """A graph that stays as it is: where its nodes are against each other is not in question."""

    def covariance(self, node: int) -> FloatArray:  # noqa: ARG002  the same for all
        return np.zeros((6, 6))

    def relative_covariance(self, i: int, j: int) -> FloatArray:  # noqa: ARG002
        return np.zeros((6, 6))

    def relative_covariances(self, nodes: Sequence[int], j: int) -> FloatArray:  # noqa: ARG002
        return np.zeros((len(nodes), 6, 6))


class Localizer:
    """Finds frames of one rig in a map, in the order of time."""

    def __init__(self, known: Map, rig: Rig | None = None, config: Config | None = None) -> None:
        """rig: of the frames to come, that of the map by default. config: settings, those of the map by
        default.

        Raises ConfigError when the settings name other features than the map has.
        """
        config = config or known.config
        near = config.registration.model_copy(update={"height_change": HEIGHT_CHANGE})
        self.config = config.model_copy(update={"registration": near, "features": known.config.features})
        self.map = known.visual
        self.rig = working_rig(rig or known.rig, self.config.features.max_width_px)
        camera = self.rig.cam0.camera
        self._extractor = create_extractor(
            self.config.features.extractor, feature_count(self.rig, self.config.features.count)
        )
        self._registrar = create_registrar(self.rig, self.config, self._extractor.max_distance)
        self._verifier = Verifier(camera, self._extractor, self._registrar, self.config.revisit)
        settled = SettledGraph(self.map.graph)
        self._places = Places(self.map, settled, self._verifier, self.config.revisit)
        self._bend_rad = map_bend(self.map)
        self._measured = any(np.isfinite(node.inverse_depth).any() for node in self.map.nodes)
        self._motion = ConstantVelocity()
        self._is_lost = True
        self._heights = np.array([_height_above_ground(node, known) for node in known.visual.nodes])
        self._placed = np.flatnonzero(known.main_piece())
        places = ground_places(self.map.graph, self._placed, self._heights[self._placed])
        self._ground = KDTree(places) if len(known) else None
        self._places.prepare()  # now, so that no frame has to wait for it

    def observe(self, frame: Frame) -> Observation:
        """A frame ready for locate, with its features. This depends on nothing but the frame, and may be done
        ahead of time in another thread.
        """
        view = Observation(frame, self.rig, self._extractor, self._registrar.tilt_prior(frame.attitude))
        view.prepare(features=True)
        return view

    def locate(self, frame: Frame | Observation) -> Fix:
        """The pose of a frame in the map, or why there is none."""
        view = frame if isinstance(frame, Observation) else self.observe(frame)
        frame = view.frame
        began = time.perf_counter()
        located, searched = self._locate(view)
        latency_ms = 1e3 * (view.prepared_s + time.perf_counter() - began)
        if isinstance(located, NotFound):
            self.forget()
            return Fix(frame.t_ns, None, None, located.reason, located.detail, None, 0, searched, latency_ms)
        self._is_lost = False
        self._motion.update(frame.t_ns, located.pose)
        return Fix(
            frame.t_ns,
            located.pose,
            self._covariance(located),
            node=located.main_node,
            n_inliers=n_distinct(located),
            searched=searched,
            latency_ms=latency_ms,
        )

    def search(self, query: Query, t_ns: int) -> Located | NotFound:
        """What a camera sees, anywhere in the map."""
        located, _ = self._places.relocalise(
            query, t_ns, self._placed if len(self._placed) < len(self.map) else None
        )
        return located

    def tie(self, located: Located, query: Query, new_node: int) -> Constraint:
        """Where something was found, as a constraint from its main node to a new one."""
        node = located.main_node
        height = float(self._heights[node])
        pose = self.map.graph.pose(node)
        return self._verifier.constraint_of(
            located, pose, new_node, query, height, self._bend_rad, self._measured
        )

    def forget(self) -> None:
        """The camera was carried elsewhere: the next frame is searched for in the whole map."""
        self._is_lost = True
        self._motion.lose()

    def _covariance(self, located: Located) -> FloatArray:
        """That of the registration, and what the map about the node is wrong by."""
        node = located.main_node
        height = float(self._heights[node])
        node_from_cam = self.map.graph.pose(node).inverse() @ located.pose
        drift = revisit_drift_covariance(node_from_cam, height, self._bend_rad, self._measured)
        return revisit_covariance(located.estimate.covariance, height) + drift

    def _locate(self, view: Observation) -> tuple[Located | NotFound, bool]:
        """The pose, and whether the whole map was searched for it."""
        if len(view.features) < self.config.registration.min_inliers:
            return NotFound(Reason.FEW_FEATURES, f"{len(view.features)} features"), False
        query = Query(view.features, view.rays, view.frame.attitude, view.tilt)
        predicted = None if self._is_lost else self._motion.predict(view.frame.t_ns)
        if predicted is not None:
            followed = self._match_near(query, predicted)
            if isinstance(followed, Located):
                return followed, False
        return self.search(query, view.frame.t_ns), True

    def _match_near(self, query: Query, predicted: Pose) -> Located | NotFound:
        """Against the nodes whose views lie nearest to where the camera should look, and near where points
        should be."""
        nodes = self._nearest_nodes(predicted)
        pool = pool_of_nodes(self.map, nodes, self._extractor.metric)
        radius = GUIDED_RADIUS * self.rig.cam0.camera.width
        expected = Expectation(predicted, np.full(len(pool.points), radius))
        surroundings = surroundings_at(self.map, nodes, HEIGHT_CHANGE)
        located, _ = self._verifier.register(query, pool, expected, surroundings)
        if isinstance(located, NotFound):
            return located
        rival = self._verifier.rival(query, pool, expected, located.pose, surroundings)
        most = self.config.revisit.rival_share * n_distinct(located)
        if rival is not None and n_distinct(rival) >= most:
            return NotFound(Reason.IMPLAUSIBLE, "another pose fits as well")
        return located

    def _nearest_nodes(self, predicted: Pose) -> IntArray:
        if self._ground is None:
            return np.empty(0, np.int64)
        # The ground is as high there as below the nearest node.
        _, nearest = self._ground.query(predicted.translation[:2])
        beside = self._placed[nearest]
        height = predicted.translation[2] - self.map.graph.positions[beside, 2] + self._heights[beside]
        _, found = self._ground.query(on_ground(predicted, float(height)), min(NEAREST, len(self._placed)))
        return self._placed[np.atleast_1d(np.asarray(found, np.int64))]


def _height_above_ground(node: Node, known: Map) -> float:
    """Metres: median depth of the node's points."""
    depth = node.points_in_cam[node.has_point, 2]
    return float(np.median(depth)) if len(depth) else float(known.visual.graph.positions[node.index, 2])
