"""overfly fly --mavlink: a real vehicle is told where it is in the map, and where to go if that is asked."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import Transformer

from overfly.config import Config
from overfly.errors import UsageError
from overfly.frame_result import FrameResult
from overfly.geometry.geodesy import GeoOrigin, enu_from_geodetic
from overfly.geometry.poses import FloatArray
from overfly.mapstore import Map
from overfly.mapstore.progress import continue_in
from overfly.mapstore.writer import write_whole
from overfly.navigation.mavlink import AutopilotLink, FixStream, OdometrySender, Placement, VehicleState
from overfly.navigation.mavlink.guidance import position_target
from overfly.navigation.safety import Fence
from overfly.pipeline.flying import CEILING_SHARE, FLOOR_SHARE, MARGIN_HEIGHTS, grown_map
from overfly.pipeline.live_frames import LiveFrames, live_rig
from overfly.pipeline.recording import interrupt_deferred
from overfly.pipeline.results import prepare_folder, write_json
from overfly.products.georeference import GeoReference
from overfly.sensors.live_camera import LiveCamera
from overfly.slam import Slam
from overfly.types import Frame

ARRIVED_M = 0.3  # autopilots do not hold a place any better by such fixes
ARRIVED_S = 2.0
_BASELINE_M = 100.0

Watcher = Callable[[Frame, FrameResult], None]


@dataclass(frozen=True, slots=True)
class AutopilotRequest:
    """places: (x, y) in the map's world to fly to, in order; holds: keep the place of the first fix.

    With neither nothing is commanded. calibration: of the camera, that of the map if None. camera_delay_s:
    from exposure to arrival of a picture.
    """

    map_file: Path
    url: str
    camera: str
    out: Path
    calibration: Path | None = None
    places: tuple[tuple[float, float], ...] = ()
    holds: bool = False
    minutes: float | None = None
    geofence_m: float | None = None
    floor_m: float | None = None
    camera_delay_s: float = 0.0
    command: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class AutopilotOutcome:
    """numbers: what --json prints and fly.json holds. interrupted: ended early, by Ctrl-C."""

    numbers: dict[str, Any]
    interrupted: bool


@dataclass(slots=True, eq=False)
class Itinerary:
    """Places (3,) to visit one after the other, inside a fence; the last one is held."""

    wanted: tuple[tuple[float, float], ...]
    holds: bool
    fence: Fence | None = None
    n_arrived: int = 0
    _here: FloatArray | None = None  # the first fix: its height is kept
    _near_since_ns: int | None = None

    def target(self, state: VehicleState) -> FloatArray | None:
        """Where to fly now; None when nothing was asked for. State: a fix that is believed."""
        if not self.wanted and not self.holds:
            return None
        place = state.world_from_body.translation
        if self._here is None:
            self._here = place.copy()
        goal = self._here.copy()
        if self.wanted:
            goal[:2] = self.wanted[min(self.n_arrived, len(self.wanted) - 1)]
        if self.fence is not None:
            goal = self.fence.nearest_inside(goal)
        if float(np.linalg.norm(place[:2] - goal[:2])) > ARRIVED_M:
            self._near_since_ns = None
        elif self._near_since_ns is None:
            self._near_since_ns = state.t_ns
        elif state.t_ns - self._near_since_ns > ARRIVED_S * 1e9 and self.n_arrived < len(self.wanted):
            self.n_arrived, self._near_since_ns = self.n_arrived + 1, None
        return goal

    @property
    def is_over(self) -> bool:
        return bool(self.wanted) and self.n_arrived >= len(self.wanted)


@dataclass(slots=True, eq=False)
class AutopilotLoop:
    """Picture, place in the map, ODOMETRY; a position target where one was asked for."""

    frames: LiveFrames
    slam: Slam
    link: AutopilotLink
    sender: OdometrySender
    itinerary: Itinerary
    interrupted: bool = False
    n_frames: int = 0
    n_located: int = 0
    n_targets: int = 0

    def run(self, until: Callable[[], bool], watch: Watcher) -> None:
        """Fly until that is true, the camera ends, or somebody interrupts."""
        while not self.interrupted and not until() and (frame := self.frames.sense()) is not None:
            result = self.slam.process(frame)
            if result.node is None and result.pose is not None:
                self.slam.records.pop()  # the map keeps what made it, not every moment of a flight
            state = self.sender.observe(result, frame.attitude)
            self.n_frames += 1
            self.n_located += result.pose is not None
            if state is not None:
                self._guide(state)
            watch(frame, result)

    def _guide(self, state: VehicleState) -> None:
        goal = self.itinerary.target(state)
        now_ns = self.link.clock_ns()
        reported = self.link.telemetry.position_now(now_ns)
        attitude = self.link.attitude_at(state.t_ns)
        if goal is None or reported is None or attitude is None:
            return
        message = position_target(state, goal, reported, attitude, self.link.target, now_ns // 1_000_000)
        if message is not None:
            self.link.send(message)
            self.n_targets += 1


def run(
    request: AutopilotRequest,
    watch: Watcher = lambda _frame, _result: None,
    camera: LiveCamera | None = None,
) -> AutopilotOutcome:
    """Fly until the time is over, the places are reached or somebody interrupts; leave map and numbers.

    camera: one that is open already. Raises OverflyError in one line each.
    """
    known = Map.open(request.map_file) if request.map_file.exists() else None
    if known is None and request.calibration is None:
        raise UsageError(f"{request.map_file}: no such map; a new one needs --calibration")
    fence = fence_of(known, request)
    for x_m, y_m in request.places:
        if fence is not None and not fence.holds(x_m, y_m):
            raise UsageError(f"({x_m:g}, {y_m:g}) lies outside the geofence: another place, or --geofence-m")
    with (
        AutopilotLink.open(request.url) as link,
        camera or LiveCamera.open(request.camera, request.camera_delay_s) as eye,
    ):
        kind = link.wait_for_autopilot()
        prepare_folder(request.out)
        height, width = eye.first().image.shape[:2]
        rig = live_rig(request.camera, (width, height), request.calibration, known.rig if known else None)
        slam = Slam(rig, known.config if known else Config())
        if known is not None:
            continue_in(slam, known)
        placement = placement_of(known.georeference if known else None)
        stream = FixStream(slam.rig.cam0.body_from_cam)
        with OdometrySender(link, stream, kind, placement) as sender:
            itinerary = Itinerary(request.places, request.holds, fence)
            loop = AutopilotLoop(LiveFrames(eye, rig, link), slam, link, sender, itinerary)
            deadline = math.inf if request.minutes is None else time.monotonic() + 60.0 * request.minutes
            with interrupt_deferred(loop):
                loop.run(lambda: time.monotonic() > deadline or itinerary.is_over, watch)
        numbers = numbers_of(loop, str(kind), request)
    if slam.map.nodes:
        write_whole(
            request.out / "map.overfly", grown_map(slam, known, f"overfly fly --mavlink {request.url}")
        )
    write_json(request.out / "fly.json", numbers)
    return AutopilotOutcome(numbers, loop.interrupted)


def fence_of(known: Map | None, request: AutopilotRequest) -> Fence | None:
    """The box about the map's nodes, with the margin asked for; None for a map that begins."""
    if known is None or not len(known):
        return None
    positions = known.visual.graph.positions
    height_m = float(np.median(positions[:, 2]))
    margin = MARGIN_HEIGHTS * height_m if request.geofence_m is None else request.geofence_m
    low, high = positions[:, :2].min(axis=0) - margin, positions[:, :2].max(axis=0) + margin
    floor = FLOOR_SHARE * height_m if request.floor_m is None else request.floor_m
    ceiling = max(CEILING_SHARE * height_m, floor + 1.0)
    return Fence(float(low[0]), float(low[1]), float(high[0]), float(high[1]), floor, ceiling)


def placement_of(reference: GeoReference | None) -> Placement:
    """Where a map lies for an autopilot: true north, not that of the map's projection."""
    if reference is None:
        return Placement()
    to_degrees = Transformer.from_crs(reference.crs, 4326, always_xy=True)
    transform = reference.crs_from_world()
    places = np.array([transform @ (0.0, 0.0), transform @ (_BASELINE_M, 0.0)])
    longitude, latitude = to_degrees.transform(places[:, 0], places[:, 1])
    height = float(reference.height_in_crs(np.zeros(1))[0])
    origin = GeoOrigin(float(latitude[0]), float(longitude[0]), height)
    along_x = enu_from_geodetic(np.column_stack([latitude, longitude, [height] * 2]), origin)[1]
    length = math.hypot(along_x[0], along_x[1])
    return Placement(origin, math.atan2(along_x[1], along_x[0]), length / _BASELINE_M)


def numbers_of(loop: AutopilotLoop, autopilot: str, request: AutopilotRequest) -> dict[str, Any]:
    """What the loop knows of itself."""
    report, clock = loop.sender.report, loop.link.clock.state()
    return {
        "autopilot": autopilot,
        "images": loop.n_frames,
        "located": loop.n_located,
        "fixes_sent": report.fixes,
        "guesses_sent": report.guesses,
        "silences": report.silences,
        "longest_gap_s": report.longest_gap_s,
        "latency_s": report.latency_s,
        "reset_counter": loop.sender.stream.reset_counter,
        "not_believed": loop.sender.stream.rejected,
        "targets_sent": loop.n_targets,
        "arrived": loop.itinerary.n_arrived,
        "clock_round_trip_ms": None if clock is None else clock.round_trip_ns * 1e-6,
        "map_nodes": len(loop.slam.map),
        "interrupted": loop.interrupted,
        "command": request.command,
    }
