"""Mission and pilot: what is done with a fix, without one, and with what operators ask for."""

from __future__ import annotations

import math

import numpy as np
import pytest

from overfly.navigation.commands import GoTo, Hold, ReturnToStart, Stop
from overfly.navigation.mission import Mission, Place
from overfly.navigation.pilot import KEEP_STILL_S, Pilot, Situation, Status, places_of
from overfly.navigation.safety import Fence
from overfly.simulation.plants import Plant, Wind
from overfly.simulation.vehicles import BLIMP
from overfly.types import Altitude, AltitudeKind, Frame, NotFound, Reason

from .loops import airframe, fix_of, true_state

LATENCY_NS = 60_000_000


class Flight:
    """A blimp with noisy fixes that can be taken away."""

    def __init__(self, fence: Fence | None = None) -> None:
        self.plant = Plant(BLIMP, np.array([0.5, -0.5, 2.0]), 0.3, wind=Wind(gust_m_s=0.03), seed=1)
        self.pilot = Pilot(airframe(BLIMP))
        self.pilot.fence = fence
        self.generator = np.random.default_rng(1)
        self.situations: list[Situation] = []
        self.has_range = True

    def fly(self, seconds: float, *, blind: bool = False) -> Situation:
        for _ in range(round(10 * seconds)):
            t_ns = round(self.plant.time_s * 1e9)
            range_m = float(self.plant.position[2] + self.generator.normal(0.0, 0.01))
            altitude = Altitude(range_m, 0.01, AltitudeKind.RANGE) if self.has_range else None
            frame = Frame(0, t_ns, "", (), None, altitude)
            fix = fix_of(self.plant, 0.005, self.generator)
            self.pilot.look(frame, NotFound(Reason.NO_IMAGE) if blind else fix)
            self.situations.append(self.pilot.act(frame, t_ns + LATENCY_NS, "black" if blind else ""))
            self.plant.step(self.situations[-1].command, 0.1)
        return self.situations[-1]

    def distance(self, x: float, y: float) -> float:
        return math.hypot(self.plant.position[0] - x, self.plant.position[1] - y)


def test_orders_are_obeyed() -> None:
    flight = Flight()
    assert flight.fly(2.0).status is Status.HOVERING
    flight.pilot.mission.obey(GoTo(2.0, 1.0))
    assert flight.fly(5.0).status is Status.FLYING
    assert flight.fly(35.0).status is Status.HOLDING
    assert flight.distance(2.0, 1.0) < 0.05
    flight.pilot.mission.obey(ReturnToStart())
    flight.fly(8.0)
    flight.pilot.mission.obey(Hold())
    flight.fly(0.5)
    target = flight.pilot.mission.target
    assert target is not None
    flight.fly(25.0)
    assert flight.distance(target.x_m, target.y_m) < 0.05
    flight.pilot.mission.obey(ReturnToStart())
    flight.fly(30.0)
    assert flight.distance(0.5, -0.5) < 0.06
    flight.pilot.mission.obey(Stop())
    assert flight.fly(1.0).status is Status.HOVERING
    assert flight.pilot.mission.target is None


def test_places_outside_the_fence_are_refused() -> None:
    mission = Mission(Fence(-1.0, -1.0, 1.0, 1.0, 0.5, 3.0))
    mission.visit([Place(0.5, 0.5), Place(5.0, 0.0), Place(-0.5, 0.0)])
    assert mission.target == Place(0.5, 0.5)
    assert mission.following == (Place(-0.5, 0.0),)
    assert "1 of 3" in mission.refused
    mission.obey(GoTo(3.0, 0.0))
    assert "outside the geofence" in mission.refused
    assert mission.target == Place(0.5, 0.5)
    mission.obey(GoTo(0.0, 0.0))
    assert not mission.refused


def test_places_are_visited_in_order_and_passed_where_there_is_no_need_to_stop() -> None:
    flight = Flight()
    points = np.array([[1.5, -0.5], [1.5, 0.5], [0.5, 0.5]])
    flight.fly(0.2)
    flight.pilot.mission.visit(places_of(points, passing=True))
    nearest = np.full(3, math.inf)
    for _ in range(400):
        flight.fly(0.1)
        nearest = np.minimum(nearest, [flight.distance(*point) for point in points])
        if flight.pilot.mission.is_over:
            break
    assert flight.pilot.mission.is_over
    assert (nearest < 0.9).all()
    assert nearest[2] < 0.08
    assert flight.pilot.mission.n_arrived == 1
    passed = flight.plant.time_s
    flight = Flight()
    flight.fly(0.2)
    flight.pilot.mission.visit(places_of(points))
    while not flight.pilot.mission.is_over and flight.plant.time_s < 200.0:
        flight.fly(0.1)
        flight.pilot.mission.proceed()
    assert flight.pilot.mission.n_arrived == 3
    assert flight.plant.time_s > passed


def test_without_a_fix_it_keeps_still_then_searches_and_goes_on_when_found() -> None:
    flight = Flight(Fence(-4.0, -4.0, 4.0, 4.0, 0.8, 4.0))
    flight.pilot.mission.obey(GoTo(0.5, -0.5))
    flight.fly(5.0)
    lost = flight.fly(KEEP_STILL_S - 0.5, blind=True)
    assert lost.status is Status.LOST
    assert lost.reason == "black"
    assert lost.lost_s == pytest.approx(KEEP_STILL_S - 0.5, abs=0.2)
    assert flight.distance(0.5, -0.5) < 0.4
    searching = flight.fly(30.0, blind=True)
    assert searching.status is Status.SEARCHING
    far = flight.distance(0.5, -0.5)
    assert 0.3 < far < 4.0
    assert abs(flight.plant.position[2] - 2.0) < 0.1, "height is held by the range sensor"
    assert flight.pilot.estimator.state is not None
    assert flight.pilot.estimator.state.horizontal_sigma_m > 1.0
    flight.fly(1.0)
    assert flight.situations[-1].status is Status.FLYING
    flight.fly(40.0)
    assert flight.distance(0.5, -0.5) < 0.06


def test_searching_ends_and_the_fence_holds_all_along() -> None:
    flight = Flight(Fence(-0.5, -1.5, 1.5, 0.5, 0.8, 4.0))
    flight.fly(1.0)
    for _ in range(26):
        flight.fly(5.0, blind=True)
        believed = flight.pilot.estimator.state
        assert believed is not None
        assert -0.6 < believed.position[0] < 1.6
        assert -1.6 < believed.position[1] < 0.6
    assert flight.situations[-1].status is Status.GIVEN_UP


def test_before_the_first_fix_it_stays_where_it_is() -> None:
    flight = Flight()
    flight.plant = Plant(BLIMP, np.array([0.5, -0.5, 2.0]))
    assert flight.fly(3.0, blind=True).status is Status.WAITING
    assert flight.distance(0.5, -0.5) < 1e-9


def test_a_state_says_how_sure_it_is() -> None:
    state = true_state(Plant(BLIMP, np.zeros(3)))
    assert state.horizontal_sigma_m == pytest.approx(math.sqrt(2e-6))
