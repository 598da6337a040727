"""What the paper's experiments measure: figures of a finished map against the truth, with what the paper
reached and what must be reached.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from overfly.evaluation import Align, Evaluation, alignment, evaluate
from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.covariance import exact_covariance, tangent_information
from overfly.graph.pose_graph import PoseGraph
from overfly.graph.shape import ShapeCovariance
from overfly.pipeline.recording import Recording
from overfly.trajectory import Trajectory
from overfly.types import ConstraintKind, IntArray

LEAST_SHAPE = 8  # nodes: of fewer, moving and turning the whole takes much of the error
NODES_CHECKED = 25  # nodes of a map whose covariance is held against the truth
CORRIDOR_M = {"A-B": 5.0, "B-C": 5.0, "C-D": 1.5, "D-E": 5.0, "E-F": 5.0, "F-A": 1.5}
PAPER_PERCENT = {"A-B": 3.6, "B-C": 5.2, "C-D": 7.3, "D-E": 4.0, "E-F": 4.2, "F-A": 8.0}
BLIMP_M = 5.0
MINUTE_NS = 60_000_000_000


@dataclass(frozen=True, slots=True)
class Quantity:
    """One figure of an experiment. statistic: mean over the seeds, sigma, or bias (mean minus ``true``)."""

    key: str
    label: str
    unit: str
    paper: str
    limit: float | None  # at most this must be reached; None: for information
    statistic: str = "mean"
    true: float = 0.0


@dataclass(frozen=True, slots=True)
class Experiment:
    """A scenario, what is measured in it, and which figure or table of the paper it repeats."""

    scenario: str
    title: str
    counterpart: str
    measure: Callable[[Recording, Flown], dict[str, float]]
    quantities: tuple[Quantity, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Flown:
    """What only the simulator knows: true poses of the first camera and true places of the landmarks; and
    the places that the map gives them.
    """

    truth: Trajectory
    landmarks: dict[str, FloatArray]
    found: dict[str, FloatArray]
    evaluation: Evaluation


def measure_path(_recording: Recording, flown: Flown) -> dict[str, float]:
    """Absolute trajectory error after rigid alignment, metres."""
    found = flown.evaluation
    return {"ate_m": found.ate_m.rmse, "height_m": found.ate_vertical_m.rmse}


def measure_corridor(recording: Recording, flown: Flown) -> dict[str, float]:
    """Errors of the distances between neighbouring landmarks, percent (Table I); over the loop the sum of the
    errors by the sum of the distances."""
    errors = {}
    for pair, true in CORRIDOR_M.items():
        errors[pair] = abs(distance_between(flown.found, *pair.split("-")) - true)
    percent = {pair: 100.0 * error / CORRIDOR_M[pair] for pair, error in errors.items()}
    loop = 100.0 * sum(errors.values()) / sum(CORRIDOR_M.values())
    return percent | {"loop": loop} | measure_path(recording, flown)


def measure_blimp(recording: Recording, flown: Flown) -> dict[str, float]:
    return {"distance_m": distance_between(flown.found, "L1", "L2")} | measure_path(recording, flown)


def measure_helicopter(recording: Recording, flown: Flown) -> dict[str, float]:
    """Errors of the landmarks' places, metres, where the paths lie on each other (rigidly: no scale)."""
    errors = {}
    for name, true in flown.landmarks.items():
        place = flown.found.get(name)
        there = None if place is None else flown.evaluation.truth_from_estimate.transform(place)
        errors[name] = math.nan if there is None else float(np.linalg.norm((there - true)[:2]))
    return errors | measure_path(recording, flown)


def measure_hold(recording: Recording, flown: Flown) -> dict[str, float]:
    """Error of the poses as they were known online, in the first and in the last minute, metres."""
    online = evaluate(recording.online(), flown.truth, Align.SE3)
    errors, t_ns = np.linalg.norm(online.errors_m, axis=1), online.truth.t_ns
    minute = min(MINUTE_NS, int(t_ns[-1] - t_ns[0]) // 2)
    first = math.sqrt(float(np.mean(errors[t_ns < t_ns[0] + minute] ** 2)))
    last = math.sqrt(float(np.mean(errors[t_ns > t_ns[-1] - minute] ** 2)))
    both = {"first_minute_m": first, "last_minute_m": last, "growth_m": last - first}
    return (
        both
        | {"features": float(sum(frame.n_matches for frame in recording.frames))}
        | measure_path(recording, flown)
    )


def distance_between(found: dict[str, FloatArray], a: str, b: str) -> float:
    """Metres between two landmarks, NaN when one was not found."""
    return float(np.linalg.norm(found[a] - found[b])) if a in found and b in found else math.nan


PATH = (Quantity("ate_m", "path, ATE", "m", "", None), Quantity("height_m", "path, height", "m", "", None))
EXPERIMENTS = {
    "outdoor": Experiment(
        "outdoor", "190 m around a building, stereo", "Figures 4 and 5", measure_path,
        (Quantity("ate_m", "path, ATE", "m", "loop closed", 0.15),
         Quantity("height_m", "path, height", "m", "", 0.10)),
    ),
    "corridor": Experiment(
        "corridor", "Corridor, six landmarks, stereo", "Figure 6 and Table I", measure_corridor,
        (*(Quantity(pair, f"distance {pair}", "%", f"{PAPER_PERCENT[pair]}", 1.0) for pair in CORRIDOR_M),
         Quantity("loop", "distances of the loop", "%", "4.8", 0.5), *PATH),
    ),
    "blimp": Experiment(
        "blimp", "Blimp, one camera and sonar, no attitude", "Figure 7", measure_blimp,
        (Quantity("distance_m", "landmarks 5 m apart: distance", "m", "4.91", None),
         Quantity("distance_m", "bias of it", "m", "0.09", 0.02, "bias", BLIMP_M),
         Quantity("distance_m", "sigma of it", "m", "0.11", 0.03, "sigma"), *PATH),
    ),
    "hold": Experiment(
        "hold", "18 minutes over one place, pushed away", "Figures 7 and 8", measure_hold,
        (Quantity("first_minute_m", "online error, first minute", "m", "", None),
         Quantity("last_minute_m", "online error, last minute", "m", "", None),
         Quantity("growth_m", "last minute minus first", "m", "drift-free", 0.0),
         Quantity("features", "features matched", "", "500000", None), *PATH),
    ),
    "helicopter": Experiment(
        "helicopter", "Helicopter, one camera, book of known size", "Figure 9", measure_helicopter,
        (*(Quantity(f"X{k}", f"landmark X{k}", "m", "0.2 to 0.6", 0.15) for k in range(1, 7)), *PATH),
    ),
}  # fmt: skip
CONSISTENCY = (
    Quantity("located", "frames located", "%", "", None),
    Quantity("nees_place", "NEES of cameras' places, per degree of freedom (1 expected)", "", "", None),
    Quantity("nees_adjusted", "NEES of poses seen from the first, likewise", "", "", None),
    Quantity("nees_pose", "NEES of the same by the graph's constraints, likewise", "", "", None),
    Quantity("nees_odometry", "NEES of odometry constraints, likewise", "", "", None),
)


# -- are the covariances honest?


def normalised_errors(recording: Recording, truth: Trajectory) -> dict[str, float]:
    """Normalised estimation error squared by degrees of freedom: 1 is expected, less is cautious.

    Of odometry's constraints, and of poses seen from the first node by all constraints of the graph, both
    with what the finish learnt of their size. By the covariance of the adjusted map: of the places of cameras
    in the map's own shape, which as a whole may be moved and turned, and of poses seen from the first node;
    NaN where the map is too small for that.
    """
    graph, nodes = recording.slam.map.graph, recording.slam.map.nodes
    true = [truth.pose(int(row)) for row in np.searchsorted(truth.t_ns, [node.t_ns for node in nodes])]
    odometry = []
    for number in graph.active:
        constraint = graph.constraint(int(number))
        if constraint.kind is ConstraintKind.ODOMETRY:
            error = relative_error(constraint.i_from_j, true[constraint.i], true[constraint.j])
            information = tangent_information(constraint.information, graph.planar)
            odometry.append(float(error @ information @ error))
    report = recording.slam.adjustment
    shape = None if report is None or len(report.shape.nodes) < LEAST_SHAPE else report.shape
    factor, covariance, every = recording.slam.variance_factor, exact_covariance(graph), np.arange(len(nodes))
    by_graph: list[float] = []
    places: list[float] = []
    poses: list[float] = []
    if covariance is not None and len(nodes) > 1:
        by_graph = _of_poses(graph, every, lambda place: covariance.relative(0, place), true)
    if shape is not None:
        places = _of_places(graph, shape, true)
        poses = _of_poses(graph, shape.nodes, lambda place: shape.relative(graph.pose, 0, place), true)
    return {
        "nees_odometry": _per_freedom(odometry, 6) / factor,
        "nees_pose": _per_freedom(by_graph, 6) / factor,
        "nees_place": _per_freedom(places, 3),
        "nees_adjusted": _per_freedom(poses, 6),
    }


def _of_places(graph: PoseGraph, shape: ShapeCovariance, true: list[Pose]) -> list[float]:
    """Of cameras, once the whole map lies on the true one."""
    nodes = shape.nodes.tolist()
    places = np.array([true[node].translation for node in nodes])
    fit = alignment(graph.positions[shape.nodes], places, Align.SE3)
    values: list[float] = []
    for node, covariance, place in zip(nodes, shape.cameras, places, strict=True):
        pose = graph.pose(node)
        error = pose.rotation.T @ fit.rotation.T @ (fit.transform(pose.translation) - place)
        values.append(float(error @ np.linalg.solve(covariance, error)))
    return values


def _of_poses(
    graph: PoseGraph, nodes: IntArray, seen_from_first: Callable[[int], FloatArray], true: list[Pose]
) -> list[float]:
    """Of some of the nodes (k,), seen from the first; seen_from_first: covariance (6, 6) of the one at a
    place."""
    first = int(nodes[0])
    values: list[float] = []
    for place in np.unique(np.linspace(1, len(nodes) - 1, NODES_CHECKED).astype(int)).tolist():
        node = int(nodes[place])
        error = relative_error(graph.pose(first).inverse() @ graph.pose(node), true[first], true[node])
        values.append(float(error @ np.linalg.solve(seen_from_first(place), error)))
    return values


def relative_error(i_from_j: Pose, true_i: Pose, true_j: Pose) -> FloatArray:
    """(6,) right perturbation, translation and rotation, that takes the relative pose to the true one."""
    return (i_from_j.inverse() @ true_i.inverse() @ true_j).log()


def _per_freedom(values: list[float], freedom: int) -> float:
    return float(np.mean(values)) / freedom if values else math.nan
