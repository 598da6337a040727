"""The loop that flies: picture, place in the map, command."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue

import numpy as np
from scipy.spatial import KDTree

from overfly.frame_result import FrameResult
from overfly.geometry.poses import FloatArray, euler_from_rotation, rotation_from_quaternion
from overfly.navigation.commands import Command
from overfly.navigation.estimator import PlaceFix, place_fix
from overfly.navigation.mission import Place
from overfly.navigation.pilot import Pilot, Situation
from overfly.navigation.vehicle import Vehicle
from overfly.slam import Slam
from overfly.types import Frame, NotFound, Reason

Watcher = Callable[[Frame, FrameResult, Situation], None]


@dataclass(slots=True, eq=False)
class ControlLoop:
    """One vehicle, its map and its pilot.

    orders: what operators ask for; watch: sees every frame and what became of it; seconds: how long each
    frame took to process.
    """

    vehicle: Vehicle
    slam: Slam
    pilot: Pilot
    orders: SimpleQueue[Command] = field(default_factory=SimpleQueue)
    watch: Watcher = lambda _frame, _result, _situation: None
    interrupted: bool = False
    seconds: list[float] = field(default_factory=list)
    _home: int | None = None  # a node of the piece of map that the vehicle flies in
    _is_passing: bool = False

    def run(self, until: Callable[[Situation], bool]) -> None:
        """Fly until that is true, the flight is over, or somebody interrupts."""
        while not self.interrupted and (frame := self.vehicle.sense()) is not None:
            began = time.perf_counter()
            result, situation = self._fly(frame)
            self.seconds.append(time.perf_counter() - began)
            self.watch(frame, result, situation)
            if until(situation):
                return

    def _fly(self, frame: Frame) -> tuple[FrameResult, Situation]:
        before = MapShape.of(self.slam)
        result = self.slam.process(frame)
        self._forget_passing(result)
        if self._moved(before, result):
            self._follow_the_map(before)
        self.pilot.look(frame, self._fix(result))
        self._take_orders()
        situation = self.pilot.act(frame, self.vehicle.now_ns, str(result.reason or ""))
        self.vehicle.command(situation.command)
        return result, situation

    def _forget_passing(self, result: FrameResult) -> None:
        """The map keeps the frames that made it, and the last one; not every moment of a flight."""
        if result.pose is None:
            return
        if self._is_passing:
            del self.slam.records[-2]
        self._is_passing = result.node is None

    def _fix(self, result: FrameResult) -> PlaceFix | NotFound:
        if result.pose is None:
            return NotFound(result.reason or Reason.NO_IMAGE, result.detail)
        if self._home is None:
            self._home = self.slam.records[-1].node
        # The same reckoning stands behind all frames of another piece: no number of them makes a fix.
        if self.slam.map.pieces()[self._home] != result.piece:
            return NotFound(Reason.OTHER_PIECE, "over ground that is not tied to the map yet")
        mount = self.slam.rig.cam0.body_from_cam
        return place_fix(result.t_ns, result.pose, result.covariance, mount)

    def _take_orders(self) -> None:
        while True:
            try:
                self.pilot.mission.obey(self.orders.get_nowait())
            except Empty:
                return

    def _moved(self, before: MapShape | None, result: FrameResult) -> bool:
        if before is None:
            return False
        loop = result.revisit is not None and result.revisit.moved
        return loop or self.slam.map.n_rescaled != before.n_rescaled

    def _follow_the_map(self, before: MapShape | None) -> None:
        """Places stay where they are on the ground when the map about them is corrected."""
        after = MapShape.of(self.slam)
        assert before is not None
        assert after is not None

        def moved(place: Place) -> Place:
            x, y = before.followed(np.array([place.x_m, place.y_m]), after)
            return Place(x, y, place.passing)

        mission = self.pilot.mission
        mission.start = moved(mission.start) if mission.start else None
        mission.target = moved(mission.target) if mission.target else None
        mission.following = tuple(moved(place) for place in mission.following)
        if self.pilot.estimator.state is not None:
            position = self.pilot.estimator.state.position.copy()
            position[:2] = before.followed(position[:2], after)
            position[2] *= after.unit_m / before.unit_m
            self.pilot.estimator.move(position)
            if self.pilot.height_m is not None:
                self.pilot.height_m *= after.unit_m / before.unit_m


@dataclass(frozen=True, slots=True, eq=False)
class MapShape:
    """Where the nodes of the map are, at one moment: positions (n, 3), quaternions (n, 4), and its unit."""

    positions: FloatArray
    quaternions: FloatArray
    unit_m: float
    n_rescaled: int

    @staticmethod
    def of(slam: Slam) -> MapShape | None:
        """The map now; None before it has begun."""
        if slam.start is None or not slam.map.nodes:
            return None
        graph = slam.map.graph
        return MapShape(
            graph.positions.copy(), graph.quaternions.copy(), slam.start.height_m, slam.map.n_rescaled
        )

    def followed(self, xy: FloatArray, after: MapShape) -> FloatArray:
        """Where a place (2,) of this map lies in a later one: as it lay by its nearest node."""
        _, node = KDTree(self.positions[:, :2]).query(xy)
        turn = self._yaw(after.quaternions[node]) - self._yaw(self.quaternions[node])
        c, s = np.cos(turn), np.sin(turn)
        offset = (xy - self.positions[node, :2]) * (after.unit_m / self.unit_m)
        return np.asarray(after.positions[node, :2] + np.array([[c, -s], [s, c]]) @ offset)

    def _yaw(self, quaternion: FloatArray) -> float:
        return euler_from_rotation(rotation_from_quaternion(quaternion))[2]
