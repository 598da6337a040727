"""Batch optimisation: exact graphs, noisy flights, priors, freedoms, robust kernels and the tree."""

from __future__ import annotations

import numpy as np
import pytest

from overfly.errors import UsageError
from overfly.geometry.poses import Pose, rotation_from_euler, rotation_z
from overfly.graph.batch import Method, Start, optimise_batch
from overfly.graph.linearise import Freedom, chi2
from overfly.graph.pose_graph import PoseGraph
from overfly.graph.robust import Kernel, Robust
from overfly.graph.synthetic import (
    LawnMower,
    fly_lawn_mower,
    replay,
    trajectory_error_m,
    with_false_loops,
)
from overfly.types import Constraint


def graph_of(recording):
    for graph, constraint in replay(recording):
        graph.add_constraint(constraint)
    return graph


def shaken(graph: PoseGraph, size: float, seed: int = 0) -> PoseGraph:
    random = np.random.default_rng(seed)
    twin = graph.copy()
    for node in range(1, len(twin)):
        twin.set_pose(node, twin.pose(node) @ Pose.exp(random.normal(0.0, size, 6)))
    return twin


def test_chi2_of_a_noisy_flight_is_its_degrees_of_freedom():
    recording = fly_lawn_mower(LawnMower(400), 3)
    graph = graph_of(recording)
    report = optimise_batch(graph)
    degrees = 6 * (len(recording.constraints) - len(graph) + 1)
    assert report.converged
    assert abs(report.chi2_after - degrees) < 5.0 * np.sqrt(2.0 * degrees)
    # 20 m rows with 2 cm and 0.17 deg a step: centimetres, neither metres nor nothing
    assert 0.005 < trajectory_error_m(graph, recording.truth) < 0.2


@pytest.mark.parametrize("size", [0.05, 0.5, 3.0])
def test_the_solution_does_not_depend_on_the_start(size):
    graph = graph_of(fly_lawn_mower(LawnMower(100), 5))
    expected = optimise_batch(graph).chi2_after
    assert optimise_batch(shaken(graph, size)).chi2_after == pytest.approx(expected, rel=1e-4)


def test_never_worse_than_before():
    graph = shaken(graph_of(fly_lawn_mower(LawnMower(80), 5)), 2.0)
    before = chi2(graph)
    report = optimise_batch(graph, start=Start.GIVEN, max_iterations=2)
    assert report.chi2_after <= before


def test_levelled_holds_roll_and_pitch():
    graph = graph_of(fly_lawn_mower(LawnMower(150), 6))
    up = np.array([graph.pose(node).rotation[2] for node in range(len(graph))])
    before = chi2(graph)
    report = optimise_batch(graph, freedom=Freedom.LEVELLED, start=Start.GIVEN)
    assert report.chi2_after < 0.9 * before
    np.testing.assert_allclose([graph.pose(node).rotation[2] for node in range(len(graph))], up, atol=1e-9)


def test_priors_pull_the_graph_to_the_world():
    """With positions, heights and attitudes measured, the first node no longer holds the frame."""
    recording = fly_lawn_mower(LawnMower(60), 7)
    moved = Pose(rotation_from_euler(0.0, 0.0, 0.4), np.array([5.0, -3.0, 2.0]))
    graph = graph_of(recording)
    for node in range(0, 60, 10):
        world = moved @ recording.truth[node]
        graph.add_prior_position(node, world.translation, 1e-4 * np.eye(3))
        graph.add_prior_attitude(node, world.rotation, 1e-3)
        graph.add_prior_height(node, float(world.translation[2]), 0.01)
    optimise_batch(graph)
    wanted = np.array([(moved @ pose).translation for pose in recording.truth])
    assert np.abs(graph.positions - wanted).max() < 0.15
    assert np.abs(graph.positions[0] - wanted[0]).max() < 0.03


def test_a_robust_position_does_not_bend_the_graph():
    recording = fly_lawn_mower(LawnMower(60), 7)
    errors = []
    for robust in (False, True):
        graph = graph_of(recording)
        for node in range(0, 60, 3):
            position = recording.truth[node].translation + (np.array([50.0, 0, 0]) if node == 30 else 0.0)
            graph.add_prior_position(node, position, 0.01 * np.eye(3), robust)
        optimise_batch(graph)
        wanted = np.array([pose.translation for pose in recording.truth])
        errors.append(np.abs(graph.positions - wanted).max())
    assert errors[0] > 1.0
    assert errors[1] < 0.3


def test_a_rejected_constraint_does_not_count():
    recording = with_false_loops(fly_lawn_mower(LawnMower(150), 8), 0.3, 1)
    graph = graph_of(recording)
    graph.states[recording.false] = 1
    optimise_batch(graph)
    clean = graph_of(fly_lawn_mower(LawnMower(150), 8))
    optimise_batch(clean)
    np.testing.assert_allclose(graph.positions, clean.positions, atol=1e-5)


def test_a_kernel_holds_against_a_few_false_loops():
    recording = with_false_loops(fly_lawn_mower(LawnMower(200), 9), 0.1, 2)
    plain, robust = graph_of(recording), graph_of(recording)
    optimise_batch(plain)
    optimise_batch(robust, robust=Robust(Kernel.CAUCHY))
    assert trajectory_error_m(robust, recording.truth) < 0.2
    assert trajectory_error_m(plain, recording.truth) > 5 * trajectory_error_m(robust, recording.truth)


@pytest.mark.parametrize("kernel", list(Kernel))
def test_weights_are_the_derivative_of_the_cost(kernel):
    robust = Robust(kernel)
    values = np.linspace(0.01, 60.0, 400)
    h = 1e-6
    slope = (robust.costs(values + h) - robust.costs(values - h)) / (2.0 * h)
    away_from_kinks = np.abs(values - robust.width) > 1e-3
    np.testing.assert_allclose(robust.weights(values)[away_from_kinks], slope[away_from_kinks], atol=1e-6)


def test_the_tree_comes_close_to_least_squares():
    recording = fly_lawn_mower(LawnMower(300), 10)
    graph = graph_of(recording)
    best = graph.copy()
    optimise_batch(best)
    report = optimise_batch(graph, Method.TREE)
    assert report.chi2_after < 3.0 * chi2(best)
    assert trajectory_error_m(graph, recording.truth) < 2.0 * trajectory_error_m(best, recording.truth)


def test_an_exact_graph_stays_exact_under_the_tree():
    graph = graph_of(fly_lawn_mower(LawnMower(60, sigma_m=1e-9, sigma_rad=1e-9), 1))
    before = graph.positions.copy()
    optimise_batch(graph, Method.TREE)
    np.testing.assert_allclose(graph.positions, before, atol=1e-6)


def test_in_the_plane_the_tree_does_what_it_does_in_space():
    """The same planar graph, resolved by the sweep for planes and by the one for space."""
    random = np.random.default_rng(5)
    plane, space = PoseGraph(planar=True), PoseGraph()
    poses = [Pose(rotation_z(0.3 * k), np.array([k % 5, k // 5, 0.0])) for k in range(25)]
    for graph in (plane, space):
        for pose in poses:
            graph.add_node(pose)
    links = [(k, k + 1) for k in range(24)] + [(0, 9), (3, 17), (20, 2), (24, 6)]
    information = np.diag([40.0, 40.0, 40.0, 90.0, 90.0, 90.0])
    for i, j in links:
        off = random.normal(0.0, 0.3, 6) * [1, 1, 0, 0, 0, 1]
        measured = poses[i].inverse() @ poses[j] @ Pose.exp(off)
        plane.add_constraint(Constraint(i, j, measured, information))
        space.add_constraint(Constraint(i, j, measured, information * [1, 1, 1, 4, 4, 4]))
    for graph in (plane, space):
        optimise_batch(graph, Method.TREE, max_iterations=20)
    np.testing.assert_allclose(plane.positions, space.positions, atol=1e-9)
    turns = np.abs((plane.quaternions * space.quaternions).sum(axis=1))
    np.testing.assert_allclose(turns, 1.0, atol=1e-12)


def test_parts_without_a_link_are_all_held():
    graph = PoseGraph()
    recording = fly_lawn_mower(LawnMower(20), 1)
    for _ in range(2):
        offset = len(graph)
        for pose in recording.truth:
            graph.add_node(pose)
        for c in recording.constraints:
            graph.add_constraint(type(c)(c.i + offset, c.j + offset, c.i_from_j, c.information, c.kind))
    assert optimise_batch(graph).converged
    np.testing.assert_allclose(graph.positions[0], recording.truth[0].translation)
    np.testing.assert_allclose(graph.positions[20], recording.truth[0].translation)


def test_what_cannot_mean_anything_is_refused():
    graph = graph_of(fly_lawn_mower(LawnMower(10), 1))
    with pytest.raises(UsageError, match="sparse"):
        optimise_batch(graph, Method.TREE, Robust(Kernel.HUBER))
    constraint = graph.constraint(0)
    with pytest.raises(UsageError, match="no node 99"):
        graph.add_constraint(type(constraint)(0, 99, constraint.i_from_j, constraint.information))


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "best"),
    [
        ("intel", 45.0),
        ("manhattan", 3549.0),
        ("parking-garage", 1.2387),
        ("sphere2500", 727.15),
        ("cubicle", 2346.0),
    ],
)
def test_public_graphs_reach_the_best_known(data_dir, name, best):
    from overfly.graph.files import read_graph

    graph = read_graph(data_dir / "graphs" / f"{name}.g2o.gz")
    assert optimise_batch(graph).chi2_after == pytest.approx(best, rel=0.01)


def test_graphs_without_anything_to_do():
    assert optimise_batch(PoseGraph()).converged
    graph = PoseGraph()
    graph.add_node(Pose.identity())
    assert optimise_batch(graph).chi2_after == 0.0
