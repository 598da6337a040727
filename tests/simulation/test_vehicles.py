"""Vehicles move as such vehicles do, recorded and in a loop."""

from __future__ import annotations

import math

import numpy as np
import pytest

from overfly.geometry.poses import euler_from_rotation
from overfly.simulation.paths import Route, lawn_mower, wobble
from overfly.simulation.plants import Plant, VelocityCommand, Wind, hold_position, towards
from overfly.simulation.vehicles import (
    BLIMP,
    FIXED_WING,
    GRAVITY,
    HELICOPTER,
    MULTIROTOR,
    ROD,
    VEHICLES,
    fly_route,
)

START = np.array([0.0, 0.0, 2.0])


@pytest.mark.parametrize("vehicle", VEHICLES.values(), ids=lambda v: v.name)
def test_every_vehicle_reaches_the_speed_it_is_told(vehicle) -> None:  # type: ignore[no-untyped-def]
    plant = Plant(vehicle, START, 0.3)
    speed = max(0.7 * vehicle.max_speed_m_s, vehicle.min_speed_m_s)
    for _ in range(600):
        plant.step(VelocityCommand(forward_m_s=speed, up_m_s=0.1), 0.1)
    along = plant.velocity[:2] @ np.array([math.cos(plant.euler[2]), math.sin(plant.euler[2])])
    assert math.isclose(along, speed, rel_tol=0.05)
    assert math.isclose(plant.velocity[2], 0.1, rel_tol=0.05)


def test_a_multirotor_leans_forward_to_go_forward_and_left_to_go_left() -> None:
    plant = Plant(MULTIROTOR, START, 1.0)
    roll, pitch, yaw = euler_from_rotation(plant.step(VelocityCommand(forward_m_s=3.0), 0.3).rotation)
    assert pitch > math.radians(5)
    assert abs(roll) < math.radians(1)
    assert math.isclose(yaw, 1.0)
    plant = Plant(MULTIROTOR, START, 1.0)
    roll, pitch, _ = euler_from_rotation(plant.step(VelocityCommand(left_m_s=3.0), 0.3).rotation)
    assert roll < -math.radians(5)
    assert abs(pitch) < math.radians(1)
    assert plant.velocity[:2] @ np.array([-math.sin(1.0), math.cos(1.0)]) > 0.3


def test_limits_hold() -> None:
    plant = Plant(MULTIROTOR, START)
    for _ in range(50):
        pose = plant.step(VelocityCommand(100.0, 0.0, 100.0, 100.0), 0.1)
        roll, pitch, _ = euler_from_rotation(pose.rotation)
        assert math.hypot(roll, pitch) < MULTIROTOR.max_tilt_rad * 1.01
    assert np.linalg.norm(plant.velocity[:2]) <= MULTIROTOR.max_speed_m_s * 1.01
    assert plant.velocity[2] <= MULTIROTOR.max_climb_m_s
    assert abs(plant._yaw_rate) <= MULTIROTOR.max_yaw_rate_rad_s


def test_steps_of_any_length_agree() -> None:
    one, many = Plant(HELICOPTER, START), Plant(HELICOPTER, START)
    command = VelocityCommand(0.8, -0.3, 0.2, 0.4)
    one.step(command, 2.0)
    for _ in range(40):
        many.step(command, 0.05)
    assert np.linalg.norm(one.position - many.position) < 1e-3
    assert math.isclose(one.time_s, many.time_s)


def test_wind_carries_an_uncommanded_blimp_and_a_controller_fights_it() -> None:
    wind = Wind((0.3, 0.0))
    adrift, held = Plant(BLIMP, START, wind=wind), Plant(BLIMP, START, wind=wind)
    for _ in range(300):
        adrift.step(VelocityCommand(), 0.1)
        held.step(towards(held, START), 0.1)
    assert adrift.position[0] > 0.0
    assert np.linalg.norm(held.position - START) < 0.5


def test_pushed_away_the_blimp_comes_back_slowly() -> None:
    plant = Plant(BLIMP, START)
    plant.push(np.array([0.9, 0.0, 0.0]))
    farthest = 0.0
    for _ in range(900):
        plant.step(towards(plant, START), 0.1)
        farthest = max(farthest, float(np.linalg.norm(plant.position - START)))
    assert 0.8 < farthest < 6.0
    assert np.linalg.norm(plant.position - START) < 0.3


def test_a_wing_never_stalls_and_banks_into_its_turn() -> None:
    plant = Plant(FIXED_WING, np.array([0.0, 0.0, 100.0]))
    for _ in range(30):
        pose = plant.step(VelocityCommand(forward_m_s=0.0, left_m_s=1.0), 0.1)
        assert np.linalg.norm(plant.velocity[:2]) > FIXED_WING.min_speed_m_s * 0.999
    roll, _, yaw = euler_from_rotation(pose.rotation)
    assert yaw > 0.3, "turned left"
    assert roll < -math.radians(10), "left wing down"


def test_recorded_tilt_is_what_the_acceleration_needs() -> None:
    """Differential flatness: without drag and wobble, thrust along the body's z gives the acceleration."""
    from dataclasses import replace

    calm = replace(
        MULTIROTOR, drag_per_s=0.0, wobble_m=0.0, wobble_height_m=0.0, wobble_tilt_rad=0.0, wobble_yaw_rad=0.0
    )
    path = fly_route(Route(np.array([[0, 0, 2], [5, 0, 2], [8, 4, 2], [4, 8, 2.0]]), 2.0), calm, 1)
    times = np.linspace(1.0, path.end_s - 1.0, 60)
    rotations, _ = path.poses(times)
    accelerations = path.accelerations(times)
    thrust = rotations[:, :, 2] * (GRAVITY / rotations[:, 2, 2])[:, None]
    assert np.abs(thrust[:, :2] - accelerations[:, :2]).max() < 0.35
    assert np.abs(accelerations[:, :2]).max() > 0.5


def test_path_derivatives_are_its_own() -> None:
    path = fly_route(Route(np.array([[0, 0, 2], [5, 0, 2], [8, 4, 2.0]]), 1.5), ROD, 2)
    t, h = np.linspace(1.0, 4.0, 13), 1e-5
    _, before = path.poses(t - h)
    _, after = path.poses(t + h)
    assert np.abs((after - before) / (2 * h) - path.velocities(t)).max() < 1e-5
    Ra, _ = path.poses(t - h)
    Rb, _ = path.poses(t + h)
    turn = np.einsum("nji,njk->nik", Ra, Rb) / (2 * h)
    rates = np.column_stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]])
    assert np.abs(rates - path.body_rates(t)).max() < 1e-4


def test_a_route_keeps_its_speed_and_its_duration() -> None:
    route = Route(np.array([[0, 0, 2], [10, 0, 2], [10, 10, 2.0]]), 1.5, pause_s=1.0)
    times, positions, _ = route.sample()
    speed = np.linalg.norm(np.gradient(positions, times, axis=0), axis=1)
    assert math.isclose(np.median(speed), 1.5, rel_tol=0.02)
    assert speed.max() < 1.6
    assert math.isclose(route.lasting(60.0).sample()[0][-1], 60.0, abs_tol=0.2)


def test_carried_from_one_path_to_another() -> None:
    first = fly_route(Route(np.array([[0, 0, 2], [5, 0, 2], [8, 4, 2.0]]), 1.5), ROD, 2)
    both = first.cut(0.0, 3.0).followed_by(first.cut(1.0, 4.0), gap_s=2.0)
    assert math.isclose(both.duration_s, 8.0, abs_tol=0.1)
    assert np.allclose(both.pose(1.5).translation, first.pose(1.5).translation, atol=1e-6)
    assert np.allclose(both.pose(6.0).translation, first.pose(2.0).translation, atol=0.1)
    steps = np.diff(both.poses(np.arange(0.0, 7.9, 0.02))[1], axis=0)
    assert np.linalg.norm(steps, axis=1).max() < 0.2


def test_a_held_position_is_left_and_found_again() -> None:
    path = hold_position(BLIMP, (0.0, 0.0, 2.0), duration_s=240.0, push_every_s=40.0, push_m=2.5, seed=1)
    away = np.linalg.norm(path.poses(np.arange(0.0, 240.0, 0.5))[1][:, :2], axis=1)
    assert 1.5 < away.max() < 6.0
    assert np.median(away) < 1.5


def test_lawn_mower_covers_the_area() -> None:
    points = lawn_mower((0.0, 0.0, 100.0, 60.0), 10.0, 12.0, 30.0, cross_height_m=40.0)
    assert set(points[:, 2].tolist()) >= {30.0, 40.0}
    rows = np.unique(points[points[:, 2] == 30.0, 1].round(6))
    assert np.diff(rows).max() <= 12.0
    assert rows.min() == 10.0
    assert rows.max() == 50.0


def test_wobble_has_the_stated_size_and_band() -> None:
    times = np.arange(0.0, 600.0, 0.05)
    motion = wobble(times, 0.02, (0.2, 2.0), np.random.default_rng(1))
    assert math.isclose(motion.std(), 0.02, rel_tol=0.05)
    power = np.abs(np.fft.rfft(motion)) ** 2
    frequency = np.fft.rfftfreq(len(times), 0.05)
    assert power[(frequency > 0.15) & (frequency < 2.5)].sum() > 0.99 * power.sum()
