"""The solution that is kept up to date: the same as one found at once, at the cost of what changed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.geometry.poses import Pose
from overfly.graph import incremental
from overfly.graph.batch import Start, optimise_batch
from overfly.graph.elimination import eliminate_part
from overfly.graph.incremental import IncrementalSolver
from overfly.graph.linearise import Freedom, chi2
from overfly.graph.pose_graph import PoseGraph, State
from overfly.graph.sparse import factor_now, find_pattern
from overfly.graph.synthetic import LawnMower, fly_lawn_mower, replay
from overfly.types import Constraint, ConstraintKind


def random_constraint(graph: PoseGraph, i: int, j: int, random: np.random.Generator) -> Constraint:
    noise = random.normal(0.0, 0.02, 6)
    if graph.planar:
        noise[2:5] = 0.0
    root = random.normal(size=(6, 6))
    measured = graph.pose(i).inverse() @ graph.pose(j) @ Pose.exp(noise)
    return Constraint(i, j, measured, root @ root.T + np.eye(6), ConstraintKind.REVISIT)


def grow(graph: PoseGraph, random: np.random.Generator) -> None:
    """A node on the last one, and by chance a loop, or one that is voted out or comes back."""
    step = np.array([1.0, 0.2, 0.0, 0.0, 0.0, 0.3]) + random.normal(0.0, 0.2, 6) * [1, 1, 0, 0, 0, 1]
    node = graph.add_node(graph.pose(len(graph) - 1) @ Pose.exp(step))
    graph.add_constraint(random_constraint(graph, node - 1, node, random))
    if random.random() < 0.5:
        i, j = random.choice(len(graph), 2, replace=False)
        graph.add_constraint(random_constraint(graph, int(i), int(j), random))
        number = int(random.integers(graph.n_constraints))
        if abs(graph.i[number] - graph.j[number]) > 1:
            graph.states[number] = State(1 - graph.states[number])


@settings(max_examples=20, deadline=None)
@given(freedom=st.sampled_from(list(Freedom)), n=st.integers(2, 40), seed=st.integers(0, 10**6))
def test_the_factor_is_that_of_the_whole_graph(freedom, n, seed):
    """After any history of nodes, loops and votes, parts of the inverse are those of the graph at once."""
    random = np.random.default_rng(seed)
    graph = PoseGraph(planar=freedom is Freedom.PLANAR)
    graph.add_node(Pose.identity())
    solver = IncrementalSolver(graph, freedom)
    for _ in range(n):
        grow(graph, random)
        if random.random() < 0.7:
            assert solver.take_in()
    assert solver.take_in()
    whole = factor_now(graph, find_pattern(graph), freedom)
    nodes = random.integers(0, len(graph), 2)
    nodes[1] = nodes[1] if nodes[1] != nodes[0] else (nodes[0] + 1) % len(graph)
    expected = whole.inverse_blocks(nodes)
    np.testing.assert_allclose(solver.factor.inverse_blocks(nodes), expected, rtol=1e-6, atol=1e-9)


def hold(graph: PoseGraph, random: np.random.Generator) -> None:
    """By chance a position of the newest node, an attitude of any, or positions that are rewritten."""
    node = int(random.integers(len(graph)))
    if random.random() < 0.4:
        noise = random.normal(0.0, 0.1, 3) * [1.0, 1.0, 0.0 if graph.planar else 1.0]
        graph.add_prior_position(len(graph) - 1, graph.positions[-1] + noise, np.diag([0.01, 0.02, 0.03]))
    if random.random() < 0.2:
        turn = [0.0, 0.0, 0.1] if graph.planar else random.normal(0.0, 0.1, 3)
        tilted = graph.pose(node) @ Pose.exp(np.concatenate([np.zeros(3), turn]))
        graph.add_prior_attitude(node, tilted.rotation, 0.1, 0.2)
    if random.random() < 0.1:
        graph.position_priors[1][:, :2] += 0.2


@settings(max_examples=25, deadline=None)
@given(freedom=st.sampled_from(list(Freedom)), n=st.integers(2, 40), seed=st.integers(0, 10**6))
def test_absolute_constraints_are_taken_in_as_they_come(freedom, n, seed):
    """The factor, chi2 and the poses are those of the whole graph at once."""
    random = np.random.default_rng(seed)
    graph = PoseGraph(planar=freedom is Freedom.PLANAR)
    graph.add_node(Pose.identity())
    graph.add_prior_attitude(0, np.eye(3), 0.1, 0.1)
    solver = IncrementalSolver(graph, freedom)
    for _ in range(n):
        grow(graph, random)
        hold(graph, random)
        if random.random() < 0.7:
            assert solver.solve(2, 1e-3) is not None
    assert solver.take_in()
    pattern = find_pattern(graph)
    np.testing.assert_array_equal(solver.fixed, pattern.fixed)
    settled = solver.solve(20, 1e-9)
    assert settled is not None
    assert settled.cost == pytest.approx(chi2(graph), rel=1e-9)
    whole = graph.copy()
    optimise_batch(whole, start=Start.GIVEN, freedom=freedom)
    np.testing.assert_allclose(graph.positions, whole.positions, atol=2e-3)
    solver._stale = np.arange(len(graph))
    assert solver.take_in()
    nodes = np.array([0, len(graph) - 1])
    expected = factor_now(graph, find_pattern(graph), freedom).inverse_blocks(nodes)
    np.testing.assert_allclose(solver.factor.inverse_blocks(nodes), expected, rtol=1e-6, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(n=st.integers(1, 80), extra=st.integers(0, 60), seed=st.integers(0, 10**6))
def test_elimination_leaves_out_no_fill(n, extra, seed):
    """Every node is eliminated once, and each front holds all that its nodes meet, then or later."""
    random = np.random.default_rng(seed)
    pairs = np.array(
        [(k, k + 1) for k in range(n - 1)] + [tuple(p) for p in random.integers(0, n, (extra, 2))], np.int64
    ).reshape(-1, 2)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    clique = np.unique(random.integers(0, n, 5))
    late = np.arange(n) == n - 1
    nodes = 10 * np.arange(n)
    fronts = eliminate_part(nodes, pairs, clique, np.array([0, len(clique)]), late)
    assert np.array_equal(np.sort(fronts.own), nodes)
    assert fronts.own[-1] == nodes[-1]
    met = {k: set() for k in nodes}
    for a, b in [*pairs, *((a, b) for a in clique for b in clique if a != b)]:
        met[nodes[a]].add(nodes[b])
        met[nodes[b]].add(nodes[a])
    gone = set()
    for f in range(len(fronts.parent)):
        own = fronts.own[fronts.own_starts[f] : fronts.own_starts[f + 1]]
        below = set(fronts.separator[fronts.separator_starts[f] : fronts.separator_starts[f + 1]])
        for k in own:
            gone.add(k)
            remaining = met[k] - gone
            assert remaining <= below | set(own)
            for a in remaining:
                met[a] |= remaining - {a}
        if below:
            parent = fronts.parent[f]
            above = fronts.own[fronts.own_starts[parent] : fronts.own_starts[parent + 1]]
            assert parent > f
            assert below & set(above)


def flown(nodes: int, seed: int) -> tuple[PoseGraph, IncrementalSolver]:
    graph = solver = None
    for graph, constraint in replay(fly_lawn_mower(LawnMower(nodes), seed)):
        solver = solver or IncrementalSolver(graph, Freedom.FULL)
        graph.add_constraint(constraint)
        assert solver.solve(2, 0.002) is not None
    return graph, solver


def test_ends_where_the_whole_solver_does():
    graph, solver = flown(200, 1)
    settled = solver.solve(10, 1e-6)
    assert settled.converged
    assert settled.cost == pytest.approx(chi2(graph), rel=1e-9)
    whole = graph.copy()
    optimise_batch(whole)
    assert chi2(whole) <= settled.cost * (1 + 1e-9)
    assert settled.cost <= chi2(whole) * (1 + 1e-4)


def test_a_new_node_concerns_few_others():
    _, solver = flown(400, 2)
    nodes, _ = solver.factor.affected(np.array([399]))
    assert 1 <= len(nodes) < 60


def test_changes_from_outside_are_noticed():
    """A node that was moved and a measurement that was rewritten."""
    graph, solver = flown(60, 3)
    graph.set_pose(30, graph.pose(30) @ Pose.exp(np.array([0.3, 0.1, 0.0, 0.0, 0.1, 0.2])))
    graph.measured_positions[40] += 0.05
    assert solver.solve(10, 1e-6).converged
    whole = graph.copy()
    optimise_batch(whole, start=Start.GIVEN)
    assert chi2(graph) == pytest.approx(chi2(whole), rel=1e-3)


def test_much_work_waits_for_the_next_constraint(monkeypatch):
    """Where one factorisation is more than enough, each call makes one, and calls in turn end as well."""
    monkeypatch.setattr(incremental, "MUCH_WORK", 0.0)
    graph = PoseGraph()
    for graph, constraint in replay(fly_lawn_mower(LawnMower(100, sigma_rad=0.03), 3)):
        graph.add_constraint(constraint)
    solver = IncrementalSolver(graph, Freedom.FULL)
    costs = [np.inf]
    for _ in range(20):
        before = solver.factor.multiplications
        settled = solver.solve(10, 1e-6)
        at_once = solver.factor.multiplications - before
        assert settled is not None
        assert settled.cost <= costs[-1] * (1.0 + 1e-6)
        costs.append(settled.cost)
        if len(costs) == 2:
            assert not settled.converged
            first = at_once
        assert at_once <= first
        if settled.converged:
            break
    assert settled.converged
    best = graph.copy()
    optimise_batch(best)
    assert settled.cost <= chi2(best) * (1.0 + 1e-4)


def test_rewritten_information_is_noticed_when_told():
    graph, solver = flown(60, 3)
    graph.information[graph.n_constraints // 2 :] /= 100.0
    solver.refresh()
    assert solver.solve(10, 1e-6).converged
    whole = graph.copy()
    optimise_batch(whole, start=Start.GIVEN)
    assert chi2(graph) == pytest.approx(chi2(whole), rel=1e-3)


def test_what_is_not_determined_is_told():
    graph = PoseGraph()
    for _ in range(2):
        graph.add_node(Pose.identity())
    graph.add_constraint(Constraint(0, 1, Pose.identity(), np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])))
    solver = IncrementalSolver(graph, Freedom.FULL)
    assert solver.solve(2, 1e-3) is None
    assert np.array_equal(graph.positions, np.zeros((2, 3)))
