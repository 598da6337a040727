"""The live view and the ground station in a real browser, over a loop that only pretends to fly."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue

import numpy as np
import pytest
from tests.viewer.conftest import Visit, on_screen
from tests.viewer.flights import RIG, above, frame_of, new_slam, plain_picture, result_at

from overfly.frame_result import FrameResult
from overfly.navigation.commands import Command, GoTo, Hold, ReturnToStart, Stop
from overfly.slam import Slam
from overfly.types import Reason
from overfly.viewer.ground_station import FlightReport, GroundStation
from overfly.viewer.live import PERIOD_S, LiveViewer
from overfly.viewer.server import open_page

GROUND = (40, 170, 60)


@pytest.fixture
def slam() -> Slam:
    return new_slam()


@pytest.fixture
def live(slam: Slam) -> Iterator[LiveViewer]:
    viewer = LiveViewer(open_page("Overfly", port=0), RIG.cam0.camera, slam.map, slam, measures=False)
    yield viewer
    viewer.close()


def test_the_ground_grows_and_numbers_are_told(
    live: LiveViewer, slam: Slam, visit: Callable[[str], Visit]
) -> None:
    for number, x in enumerate((0.0, 1.5, 3.0)):
        live.show_frame(
            frame_of(number, plain_picture(GROUND)), result_at(slam, number, above(x, 0.0), is_node=True)
        )
        time.sleep(PERIOD_S)
    seen = visit(live.page.url)
    server = live.page.server
    seen.wait_until_ready(server, "inliers")

    def is_there() -> bool:
        lost = FrameResult(10**9, None, Reason.FEW_MATCHES, "3 matches")
        live.show_frame(frame_of(10, plain_picture(GROUND)), lost)  # the page goes on all the while
        if "lost: too few matches" not in seen.text():
            return False
        picture = seen.picture().astype(int)
        found = [picture[round(row), round(column)] for column, row in (
            on_screen(server, place) for place in ((-1.0, -0.8, 0.0), (3.5, 0.9, 0.0), (1.2, -1.0, 0.0))
        )]  # fmt: skip
        return bool((np.abs(np.array(found) - GROUND).max(axis=1) < 60).sum() >= 2)

    seen.wait_until(is_there, "the ground in its colour, and why the vehicle is lost")
    assert "3" in seen.text()
    assert seen.asked == {"127.0.0.1"}
    assert seen.failures == []


@dataclass
class PretendedFlight:
    """A vehicle that goes straight to where it is told, 0.2 m each step."""

    slam: Slam
    station: GroundStation
    place: np.ndarray = field(default_factory=lambda: np.zeros(2))
    target: np.ndarray | None = None
    obeyed: list[Command] = field(default_factory=list)
    number: int = 0

    def step(self) -> None:
        try:
            while True:
                self.obey(self.station.orders.get_nowait())
        except Empty:
            pass
        if self.target is not None:
            way = self.target - self.place
            self.place = self.place + way * min(1.0, 0.2 / max(math.hypot(*way), 1e-9))
        result = result_at(self.slam, self.number, above(*self.place), is_node=self.number == 0)
        target = None if self.target is None else (float(self.target[0]), float(self.target[1]))
        report = FlightReport("flying to its place" if target else "hovering", target)
        self.station.show(frame_of(self.number, plain_picture(GROUND)), result, report)
        self.number += 1

    def obey(self, order: Command) -> None:
        self.obeyed.append(order)
        if isinstance(order, GoTo):
            self.target = np.array([order.x_m, order.y_m])
        elif isinstance(order, ReturnToStart):
            self.target = np.zeros(2)
        else:
            self.target = None


def test_a_place_is_clicked_and_the_vehicle_goes_there(
    live: LiveViewer, slam: Slam, visit: Callable[[str], Visit]
) -> None:
    station = GroundStation(live, SimpleQueue())
    flight = PretendedFlight(slam, station)
    flight.step()
    seen = visit(live.page.url)
    seen.wait_until_ready(live.page.server, "hovering")
    assert "fix ± 3.0 mm" in seen.text()
    flight.step()

    def fly(is_so: Callable[[], bool], what: str) -> None:
        def step() -> bool:
            flight.step()
            return is_so()

        seen.wait_until(step, what)

    fly(lambda: live.page.server.get_clients() != {} and live.unit_m is not None, "the map is drawn")
    seen.page.wait_for_timeout(1500)  # the visitor's camera is turned to the vehicle
    wanted = (1.2, -0.9)
    seen.page.mouse.click(*on_screen(live.page.server, (*wanted, live.ground_m)))
    fly(lambda: any(isinstance(order, GoTo) for order in flight.obeyed), "the click is an order")
    fly(lambda: bool(np.hypot(*(flight.place - wanted)) < 0.05), "the vehicle is there")
    for name, order in (("Stop", Stop()), ("Hold", Hold()), ("Return to start", ReturnToStart())):
        seen.page.get_by_role("button", name=name).click(timeout=60_000)
        fly(lambda order=order: flight.obeyed[-1] == order, f"{name} is an order")
    fly(lambda: bool(np.hypot(*flight.place) < 0.05), "the vehicle is back")
    assert [type(order) for order in flight.obeyed] == [GoTo, Stop, Hold, ReturnToStart]
