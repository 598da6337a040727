"""The paper's experiments: what is measured, how it is judged, and one short run of the whole command."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from overfly.cli import main
from overfly.errors import UsageError
from overfly.evaluation import Align, evaluate
from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.covariance import exact_covariance
from overfly.graph.pose_graph import PoseGraph
from overfly.graph.shape import shape_covariance
from overfly.pipeline.experiment_measures import (
    CORRIDOR_M,
    EXPERIMENTS,
    Flown,
    Quantity,
    measure_corridor,
    measure_helicopter,
    normalised_errors,
)
from overfly.pipeline.experiments import SeedResult, _row, names_of
from overfly.products.experiments_page import Row
from overfly.simulation import simulate
from overfly.trajectory import Trajectory
from overfly.types import Constraint
from overfly.vision.odometry import information_of_constraint

MARKS = {"A": (0, 0), "B": (5, 0), "C": (10, 0), "D": (10, 1.5), "E": (5, 1.5), "F": (0, 1.5)}


def flown(found: dict[str, FloatArray], true: dict[str, FloatArray], poses: list[Pose]) -> Flown:
    truth = Trajectory.from_poses(np.arange(len(poses)) * 10**8, poses)
    return Flown(truth, true, found, evaluate(truth, truth, Align.SE3))


def wandering(n: int, seed: int) -> list[Pose]:
    generator = np.random.default_rng(seed)
    poses = [Pose.identity()]
    for _ in range(n - 1):
        step = np.concatenate([generator.normal(0, 0.3, 3), generator.normal(0, 0.1, 3)])
        poses.append(poses[-1] @ Pose.exp(step))
    return poses


def test_the_corridor_is_that_of_the_simulator() -> None:
    places = simulate("corridor", frames=1).landmarks
    for pair, length in CORRIDOR_M.items():
        a, b = pair.split("-")
        assert np.linalg.norm(places[a] - places[b]) == pytest.approx(length)


def test_corridor_errors_are_percent_of_the_distances() -> None:
    true = {name: np.array([x, y, 0.0]) for name, (x, y) in MARKS.items()}
    stretched = {name: 1.02 * place for name, place in true.items()}
    found = measure_corridor(None, flown(stretched, true, wandering(5, 1)))  # type: ignore[arg-type]
    for pair in (*CORRIDOR_M, "loop"):
        assert found[pair] == pytest.approx(2.0)
    del stretched["C"]
    found = measure_corridor(None, flown(stretched, true, wandering(5, 1)))  # type: ignore[arg-type]
    assert math.isnan(found["B-C"])
    assert math.isnan(found["loop"])
    assert found["A-B"] == pytest.approx(2.0)


def test_landmarks_of_the_helicopter_lie_where_the_path_does() -> None:
    true = {"X1": np.array([1.0, 2.0, 0.0]), "X2": np.array([3.0, 2.0, 0.0])}
    found = {"X1": np.array([1.3, 2.4, 0.7])}
    errors = measure_helicopter(None, flown(found, true, wandering(6, 2)))  # type: ignore[arg-type]
    assert errors["X1"] == pytest.approx(0.5)  # on the ground: height does not count
    assert math.isnan(errors["X2"])


def test_figures_are_judged_by_mean_sigma_or_bias() -> None:
    results = [SeedResult("blimp", k, 1, 1, {"d": value}, 0.0) for k, value in enumerate([4.9, 5.0, 5.2])]
    mean = _row(Quantity("d", "d", "m", "", 5.1), results)
    assert (mean.ours, mean.reached) == (pytest.approx(5.0333, abs=1e-3), True)
    sigma = _row(Quantity("d", "d", "m", "", 0.1, "sigma"), results)
    assert (sigma.ours, sigma.reached) == (pytest.approx(np.std([4.9, 5.0, 5.2], ddof=1)), False)
    bias = _row(Quantity("d", "d", "m", "", 0.03, "bias", 5.0), results)
    assert (bias.ours, bias.reached) == (pytest.approx(0.0333, abs=1e-3), False)
    lost = [*results, SeedResult("blimp", 9, 1, 1, {"d": math.nan}, 0.0)]
    assert _row(Quantity("d", "d", "m", "", 100.0), lost).reached is False
    assert Row("d", "m", "", math.nan, math.nan, 1.0, False).cells()[3] == "none"


@pytest.mark.parametrize(("claimed", "learnt"), [(1.0, 1.0), (3.0, 1.0), (3.0, 1.0 / 9.0)])
def test_normalised_errors_tell_honest_covariances_from_timid_ones(claimed: float, learnt: float) -> None:
    """Noise drawn from its own covariance gives 1 per degree of freedom; claimed three times as large, a
    ninth, unless the finish of the map has learnt that."""
    true = wandering(60, 3)
    generator = np.random.default_rng(4)
    sigma = np.array([0.02, 0.02, 0.01, 0.002, 0.002, 0.004])
    graph = PoseGraph()
    graph.add_node(true[0])
    for k in range(1, len(true)):
        measured = true[k - 1].inverse() @ true[k] @ Pose.exp(sigma * generator.normal(size=6))
        graph.add_node(graph.pose(k - 1) @ measured)
        information = information_of_constraint(np.diag((claimed * sigma) ** 2))
        graph.add_constraint(Constraint(k - 1, k, measured, information))
    nodes = [SimpleNamespace(t_ns=k * 10**8) for k in range(len(true))]
    every = np.arange(len(true))
    covariance = exact_covariance(graph)
    assert covariance is not None
    shape = shape_covariance(
        every, np.array([graph.pose(k).rotation for k in every]), graph.positions,
        learnt * covariance._from_factor(*every.tolist()), np.zeros(60),
    )  # fmt: skip
    slam = SimpleNamespace(
        map=SimpleNamespace(graph=graph, nodes=nodes),
        variance_factor=learnt,
        adjustment=SimpleNamespace(shape=shape),
    )
    recording = SimpleNamespace(slam=slam)
    truth = Trajectory.from_poses([node.t_ns for node in nodes], true)
    found = normalised_errors(recording, truth)  # type: ignore[arg-type]
    assert 0.75 < found["nees_odometry"] * claimed**2 * learnt < 1.3  # 354 degrees of freedom
    assert 0.2 < found["nees_pose"] * claimed**2 * learnt < 3.5  # poses of one flight err together
    assert 0.2 < found["nees_place"] * claimed**2 * learnt < 3.5  # and so do places
    assert found["nees_adjusted"] == pytest.approx(found["nees_pose"], rel=1e-6)  # told the same covariance


def test_names() -> None:
    assert names_of("all") == tuple(EXPERIMENTS)
    assert names_of("blimp") == ("blimp",)
    with pytest.raises(UsageError, match="corridor"):
        names_of("submarine")


def test_the_command_writes_page_and_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["experiments", "blimp", "--seeds", "1", "--frames", "50", "-o", str(tmp_path), "--json"]
    assert main(arguments) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "experiments.json").read_text())
    measures = printed["experiments"]["blimp"]["seeds"]["1"]
    assert measures["located"] == 100.0
    assert 0 < measures["ate_m"] < 0.05
    page = (tmp_path / "experiments.html").read_text()
    assert "4.91" in page
    assert "After optimisation" in page
    assert (tmp_path / "blimp" / "report.html").exists()
