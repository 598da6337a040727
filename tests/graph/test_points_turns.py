"""Turns of a gyroscope in the adjustment: its equations are those of its cost, and its faults are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.geometry.poses import FloatArray
from overfly.geometry.rotations import rotations_from_vectors, vectors_from_rotations
from overfly.graph.points import adjust_points
from overfly.graph.points_priors import FAULTS
from overfly.graph.points_turns import FAULT_SIGMAS, N_FAULTS, OUTLIER, Turns

from .test_points import problem_of, survey


def random_turns(seed: int, density: float = 0.01) -> tuple[Turns, FloatArray]:
    """Between six poses, the later one first where it likes, and poses that differ from them."""
    generator = np.random.default_rng(seed)
    rotations = rotations_from_vectors(generator.normal(0, 1, (6, 3)))
    i = np.array([0, 2, 2, 4, 5])
    j = np.array([1, 1, 3, 3, 4])
    measured = np.einsum("cji,cjk->cik", rotations[i], rotations[j])
    measured = measured @ rotations_from_vectors(generator.normal(0, 0.01, (5, 3)))
    by_faults = generator.normal(0, 0.5, (5, 3, N_FAULTS))
    return Turns(i, j, measured, by_faults, generator.uniform(0.2, 2.0, 5), density), rotations


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_gradient_is_that_of_the_cost(seed: int) -> None:
    turns, rotations = random_turns(seed)
    faults = np.random.default_rng(seed + 1).normal(0, 0.002, N_FAULTS)
    gradient, corner_gradient = np.zeros((6, 6)), np.zeros(N_FAULTS)
    turns.add_to(
        rotations, faults, np.arange(5), np.zeros((6, 6, 6)), np.zeros((5, 6, 6)), gradient,
        np.zeros((6, 6, N_FAULTS)), np.zeros((N_FAULTS, N_FAULTS)), corner_gradient,
    )  # fmt: skip

    def cost(x: FloatArray) -> float:
        turned = rotations @ rotations_from_vectors(x[:18].reshape(6, 3))
        return 0.5 * turns.cost(turned, faults + x[18:])

    h = 1e-6
    by_hand = np.array([(cost(h * e) - cost(-h * e)) / (2.0 * h) for e in np.eye(18 + N_FAULTS)])
    scale = np.abs(by_hand).max()
    # Errors of hundredths of a radian: derivatives of small angles are right to a few parts in a hundred.
    np.testing.assert_allclose(gradient[:, 3:].ravel(), by_hand[:18], atol=0.03 * scale)
    np.testing.assert_allclose(corner_gradient, by_hand[18:], atol=1e-4 * scale)
    assert not gradient[:, :3].any()


def test_blocks_are_those_of_a_square() -> None:
    """The blocks put together are J'WJ, so a step along them lowers a quadratic cost to nothing."""
    turns, rotations = random_turns(3)
    pairs, pair = np.unique(turns.pairs(), return_inverse=True)
    diagonal, off = np.zeros((6, 6, 6)), np.zeros((len(pairs), 6, 6))
    border, corner = np.zeros((6, 6, N_FAULTS)), np.zeros((N_FAULTS, N_FAULTS))
    turns.add_to(
        rotations, np.zeros(N_FAULTS), pair, diagonal, off, np.zeros((6, 6)), border, corner,
        np.zeros(N_FAULTS),
    )  # fmt: skip
    whole = np.zeros((18 + N_FAULTS, 18 + N_FAULTS))
    for n in range(6):
        whole[3 * n : 3 * n + 3, 3 * n : 3 * n + 3] = diagonal[n, 3:, 3:]
        whole[3 * n : 3 * n + 3, 18:] = border[n, 3:]
        whole[18:, 3 * n : 3 * n + 3] = border[n, 3:].T
    for key, block in zip(pairs, off, strict=True):
        low, high = 3 * (int(key) >> 32), 3 * (int(key) & 0xFFFFFFFF)
        whole[low : low + 3, high : high + 3] = block[3:, 3:]
        whole[high : high + 3, low : low + 3] = block[3:, 3:].T
    whole[18:, 18:] = corner
    assert np.linalg.matrix_rank(whole, tol=1e-6 * whole.max()) == 15  # five turns of three numbers
    assert np.linalg.eigvalsh(whole).min() > -1e-9 * whole.max()


def gyro_of(poses_rotations: FloatArray, faults: FloatArray, density: float, seed: int) -> Turns:
    """Turns from each pose to the next within a second, by a gyroscope with such faults."""
    true = np.einsum("cji,cjk->cik", poses_rotations[:-1], poses_rotations[1:])
    vectors = vectors_from_rotations(true)
    matrix = np.einsum("ap,cq->capq", np.eye(3), vectors).reshape(-1, 3, 9)
    by_faults = np.concatenate([np.tile(np.eye(3), (len(true), 1, 1)), -matrix], axis=2)
    noise = density * np.random.default_rng(seed).normal(0, 1, (len(true), 3))
    measured = true @ rotations_from_vectors(by_faults @ faults + noise)
    n = np.arange(len(true))
    return Turns(n, n + 1, measured, by_faults, np.ones(len(true)), density)


def test_turns_mend_what_poor_pictures_leave_and_show_the_bias() -> None:
    poses, points = survey(3, 8, 5)
    truth = np.array([pose.rotation for pose in poses])
    faults = np.random.default_rng(1).normal(0, 1, N_FAULTS) * FAULT_SIGMAS
    poor = problem_of(poses, points, 0.01, 5)
    without = adjust_points(poor)
    turns = gyro_of(truth, faults, 5e-4, 2)
    solution = adjust_points(replace(poor, turns=turns))
    assert without is not None and solution is not None

    def error(rotations: FloatArray) -> float:
        relative = np.einsum("cji,cjk->cik", rotations[:-1], rotations[1:])
        true = np.einsum("cji,cjk->cik", truth[:-1], truth[1:])
        return float(np.sqrt(np.mean(vectors_from_rotations(true.transpose(0, 2, 1) @ relative) ** 2)))

    assert error(solution.rotations) < 0.5 * error(without.rotations)
    np.testing.assert_allclose(solution.common[FAULTS][:3], faults[:3], atol=3e-3)
    assert np.abs(faults[:3]).max() > 0.02


def test_a_gyroscope_of_unknown_noise_changes_nothing() -> None:
    poses, points = survey(2, 4, 6)
    problem = problem_of(poses, points, 0.003, 6)
    turns = gyro_of(np.array([pose.rotation for pose in poses]), np.zeros(N_FAULTS), 0.1, 2)
    silent = adjust_points(replace(problem, turns=replace(turns, density=float("inf"))))
    without = adjust_points(problem)
    assert silent is not None and without is not None
    np.testing.assert_allclose(silent.rotations, without.rotations, atol=1e-9)
    np.testing.assert_allclose(silent.points, without.points, atol=1e-9)
    assert not silent.common[FAULTS].any()


def test_a_turn_far_off_counts_linearly() -> None:
    turns, rotations = random_turns(7, 1e-4)
    measured = turns.rotations
    costs = [
        replace(turns, rotations=measured @ rotations_from_vectors(np.tile([0.0, 0.0, far], (5, 1)))).cost(
            rotations, np.zeros(N_FAULTS)
        )
        for far in (0.5, 1.0, 1.5)
    ]
    assert costs[2] - costs[1] == pytest.approx(costs[1] - costs[0], rel=0.1)
    length = np.linalg.norm(turns.errors(rotations, np.zeros(N_FAULTS)), axis=1) / turns.sigma
    assert (length > OUTLIER).all()
