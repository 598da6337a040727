"""Pose graphs with known truth: a lawn-mower flight with noise of exactly the stated size, and false loops to
add to any graph.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from overfly.geometry.poses import FloatArray, Pose, rotation_from_euler
from overfly.graph.pose_graph import PoseGraph
from overfly.types import BoolArray, Constraint, ConstraintKind


@dataclass(frozen=True)
class LawnMower:
    """nodes along parallel rows, step_m apart; loops to the row before; standard deviations of every
    constraint.
    """

    nodes: int = 1000
    step_m: float = 1.0
    loop_rate: float = 0.3
    sigma_m: float = 0.02
    sigma_rad: float = 0.003


@dataclass(frozen=True, eq=False)
class Recording:
    """truth: poses world_from_node. constraints in the order in which a flight would meet them. false (m,):
    made up.
    """

    truth: list[Pose]
    constraints: list[Constraint]
    false: BoolArray


def fly_lawn_mower(flight: LawnMower, seed: int) -> Recording:
    """Simulate the constraints of a flight in rows, heading along the row, with a little roll and pitch."""
    random = np.random.default_rng(seed)
    row_length = int(np.ceil(np.sqrt(flight.nodes)))
    truth = []
    for node in range(flight.nodes):
        row, place = divmod(node, row_length)
        back = row % 2 == 1
        x = (row_length - 1 - place if back else place) * flight.step_m
        roll, pitch = random.normal(0.0, 0.05, 2)
        rotation = rotation_from_euler(roll, pitch, np.pi if back else 0.0)
        truth.append(Pose(rotation, np.array([x, row * flight.step_m, 20.0 + random.normal(0.0, 0.3)])))
    sigmas = np.repeat([flight.sigma_m, flight.sigma_rad], 3)
    constraints = []
    for node in range(1, flight.nodes):
        constraints.append(_measured(truth, node - 1, node, sigmas, ConstraintKind.ODOMETRY, random))
        row, place = divmod(node, row_length)
        if row > 0 and random.random() < flight.loop_rate:
            neighbour = (row - 1) * row_length + row_length - 1 - place
            if neighbour < node - 1:
                constraints.append(_measured(truth, neighbour, node, sigmas, ConstraintKind.REVISIT, random))
    return Recording(truth, constraints, np.zeros(len(constraints), dtype=bool))


def _measured(
    truth: list[Pose],
    i: int,
    j: int,
    sigmas: FloatArray,
    kind: ConstraintKind,
    random: np.random.Generator,
) -> Constraint:
    exact = truth[i].inverse() @ truth[j]
    noise = random.normal(0.0, 1.0, 6) * sigmas
    # information of the vector part of the quaternion: half the angle
    information = np.diag(np.concatenate([sigmas[:3], sigmas[3:] / 2.0]) ** -2.0)
    return Constraint(i, j, exact @ Pose.exp(noise), information, kind)


def with_false_loops(recording: Recording, rate: float, seed: int) -> Recording:
    """Add made-up revisits, ``rate`` of all revisits then being false: random nodes, random poses of the size
    of true ones.
    """
    random = np.random.default_rng(seed)
    loops = [constraint for constraint in recording.constraints if constraint.kind is ConstraintKind.REVISIT]
    n_false = round(len(loops) * rate / (1.0 - rate))
    reach = float(np.median([np.linalg.norm(loop.i_from_j.translation) for loop in loops]))
    later: dict[int, list[Constraint]] = {}
    for _ in range(n_false):
        j = int(random.integers(3, len(recording.truth)))
        i = int(random.integers(0, j - 2))
        tangent = np.concatenate(
            [random.normal(0.0, reach, 3), random.normal(0.0, 0.1, 2), random.uniform(-3, 3, 1)]
        )
        information = loops[int(random.integers(len(loops)))].information
        later.setdefault(j, []).append(
            Constraint(i, j, Pose.exp(tangent), information, ConstraintKind.REVISIT)
        )
    constraints, false = [], []
    for k, constraint in enumerate(recording.constraints):
        constraints.append(constraint)
        false.append(bool(recording.false[k]))
        following = recording.constraints[k + 1 :][:1]
        if not following or following[0].j != constraint.j:
            added = later.get(constraint.j, [])
            constraints += added
            false += [True] * len(added)
    return Recording(recording.truth, constraints, np.array(false))


def replay(recording: Recording, planar: bool = False) -> Iterator[tuple[PoseGraph, Constraint]]:
    """One constraint at a time, with the graph into which it has to go; new nodes have been placed by their
    first one.
    """
    graph = PoseGraph(planar)
    graph.add_node(recording.truth[0])
    for constraint in recording.constraints:
        while len(graph) <= max(constraint.i, constraint.j):
            if constraint.i < constraint.j:
                graph.add_node(graph.pose(constraint.i) @ constraint.i_from_j)
            else:
                graph.add_node(graph.pose(constraint.j) @ constraint.i_from_j.inverse())
        yield graph, constraint


def trajectory_error_m(graph: PoseGraph, truth: list[Pose]) -> float:
    """Root mean square distance in metres after the best rigid alignment (Umeyama 1991)."""
    wanted = np.array([pose.translation for pose in truth])
    found = graph.positions
    a, b = found - found.mean(axis=0), wanted - wanted.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    U[:, 2] *= np.linalg.det(U @ Vt)
    return float(np.sqrt(((a @ (U @ Vt) - b) ** 2).sum(axis=1).mean()))
