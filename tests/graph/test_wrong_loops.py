"""What the end of a flight makes of its loops: all true ones kept, however unevenly noise was stated, no
false ones, and a stretch of poses that wrong loops have wound up is unwound.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.geometry.poses import Pose
from overfly.graph import online
from overfly.graph.batch import Start, optimise_batch
from overfly.graph.gate import Gate, gate_bound
from overfly.graph.linearise import chi2
from overfly.graph.online import Decision, OnlineOptimiser, OnlineSettings
from overfly.graph.pose_graph import PoseGraph, State
from overfly.graph.synthetic import (
    LawnMower,
    fly_lawn_mower,
    replay,
    trajectory_error_m,
    with_false_loops,
)
from overfly.types import Constraint, ConstraintKind


def run(recording):
    optimiser, outcomes = None, []
    for graph, constraint in replay(recording):
        optimiser = optimiser or OnlineOptimiser(graph, OnlineSettings())
        outcomes.append(optimiser.add(constraint))
    return optimiser, outcomes


def uneven(recording, overstated, spread, seed):
    """The same flight, its noise stated so many times too large, and of another size in every constraint."""
    random = np.random.default_rng(seed)
    constraints = []
    for c in recording.constraints:
        truth = recording.truth[c.i].inverse() @ recording.truth[c.j]
        noise = (truth.inverse() @ c.i_from_j).log() * np.exp(random.normal(0.0, spread))
        constraints.append(
            replace(c, i_from_j=truth @ Pose.exp(noise), information=c.information / overstated**2)
        )
    return replace(recording, constraints=constraints)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 1000), st.floats(1.0, 2.0), st.integers(200, 3000))
def test_the_bound_holds_all_distances_and_no_false_ones(seed, power, count):
    """Distances of overstated noise, evenly spread or not; a tenth more are a thousand times the largest."""
    distances = 1e-9 * np.random.default_rng(seed).chisquare(6, count) ** power
    far = np.full(count // 10, 1000.0 * distances.max())
    gate = Gate(3.0, 6, 0)
    assert (distances > gate.bound_for_all(distances)).sum() <= max(1, 0.002 * count)
    assert gate.bound_for_all(np.concatenate([distances, far])) < far[0]


def test_the_bound_is_never_wider_than_stated():
    assert Gate(3.0, 6, 0).bound_for_all(np.random.default_rng(0).chisquare(6, 500)) == gate_bound(3.0, 6)


@pytest.mark.parametrize("rate", [0.0, 0.1, 0.5])
def test_finish_keeps_every_true_loop_of_uneven_overstated_noise(rate):
    flown = fly_lawn_mower(LawnMower(400, sigma_m=1e-3, sigma_rad=1e-4), 2)
    recording = with_false_loops(uneven(flown, 100.0, 0.7, 3), rate, 4)
    optimiser, _ = run(recording)
    report = optimiser.finish()
    best = optimiser.graph.copy()
    best.states[:] = np.where(recording.false, State.REJECTED, State.ACTIVE)
    optimise_batch(best)
    kept = optimiser.graph.states == State.ACTIVE
    assert not (kept & recording.false).any()
    assert (~kept & ~recording.false).sum() <= 1
    assert report.chi2_after <= chi2(best) * 1.001
    assert trajectory_error_m(optimiser.graph, recording.truth) < 1.2 * trajectory_error_m(
        best, recording.truth
    )


def test_each_start_unwinds_a_turn_too_many():
    """Poses on a ring that turn once around, each a little, though nothing says so: no step undoes that."""
    graph = PoseGraph()
    for node in range(60):
        graph.add_node(Pose.exp(np.array([0.0, 0.0, 0.0, 2.0 * np.pi * node / 60.0, 0.0, 0.0])))
    for node in range(60):
        kind = ConstraintKind.ODOMETRY if node < 59 else ConstraintKind.REVISIT
        graph.add_constraint(Constraint(node, (node + 1) % 60, Pose.identity(), np.eye(6), kind))
    wound = chi2(graph)
    optimise_batch(graph, start=Start.GIVEN)
    assert chi2(graph) > 0.9 * wound
    optimise_batch(graph, start=Start.EACH)
    assert chi2(graph) < 1e-6 * wound


def test_a_solver_that_has_used_its_share_waits(monkeypatch):
    """False loops that pass every gate make it work; beyond its share, loops wait for the end."""
    precise = uneven(fly_lawn_mower(LawnMower(200, sigma_m=1e-3, sigma_rad=1e-4), 2), 1000.0, 0.0, 1)
    recording = with_false_loops(precise, 0.5, 3)
    _, free = run(recording)
    monkeypatch.setattr(online, "MULTIPLICATIONS", 1e4)
    optimiser, bounded = run(recording)
    assert all(outcome.decision is not Decision.PENDING for outcome in free)
    assert sum(outcome.optimised for outcome in bounded) < 0.5 * sum(outcome.optimised for outcome in free)
    waiting = [outcome for outcome in bounded if outcome.decision is Decision.PENDING]
    assert waiting
    assert all(outcome.innovation is None for outcome in waiting)
    optimiser.finish()
    kept = optimiser.graph.states == State.ACTIVE
    assert not (kept & recording.false).any()
    revisits = np.array([c.kind is ConstraintKind.REVISIT for c in recording.constraints])
    assert kept[revisits & ~recording.false].mean() > 0.95
