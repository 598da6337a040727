"""What a gyroscope's rates are put together to, and how exact they are found to be."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.geometry.poses import FloatArray
from overfly.geometry.rotations import rotations_from_vectors, vectors_from_rotations
from overfly.graph.points_turns import N_FAULTS
from overfly.gyroscope import Gyroscope, noise_density, turns_between
from overfly.sensors import open_flight
from overfly.slam import Slam
from overfly.trajectory import Trajectory, read_tum

RATE_HZ = 200.0


def rates_of(seed: int, seconds: float) -> tuple[np.ndarray, FloatArray]:
    """Times and angular rates of something that wobbles."""
    generator = np.random.default_rng(seed)
    t_s = np.arange(0.0, seconds, 1.0 / RATE_HZ)
    wave = [a * np.sin(f * t_s + p) for a, f, p in generator.uniform(0.1, 1.0, (3, 3)) * [0.6, 6.0, 6.0]]
    return 7_000_000_000 + np.round(t_s * 1e9).astype(np.int64), np.column_stack(wave)


def in_small_steps(t_ns: np.ndarray, rates: FloatArray, first_ns: int, last_ns: int) -> FloatArray:
    """(3, 3) turn by midpoints of a millisecond, one after the other."""
    edges = np.linspace(first_ns, last_ns, max(2, (last_ns - first_ns) // 1_000_000))
    middle, step_s = 0.5 * (edges[1:] + edges[:-1]), float(edges[1] - edges[0]) * 1e-9
    turn = np.eye(3)
    for rate in np.column_stack([np.interp(middle, t_ns, column) for column in rates.T]):
        turn = turn @ rotations_from_vectors(rate * step_s)
    return turn


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.floats(0.1, 3.0), st.floats(0.01, 1.5))
def test_a_turn_is_that_of_small_steps(seed: int, begin_s: float, length_s: float) -> None:
    t_ns, rates = rates_of(seed, 5.0)
    first, last = int(7e9 + begin_s * 1e9), int(7e9 + (begin_s + length_s) * 1e9)
    measured = Gyroscope(t_ns, rates).between(np.array([first]), np.array([last]))
    apart = measured.rotations[0].T @ in_small_steps(t_ns, rates, first, last)
    assert np.linalg.norm(vectors_from_rotations(apart)) < 3e-4
    assert measured.is_known[0]
    assert measured.seconds[0] == pytest.approx(length_s, abs=1e-8)


def test_faults_turn_as_they_are_said_to() -> None:
    """Half a second of wobble: a bias to a hundredth; scale and misalignment as if it turned evenly."""
    left: list[list[float]] = [[], []]
    for seed in range(40):
        t_ns, rates = rates_of(seed, 3.0)
        generator = np.random.default_rng(seed)
        first, last = np.array([int(8e9)]), np.array([int(8.5e9)])
        measured = Gyroscope(t_ns, rates).between(first, last)
        bias, matrix = generator.normal(0, 0.02, 3), generator.normal(0, 0.005, 9)
        for k, faults in enumerate((np.append(bias, np.zeros(9)), np.append(np.zeros(3), matrix))):
            true_rates = rates @ (np.eye(3) + faults[3:].reshape(3, 3)).T - faults[:3]
            true = Gyroscope(t_ns, true_rates).between(first, last).rotations[0]
            off = vectors_from_rotations(true.T @ measured.rotations[0])
            said = measured.by_faults[0] @ faults
            left[k].append(float(np.linalg.norm(off - said) / np.linalg.norm(off)))
    assert np.median(left[0]) < 0.01
    assert np.median(left[1]) < 0.15


def test_where_it_was_not_heard_nothing_is_said() -> None:
    t_ns, rates = rates_of(1, 5.0)
    heard = np.abs((t_ns - 7e9) * 1e-9 - 2.0) > 0.4
    moments = 7_000_000_000 + np.array([-1, 5, 10, 15, 18, 22, 25, 30, 60]) * 100_000_000
    gyroscope = Gyroscope(t_ns[heard], rates[heard])
    known = gyroscope.between(moments[:-1], moments[1:]).is_known
    assert known.tolist() == [False, True, True, False, False, False, True, False]
    assert not gyroscope.between(moments[3:2:-1], moments[2:1:-1]).is_known.any()  # backwards
    part = np.array([0, 0, 0, 1, 1, 1, 1, 2, 2])
    turns = turns_between(gyroscope, moments, part, 0.01)
    assert turns is not None
    assert (turns.i.tolist(), turns.j.tolist()) == ([1], [2])
    assert turns_between(gyroscope, moments, np.arange(9), 0.01) is None


@pytest.mark.parametrize("density", [2e-4, 1.2e-3, 5e-3])
@pytest.mark.parametrize("pose_noise", [0.0, 3e-4])
def test_noise_is_found_and_never_far_below(density: float, pose_noise: float) -> None:
    """120 nodes, half a second apart, by poses that err themselves, least about the world's z."""
    t_ns, rates = rates_of(4, 62.0)
    generator = np.random.default_rng(int(density * 1e6))
    exact = Gyroscope(t_ns, rates)
    nodes = t_ns[0] + np.arange(1, 121) * 500_000_000
    rotations = exact.between(np.full(120, t_ns[0]), nodes).rotations
    noisy = rates @ (np.eye(3) + 0.01 * generator.normal(0, 1, (3, 3))) + [0.02, -0.03, 0.01]
    noisy += density * math.sqrt(RATE_HZ) * generator.normal(0, 1, rates.shape)
    turns = turns_between(Gyroscope(t_ns, noisy), nodes, np.zeros(120, np.int64), math.inf)
    assert turns is not None and len(turns) == 119
    poses = rotations_from_vectors(generator.normal(0, 1, (120, 3)) * pose_noise * [3, 3, 1]) @ rotations
    most = density + 2.0 * pose_noise / math.sqrt(0.5)
    assert 0.7 * density < noise_density(turns, poses) < 1.2 * most
    few = replace(
        turns, i=turns.i[:19], j=turns.j[:19], rotations=turns.rotations[:19],
        by_faults=turns.by_faults[:19], seconds=turns.seconds[:19],
    )  # fmt: skip
    assert math.isinf(noise_density(few, poses))
    assert turns.by_faults.shape[2] == N_FAULTS


@pytest.mark.data
def test_turns_of_a_finished_map_are_truer_with_it(data_dir: Path) -> None:
    """A gyroscope of 1.2e-3 rad/s/sqrt(Hz), whose noise is found to be about that."""
    folder = data_dir / "flights" / "corridor"
    flight = open_flight(folder)
    frames = list(flight)[:300]
    truth = read_tum(folder / "truth" / "groundtruth_cam0.tum")
    errors = []
    for read_imu in (None, lambda: flight.imu):
        slam = Slam(flight.rig, None, None, flight.attitude_at, read_imu)
        for frame in frames:
            slam.process(frame)
        slam.finish()
        assert slam.adjustment is not None
        errors.append(_turn_error(slam, truth))
    assert 8e-4 < slam.adjustment.gyro_density < 2.5e-3
    assert errors[1] < 0.8 * errors[0]


def _turn_error(slam: Slam, truth: Trajectory) -> float:
    """RMS of the turns between nodes that follow each other, radians."""
    at = {int(t): k for k, t in enumerate(truth.t_ns)}
    found = np.array([slam.map.graph.pose(node.index).rotation for node in slam.map.nodes])
    true = np.array([truth.pose(at[node.t_ns]).rotation for node in slam.map.nodes])
    turns = [np.einsum("cji,cjk->cik", R[:-1], R[1:]) for R in (found, true)]
    return float(np.sqrt(np.mean(vectors_from_rotations(turns[1].transpose(0, 2, 1) @ turns[0]) ** 2)))
