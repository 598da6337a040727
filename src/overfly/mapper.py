"""How the map grows: the first frame, and every frame that shows enough that is new, become nodes of the
graph.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from overfly.config import Config
from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.online import OnlineOptimiser
from overfly.pieces import Reckoned
from overfly.revisit.drift import map_bend, with_drift
from overfly.sighting import (
    Sighting,
    first_sighting,
    followed_sighting,
    matched_sighting,
)
from overfly.start import Start, begin_height, first_pose, range_height
from overfly.timing import Stopwatch
from overfly.types import Constraint, ConstraintKind, NotFound, Reason, Rig, ScaleLandmark
from overfly.vision.depth import RELIEF_SHARE, DepthFinder, height_above_points
from overfly.vision.motion import moved_enough
from overfly.vision.observation import Observation, feature_count
from overfly.vision.odometry import Located, Reference, constraints_to_nodes, information_of_constraint
from overfly.vision.refine import HeightPrior
from overfly.vision.registration import Registrar
from overfly.visual_map import Node, VisualMap
from overfly.window import LARGEST_RELIEF, LEAST_RELIEF, adjust_window

HELD_SHARE = 1e-3  # of its height: how firmly the first node holds the scale of the map
FIRST_RANGES_SHARE = 0.02  # the same, when the metre is that of a few range readings
RELIEF_LEARNING = 0.3  # weight of the newest window in what is known of the ground's relief


class Mapper:
    """Adds nodes to the map and refines the newest of them."""

    def __init__(
        self,
        visual_map: VisualMap,
        rig: Rig,
        config: Config,
        registrar: Registrar,
        optimiser: OnlineOptimiser,
        landmark: ScaleLandmark | None,
        watch: Stopwatch,
    ) -> None:
        self._map = visual_map
        self._rig = rig
        self._config = config
        self._registrar = registrar
        self._optimiser = optimiser
        self._landmark = landmark
        self._watch = watch
        self._depth = DepthFinder(rig)
        self._n_features = feature_count(rig, config.features.count)
        self._relief = RELIEF_SHARE  # of the ground about its plane, as a share of the height; learnt
        self.start: Start | None = None

    @property
    def measures_depth(self) -> bool:
        """Whether points are measured, not assumed to lie on flat ground."""
        return self._depth.is_metric

    @property
    def inverse_depth_sigma(self) -> float:
        """Standard deviation of measured inverse depths, 1/m."""
        return self._depth.inverse_depth_sigma

    @property
    def rig_turn_rad(self) -> FloatArray:
        """(3,) by how much the second camera was found to be turned against its calibration."""
        return self._depth.rig_turn_rad

    def begin(self, view: Observation) -> Pose | NotFound:
        """Make the first frame the first node; it needs features and a height."""
        if len(view.features) < self._config.registration.min_inliers:
            return NotFound(Reason.FEW_FEATURES, f"{len(view.features)} features")
        measured = self._depth.measured(view, view.features.px)
        if measured is not None:
            height = height_above_points(measured.points_in_cam, view.tilt.level_from_cam)
            if not math.isfinite(height):
                return NotFound(Reason.FEW_MATCHES, "no stereo matches")
            self.start = Start(height, view.tilt.level_from_cam, "stereo")
        else:
            self.start = begin_height(view.frame, self._rig, view.tilt, self._config, self._landmark)
        pose = first_pose(self.start, view.frame.attitude.yaw_rad if view.frame.attitude else None)
        held = HeightPrior(self.start.height_m, HELD_SHARE * self.start.height_m)
        if self.start.source == "range":
            held = range_height(view.frame, self._rig, view.tilt.level_from_cam, 0.0) or held
        self._add_node(view, pose, first_sighting(view, self._map, self._ray_sigma), held, -1)
        return pose

    def begin_piece(
        self,
        view: Observation,
        reckoned: Reckoned,
        last: int,
        height: HeightPrior | None,
        kind: ConstraintKind = ConstraintKind.DEAD_RECKONING,
    ) -> int:
        """Make a frame that is not found in the map the first node of a new piece, tied by dead reckoning to
        the last node before the camera was lost; or, over a bridge, the next node of the same piece.

        height: by the range sensor; without one it stays what it was when the camera was lost.
        """
        z = float(reckoned.pose.translation[2])
        z_sigma = HELD_SHARE * abs(z)
        if kind is ConstraintKind.BRIDGE:
            up = reckoned.pose.rotation[2]
            z_sigma = math.sqrt(float(up @ reckoned.covariance[:3, :3] @ up))
        held = None if self.measures_depth else height or HeightPrior(z, z_sigma)
        sighting = first_sighting(view, self._map, self._ray_sigma)
        self._map.forget_recent()
        index = self._add_node(view, reckoned.pose, sighting, held, last)
        last_from_cam = self._map.graph.pose(last).inverse() @ reckoned.pose
        gap = Constraint(
            last,
            index,
            last_from_cam,
            information_of_constraint(reckoned.covariance),
            kind,
        )
        self._map.nodes[index].constraint = self._optimiser.add(gap).constraint
        return index

    def reference(self, view: Observation, pose: Pose) -> Reference:
        """What a view shows that is no node, if its pose is world_from_cam."""
        relief = self._relief * float(pose.translation[2])
        px = view.features.px
        depth = self._depth.find(view, px, view.rays, pose, view.tilt.sigma_rad, relief)
        along = depth.points_in_cam * (depth.depth_sigma_m / depth.points_in_cam[:, 2])[:, None]
        points = pose.transform(depth.points_in_cam)
        return Reference(len(self._map), view.features, points, along @ pose.rotation.T)

    def height(self, view: Observation) -> HeightPrior | None:
        """Height of a camera by the range sensor, where that is what knows the metre or agrees with it."""
        if self.start is None or self.start.source not in ("range", "landmark"):
            return None
        return range_height(view.frame, self._rig, view.tilt.level_from_cam, 0.0)

    def rescale(self, factor: float, source: str) -> None:
        """All lengths were multiplied: the first height too, which now comes from this source."""
        if self.start is None:
            return
        if source == "range" != self.start.source:  # from now on the sensor holds the scale
            first = self._map.nodes[0]
            z = float(self._map.graph.positions[0, 2])
            first.height = HeightPrior(z, FIRST_RANGES_SHARE * z)
        self.start = Start(self.start.height_m * factor, self.start.level_from_cam, source)

    def shows_enough_new(self, located: Located) -> bool:
        """Whether a located frame should become a node."""
        heights = self._map.graph.positions[:, 2]
        node = self._map.nodes[located.main_node]
        if self._is_old(node.index):  # found again elsewhere: odometry starts from here
            return True
        n_left = len(located.inliers_of(located.main_node))
        node.n_continued = max(node.n_continued, n_left)
        settings = self._config.nodes
        if n_left < settings.overlap * node.n_continued:
            return True
        newest, camera = len(self._map) - settings.previous, self._rig.cam0.camera
        # Against all of them: a camera that turns back comes to the one before the last.
        return all(
            moved_enough(
                self._map.graph.pose(last.index), located.pose,
                (float(heights[last.index]), float(located.pose.translation[2])), camera, settings,
                is_known=last.index < newest,
            )
            for last in self._map.previous(settings.previous)
        )  # fmt: skip

    def extend(self, view: Observation, located: Located, height: HeightPrior | None) -> int:
        """Make the frame a node, tied by constraints to the nodes it was located against, and refine the
        newest ones.
        """
        with self._watch.stage("features"):
            localisation_px = self._config.registration.localisation_px
            if located.px is None:
                sighting = matched_sighting(view, located, self._map, self._ray_sigma)
            else:
                localisation_px = self._config.tracking.localisation_px
                sighting = followed_sighting(view, located, self._map, self._ray_sigma, self._n_features)
        with self._watch.stage("node"):
            is_revisit = self._is_old(located.main_node)
            if is_revisit:
                self._map.go_on_from(located.main_node)
            index = self._add_node(view, located.pose, sighting, height, located.main_node)
            poses = {node: self._map.graph.pose(node) for node in located.nodes()}
            ties = constraints_to_nodes(located, poses, index, self._registrar, view.tilt, localisation_px)
            self._tie(index, located.main_node, ties, is_revisit)
        if self._config.window.nodes:
            with self._watch.stage("window"):
                self._adjust_window()
        return index

    def _is_old(self, node: int) -> bool:
        """Whether odometry no longer compares with this node."""
        return all(node != last.index for last in self._map.previous(self._config.nodes.previous))

    def _tie(self, index: int, parent: int, constraints: list[Constraint], is_revisit: bool) -> None:
        """Enter the constraints of a new node into the graph, the one to its parent first.

        The window ties a node to its neighbours by the points that they share, and puts all of that into the
        one constraint to the parent; the others would count the same observations again.
        """
        height, bend = float(self._map.graph.positions[index, 2]), map_bend(self._map)
        for constraint in sorted(constraints, key=lambda tie: tie.i != parent):
            if constraint.i == parent:
                kind = ConstraintKind.REVISIT if is_revisit else ConstraintKind.ODOMETRY
                added = self._optimiser.add(replace(with_drift(constraint, height, bend), kind=kind))
                self._map.nodes[index].constraint = added.constraint
            elif not self._config.window.nodes:
                self._optimiser.add(with_drift(constraint, height, bend))

    @property
    def _ray_sigma(self) -> float:
        """Standard deviation of a described feature's ray."""
        return self._registrar.pixels(self._config.registration.localisation_px)

    def _adjust_window(self) -> None:
        height = float(self._map.graph.positions[-1, 2])
        relief = None if self.measures_depth else self._relief
        seen = adjust_window(self._map, self._config.window, self._depth.inverse_depth_sigma, relief)
        if seen is not None and not self.measures_depth:  # the ground is as flat as it turns out to be
            share = min(max(seen / height, LEAST_RELIEF), LARGEST_RELIEF)
            self._relief += RELIEF_LEARNING * (share - self._relief)

    def _add_node(
        self, view: Observation, pose: Pose, sighting: Sighting, height: HeightPrior | None, parent: int
    ) -> int:
        """Points that are known keep their place; new ones get the depth that the rig measures or the ground
        gives.
        """
        index = len(self._map)
        relief = self._relief * float(pose.translation[2])
        depth = self._depth.find(view, sighting.features.px, sighting.rays, pose, view.tilt.sigma_rad, relief)
        inverse_depth = np.full(len(sighting.features), np.nan)
        if depth.is_measured:
            inverse_depth = 1.0 / depth.points_in_cam[:, 2]
        known = np.isfinite(sighting.world[:, 2])
        points, sigma = depth.points_in_cam.copy(), depth.depth_sigma_m.copy()
        points[known] = pose.inverse().transform(sighting.world[known])
        sigma[known] = sighting.depth_sigma_m[known]
        own = sighting.anchor < 0
        node = Node(
            index=index,
            frame_index=view.frame.index,
            t_ns=view.frame.t_ns,
            features=sighting.features,
            rays=sighting.rays,
            ray_sigma=sighting.ray_sigma,
            points_in_cam=points,
            depth_sigma_m=sigma,
            inverse_depth=inverse_depth,
            tracks=sighting.tracks,
            anchor=np.where(own, index, sighting.anchor),
            anchor_row=np.where(own, np.arange(len(own)), sighting.anchor_row),
            tilt=view.tilt,
            height=height,
            parent=parent,
            pyramid=view.pyramid,
        )
        self._map.add_node(node, pose)
        return index
