"""Where the camera is in the map (paper, section IV): points followed from the last frame; else features
matched with the previous n nodes; else with the rest of the map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from overfly.config import Config
from overfly.geometry.poses import Pose
from overfly.revisit.drift import map_bend, revisit_drift_covariance
from overfly.revisit.outcome import Revisit
from overfly.revisit.places import Places
from overfly.revisit.verification import Query, revisit_covariance
from overfly.timing import Stopwatch
from overfly.types import Constraint, ConstraintKind, NotFound, Reason, Rig
from overfly.vision.features import Extractor
from overfly.vision.motion import ConstantVelocity, moved_enough
from overfly.vision.observation import Observation
from overfly.vision.odometry import Located, Reference, information_of_constraint, locate_against
from overfly.vision.refine import HeightPrior
from overfly.vision.registration import Registrar
from overfly.vision.tracking import Anchor, TrackedPoints, Tracker
from overfly.visual_map import Node, VisualMap

WIDER_SPREAD = 4.0  # when nothing agrees on ground as flat as assumed, it may be this much rougher


@dataclass(frozen=True, slots=True, eq=False)
class Recognised:
    """A view located against nodes that odometry had left behind, those near it, and the constraint that ties
    them to where odometry came from, None where both agree."""

    located: Located
    near: list[Node]
    tie: Constraint | None


class Locator:
    """Finds poses; changes nothing in the map."""

    def __init__(
        self,
        visual_map: VisualMap,
        rig: Rig,
        config: Config,
        extractor: Extractor,
        registrar: Registrar,
        places: Places,
        height: Callable[[Observation], HeightPrior | None],
        watch: Stopwatch,
    ) -> None:
        self._map = visual_map
        self._rig = rig
        self._config = config
        self._extractor = extractor
        self._registrar = registrar
        self._places = places
        self._height = height  # of a view's camera by the range sensor
        self._watch = watch
        self._is_lost = False
        self.revisit: Revisit | None = None  # what came of looking for the present view elsewhere in the map
        self._motion = ConstantVelocity()
        self._tracker = Tracker(rig.cam0.camera, registrar, config.tracking)

    def locate(self, view: Observation) -> Located | NotFound:
        """The pose of the view, or why there is none."""
        self.revisit = None
        with self._watch.stage("tracking"):
            located = self._follow(view)
        if isinstance(located, Located):
            return located
        with self._watch.stage("features"):
            n_features = len(view.features)
        if n_features < self._config.registration.min_inliers:
            return NotFound(Reason.FEW_FEATURES, f"{n_features} features")
        if not self._is_lost or not self._config.revisit.enabled:  # else anywhere, which has to be verified
            with self._watch.stage("odometry"):
                located = self._match_previous(view)
            if isinstance(located, Located):
                with self._watch.stage("tracking"):
                    return self._settle(view, located)
        elsewhere = self._match_elsewhere(view)
        if isinstance(elsewhere, Located):
            return elsewhere
        with self._watch.stage("tracking"):
            return self._compare_pictures(view) or (elsewhere if self._is_lost else located)

    def recognise(self, view: Observation, located: Located) -> Recognised | None:
        """The view located against nodes that odometry left behind, when they show the same ground: then the
        map needs no new node here, and odometry can go on from them.

        Where they put the camera at another place, as before a loop is closed, both have to be tied first.
        """
        settings = self._config.nodes
        if not self._config.tracking.enabled or settings.reuse_px <= 0.0:
            return None
        near = self._nodes_like(located.pose)
        if not near:
            return None
        anchors = {
            node.index: Anchor(node.pyramid, self._map.graph.pose(node.index))
            for node in near
            if node.pyramid is not None
        }
        points = self._map.points_to_follow(near, anchors)
        found = self._tracker.settle(view, points, anchors, located.pose, self._height(view))
        if isinstance(found, NotFound):
            return None
        main = self._map.nodes[found.main_node]
        n_inliers = len(found.inliers_of(main.index))
        shift = float(np.linalg.norm(found.pose.translation - located.pose.translation))
        apart = shift / float(located.pose.translation[2])
        enough = max(settings.overlap * main.n_continued, self._config.tracking.min_tracked)
        if n_inliers < enough:
            return None
        agree = apart <= self._registrar.pixels(settings.reuse_px)
        return Recognised(found, near, None if agree else self._tie(found, located))

    def go_on_from(self, recognised: Recognised) -> None:
        """Odometry compares with nodes that were recognised."""
        located = recognised.located
        main = self._map.nodes[located.main_node]
        main.n_continued = len(located.inliers_of(main.index))
        for node in recognised.near[::-1]:
            self._map.use(node.index)
        self._map.use(main.index)

    def _tie(self, found: Located, located: Located) -> Constraint:
        """What one view, located twice, says of both places: from the older main node to the newer."""
        older, newer = self._map.graph.pose(found.main_node), self._map.graph.pose(located.main_node)
        cam_from_newer = located.pose.inverse() @ newer
        carry = cam_from_newer.inverse().adjoint()
        registered = carry @ (found.estimate.covariance + located.estimate.covariance) @ carry.T
        older_from_newer = older.inverse() @ found.pose @ cam_from_newer
        height = float(found.pose.translation[2])
        measured = bool(np.isfinite(self._map.nodes[found.main_node].inverse_depth).any())
        drift = revisit_drift_covariance(older_from_newer, height, map_bend(self._map), measured)
        return Constraint(
            found.main_node,
            located.main_node,
            older_from_newer,
            information_of_constraint(revisit_covariance(registered, height) + drift),
            ConstraintKind.REVISIT,
        )

    def _nodes_like(self, pose: Pose) -> list[Node]:
        """Nodes left behind, with pictures, from which this pose has not moved enough for a node; nearest
        first."""
        count, camera = self._config.nodes.previous, self._rig.cam0.camera
        behind = self._map.left_behind(count)
        if not behind:
            return []
        positions = self._map.graph.positions[[node.index for node in behind]]
        order = np.argsort(np.linalg.norm(positions - pose.translation, axis=1), kind="stable")
        z = float(pose.translation[2])
        nearest = [behind[int(row)] for row in order[: 2 * count]]
        alike = [
            node
            for node in nearest
            if not moved_enough(
                self._map.graph.pose(node.index),
                pose,
                (float(self._map.graph.positions[node.index, 2]), z),
                camera,
                self._config.nodes,
                is_known=True,
            )
        ]
        return alike[:count]

    def remember(self, view: Observation, located: Located, pose: Pose) -> None:
        """The view is at this pose: the next one is expected from there.

        The pose is not quite where it was located when the map about the camera moved since; that is no
        motion of the camera.
        """
        self._is_lost = False
        world_from_old = pose @ located.pose.inverse()
        self._motion.move(world_from_old)
        self._motion.update(view.frame.t_ns, pose)
        self._tracker.remember(view, located)
        self._tracker.move(world_from_old)

    def remember_first(self, view: Observation, pose: Pose) -> None:
        """The first view of a piece of map; nothing has been followed yet."""
        self._is_lost = False
        self._tracker.remember_first(view, pose)
        self._motion.update(view.frame.t_ns, pose)

    def lose(self) -> None:
        """The view was not found: nothing can be followed from it."""
        self._is_lost = True
        self._motion.lose()
        self._tracker.forget()

    def rescale(self, factor: float) -> None:
        """All lengths of the map were multiplied."""
        self._motion.rescale(factor)
        self._tracker.rescale(factor)

    # -- the ways to find a pose

    def _follow(self, view: Observation) -> Located | NotFound:
        """Points followed since the last frame, without descriptors."""
        last = self._motion.last_pose
        if not self._config.tracking.enabled or last is None:
            return NotFound(Reason.FEW_MATCHES, "points are not followed")
        predicted = self._motion.predict(view.frame.t_ns)
        calmly = self._motion.predict_calmly(view.frame.t_ns)
        return self._tracker.track(view, *self._followable(), last, predicted, self._height(view), calmly)

    def _compare_pictures(self, view: Observation) -> Located | None:
        """By the whole picture, where nothing in it is found again and the camera can not be far."""
        last = self._motion.last_pose
        if not self._config.tracking.enabled or last is None:
            return None
        calmly = self._motion.predict_calmly(view.frame.t_ns)
        height = self._height(view)
        return self._tracker.by_whole_picture(view, *self._followable(), last, calmly, height)

    def _settle(self, view: Observation, located: Located) -> Located:
        """The same pose, made exact by aligning patches where the nodes' pictures are at hand."""
        if not self._config.tracking.enabled or self._map.nodes[located.main_node].pyramid is None:
            return located
        settled = self._tracker.settle(view, *self._followable(), located.pose, self._height(view))
        return settled if isinstance(settled, Located) else located

    def _followable(self) -> tuple[TrackedPoints, dict[int, Anchor]]:
        """Points of the previous n nodes, and the nodes whose pictures are at hand."""
        return self._map.followable(self._config.nodes.previous)

    def _match_previous(self, view: Observation) -> Located | NotFound:
        """Visual odometry: features against those of the previous n nodes; then as if the ground were
        rougher.
        """
        previous = [node.index for node in self._map.previous(self._config.nodes.previous)]
        predicted = self._motion.predict(view.frame.t_ns)
        outcome = self._match_nodes(view, previous, predicted)
        if isinstance(outcome, Located) or self._rig.is_stereo:
            return outcome
        rougher = self._match_nodes(view, previous, None, WIDER_SPREAD)
        return rougher if isinstance(rougher, Located) else outcome

    def _match_elsewhere(self, view: Observation) -> Located | NotFound:
        """The whole map, the previous nodes too, verified as a place seen before."""
        if not self._config.revisit.enabled:
            return NotFound(Reason.FEW_MATCHES, "lost, and places are not sought")
        with self._watch.stage("revisit"):
            query = Query(view.features, view.rays, view.frame.attitude, view.tilt, self._height(view))
            located, self.revisit = self._places.relocalise(query, view.frame.t_ns)
        return located

    def _match_nodes(
        self, view: Observation, nodes: list[int], predicted: Pose | None, wider: float = 1.0
    ) -> Located | NotFound:
        if not nodes:
            return NotFound(Reason.FEW_MATCHES, "no node that odometry could go on from")
        references = [
            Reference(
                index,
                self._map.nodes[index].features,
                self._map.points_in_world(self._map.nodes[index]),
                wider * self._map.spread_in_world(self._map.nodes[index]),
            )
            for index in nodes
        ]
        change = self._config.registration.height_change
        z = self._map.graph.positions[nodes, 2]
        return locate_against(
            view,
            references,
            self._extractor,
            self._registrar,
            predicted,
            (float(z.min()) / change, float(z.max()) * change),
            self._height(view),
        )
