"""The state estimator: right, as sure of itself as it may be, and not older than it must be."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.geometry.poses import Pose, rotation_from_euler, wrap_angle
from overfly.navigation.estimator import (
    MOST_REFUSED,
    Estimator,
    PlaceFix,
    command_in_heading,
    place_fix,
    velocity_in_world,
)
from overfly.simulation.plants import Plant, Wind
from overfly.simulation.vehicles import BLIMP, MULTIROTOR, Vehicle
from overfly.types import VelocityCommand

from .loops import PERIOD_NS, VEHICLES, airframe, error_of, fix_of

SIGMA_M = 0.01


def flown(vehicle: Vehicle, seed: int, seconds: float = 20.0) -> tuple[Estimator, Plant, list[np.ndarray]]:
    """Random commands and gusts; errors (6,) divided by what the filter thinks of them, of each frame."""
    generator = np.random.default_rng(seed)
    plant = Plant(vehicle, np.array([1.0, -2.0, 2.0]), 0.7, wind=Wind(gust_m_s=0.1), seed=seed)
    estimator = Estimator(airframe(vehicle))
    normalised = []
    for number in range(int(seconds * 10)):
        if number % 15 == 0:
            command = VelocityCommand(*generator.uniform(-0.4, 0.4, 2), 0.1, generator.uniform(-0.3, 0.3))
        estimator.see(fix_of(plant, SIGMA_M, generator))
        estimator.commanded(round(plant.time_s * 1e9), command)
        state = estimator.state
        assert state is not None
        if number > 20:
            error = np.concatenate([state.position - plant.position, state.velocity - plant.velocity])
            normalised.append(error / np.sqrt(np.diag(state.covariance)[:6]))
        plant.step(command, 0.1)
    return estimator, plant, normalised


@pytest.mark.parametrize("vehicle", VEHICLES, ids=lambda vehicle: vehicle.name)
def test_it_is_as_sure_as_it_may_be(vehicle: Vehicle) -> None:
    """Errors lie within their standard deviations, and these are not idly wide."""
    rms = np.sqrt(np.mean(np.array(flown(vehicle, 3)[2]) ** 2, axis=0))
    assert (rms < 1.4).all()
    assert (rms[:3] > 0.3).all(), "positions are known better than the filter thinks"


def test_it_is_better_than_its_fixes_say_of_velocity() -> None:
    generator = np.random.default_rng(0)
    plant, estimator = Plant(BLIMP, np.zeros(3)), Estimator(airframe(BLIMP))
    command = VelocityCommand(forward_m_s=0.5)
    errors, differences = [], []
    last = None
    for number in range(200):
        fix = fix_of(plant, SIGMA_M, generator)
        estimator.see(fix)
        estimator.commanded(fix.t_ns, command)
        assert estimator.state is not None
        if last is not None and number > 50:
            errors.append(estimator.state.velocity[0] - plant.velocity[0])
            differences.append((fix.position[0] - last.position[0]) / 0.1 - plant.velocity[0])
        last = fix
        plant.step(command, 0.1)
    assert np.std(errors) < 0.6 * np.std(differences)


@pytest.mark.parametrize("vehicle", [BLIMP, MULTIROTOR], ids=lambda vehicle: vehicle.name)
def test_latency_is_made_up_for(vehicle: Vehicle) -> None:
    """A fix that is 150 ms old: carried on by the commands it is nearer to the truth than left as it was."""
    generator = np.random.default_rng(1)
    plant, estimator = Plant(vehicle, np.zeros(3)), Estimator(airframe(vehicle))
    left, carried = [], []
    late_ns = 150_000_000
    for number in range(120):
        angle = 0.08 * number
        command = VelocityCommand(0.8 * math.cos(angle), 0.8 * math.sin(angle))
        estimator.see(fix_of(plant, 0.003, generator))
        before = plant.position.copy()
        plant.step(command, 0.05)
        estimator.commanded(round(plant.time_s * 1e9), command)
        plant.step(command, 0.10)
        assert estimator.state is not None
        left.append(np.linalg.norm(before - plant.position))
        carried.append(np.linalg.norm(error_of(estimator, plant, estimator.state.t_ns + late_ns)[:3]))
    assert np.median(carried[20:]) < 0.35 * np.median(left[20:])


def test_one_wild_fix_is_refused_and_several_are_believed() -> None:
    estimator, plant, _ = flown(BLIMP, 5, 5.0)
    generator = np.random.default_rng(2)
    far = np.array([3.0, 0.0, 0.0])
    right = fix_of(plant, SIGMA_M, generator)
    for number in range(MOST_REFUSED):
        wild = PlaceFix(
            right.t_ns + number * PERIOD_NS, right.position + far, right.yaw_rad, right.covariance
        )
        believed = estimator.see(wild)
        assert believed == (number == MOST_REFUSED - 1)
        if number == 0:
            assert estimator.at(right.t_ns) is not None
            assert np.linalg.norm(error_of(estimator, plant, right.t_ns)[:3]) < 0.3
    assert estimator.n_resets == 1
    assert estimator.state is not None
    np.testing.assert_allclose(estimator.state.position, right.position + far)


def test_without_fixes_it_follows_the_commands_and_grows_unsure() -> None:
    estimator, plant, _ = flown(BLIMP, 7, 8.0)
    began = round(plant.time_s * 1e9)
    estimator.commanded(began, VelocityCommand())
    sigmas = []
    for _ in range(50):
        plant.step(VelocityCommand(), 0.1)
        estimator.pass_time(round(plant.time_s * 1e9))
        assert estimator.state is not None
        sigmas.append(estimator.state.horizontal_sigma_m)
    assert (np.diff(sigmas) > 0).all()
    error = np.linalg.norm(error_of(estimator, plant, round(plant.time_s * 1e9))[:2])
    assert 0.0 < error < 3.0 * sigmas[-1]
    assert error < 0.5


def test_height_alone_is_kept_by_the_range() -> None:
    estimator, plant, _ = flown(BLIMP, 9, 5.0)
    generator = np.random.default_rng(3)
    for _ in range(100):
        plant.step(VelocityCommand(), 0.1)
        t_ns = round(plant.time_s * 1e9)
        estimator.see_height(t_ns, float(plant.position[2] + generator.normal(0.0, 0.03)), 0.03)
    assert estimator.state is not None
    assert math.sqrt(estimator.state.covariance[2, 2]) < 0.03
    assert abs(estimator.state.position[2] - plant.position[2]) < 0.09
    assert estimator.state.horizontal_sigma_m > 0.5


@given(st.floats(-20.0, 20.0), st.floats(-0.4, 0.4))
@settings(max_examples=30)
def test_headings_go_round(start: float, rate: float) -> None:
    """Whatever the heading, it is followed across the jump from pi to minus pi."""
    estimator = Estimator(airframe(BLIMP))
    covariance = np.diag([1e-4, 1e-4, 1e-4, 2.5e-5])
    for number in range(40):
        yaw = wrap_angle(start + rate * 0.1 * number)
        estimator.see(PlaceFix(number * PERIOD_NS, np.zeros(3), yaw, covariance))
    assert estimator.n_resets == 0
    assert estimator.state is not None
    assert abs(wrap_angle(estimator.state.yaw_rad - yaw)) < 0.02
    assert estimator.state.yaw_rate_rad_s == pytest.approx(rate, abs=0.05)


@given(st.floats(-4.0, 4.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_commands_and_velocities_are_each_other_s_inverse(yaw: float, x: float, y: float, z: float) -> None:
    velocity = np.array([x, y, z])
    again = velocity_in_world(command_in_heading(velocity, yaw, 0.2), yaw)
    np.testing.assert_allclose(again, velocity, atol=1e-12)


def test_the_body_s_place_and_its_covariance_come_from_the_camera_s() -> None:
    """By perturbing the camera and looking where the body goes."""
    generator = np.random.default_rng(4)
    mount = Pose(rotation_from_euler(3.1, 0.05, 1.2), np.array([0.1, -0.05, -0.2]))
    body = Pose(rotation_from_euler(0.05, -0.03, 2.9), np.array([1.0, 2.0, 3.0]))
    camera = body @ mount
    root = generator.normal(0.0, 0.01, (6, 6))
    fix = place_fix(5, camera, root @ root.T, mount)
    np.testing.assert_allclose(fix.position, body.translation, atol=1e-12)
    assert fix.yaw_rad == pytest.approx(2.9)
    seen = []
    for _ in range(4000):
        moved = place_fix(5, camera @ Pose.exp(root @ generator.normal(size=6)), None, mount)
        seen.append(np.append(moved.position - fix.position, wrap_angle(moved.yaw_rad - fix.yaw_rad)))
    sampled = np.cov(np.array(seen).T)
    seams = place_fix(5, camera, None, mount).covariance
    np.testing.assert_allclose(np.diag(fix.covariance - seams), np.diag(sampled), rtol=0.25)
    assert (np.diag(seams) > 0).all()
