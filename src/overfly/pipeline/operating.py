"""overfly fly --viewer: an operator at a page, who sees the flight and gives orders."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue

from overfly.frame_result import FrameResult
from overfly.mapstore import Map
from overfly.navigation.commands import Command
from overfly.navigation.pilot import Situation
from overfly.pipeline.control import ControlLoop
from overfly.pipeline.simulated_vehicle import SimulatedVehicle
from overfly.types import Frame
from overfly.viewer.ground_station import FlightReport, GroundStation
from overfly.viewer.live import LiveViewer
from overfly.viewer.server import LOCAL_HOST, open_page

MOST_BEHIND_S = 0.5  # a flight that falls further behind than this does not hurry to catch up


@dataclass(slots=True, eq=False)
class Operator:
    """Joins a ground station to a control loop, as its ``begin``, ``watch`` and ``orders``.

    announce: is told the address; map_file: of the map that exists, if there is one. A simulated mission, not
    the survey before it, is flown no faster than real time.
    """

    announce: Callable[[str], None]
    map_file: Path | None = None
    host: str = LOCAL_HOST
    port: int | None = None
    orders: SimpleQueue[Command] = field(default_factory=SimpleQueue)
    station: GroundStation | None = None
    _loop: ControlLoop | None = None
    _real_from_simulated_s: float | None = None

    def begin(self, loop: ControlLoop) -> None:
        """Open the page. Raises OutputError when its port cannot be had."""
        known = Map.open(self.map_file) if self.map_file is not None and self.map_file.exists() else None
        page = open_page("Overfly", self.host, self.port)
        camera = loop.vehicle.rig.cam0.camera
        live = LiveViewer(page, camera, loop.slam.map, loop.slam, known, measures=False, follows=False)
        self._loop, self.station = loop, GroundStation(live, self.orders)
        self.announce(page.url)

    def watch(self, frame: Frame, result: FrameResult, situation: Situation) -> None:
        """A frame was flown."""
        if self.station is None or self._loop is None:
            return
        target = situation.target
        place = None if target is None else (target.x_m, target.y_m)
        refused = self._loop.pilot.mission.refused
        self.station.show(
            frame, result, FlightReport(str(situation.status), place, situation.lost_s, refused)
        )
        vehicle = self._loop.vehicle
        if isinstance(vehicle, SimulatedVehicle) and vehicle.mission_began_s > 0.0:
            self._keep_real_time(frame.t_ns)

    def close(self) -> None:
        if self.station is not None:
            self.station.close()

    def _keep_real_time(self, t_ns: int) -> None:
        """Wait until the clock on the wall is where the simulated one is."""
        now_s, simulated_s = time.monotonic(), 1e-9 * t_ns
        if self._real_from_simulated_s is None:
            self._real_from_simulated_s = now_s - simulated_s
        ahead_s = simulated_s + self._real_from_simulated_s - now_s
        if ahead_s < -MOST_BEHIND_S:
            self._real_from_simulated_s = now_s - simulated_s
        elif ahead_s > 0.0:
            time.sleep(ahead_s)
