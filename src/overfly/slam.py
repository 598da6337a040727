"""The heart: one frame in, its pose out, the map grown (paper, section IV).

"Every time a new image is acquired, we compute the current pose of the camera based on both visual odometry
and place revisiting and augment the graph accordingly." No input or output here; pipeline feeds and saves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from overfly.adjustment import Instruments, Positions, adjust_map
from overfly.adjustment_report import AdjustmentReport
from overfly.attitude_clock import AttitudeAt, ClockLag, set_attitude_clock
from overfly.attitude_hold import hold_attitude
from overfly.config import AttitudeUse, Config
from overfly.frame_records import (
    FrameRecord,
    FrameRecords,
    Seen,
    gap_covariance,
    scaled,
    seen_by,
    seen_by_another,
    settle,
)
from overfly.frame_result import FrameResult
from overfly.gaps import Gaps
from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.online import OnlineOptimiser
from overfly.gyroscope import Gyroscope, gyroscope_of
from overfly.locator import Locator
from overfly.map_points import Comparison
from overfly.mapper import Mapper
from overfly.pieces import Reckoned, main_piece
from overfly.range_offset import RangeLog
from overfly.revisit.outcome import Revisit, RevisitStatus
from overfly.revisit.places import Places
from overfly.revisit.verification import Query, Verifier, best_matched
from overfly.scale import WITHOUT_OWN_METRE, ScaleKeeper, size_ratio
from overfly.self_calibration import RefinedCamera, refined_camera, refined_rig, refines_camera
from overfly.start import Start, range_height
from overfly.timing import Stopwatch
from overfly.types import (
    BoolArray,
    ConstraintKind,
    Frame,
    ImuRecord,
    IntArray,
    NotFound,
    Rig,
    ScaleLandmark,
)
from overfly.vision.features import create_extractor
from overfly.vision.observation import Observation, feature_count, working_landmark, working_rig
from overfly.vision.odometry import Located
from overfly.vision.registration import create_registrar
from overfly.vision.rig_bend import bent_rig
from overfly.visual_map import VisualMap


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """Where a frame has come to stand in the map.

    located: as it was found; pose: world_from_cam, after what the map learnt from the frame; node: that it
    became; world_from_old: how the map about the camera moved meanwhile, None if it did not.
    """

    located: Located
    pose: Pose
    node: int | None = None
    revisit: Revisit | None = None
    world_from_old: Pose | None = None


class Slam:
    """Simultaneous localisation and mapping for one rig. Feed it frames in the order of time."""

    def __init__(
        self,
        rig: Rig,
        config: Config | None = None,
        landmark: ScaleLandmark | None = None,
        attitude_at: AttitudeAt | None = None,
        read_imu: Callable[[], ImuRecord | None] | None = None,
    ) -> None:
        """attitude_at: the attitude sensor's whole record, by which its clock is set in the end. read_imu:
        the inertial unit's, whose gyroscope tells in the end how the camera turned from node to node.
        """
        self.config = config or Config()
        self.source_rig = rig
        self.rig = working_rig(rig, self.config.features.max_width_px)
        self.map = VisualMap()
        self.records = FrameRecords()
        self.is_finished = False  # nothing was processed since the map was finished
        self.adjustment: AdjustmentReport | None = None  # what the last adjustment of the whole map did
        self.refined_camera: RefinedCamera | None = None
        self._refines_camera = refines_camera(rig, self.config.adjustment)
        self.rig_turn_rad = np.zeros(3)  # by which the second camera's calibration was corrected
        self.attitude_at = attitude_at
        self._read_imu = read_imu
        self.attitude_lag: ClockLag | NotFound | None = None  # None: not looked for
        self._scale: ScaleKeeper | None = None
        self._ranges = RangeLog()
        self._watch = Stopwatch()
        self._extractor = create_extractor(
            self.config.features.extractor, feature_count(self.rig, self.config.features.count)
        )
        self._registrar = create_registrar(self.rig, self.config, self._extractor.max_distance)
        self._optimiser = OnlineOptimiser(self.map.graph)
        verifier = Verifier(self.rig.cam0.camera, self._extractor, self._registrar, self.config.revisit)
        self._places = Places(self.map, self._optimiser, verifier, self.config.revisit)
        seen = working_landmark(landmark, rig, self.rig) if landmark else None
        self._mapper = Mapper(
            self.map, self.rig, self.config, self._registrar, self._optimiser, seen, self._watch
        )
        self._gaps = Gaps(self.map, self._mapper, self._extractor, self._registrar, self.config.pieces)
        self._locator = Locator(
            self.map, self.rig, self.config, self._extractor, self._registrar, self._places,
            self._mapper.height, self._watch,
        )  # fmt: skip

    def observe(self, frame: Frame) -> Observation:
        """A frame ready for process: gray, of working size, with its pyramid. This depends on nothing but the
        frame, and may be done ahead of time in another thread.
        """
        view = Observation(frame, self.rig, self._extractor, self._registrar.tilt_prior(frame.attitude))
        view.prepare(features=not self.config.tracking.enabled)
        return view

    def process(self, frame: Frame | Observation) -> FrameResult:
        """Locate one frame; make it a node of the map if it shows enough that is new."""
        self._watch.restart()
        view = frame if isinstance(frame, Observation) else self.observe(frame)
        frame = view.frame
        self._watch.seconds["preparing"] = view.prepared_s
        self.is_finished = False
        if not self.map.nodes:
            return self._begin(view)
        # The current pose, by visual odometry or, when that fails, from any place of the map.
        located = self._locator.locate(view)
        if isinstance(located, NotFound):
            self._locator.lose()
            way_on = self._gaps.way_on(view, self.records)
            return self._lost(frame, located) if way_on is None else self._begin_piece(view, *way_on)
        self._gaps.found()
        # Augment the graph, if the frame shows enough that is new: by odometry, and by the place if it was
        # seen before.
        stand = Standing(located, located.pose, revisit=self._locator.revisit)
        if self._mapper.shows_enough_new(located):
            stand = self._go_on_from_known_ground(view, located) or self._extend(view, located)
        else:
            self._places.tend()
        self._locator.remember(view, stand.located, stand.pose)
        self._record(frame, stand)
        self._keep_scale(view, stand.pose)
        return self._found(frame, stand)

    def _go_on_from_known_ground(self, view: Observation, located: Located) -> Standing | None:
        """When older nodes show the same, the map needs no new one: they are tied, where they disagree, to
        those that the camera came from, and odometry goes on from them. None where there are none."""
        known = self._locator.recognise(view, located)
        if known is None:
            return None
        revisit, world_from_old = self._locator.revisit, Pose.identity()
        if known.tie is not None:
            before = self.map.graph.pose(known.tie.i)
            with self._watch.stage("revisit"):
                revisit = self._places.enter(known.tie)
            world_from_old = self.map.graph.pose(known.tie.i) @ before.inverse()
            if revisit.status is not RevisitStatus.ACCEPTED:
                return None
        self._locator.go_on_from(known)
        return Standing(
            known.located,
            world_from_old @ known.located.pose,
            revisit=revisit,
            world_from_old=world_from_old if revisit is not None and revisit.moved else None,
        )

    def _extend(self, view: Observation, located: Located) -> Standing:
        """Make the frame a node, and look for its place among the older ones."""
        index = self._mapper.extend(view, located, self._mapper.height(view))
        revisit, world_from_old = self._locator.revisit, None
        if self.config.revisit.enabled:
            before = self.map.graph.pose(index)
            sought = self._seek_revisit(
                view, index, best_matched(located, len(self.map.nodes[index].features))
            )
            revisit = revisit or sought
            world_from_old = self.map.graph.pose(index) @ before.inverse() if sought.moved else None
        return Standing(located, self.map.graph.pose(index), index, revisit, world_from_old)

    @property
    def start(self) -> Start | None:
        """How the map began: the first height and where it came from; None before the first node."""
        return self._mapper.start

    @property
    def measures_depth(self) -> bool:
        """Whether the map's points were measured, not assumed to lie on flat ground."""
        return self._mapper.measures_depth

    def pose_of(self, record: FrameRecord) -> Pose:
        """world_from_cam of a located frame as the graph has it now."""
        return self.map.graph.pose(record.node) @ record.node_from_cam

    def covariance_at_hand(self, node: int) -> FloatArray | None:
        """(6, 6) of a node's pose in the map as far as it is known already: asking changes nothing."""
        return self._optimiser.covariance_at_hand(node)

    def main_piece(self) -> BoolArray:
        """(n,) whether a node belongs to the piece of the map in which most frames were located."""
        return main_piece(self.map.graph, np.array([record.node for record in self.records], np.int64))

    def placed(self) -> list[FrameRecord]:
        """Frames of the main piece. Where the others are against it is reckoned only, and not known."""
        is_placed = self.main_piece()
        return [record for record in self.records if is_placed[record.node]]

    def finish(self) -> None:
        """The flight is over: optimise the graph to the end, the attitude sensor judging what is level, and
        adjust all poses and points together."""
        if self.map.nodes and not self.is_finished:
            self._take_bent_rig()
            if self.attitude_at is not None and self.config.attitude.use is AttitudeUse.PRIOR:
                self.attitude_lag = set_attitude_clock(
                    self.map, self.records, self.attitude_at, self.rig.cam0, self._registrar.tilt_prior
                )
            hold_attitude(self.map, self.rig.cam0.body_from_cam.rotation)
            before = self.map.graph.positions.copy()
            self.adjust()
            if self.start is not None and self.start.source == "gps":
                # The metre is the whole flight's, and the adjustment knows it by one height only.
                self.rescale(size_ratio(before, self.map.graph.positions, self.main_piece()), "gps")
            self._optimiser.refresh()
            self.is_finished = True

    def _take_bent_rig(self) -> None:
        """What is made of the map from now on knows where the second camera really stands."""
        known = self._mapper.rig_turn_rad - self.rig_turn_rad
        if known.any():
            self.rig, self.source_rig = bent_rig(self.rig, known), bent_rig(self.source_rig, known)
            self.rig_turn_rad = self._mapper.rig_turn_rad

    def adjust(self, positions: Positions | None = None) -> AdjustmentReport | None:
        """Adjust all poses and points of the map together; frames between nodes follow. None where that is
        switched off or there is nothing to adjust.
        """
        if not self.config.adjustment.enabled:
            return None
        holds_height = self.start is not None and self.start.source == "range"
        readings = self._ranges.readings(self.records) if holds_height else None
        instruments = replace(
            self.instruments, refine_camera=self._refines_camera, ranges=readings, gyroscope=self._gyroscope
        )
        before = [self.map.graph.pose(index) for index in range(len(self.map))]
        self.adjustment = adjust_map(self.map, instruments, positions)
        if self.adjustment is not None:
            growth = self.adjustment.growth
            self._rescale_what_follows(growth)
            before = [pose.scaled(growth) for pose in before]
            if self._refines_camera:
                self._take_camera(self.adjustment)
            self.records = settle(self.map, self.records, before, self.ray_sigma)
        return self.adjustment

    @cached_property
    def _gyroscope(self) -> Gyroscope | None:
        """That of the inertial unit, if the flight has one; who believes no attitude sensor believes none."""
        if self._read_imu is None or self.config.attitude.use is AttitudeUse.NONE:
            return None
        return gyroscope_of(self._read_imu(), self.rig.cam0)

    @property
    def instruments(self) -> Instruments:
        """What measured the map."""
        comparison = Comparison(self.rig.cam0.camera, self._extractor.metric, self._extractor.max_distance)
        return Instruments(comparison, self._mapper.inverse_depth_sigma, self.measures_depth)

    @property
    def variance_factor(self) -> float:
        """What the covariances of the graph are to be multiplied with, as the finish of the map learnt it."""
        return 1.0 if self.adjustment is None else self.adjustment.odometry_variance

    @property
    def ray_sigma(self) -> float:
        """Standard deviation of a followed point's undistorted image coordinates."""
        return self._registrar.pixels(self.config.tracking.localisation_px)

    def _take_camera(self, report: AdjustmentReport) -> None:
        """From now on the camera is as the adjustment found it."""
        old = self.rig.cam0.camera
        self.rig = refined_rig(self.rig, report.camera_changes)
        self.source_rig = refined_rig(self.source_rig, report.camera_changes)
        self.records = seen_by_another(self.records, old, self.rig.cam0.camera)
        self.refined_camera = refined_camera(self.source_rig.cam0.camera, report.camera_covariance)

    def rescale(self, factor: float, source: str) -> None:
        """Multiply all lengths, when a better source of scale was found after the fact."""
        measured = self.start is not None and self.start.source == "range"
        self.map.rescale(factor, heights_are_measured=measured)
        self._rescale_what_follows(factor)
        self._mapper.rescale(factor, source)

    def _rescale_what_follows(self, factor: float) -> None:
        """All lengths of the map were multiplied; so are those of whatever was measured in it."""
        self.records = scaled(self.records, factor, np.ones(len(self.map), np.bool_))
        self._optimiser.refresh()
        self._places.rescale(factor)
        self._locator.rescale(factor)

    def lay_piece(self, is_moved: BoolArray, factor: float, new_from_old: Pose) -> None:
        """Put a piece of the map, nodes (n,), elsewhere: its lengths are multiplied, then it is moved."""
        measured = self.start is not None and self.start.source == "range"
        self.map.lay(is_moved, factor, new_from_old, heights_are_measured=measured)
        self.records = scaled(self.records, factor, is_moved)
        self._optimiser.refresh()

    def _keep_scale(self, view: Observation, pose: Pose) -> None:
        """Rescale the map when the other sensors agree on another metre than it began with."""
        height = range_height(view.frame, self.rig, view.tilt.level_from_cam, 0.0)
        if height is not None:
            self._ranges.add(view.frame.t_ns, height.z_m, height.sigma_m)
        if self._scale is None:
            return
        self._scale.observe(view.frame, self.rig, view.tilt.level_from_cam, pose)
        factor = self._scale.due_factor()
        if factor is not None:
            self.rescale(factor, self._scale.source)

    def _seek_revisit(self, view: Observation, index: int, first_rows: IntArray) -> Revisit:
        """Look for the place of a new node among older ones, by its features first_rows, best first; this may
        move the map."""
        node = self.map.nodes[index]
        query = Query(node.features, node.rays, view.frame.attitude, view.tilt, node.height)
        with self._watch.stage("revisit"):
            return self._places.seek(index, query, first_rows)

    def _begin(self, view: Observation) -> FrameResult:
        frame = view.frame
        pose = self._mapper.begin(view)
        if isinstance(pose, NotFound):
            return self._lost(frame, pose)
        self._locator.remember_first(view, pose)
        if self.start is not None and self.start.source in ("range", *WITHOUT_OWN_METRE):
            self._scale = ScaleKeeper(self.start.source)
        self._hang(frame, 0, pose)
        return FrameResult(frame.t_ns, pose, node=0, timings_s=self._watch.seconds)

    def _begin_piece(self, view: Observation, reckoned: Reckoned, kind: ConstraintKind) -> FrameResult:
        """The camera sees ground that the map does not know: go on from where it may be."""
        frame, last = view.frame, self.records[-1]
        node = self._mapper.begin_piece(view, reckoned, last.node, self._mapper.height(view), kind)
        self._gaps.found()
        revisit = self._locator.revisit
        if kind is ConstraintKind.BRIDGE and self.config.revisit.enabled:
            revisit = self._seek_revisit(view, node, np.arange(len(view.features)))
        pose = self.map.graph.pose(node)
        self._locator.remember_first(view, pose)
        self._hang(frame, node, pose)
        return FrameResult(
            frame.t_ns,
            pose,
            covariance=gap_covariance(self.map, self.records[-1]),
            node=node,
            revisit=revisit,
            piece=self.records[-1].piece,
            timings_s=self._watch.seconds,
        )

    def _lost(self, frame: Frame, why: NotFound) -> FrameResult:
        return FrameResult(
            frame.t_ns,
            None,
            why.reason,
            why.detail,
            revisit=self._locator.revisit,
            timings_s=self._watch.seconds,
        )

    def _found(self, frame: Frame, stand: Standing) -> FrameResult:
        estimate = stand.located.estimate
        return FrameResult(
            frame.t_ns,
            stand.pose,
            covariance=estimate.covariance + gap_covariance(self.map, self.records[-1]),
            n_matches=len(stand.located.matches.correspondences),
            n_inliers=len(estimate.inliers),
            rms_px=estimate.rms_px,
            node=stand.node,
            revisit=stand.revisit,
            piece=self.records[-1].piece,
            timings_s=self._watch.seconds,
        )

    def _record(self, frame: Frame, stand: Standing) -> None:
        if stand.node is None:
            self._hang(frame, stand.located.main_node, stand.pose, seen_by(stand.located))
        else:
            self._hang(frame, stand.node, stand.pose)

    def _hang(self, frame: Frame, node: int, pose: Pose, seen: Seen | None = None) -> None:
        node_from_cam = self.map.graph.pose(node).inverse() @ pose
        piece = int(self.map.pieces()[node])
        self.records.append(FrameRecord(frame.index, frame.t_ns, node, node_from_cam, pose, piece, seen))
