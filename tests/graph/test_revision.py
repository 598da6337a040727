"""What the revision of loops stands on: covariances along all constraints at once, the same result in steps
or at once, and loops that would bend everything waiting for a second one.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.geometry.poses import Pose
from overfly.graph import in_flight
from overfly.graph.covariance import exact_covariance
from overfly.graph.gate import Gate
from overfly.graph.in_flight import RevisionInFlight
from overfly.graph.linearise import Freedom
from overfly.graph.online import OnlineOptimiser
from overfly.graph.pose_graph import PoseGraph, State
from overfly.graph.revision import revise
from overfly.graph.robust import PLAIN
from overfly.graph.steps import to_the_end
from overfly.graph.synthetic import LawnMower, fly_lawn_mower, replay, with_false_loops
from overfly.types import Constraint, ConstraintKind


def random_graph(n: int, planar: bool, seed: int) -> PoseGraph:
    """A chain with loops, some told twice and the other way round, some set aside."""
    random = np.random.default_rng(seed)
    graph = PoseGraph(planar)
    for node in range(n):
        tangent = random.normal(0.0, 1.0, 6)
        if planar:
            tangent[2:5] = 0.0
        graph.add_node(Pose.exp(tangent))
        ends = [(node - 1, node)] if node else []
        ends += [tuple(random.choice(node + 1, 2, replace=False)) for _ in range(2) if node > 1]
        for i, j in ends:
            root = random.normal(size=(6, 6))
            measured = graph.pose(int(i)).inverse() @ graph.pose(int(j))
            kind = ConstraintKind.REVISIT if abs(i - j) > 1 else ConstraintKind.ODOMETRY
            graph.add_constraint(Constraint(int(i), int(j), measured, root @ root.T + np.eye(6), kind))
    revisits = np.flatnonzero(graph.kinds == 1)
    graph.states[revisits[::3]] = State.REJECTED
    return graph


@settings(max_examples=20, deadline=None)
@given(freedom=st.sampled_from(list(Freedom)), n=st.integers(3, 40), seed=st.integers(0, 10**6))
def test_covariances_of_all_constraints_at_once_are_those_of_each(freedom, n, seed):
    graph = random_graph(n, freedom is Freedom.PLANAR, seed)
    covariance = exact_covariance(graph, freedom)
    found = to_the_end(covariance.along_constraints())
    i, j = graph.i[graph.active], graph.j[graph.active]
    expected = np.array([covariance.relative(int(a), int(b)) for a, b in zip(i, j, strict=True)])
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)
    slack = np.linalg.eigvalsh(covariance.at_most(i, j) - expected)
    assert slack.min() > -1e-9 * np.abs(expected).max()


def bent_flight(seed: int, rate: float) -> tuple[PoseGraph, np.ndarray]:
    recording = with_false_loops(fly_lawn_mower(LawnMower(200), seed), rate, seed)
    graph = None
    for graph, constraint in replay(recording):
        graph.add_constraint(constraint)
    return graph, recording.false


@pytest.mark.parametrize("rate", [0.1, 0.5])
def test_a_revision_finds_what_is_false_where_all_was_believed(rate):
    graph, false = bent_flight(2, rate)
    revised = to_the_end(revise(graph, Gate(3.0, 6, 0), PLAIN, Freedom.FULL))
    kept = graph.states == State.ACTIVE
    assert not (kept & false).any()
    assert (kept | false).mean() > 0.97
    assert revised.report.converged


def test_steps_are_the_same_as_all_at_once_and_many():
    graph, _ = bent_flight(3, 0.2)
    other = graph.copy()
    to_the_end(revise(graph, Gate(3.0, 6, 0), PLAIN, Freedom.FULL))
    n_steps = sum(1 for _ in revise(other, Gate(3.0, 6, 0), PLAIN, Freedom.FULL))
    assert n_steps > 10
    assert np.array_equal(graph.states, other.states)
    assert np.array_equal(graph.positions, other.positions)


def ring(n: int, radius_m: float = 20.0) -> PoseGraph:
    """Nodes on a circle, nearly closed, tied one to the next without error but with noise stated."""
    graph = PoseGraph()
    for node in range(n):
        angle = 2.0 * np.pi * node / n
        graph.add_node(
            Pose.exp(np.array([radius_m * np.cos(angle), radius_m * np.sin(angle), 0, 0, 0, angle]))
        )
        if node:
            step = graph.pose(node - 1).inverse() @ graph.pose(node)
            graph.add_constraint(Constraint(node - 1, node, step, 100.0 * np.eye(6), ConstraintKind.ODOMETRY))
    return graph


def loop(graph: PoseGraph, i: int, j: int, offset_m: float) -> int:
    measured = graph.pose(i).inverse() @ graph.pose(j) @ Pose.exp(np.array([0.0, offset_m, 0, 0, 0, 0]))
    return graph.add_constraint(Constraint(i, j, measured, 100.0 * np.eye(6), ConstraintKind.REVISIT))


def test_where_noise_is_overstated_a_loop_that_bends_everything_waits_for_a_second():
    graph = ring(100)
    gate = Gate(3.0, 6, 0)
    revision = RevisionInFlight(graph, gate, PLAIN, Freedom.FULL)
    bends, alike, other, small = (
        loop(graph, 2, 97, 3.0), loop(graph, 3, 96, 3.0), loop(graph, 1, 95, -8.0), loop(graph, 2, 90, 0.01)
    )  # fmt: skip
    assert revision.believes(bends, 1.0, 0.1)  # as long as the noise is believed
    gate.narrow(2.0)
    assert not revision.believes(bends, 3.0, 0.1)  # outside
    assert revision.believes(small, 1.0, 0.1)  # bends nothing
    assert not revision.believes(bends, 1.0, 0.1)
    assert not revision.believes(bends, 1.0, 0.1)  # asking twice is no second loop
    assert not revision.believes(other, 1.0, 0.1)  # tells something else
    assert revision.believes(alike, 1.0, 0.1)
    assert revision.confirmed_late == [bends]  # to be judged again
    assert revision.believes(bends, 1.0, 0.1)


def test_a_revision_that_takes_too_long_is_given_up(monkeypatch):
    monkeypatch.setattr(in_flight, "MOST_STEPS", 3)
    graph, _ = bent_flight(2, 0.5)
    revision = RevisionInFlight(graph, Gate(3.0, 6, 0), PLAIN, Freedom.FULL)
    for _ in range(100):
        revision.count()
    before = graph.states.copy()
    assert all(revision.advance(0.0, is_stuck=True) is None for _ in range(500))
    assert np.array_equal(graph.states, before)


def test_noise_as_stated_is_not_revised(monkeypatch):
    """Flights whose loops look like their noise pay nothing for the others."""

    def never(*_arguments):
        raise AssertionError("revised")

    monkeypatch.setattr(in_flight, "revise", never)
    optimiser = None
    for graph, constraint in replay(with_false_loops(fly_lawn_mower(LawnMower(400), 5), 0.1, 5)):
        optimiser = optimiser or OnlineOptimiser(graph)
        optimiser.add(constraint)
