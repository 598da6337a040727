"""overfly experiments: the paper's section V repeated on the simulator, our figures beside the paper's.

Every seed is flown, written as any flight, mapped with the default configuration, and only then compared with
the truth. Seeds run in two processes.
"""

from __future__ import annotations

import math
import multiprocessing
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from overfly.config import Config
from overfly.errors import UsageError
from overfly.evaluation import Align, Evaluation, evaluate
from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.covariance import exact_covariance, tangent_information
from overfly.pipeline.landmarks import locate_landmarks
from overfly.pipeline.mapping import MapRequest, fly, save
from overfly.pipeline.page import constraint_times
from overfly.pipeline.recording import Recording
from overfly.pipeline.results import finite_or_none, prepare_folder, write_json
from overfly.products.experiments_page import ExperimentFigures, Row, Section, write_experiments
from overfly.products.pictures import map_picture
from overfly.sensors import open_flight
from overfly.simulation import simulate, write_flight
from overfly.trajectory import Trajectory
from overfly.types import ConstraintKind

PROCESSES = 2
DEGREES_OF_FREEDOM = 6
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


@dataclass(frozen=True, slots=True)
class Job:
    """One seed of one experiment. out: where the whole map is left, or None."""

    name: str
    seed: int
    frames: int | None
    out: Path | None
    config: Config


@dataclass(frozen=True, slots=True, eq=False)
class SeedResult:
    """measures by key, NaN where there is none; figures only of the seed whose map was kept."""

    name: str
    seed: int
    frames: int
    located: int
    measures: dict[str, float]
    seconds: float
    figures: ExperimentFigures | None = None


@dataclass(frozen=True, slots=True)
class ExperimentsRequest:
    """Which experiments, how many seeds (from ``first_seed`` on), at most so many frames each, and where to
    leave the results.
    """

    names: tuple[str, ...]
    seeds: int
    out: Path
    frames: int | None = None
    first_seed: int = 1
    config: Config = field(default_factory=Config)
    command: str = ""


# -- what is measured


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
        | {"features": float(sum(result.n_matches for result in recording.results))}
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
    Quantity("nees_pose", "NEES of poses, per degree of freedom (1 expected)", "", "", None),
    Quantity("nees_odometry", "NEES of odometry constraints, likewise", "", "", None),
)


# -- runs


def names_of(name: str) -> tuple[str, ...]:
    """The experiments that a name stands for. Raises UsageError."""
    if name == "all":
        return tuple(EXPERIMENTS)
    if name not in EXPERIMENTS:
        raise UsageError(f"no experiment is called '{name}': choose one of {', '.join(EXPERIMENTS)}, all")
    return (name,)


def run_experiments(request: ExperimentsRequest, say: Callable[[str], None]) -> dict[str, Any]:
    """Fly, map, compare; experiments.html and experiments.json in the folder. Raises OverflyError."""
    prepare_folder(request.out)
    seeds = range(request.first_seed, request.first_seed + request.seeds)
    jobs = [
        Job(
            name,
            seed,
            request.frames,
            request.out / name if seed == request.first_seed else None,
            request.config,
        )
        for name in request.names
        for seed in seeds
    ]
    results: dict[str, list[SeedResult]] = {name: [] for name in request.names}
    for count, result in enumerate(_run_all(jobs), start=1):
        results[result.name].append(result)
        say(
            f"{count} of {len(jobs)}: {result.name}, seed {result.seed}: {result.located} of "
            f"{result.frames} frames located, ATE {result.measures['ate_m']:.3f} m, {result.seconds:.0f} s"
        )
    sections = [_section(name, results[name]) for name in request.names]
    write_experiments(request.out / "experiments.html", sections, request.seeds, request.command)
    report = {section.name: _as_tree(section, results[section.name]) for section in sections}
    write_json(request.out / "experiments.json", {"seeds": list(seeds), "experiments": report})
    return {"seeds": list(seeds), "experiments": report}


def _run_all(jobs: list[Job]) -> Iterator[SeedResult]:
    if len(jobs) == 1:
        yield run_seed(jobs[0])
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(PROCESSES, len(jobs)), mp_context=context) as pool:
        futures = [pool.submit(run_seed, job) for job in jobs]
        try:
            for future in as_completed(futures):
                yield future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def run_seed(job: Job) -> SeedResult:
    """One flight: simulated into a folder that is removed afterwards, mapped, compared."""
    began = time.perf_counter()
    experiment = EXPERIMENTS[job.name]
    with tempfile.TemporaryDirectory(prefix="overfly-") as folder:
        simulated = simulate(experiment.scenario, job.seed)
        if job.frames is not None and job.frames < len(simulated):
            simulated = simulate(experiment.scenario, job.seed, job.frames)
        write_flight(simulated, Path(folder) / experiment.scenario)
        flight = open_flight(Path(folder) / experiment.scenario)
        recording = fly(flight, job.config, lambda _count, _result: None)
        truth = Trajectory.from_poses(simulated.stamps_ns, simulated.truth)
        found = {mark.name: mark.position_m for mark in locate_landmarks(flight.landmark_clicks, recording)}
        compared = evaluate(recording.trajectory(), truth, Align.SE3)
        flown = Flown(truth, simulated.landmarks, found, compared)
        measures = experiment.measure(recording, flown) | normalised_errors(recording, truth)
        measures["located"] = 100.0 * recording.n_located / len(recording.results)
        figures = None
        if job.out is not None:
            command = (
                f"overfly simulate {experiment.scenario} --seed {job.seed} -o flight; overfly map flight"
            )
            request = MapRequest(flight.path, job.out, job.config, command=command)
            if job.out.is_dir():
                shutil.rmtree(job.out)
            prepare_folder(job.out)
            save(flight, recording, request, lambda _run: compared)
            figures = _figures(recording, flown, job.out)
    return SeedResult(
        job.name,
        job.seed,
        len(recording.results),
        recording.n_located,
        measures,
        time.perf_counter() - began,
        figures,
    )


def _figures(recording: Recording, flown: Flown, out: Path) -> ExperimentFigures:
    mosaic = out / "mosaic.tif"
    return ExperimentFigures(
        recording.trajectory(),
        recording.odometry(),
        constraint_times(recording),
        flown.evaluation,
        map_picture(mosaic, longest_px=1000) if mosaic.exists() else None,
        flown.found,
        f"{out.name}/report.html",
    )


# -- are the covariances honest?


def normalised_errors(recording: Recording, truth: Trajectory) -> dict[str, float]:
    """Normalised estimation error squared by degrees of freedom: 1 is expected, less is cautious.

    Of node poses, seen from the first node, and of odometry constraints.
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
    found = {"nees_odometry": _per_freedom(odometry), "nees_pose": math.nan}
    covariance = exact_covariance(graph)
    if covariance is not None and len(nodes) > 1:
        values = []
        for k in np.unique(np.linspace(1, len(nodes) - 1, NODES_CHECKED).astype(int)):
            error = relative_error(graph.pose(0).inverse() @ graph.pose(int(k)), true[0], true[int(k)])
            values.append(float(error @ np.linalg.solve(covariance.relative(0, int(k)), error)))
        found["nees_pose"] = _per_freedom(values)
    return found


def relative_error(i_from_j: Pose, true_i: Pose, true_j: Pose) -> FloatArray:
    """(6,) right perturbation, translation and rotation, that takes the relative pose to the true one."""
    return (i_from_j.inverse() @ true_i.inverse() @ true_j).log()


def _per_freedom(values: list[float]) -> float:
    return float(np.mean(values)) / DEGREES_OF_FREEDOM if values else math.nan


# -- results


def _section(name: str, results: list[SeedResult]) -> Section:
    experiment = EXPERIMENTS[name]
    ordered = sorted(results, key=lambda result: result.seed)
    rows = tuple(_row(quantity, ordered) for quantity in (*experiment.quantities, *CONSISTENCY))
    figures = next((result.figures for result in ordered if result.figures is not None), None)
    return Section(name, experiment.title, experiment.counterpart, rows, figures)


def _row(quantity: Quantity, results: Iterable[SeedResult]) -> Row:
    """A quantity that one seed does not have is not reached: the mean is then NaN."""
    values = np.array([result.measures[quantity.key] for result in results])
    sigma = float(np.std(values, ddof=1)) if len(values) > 1 else math.nan
    mean = float(np.mean(values))
    judged = {"mean": mean, "sigma": sigma, "bias": abs(mean - quantity.true)}[quantity.statistic]
    ours = {"mean": mean, "sigma": sigma, "bias": mean - quantity.true}[quantity.statistic]
    reached = None if quantity.limit is None else bool(judged <= quantity.limit)
    spread = sigma if quantity.statistic == "mean" else math.nan
    return Row(quantity.label, quantity.unit, quantity.paper, ours, spread, quantity.limit, reached)


def _as_tree(section: Section, results: list[SeedResult]) -> dict[str, Any]:
    ordered = sorted(results, key=lambda result: result.seed)
    return {
        "title": section.title,
        "rows": [
            {
                "label": row.label,
                "unit": row.unit,
                "paper": row.paper,
                "ours": finite_or_none(row.ours),
                "sigma": finite_or_none(row.sigma),
                "limit": row.limit,
                "reached": row.reached,
            }
            for row in section.rows
        ],
        "seeds": {
            str(result.seed): {key: finite_or_none(value) for key, value in result.measures.items()}
            for result in ordered
        },
    }
