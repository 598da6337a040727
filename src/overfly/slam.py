"""The heart: one frame in, its pose out, the map grown (paper, section IV).

"Every time a new image is acquired, we compute the current pose of the camera based on both visual odometry and place
revisiting and augment the graph accordingly." No input or output here; pipeline.py feeds and saves.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from overfly.config import Config
from overfly.geometry.poses import FloatArray, Pose
from overfly.start import Start, begin_height, first_pose, range_height
from overfly.sighting import Sighting, first_sighting, followed_sighting, matched_sighting
from overfly.types import Frame, NotFound, Reason, Rig, ScaleLandmark, UInt8Array
from overfly.vision.alignment import build_pyramid
from overfly.vision.depth import RELIEF_SHARE, DepthFinder, height_above_points
from overfly.vision.features import create_extractor
from overfly.vision.motion import ConstantVelocity, moved_enough
from overfly.vision.observation import Observation, working_rig
from overfly.vision.odometry import Located, Reference, constraints_to_nodes, locate_against
from overfly.vision.refine import HeightPrior
from overfly.vision.registration import create_registrar
from overfly.vision.tracking import Anchor, TrackedPoints, Tracker
from overfly.visual_map import Node, VisualMap
from overfly.window import LARGEST_RELIEF, LEAST_RELIEF, adjust_window

RETAINED_PICTURES = 8  # nodes whose pictures are kept for tracking
HELD_SHARE = 1e-3  # of its height: how firmly the first node holds the scale of the map


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """What became of one frame: its pose world_from_cam with covariance (6, 6), or the reason why there is none."""

    t_ns: int
    pose: Pose | None
    reason: Reason | None = None
    detail: str = ""
    covariance: FloatArray | None = None
    n_features: int = 0
    n_matches: int = 0
    n_inliers: int = 0
    rms_px: float = math.nan
    node: int | None = None  # set when the frame became a node
    timings_s: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class FrameRecord:
    """Where a located frame hangs in the graph, so that its pose follows when the graph is optimised.

    online: world_from_cam as it was known when the frame had just been processed; never rewritten.
    """

    frame_index: int
    t_ns: int
    node: int
    node_from_cam: Pose
    online: Pose


class Slam:
    """Simultaneous localisation and mapping for one rig. Feed it frames in the order of time."""

    def __init__(self, rig: Rig, config: Config | None = None, landmark: ScaleLandmark | None = None) -> None:
        self.config = config or Config()
        self.source_rig = rig
        self.rig = working_rig(rig, self.config.features.max_width_px)
        self.map = VisualMap()
        self.records: list[FrameRecord] = []
        self.start: Start | None = None
        self._landmark = landmark
        self._extractor = create_extractor(self.config.features.extractor, self.config.features.count)
        self._registrar = create_registrar(self.rig, self.config, self._extractor.max_distance)
        self._depth = DepthFinder(self.rig)
        self._motion = ConstantVelocity()
        self._tracker = Tracker(self.rig.cam0.camera, self._registrar, self.config.tracking)
        self._pyramids: dict[int, list[UInt8Array]] = {}  # of the newest nodes, for tracking
        self._relief = RELIEF_SHARE  # of the ground about its plane, as a share of the height; learnt
        self._timings: dict[str, float] = {}

    def process(self, frame: Frame) -> FrameResult:
        """Locate one frame; make it a node of the map if it shows enough that is new."""
        self._timings = {}
        view = Observation(frame, self.rig, self._extractor, self._registrar.tilt_prior(frame.attitude))
        if not self.map.nodes:
            return self._begin(view)
        with self._timed("tracking"):
            located = self._follow(view)
        if isinstance(located, NotFound):
            with self._timed("features"):
                n_features = len(view.features)
            with self._timed("odometry"):
                located = self._locate(view)
        if isinstance(located, NotFound):
            self._motion.lose()
            self._tracker.forget()
            return FrameResult(
                frame.t_ns,
                None,
                located.reason,
                located.detail,
                n_features=n_features,
                timings_s=self._timings,
            )
        node = None
        if self._shows_enough_new(located):
            with self._timed("node"):
                node = self._extend(view, located)
        pose = located.pose if node is None else self.map.graph.pose(node)
        self._motion.update(frame.t_ns, pose)
        self._tracker.remember(view, located)
        self._record(frame, located.main_node if node is None else node, pose)
        estimate = located.estimate
        return FrameResult(
            frame.t_ns,
            pose,
            covariance=estimate.covariance,
            n_matches=len(located.matches.correspondences),
            n_inliers=len(estimate.inliers),
            rms_px=estimate.rms_px,
            node=node,
            timings_s=self._timings,
        )

    @property
    def measures_depth(self) -> bool:
        """Whether the map's points were measured, not assumed to lie on flat ground."""
        return self._depth.is_metric

    def pose_of(self, record: FrameRecord) -> Pose:
        """world_from_cam of a located frame as the graph has it now."""
        return self.map.graph.pose(record.node) @ record.node_from_cam

    def rescale(self, factor: float, source: str) -> None:
        """Multiply all lengths, when a better source of scale was found after the fact."""
        self.map.rescale(factor)
        self.records = [
            replace(record, node_from_cam=record.node_from_cam.scaled(factor), online=record.online.scaled(factor))
            for record in self.records
        ]
        if self.start is not None:
            self.start = Start(self.start.height_m * factor, self.start.level_from_cam, source)

    # -- the steps of process

    def _begin(self, view: Observation) -> FrameResult:
        """The first frame: it needs features and a height, and becomes the first node."""
        frame = view.frame
        settings = self.config.registration
        if len(view.features) < settings.min_inliers:
            return FrameResult(frame.t_ns, None, Reason.FEW_FEATURES, f"{len(view.features)} features")
        measured = self._depth.measured(view, view.features.px)
        if measured is not None:
            height = height_above_points(measured.points_in_cam, view.tilt.level_from_cam)
            if not math.isfinite(height):
                return FrameResult(frame.t_ns, None, Reason.FEW_MATCHES, "no stereo matches")
            self.start = Start(height, view.tilt.level_from_cam, "stereo")
        else:
            self.start = begin_height(frame, self.rig, view.tilt, self.config, self._landmark)
        yaw = frame.attitude.yaw_rad if frame.attitude else None
        pose = first_pose(self.start, yaw)
        sigma = self._registrar.pixels(self.config.registration.localisation_px)
        self._add_node(view, pose, first_sighting(view, self.map, sigma))
        self._motion.update(frame.t_ns, pose)
        self._record(frame, 0, pose)
        return FrameResult(frame.t_ns, pose, n_features=len(view.features), node=0, timings_s=self._timings)

    def _follow(self, view: Observation) -> Located | NotFound:
        """The pose from points followed since the last frame, without descriptors."""
        last = self._motion.last_pose
        if not self.config.tracking.enabled or last is None:
            return NotFound(Reason.FEW_MATCHES, "points are not followed")
        predicted = self._motion.predict(view.frame.t_ns)
        return self._tracker.track(view, *self._followable(), last, predicted, self._height(view))

    def _followable(self) -> tuple[TrackedPoints, dict[int, Anchor]]:
        """Points of the previous n nodes, and the nodes whose pictures are at hand."""
        points = self.map.points_to_follow(self.map.previous(self.config.nodes.previous), self._pyramids)
        return points, {
            node: Anchor(pyramid, self.map.graph.pose(node)) for node, pyramid in self._pyramids.items()
        }

    def _settle(self, view: Observation, located: Located) -> Located:
        """The same pose, made exact by aligning patches where the nodes' pictures are at hand."""
        if not self.config.tracking.enabled or located.main_node not in self._pyramids:
            return located
        settled = self._tracker.settle(view, *self._followable(), located.pose, self._height(view))
        return settled if isinstance(settled, Located) else located

    def _locate(self, view: Observation) -> Located | NotFound:
        """The pose against the previous n nodes; when that fails, against all others, nearest first."""
        predicted = self._motion.predict(view.frame.t_ns)
        height = self._height(view)
        previous = [node.index for node in self.map.previous(self.config.nodes.previous)]
        outcome = self._locate_against(view, previous, predicted, height)
        if isinstance(outcome, Located):
            return self._settle(view, outcome)
        last = self._motion.last_pose
        if last is None:
            return outcome
        distance = np.linalg.norm(self.map.graph.positions[:, :2] - last.translation[:2], axis=1)
        for node in np.argsort(distance, kind="stable"):
            if int(node) not in previous:
                elsewhere = self._locate_against(view, [int(node)], None, height)
                if isinstance(elsewhere, Located):
                    return elsewhere
        return outcome

    def _locate_against(
        self, view: Observation, nodes: list[int], predicted: Pose | None, height: HeightPrior | None
    ) -> Located | NotFound:
        references = [
            Reference(
                index,
                self.map.nodes[index].features,
                self.map.points_in_world(self.map.nodes[index]),
                self.map.spread_in_world(self.map.nodes[index]),
            )
            for index in nodes
        ]
        change = self.config.registration.height_change
        z = self.map.graph.positions[nodes, 2]
        return locate_against(
            view,
            references,
            self._extractor,
            self._registrar,
            predicted,
            (float(z.min()) / change, float(z.max()) * change),
            height,
        )

    def _height(self, view: Observation) -> HeightPrior | None:
        """Height by the range sensor, where there is no stereo."""
        if self._depth.is_metric:
            return None
        return range_height(view.frame, self.rig, view.tilt.level_from_cam, 0.0)

    def _shows_enough_new(self, located: Located) -> bool:
        world_from_node = self.map.graph.pose(located.main_node)
        heights = (float(world_from_node.translation[2]), float(located.pose.translation[2]))
        node = self.map.nodes[located.main_node]
        n_left = len(located.inliers_of(located.main_node))
        node.n_continued = max(node.n_continued, n_left)
        return n_left < self.config.nodes.overlap * node.n_continued or moved_enough(
            world_from_node, located.pose, heights, self.rig.cam0.camera, self.config.nodes
        )

    def _extend(self, view: Observation, located: Located) -> int:
        """Make the frame a node, tied by constraints to the nodes it was located against."""
        sigma = self._registrar.pixels(self.config.registration.localisation_px)
        localisation_px = self.config.registration.localisation_px
        if located.px is None:
            sighting = matched_sighting(view, located, self.map, sigma)
        else:
            localisation_px = self.config.tracking.localisation_px
            sigmas = (self._registrar.pixels(localisation_px), sigma)
            sighting = followed_sighting(view, located, self.map, sigmas, self.config.features.count)
        index = self._add_node(view, located.pose, sighting, located.main_node)
        poses = {node: self.map.graph.pose(node) for node in located.nodes()}
        for constraint in constraints_to_nodes(located, poses, index, self._registrar, view.tilt, localisation_px):
            number = self.map.graph.add_constraint(constraint)
            if constraint.i == located.main_node:
                self.map.nodes[index].constraint = number
        if self.config.window.nodes:
            with self._timed("window"):
                self._adjust_window()
        return index

    def _adjust_window(self) -> None:
        height = float(self.map.graph.positions[-1, 2])
        relief = None if self.measures_depth else self._relief * height
        seen = adjust_window(
            self.map,
            self.config.window,
            self._depth.inverse_depth_sigma,
            relief,
        )
        if seen is not None and not self.measures_depth:  # the ground is as flat as it turns out to be
            self._relief += 0.3 * (min(max(seen / height, LEAST_RELIEF), LARGEST_RELIEF) - self._relief)

    def _add_node(self, view: Observation, pose: Pose, sighting: Sighting, parent: int = -1) -> int:
        depth = self._depth.find(view, sighting.features.px, sighting.rays, pose, view.tilt.sigma_rad)
        number = len(self.map)
        own = sighting.anchor < 0
        node = Node(
            number,
            view.frame.index,
            view.frame.t_ns,
            sighting.features,
            sighting.rays,
            depth.points_in_cam,
            depth.depth_sigma_m,
            1.0 / depth.points_in_cam[:, 2] if self.measures_depth else np.full(len(own), np.nan),
            sighting.ray_sigma,
            sighting.tracks,
            np.where(own, number, sighting.anchor),
            np.where(own, np.arange(len(own)), sighting.anchor_row),
            view.tilt,
            self._height(view) if parent >= 0 else HeightPrior(float(pose.translation[2]), HELD_SHARE * float(pose.translation[2])),
            parent,
        )
        self.map.add_node(node, pose)
        self._pyramids[number] = build_pyramid(view.gray)
        self._pyramids.pop(number - RETAINED_PICTURES, None)
        return number

    def _record(self, frame: Frame, node: int, pose: Pose) -> None:
        node_from_cam = self.map.graph.pose(node).inverse() @ pose
        self.records.append(FrameRecord(frame.index, frame.t_ns, node, node_from_cam, pose))

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        self._timings[stage] = self._timings.get(stage, 0.0) + time.perf_counter() - begin
