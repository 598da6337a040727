"""The loop that a controller closes: command, step, frame."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest

from overfly.geometry.poses import Pose
from overfly.simulation import LiveFlight, VelocityCommand, Wind
from overfly.simulation.plants import towards
from overfly.simulation.scenario import Scenario, declared

from .scenes import dots_flight, still


@functools.cache
def built(name: str) -> Scenario:
    return declared(name).build(1)


def live(name: str = "hold", seed: int = 1, **wind: object) -> LiveFlight:
    return LiveFlight(built(name), seed, Wind(**wind) if wind else None)  # type: ignore[arg-type]


def test_same_commands_same_frames() -> None:
    flights = [live(gust_m_s=0.1), live(gust_m_s=0.1)]
    for flight in flights:
        for _ in range(4):
            flight.step(VelocityCommand(forward_m_s=0.4, yaw_rate_rad_s=0.1), 0.1)
    one, two = (flight.frame() for flight in flights)
    assert np.array_equal(one.images[0], two.images[0])
    assert one.altitude == two.altitude
    assert one.t_ns == two.t_ns


def test_the_picture_moves_with_the_vehicle() -> None:
    flight = live()
    before = flight.frame()
    for _ in range(30):
        flight.step(VelocityCommand(forward_m_s=0.5), 0.1)
    after = flight.frame()
    assert flight.truth.translation[0] > 0.3
    assert math.isclose((after.t_ns - before.t_ns) * 1e-9, 3.0, abs_tol=1e-6)
    assert np.abs(before.images[0].astype(int) - after.images[0]).mean() > 5.0
    assert after.index == 1


def test_a_closed_loop_holds_against_pushes() -> None:
    flight = live(gust_m_s=0.05)
    place = flight.truth.translation
    flight.plant.push(np.array([0.6, 0.3, 0.0]))
    for _ in range(400):
        flight.step(towards(flight.plant, place), 0.1)
    assert np.linalg.norm(flight.truth.translation - place) < 0.5


def test_sensors_are_those_of_the_scenario() -> None:
    survey = live("fixed-wing")
    survey.step(VelocityCommand(forward_m_s=16.0), 0.5)
    frame = survey.frame()
    assert frame.attitude is not None
    assert frame.position is not None
    assert frame.altitude is not None
    blimp = live()
    ranges = []
    for _ in range(60):
        blimp.step(VelocityCommand(), 0.05)
        altitude = blimp._altitude(blimp.truth)
        ranges.append(math.nan if altitude is None else altitude.value_m)
    assert np.nanmean(ranges) == pytest.approx(blimp.truth.translation[2], abs=0.03)


def test_it_sees_what_a_recorded_flight_sees() -> None:
    """Not moving, the live picture is that of the recorded flight from the same pose."""
    at = np.array([0.4, -0.3, 1.8])
    recorded = dots_flight(
        np.array([[0.1, 0.2, 0.0], [0.5, -0.4, 0.0]]), still(at, np.zeros(3)), sigma_m=0.02
    )
    scenario = dataclasses.replace(recorded.scenario)
    loop = LiveFlight(scenario)
    assert isinstance(loop.truth, Pose)
    assert np.array_equal(loop.frame().images[0], recorded.frame(1).images[0])


def test_an_object_of_known_size_is_seen_where_it_is() -> None:
    """Its corners as they are clicked give the height of the camera."""
    flight = live("helicopter")
    thing = flight.scale_landmark
    assert thing is not None
    assert thing.t_ns == flight.stamp_ns == flight.frame().t_ns
    camera = flight.scenario.cameras[0].real_camera
    world_from_cam = flight.truth @ flight.scenario.cameras[0].real_mount
    rays = (
        np.column_stack([camera.rays_from_pixels(thing.corners_px), np.ones(4)]) @ world_from_cam.rotation.T
    )
    ground = world_from_cam.translation - rays * (world_from_cam.translation[2] / rays[:, 2:])
    sides = np.linalg.norm(np.diff(ground[[0, 1, 3, 2, 0]], axis=0), axis=1)
    expected = np.linalg.norm(np.diff(thing.corners_m[[0, 1, 3, 2, 0]], axis=0), axis=1)
    assert 0.0 < np.abs(sides - expected).max() < 0.01
    assert live("blimp").scale_landmark is None
