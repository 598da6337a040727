"""Controller, geofence and search: in a loop with the plants of the simulator."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.geometry.poses import wrap_angle
from overfly.navigation.controller import Setpoint, steer
from overfly.navigation.safety import Fence, SearchPattern, guard
from overfly.simulation.plants import Plant, Wind
from overfly.simulation.vehicles import BLIMP, Vehicle
from overfly.types import VelocityCommand

from .loops import VEHICLES, airframe, true_state

FENCE = Fence(-3.0, -2.0, 3.0, 2.0, 0.7, 3.5)
vehicles = st.sampled_from(VEHICLES)
angles = st.floats(-math.pi, math.pi)


@given(vehicles, angles, st.floats(0.2, 5.0), angles, st.floats(0.0, 0.15))
@settings(max_examples=10)
def test_it_comes_to_its_place_and_stays(
    vehicle: Vehicle, direction: float, distance: float, yaw: float, wind: float
) -> None:
    place = np.array([distance * math.cos(direction), distance * math.sin(direction), 2.2])
    plant = Plant(vehicle, np.array([0.0, 0.0, 1.8]), yaw, wind=Wind((wind, 0.0), 0.3 * wind))
    setpoint = Setpoint(place, yaw + 0.5)
    frame = airframe(vehicle)
    apart, along = [], []
    for _ in range(600):
        plant.step(steer(true_state(plant), setpoint, frame), 0.1)
        away = plant.position[:2] - place[:2]
        apart.append(float(np.linalg.norm(away)))
        along.append(float(away @ place[:2]) / distance)
    assert max(apart[450:]) < 0.05 + 0.5 * wind
    assert max(along) < 0.03 * distance + 0.05 + 0.5 * wind, "it overshoots"
    assert abs(plant.position[2] - 2.2) < 0.03
    assert abs(wrap_angle(plant.euler[2] - yaw - 0.5)) < 0.03


def test_it_goes_no_faster_than_it_is_told() -> None:
    plant = Plant(BLIMP, np.array([0.0, 0.0, 1.8]))
    setpoint = Setpoint(np.array([6.0, 0.0, 1.8]), 0.0, max_speed_m_s=0.3)
    fastest = 0.0
    for _ in range(250):
        plant.step(steer(true_state(plant), setpoint, airframe(BLIMP)), 0.1)
        fastest = max(fastest, float(np.linalg.norm(plant.velocity)))
    assert 0.25 < fastest < 0.34


@given(
    vehicles,
    angles,
    st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-2, 2), st.floats(-1, 1)), min_size=4),
    st.integers(1, 60),
)
@settings(max_examples=20)
def test_no_command_leads_out_of_the_fence(
    vehicle: Vehicle, yaw: float, commands: list[tuple[float, float, float, float]], each: int
) -> None:
    """Whatever is asked, and for however long."""
    plant, frame = Plant(vehicle, np.array([0.0, 0.0, 1.8]), yaw), airframe(vehicle)
    for asked in commands[:12]:
        for _ in range(each):
            state = true_state(plant)
            plant.step(guard(VelocityCommand(*asked), state, FENCE, frame, float(plant.position[2])), 0.1)
            x, y, z = plant.position
            assert -3.05 < x < 3.05
            assert -2.05 < y < 2.05
            assert 0.7 - 0.02 < z < 3.5 + 0.02


@given(vehicles, angles, st.floats(1.2, 2.5), st.floats(0.2, 0.68))
@settings(max_examples=8)
def test_from_outside_it_comes_back_in(vehicle: Vehicle, direction: float, far: float, low: float) -> None:
    """Pushed out and down, and told to go on outwards."""
    outside = np.array([far * 3.6 * math.cos(direction), far * 3.6 * math.sin(direction), low])
    plant, frame = Plant(vehicle, outside.copy()), airframe(vehicle)
    away = VelocityCommand(math.cos(direction), math.sin(direction), -1.0)
    for _ in range(700):
        plant.step(guard(away, true_state(plant), FENCE, frame), 0.1)
    x, y, z = plant.position
    assert abs(x) < 3.05
    assert abs(y) < 2.05
    assert 0.68 < z < 0.9


@given(vehicles, st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.05, 0.05), angles)
def test_far_from_its_sides_the_fence_changes_nothing(
    vehicle: Vehicle, x: float, y: float, up: float, yaw: float
) -> None:
    wide = Fence(-90.0, -90.0, 90.0, 90.0, 0.5, 60.0)
    asked = VelocityCommand(x, y, up, 0.1)
    state = true_state(Plant(vehicle, np.array([0.0, 0.0, 20.0]), yaw))
    allowed = guard(asked, state, wide, airframe(vehicle))
    np.testing.assert_allclose(dataclasses.astuple(allowed), dataclasses.astuple(asked), atol=1e-12)


def test_the_floor_is_above_the_ground_not_above_zero() -> None:
    """Over a table of 1.2 m the map's height is no comfort."""
    state = true_state(Plant(BLIMP, np.array([0.0, 0.0, 1.8])))
    down = VelocityCommand(up_m_s=-0.3)
    assert guard(down, state, FENCE, airframe(BLIMP)).up_m_s < 0.0
    assert guard(down, state, FENCE, airframe(BLIMP), height_above_ground_m=0.6).up_m_s > 0.0


def test_the_nearest_place_inside() -> None:
    np.testing.assert_allclose(FENCE.nearest_inside(np.array([9.0, 0.5, 0.1])), [3.0, 0.5, 0.7])
    assert FENCE.holds(2.9, -1.9)
    assert not FENCE.holds(2.9, -2.1)


@given(st.floats(0.2, 3.0), st.floats(0.05, 1.0), st.floats(0.0, 200.0), st.floats(0.0, 1.0))
def test_a_search_is_flown_at_its_speed(leg: float, speed: float, time_s: float, later: float) -> None:
    pattern = SearchPattern(1.0, -2.0, leg, speed)
    here, there = np.array(pattern.place(time_s)), np.array(pattern.place(time_s + later))
    assert np.linalg.norm(there - here) <= speed * later + 1e-9


def test_a_search_leaves_nothing_out() -> None:
    """Its lines are a leg apart in all directions."""
    pattern = SearchPattern(0.0, 0.0, 0.5, 0.5)
    places = np.array([pattern.place(time_s) for time_s in np.arange(0.0, 120.0, 0.1)])
    for x, y in np.random.default_rng(0).uniform(-1.2, 1.2, (100, 2)):
        assert np.linalg.norm(places - [x, y], axis=1).min() < 0.5 / math.sqrt(2.0) + 0.03
    assert pattern.place(0.0) == pytest.approx((0.0, 0.0))
