"""overfly demo: simulate, map, compare."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from overfly.config import Config
from overfly.evaluation import Align, Evaluation, evaluate
from overfly.pipeline.mapping import MapRequest, fly, save
from overfly.pipeline.recording import Progress, Recording
from overfly.pipeline.results import prepare_folder
from overfly.sensors import open_flight
from overfly.simulation import simulate, write_flight
from overfly.trajectory import read_tum


@dataclass(frozen=True, slots=True, eq=False)
class DemoResult:
    metrics: dict[str, Any]
    evaluation: Evaluation


def run_demo(out: Path, seed: int, progress: Progress) -> DemoResult:
    """Write out/flight and out/map. The truth is read only after the map is made."""
    flight_folder, map_folder = out / "flight", out / "map"
    prepare_folder(out)
    if (flight_folder / "mav0").is_dir() and (flight_folder / "truth").is_dir():
        shutil.rmtree(flight_folder)  # of an earlier demo
    write_flight(simulate("demo", seed), flight_folder)
    request = MapRequest(
        flight_folder, map_folder, Config(), command=f"overfly map {flight_folder} -o {map_folder}"
    )
    flight = open_flight(flight_folder)
    prepare_folder(map_folder)
    recording = fly(flight, request.config, progress)
    outcome = save(flight, recording, request, lambda run: _compare(run, flight_folder))
    return DemoResult(outcome.metrics, _compare(recording, flight_folder))


def _compare(recording: Recording, flight_folder: Path) -> Evaluation:
    truth = read_tum(flight_folder / "truth" / "groundtruth_cam0.tum")
    return evaluate(recording.trajectory(), truth, Align.SE3)
