"""overfly fly --sim: a simulated vehicle keeps its place, or flies to places, by its map alone."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np

from overfly.config import Config
from overfly.errors import SourceError, UsageError
from overfly.frame_result import FrameResult
from overfly.geometry.poses import FloatArray
from overfly.mapstore import FrameEntry, Map
from overfly.mapstore.live import flight_entry
from overfly.mapstore.progress import continue_in
from overfly.mapstore.writer import write_whole
from overfly.navigation.commands import Command
from overfly.navigation.mission import Place
from overfly.navigation.pilot import Pilot, Situation, places_of
from overfly.navigation.safety import Fence
from overfly.navigation.survey import DEFAULT_PICTURES, picture_m, survey_places
from overfly.pipeline.control import ControlLoop, Watcher
from overfly.pipeline.flight_page import Strip, write_flight_page
from overfly.pipeline.judging import FlightLog, Judgement, judge
from overfly.pipeline.recording import interrupt_deferred, peak_memory_mb
from overfly.pipeline.results import prepare_folder, write_json, write_text
from overfly.pipeline.simulated_vehicle import Disturbances, SimulatedVehicle
from overfly.simulation import Wind
from overfly.simulation.scenario import declared
from overfly.slam import Slam
from overfly.types import Frame
from overfly.visual_map import VisualMap

SCENARIO_OF = {"multirotor": "demo"}  # names of vehicles beside those of scenarios
FIND_S = 15.0  # for so long a vehicle may look for itself in a map at the start
HOLD_MINUTES = 2.0  # when nobody says
TRAVEL_MINUTES = 10.0  # for each place, at most
MARGIN_HEIGHTS = 3.0  # of the geofence about what the map shows
FLOOR_SHARE = 0.4  # of the flying height
CEILING_SHARE = 2.0
GUST_SHARE = 0.4  # of the mean wind
CALM_GUST_M_S = 0.05


@dataclass(frozen=True, slots=True)
class FlyRequest:
    """What to fly. places: (x, y) in the map's world, in order; none: hold where the mission begins.

    minutes: of flight after any survey; None: until all places are reached, or some minutes of holding.
    survey_m: width and depth of ground to map first; None: some pictures if the map is new, (0, 0): none.
    """

    map_file: Path
    scenario: str
    out: Path
    places: tuple[tuple[float, float], ...] = ()
    minutes: float | None = None
    wind_m_s: float = 0.0
    pushes: int = 0
    drop_outs: bool = False
    seed: int = 0
    survey_m: tuple[float, float] | None = None
    geofence_m: float | None = None  # about what the map shows when the mission begins
    floor_m: float | None = None
    endless: bool = False  # for an operator: until somebody interrupts
    command: str = ""

    @property
    def source(self) -> str:
        """What the map says that this flight came from."""
        return f"overfly fly --sim {self.scenario} --seed {self.seed}"


@dataclass(frozen=True, slots=True, eq=False)
class FlyOutcome:
    """numbers: what --json prints and fly.json holds. interrupted: ended early, by Ctrl-C."""

    numbers: dict[str, Any]
    interrupted: bool


@dataclass(slots=True, eq=False)
class Recorder:
    """Watches the loop: the log, pictures for the report, and whoever else wants to see."""

    vehicle: SimulatedVehicle
    pilot: Pilot
    visual_map: VisualMap
    others: Watcher
    log: FlightLog = field(default_factory=FlightLog)
    strip: Strip = field(default_factory=Strip)
    goes_places: bool = False  # arrivals at places count; keeping one does not
    flying_mission: bool = False
    n_frames: int = 0
    _n_arrived: int = 0

    def __call__(self, frame: Frame, result: FrameResult, situation: Situation) -> None:
        self.n_frames += 1
        if self.flying_mission:
            arrived = self.pilot.mission.n_arrived > self._n_arrived
            self._n_arrived = self.pilot.mission.n_arrived
            self.log.add(
                situation,
                self.vehicle.truth,
                len(self.visual_map),
                held=self.vehicle.is_held,
                arrived=arrived and self.goes_places,
            )
            self.strip.see(frame.images[0], held=self.vehicle.is_held)
        self.others(frame, result, situation)


def run(
    request: FlyRequest,
    watch: Watcher = lambda _frame, _result, _situation: None,
    orders: SimpleQueue[Command] | None = None,
    begin: Callable[[ControlLoop], None] = lambda _loop: None,
) -> FlyOutcome:
    """Fly, and leave the grown map, the log, the numbers and a report in ``out``.

    begin: called with the loop before it starts. Raises OverflyError in one line each.
    """
    known = Map.open(request.map_file) if request.map_file.exists() else None
    scenario = declared(SCENARIO_OF.get(request.scenario, request.scenario)).build(request.seed)
    if scenario.vehicle.min_speed_m_s:
        raise UsageError(f"{request.scenario}: a {scenario.vehicle.name} cannot hover: choose another one")
    prepare_folder(request.out)
    vehicle = SimulatedVehicle(scenario, request.seed, disturbances_of(request))
    slam = Slam(vehicle.rig, known.config if known else Config(), vehicle.scale_landmark)
    if known is not None:
        continue_in(slam, known)
    pilot = Pilot(vehicle.airframe)
    recorder = Recorder(vehicle, pilot, slam.map, watch, goes_places=bool(request.places))
    loop = ControlLoop(vehicle, slam, pilot, orders or SimpleQueue(), recorder)
    begin(loop)
    clock, cpu = time.perf_counter(), time.process_time()
    with interrupt_deferred(loop):
        find_itself(loop, request, known)
        survey(loop, request, known)
        if known is None and not loop.interrupted:
            write_whole(request.map_file, grown_map(slam, None, request.source))
        surveyed = recorder.n_frames
        fly_mission(loop, recorder, request)
    wall_s, cpu_s = time.perf_counter() - clock, time.process_time() - cpu
    write_whole(request.out / "map.overfly", grown_map(slam, known, request.source))
    found = judge(recorder.log) if recorder.log.t_s else None
    simulated_s = recorder.n_frames / scenario.rate_hz
    numbers = {
        "scenario": request.scenario,
        "vehicle": scenario.vehicle.name,
        "seed": request.seed,
        "wind_m_s": request.wind_m_s,
        **(found.numbers if found else {}),
        "survey_images": surveyed,
        "realtime_factor": simulated_s / wall_s,
        "realtime_factor_cpu": simulated_s / cpu_s,  # on a machine that does nothing else
        **numbers_of(loop),
        "interrupted": loop.interrupted,
        "command": request.command,
    }
    write_json(request.out / "fly.json", numbers)
    if found is not None:
        write_text(request.out / "flight.csv", table_of(recorder.log, found))
        write_flight_page(request.out / "report.html", request.scenario, found, recorder.strip, numbers)
    return FlyOutcome(numbers, loop.interrupted)


def disturbances_of(request: FlyRequest) -> Disturbances:
    """Wind with its gusts; pushes spread evenly, the last one early enough to come back from."""
    wind = request.wind_m_s
    breeze = Wind((0.8 * wind, 0.6 * wind), max(CALM_GUST_M_S, GUST_SHARE * wind), 4.0)
    seconds = 60.0 * (request.minutes or HOLD_MINUTES)
    pushes = tuple(seconds * (number + 0.2) / request.pushes for number in range(request.pushes))
    return Disturbances(breeze, pushes, request.drop_outs)


def find_itself(loop: ControlLoop, request: FlyRequest, known: Map | None) -> None:
    """The first fix. Raises SourceError when there is none: then the map is of another place."""
    first: list[int] = []

    def found_or_late(situation: Situation) -> bool:
        first.append(situation.t_ns)
        return situation.state is not None or situation.t_ns - first[0] > FIND_S * 1e9

    loop.run(found_or_late)
    if loop.pilot.estimator.state is None and not loop.interrupted:
        where = f"in {request.map_file}" if known else "a place to begin a map"
        raise SourceError(
            f"the vehicle of '{request.scenario}' does not find {'itself ' if known else ''}{where}: "
            f"is it a map of that scenario with --seed {request.seed}?"
        )


def survey(loop: ControlLoop, request: FlyRequest, known: Map | None) -> None:
    """Fly over the ground that the map does not show yet, and come back."""
    state, camera = loop.pilot.estimator.state, loop.slam.rig.cam0.camera
    if state is None:
        return
    height_m = float(state.position[2])
    size = request.survey_m
    if size is None:
        wide, deep = picture_m(camera, height_m)
        size = (DEFAULT_PICTURES[0] * wide, DEFAULT_PICTURES[1] * deep) if known is None else (0.0, 0.0)
    if not any(size):
        return
    places = survey_places(state.position[:2], size, camera, height_m)
    loop.pilot.fence = fence_about(np.vstack([places, state.position[:2]]), height_m, request)
    loop.pilot.mission.visit(places_of(places, passing=True))
    loop.run(lambda _situation: loop.pilot.mission.is_over)


def fence_about(places: FloatArray, height_m: float, request: FlyRequest) -> Fence:
    """The box about places (n, 2) with the margin asked for."""
    margin = MARGIN_HEIGHTS * height_m if request.geofence_m is None else request.geofence_m
    low, high = places.min(axis=0) - margin, places.max(axis=0) + margin
    floor = FLOOR_SHARE * height_m if request.floor_m is None else request.floor_m
    ceiling = max(CEILING_SHARE * height_m, floor + 1.0)
    return Fence(float(low[0]), float(low[1]), float(high[0]), float(high[1]), floor, ceiling)


def fly_mission(loop: ControlLoop, recorder: Recorder, request: FlyRequest) -> None:
    """Hold, or visit the places, for as long as was asked for."""
    state, pilot = loop.pilot.estimator.state, loop.pilot
    if state is None or loop.interrupted:
        return
    pilot.fence = fence_about(loop.slam.map.graph.positions[:, :2], float(state.position[2]), request)
    here = (float(state.position[0]), float(state.position[1]))
    pilot.mission.start = Place(*here)
    pilot.mission.visit([Place(*xy) for xy in request.places or (here,)])
    if pilot.mission.refused:
        raise UsageError(f"{pilot.mission.refused}: give other places, or a wider --geofence-m")
    recorder.flying_mission, recorder._n_arrived = True, pilot.mission.n_arrived
    recorder.vehicle.mission_began_s = recorder.vehicle.time_s
    began_ns = recorder.vehicle.now_ns
    minutes = request.minutes
    if minutes is None:
        minutes = TRAVEL_MINUTES * len(request.places) if request.places else HOLD_MINUTES

    def over(situation: Situation) -> bool:
        pilot.mission.proceed()
        late = (situation.t_ns - began_ns) * 1e-9 >= 60.0 * minutes
        done = bool(request.places) and request.minutes is None and pilot.mission.is_over
        return not request.endless and (late or done)

    loop.run(over)


def grown_map(slam: Slam, known: Map | None, source: str) -> Map:
    """The map with what this flight added; of the flight the frames that became nodes."""
    number = 0 if known is None else len(known.flights)
    entry = flight_entry(slam, source)
    frames = [
        FrameEntry(
            number, record.t_ns, record.frame_index, record.node, True, record.node_from_cam, record.online
        )
        for record in slam.records
        if slam.map.nodes[record.node].t_ns == record.t_ns
    ]
    older = 0 if known is None else len(known.node_flights)
    flights = [] if known is None else known.flights
    return Map(
        slam.map,
        [*flights, replace(entry, number=number, complete=True)],
        [*([] if known is None else known.node_flights), *[number] * (len(slam.map) - older)],
        [*([] if known is None else known.frames), *frames],
        None if known is None else known.georeference,
    )


def numbers_of(loop: ControlLoop) -> dict[str, Any]:
    """What the loop knows of itself."""
    milliseconds = 1e3 * np.array(loop.seconds)
    fence = loop.pilot.fence
    return {
        "latency_ms": {
            name: float(np.percentile(milliseconds, share)) for name, share in (("p50", 50), ("p95", 95))
        }
        | {"max": float(milliseconds.max())},
        "map_nodes": len(loop.slam.map),
        "map_constraints": loop.slam.map.graph.n_constraints,
        "estimator_resets": loop.pilot.estimator.n_resets,
        "geofence": None if fence is None else asdict(fence),
        "peak_memory_mb": round(peak_memory_mb(), 1),
    }


def table_of(log: FlightLog, found: Judgement) -> str:
    """flight.csv: one row a frame of the mission."""
    head = (
        "time [s],x [m],y [m],fix x [m],fix y [m],target x [m],target y [m],distance [m],"
        "located,held,settled,nodes,status"
    )
    flags = np.column_stack([log.located, log.held, found.settled, found.nodes]).astype(np.int64)
    fixes = np.array(log.fix)[:, :2]
    metres = np.column_stack([found.map_xy, fixes, found.target_xy, found.distance_m])
    lines = [
        f"{t_s:.3f},{','.join(f'{value:.4f}' for value in row)},{','.join(map(str, marks))},"
        + status.replace(",", ";")
        for t_s, row, marks, status in zip(found.t_s, metres, flags, log.status, strict=True)
    ]
    return "\n".join([head, *lines]) + "\n"
