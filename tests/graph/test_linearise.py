"""Errors and normal equations: against a plain NumPy twin and against numerical derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from overfly.geometry.poses import Pose, rotation_z
from overfly.graph.linearise import Freedom, chi2, constraint_errors, move, normal_equations
from overfly.graph.pose_graph import PoseGraph
from overfly.types import Constraint, ConstraintKind


def random_graph(planar: bool, seed: int, priors: bool = False) -> PoseGraph:
    random = np.random.default_rng(seed)

    def pose() -> Pose:
        tangent = random.normal(0.0, 1.0, 6)
        return Pose.exp(
            np.where([True, True, False, False, False, True], tangent, 0.0) if planar else tangent
        )

    graph = PoseGraph(planar)
    for _ in range(5):
        graph.add_node(pose())
    for i, j in [(0, 1), (1, 2), (2, 3), (4, 3), (0, 3)]:
        noise = 0.3 * pose().log()
        root = random.normal(size=(6, 6))
        measured = graph.pose(i).inverse() @ graph.pose(j) @ Pose.exp(noise)
        graph.add_constraint(Constraint(i, j, measured, root @ root.T, ConstraintKind.ODOMETRY))
    if priors:
        graph.add_prior_position(1, random.normal(size=3), np.diag([0.1, 0.2, 0.3]))
        graph.add_prior_height(2, 0.7, 0.2)
        tilted = graph.pose(3).rotation @ Pose.exp(np.array([0, 0, 0, 0.02, -0.01, 0.03])).rotation
        graph.add_prior_attitude(3, tilted, 0.02, 0.05)
    return graph


def test_errors_are_those_of_the_definition():
    graph = random_graph(False, 0)
    errors = constraint_errors(graph, graph.active)
    for number, found in enumerate(errors):
        constraint = graph.constraint(number)
        predicted = graph.pose(constraint.i).inverse() @ graph.pose(constraint.j)
        error = constraint.i_from_j.inverse() @ predicted
        np.testing.assert_allclose(found, [*error.translation, *error.quaternion()[:3]], atol=1e-12)


def test_planar_errors_are_angles():
    graph = PoseGraph(planar=True)
    graph.add_node(Pose.identity())
    graph.add_node(Pose(rotation_z(3.0), np.array([1.0, 0.0, 0.0])))
    measured = Pose(rotation_z(-3.0), np.array([1.0, 0.0, 0.0]))
    graph.add_constraint(Constraint(0, 1, measured, np.eye(6)))
    np.testing.assert_allclose(
        constraint_errors(graph, graph.active)[0], [0, 0, 0, 0, 0, 6.0 - 2.0 * np.pi], atol=1e-12
    )


@pytest.mark.parametrize("freedom", list(Freedom))
@pytest.mark.parametrize("priors", [False, True])
def test_gradient_is_the_derivative_of_chi2(freedom, priors):
    """chi2 changes by 2 g dx to first order, for every node and direction."""
    graph = random_graph(freedom is Freedom.PLANAR, 4, priors and freedom is not Freedom.PLANAR)
    free = np.zeros(len(graph), dtype=bool)
    equations = normal_equations(graph, graph.active, np.ones(graph.n_constraints), free, freedom)
    h = 1e-6
    for node in range(len(graph)):
        for axis in range(freedom):
            step = np.zeros((len(graph), freedom))
            values = []
            for sign in (1.0, -1.0):
                moved = graph.copy()
                step[node, axis] = sign * h
                move(moved, step)
                values.append(chi2(moved))
            slope = (values[0] - values[1]) / (2.0 * h)
            # an attitude prior's own derivative is that of small tilts
            tolerance = 0.1 if priors and node == 3 else 1e-5
            assert slope == pytest.approx(2.0 * equations.gradient[node, axis], rel=tolerance, abs=1e-3)


@pytest.mark.parametrize("freedom", list(Freedom))
def test_hessian_is_the_square_of_the_jacobian(freedom):
    """H from the kernel equals J^T Omega J with J by differences: the NumPy twin."""
    graph = random_graph(freedom is Freedom.PLANAR, 5)
    n, d, h = len(graph), int(freedom), 1e-6
    jacobian = np.empty((graph.n_constraints, 6, n, d))
    for node in range(n):
        for axis in range(d):
            step = np.zeros((n, d))
            step[node, axis] = h
            ahead, behind = graph.copy(), graph.copy()
            move(ahead, step)
            move(behind, -step)
            difference = constraint_errors(ahead, graph.active) - constraint_errors(behind, graph.active)
            jacobian[:, :, node, axis] = difference / (2.0 * h)
    information = graph.information.copy()
    if graph.planar:
        information[:, [2, 3, 4]] = information[:, :, [2, 3, 4]] = 0.0
    expected = np.einsum("kand,kab,kbme->ndme", jacobian, information, jacobian)
    equations = normal_equations(
        graph, graph.active, np.ones(graph.n_constraints), np.zeros(n, dtype=bool), freedom
    )
    for node in range(n):
        np.testing.assert_allclose(equations.diagonal[node], expected[node, :, node], rtol=1e-4, atol=1e-5)
    for number in range(graph.n_constraints):
        i, j = graph.i[number], graph.j[number]
        np.testing.assert_allclose(equations.off_diagonal[number], expected[i, :, j], rtol=1e-4, atol=1e-5)
