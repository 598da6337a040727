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
from overfly.evaluation import Align, evaluate
from overfly.pipeline.experiment_measures import (
    CONSISTENCY,
    EXPERIMENTS,
    Flown,
    Quantity,
    normalised_errors,
)
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

PROCESSES = 2


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
        measures["located"] = 100.0 * recording.n_located / len(recording.frames)
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
        len(recording.frames),
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
