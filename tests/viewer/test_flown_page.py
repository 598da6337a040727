"""The ground station over the simulator: one clicks, and the blimp is there, by its map alone."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tests.viewer.conftest import Visit, on_screen

from overfly.pipeline.control import ControlLoop
from overfly.pipeline.flying import FlyOutcome, FlyRequest, run
from overfly.pipeline.operating import Operator
from overfly.pipeline.simulated_vehicle import SimulatedVehicle

ARRIVAL_M = 0.15


@pytest.mark.timeout(900)  # the first time everything is compiled
def test_the_simulated_vehicle_arrives_at_the_place_that_was_clicked(
    tmp_path: Path, visit: Callable[[str], Visit]
) -> None:
    urls: list[str] = []
    loops: list[ControlLoop] = []
    outcomes: list[FlyOutcome] = []
    operator = Operator(urls.append, tmp_path / "map.overfly", port=0)
    request = FlyRequest(
        tmp_path / "map.overfly", "blimp", tmp_path / "out", survey_m=(1.2, 0.8), endless=True
    )

    def begin(loop: ControlLoop) -> None:
        operator.begin(loop)
        loops.append(loop)

    flight = threading.Thread(
        target=lambda: outcomes.append(run(request, operator.watch, operator.orders, begin)), daemon=True
    )
    flight.start()
    while not loops:
        flight.join(0.05)
        assert flight.is_alive()
    seen = visit(urls[0])
    try:
        seen.wait_until(lambda: "at its place" in seen.text(), "the survey is flown", patience_s=200.0)
        loop = loops[0]
        assert operator.station is not None
        assert isinstance(loop.vehicle, SimulatedVehicle)
        assert "fix ± " in seen.text()
        seen.page.wait_for_timeout(2000)
        before = loop.vehicle.truth.translation[:2].copy()
        state = loop.pilot.estimator.state
        assert state is not None
        wanted = state.position[:2] + np.array([0.7, -0.4])
        place = (float(wanted[0]), float(wanted[1]), operator.station.live.ground_m)
        seen.page.mouse.click(*on_screen(operator.station.live.page.server, place))

        def is_there() -> bool:
            target = loop.pilot.mission.target
            asked = target is not None and np.hypot(*(np.array([target.x_m, target.y_m]) - wanted)) < 0.1
            return asked and loop.pilot.mission.arrived

        seen.wait_until(is_there, "the vehicle has arrived where the click was", patience_s=200.0)
        flown = float(np.hypot(*(loop.vehicle.truth.translation[:2] - before)))
        assert abs(flown - float(np.hypot(0.7, 0.4))) < ARRIVAL_M
        assert seen.asked == {"127.0.0.1"}
    finally:
        loops[0].interrupted = True
        flight.join(60.0)
        operator.close()
    assert outcomes[0].numbers["longest_lost_s"] < 1.0
