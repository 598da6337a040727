"""overfly bench: how fast it is, beside what else is installed; in one run, for the sake of the ratios."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from html import escape
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from overfly.config import Config, load_config
from overfly.errors import SourceError
from overfly.pipeline.alternatives import ALTERNATIVES
from overfly.pipeline.prefetch import read_ahead
from overfly.pipeline.recording import stage_seconds
from overfly.pipeline.results import LIBRARIES, prepare_folder, write_json, write_text
from overfly.sensors import ReadOptions, open_flight
from overfly.simulation import SimulatedFlight
from overfly.simulation.scenario import declared
from overfly.slam import Slam
from overfly.types import Frame, Rig

RATE_HZ = 30.0  # of the simulated cameras
SMALL, LARGE = (320, 240), (1280, 960)
REPEATS = 2  # runs of each case; the faster one counts, the first one may also compile
LARGE_SHARE = 3  # so many times fewer frames of large pictures, which take long to simulate
NOT_MEASURED = ("orbslam3",)  # named when installed, but with nothing here that would time them
Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class Film:
    """A flight in memory: frames and the cameras that took them."""

    name: str
    rig: Rig
    frames: list[Frame]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        camera = self.rig.cam0.camera
        return camera.width, camera.height


@dataclass(frozen=True, slots=True)
class Measured:
    """One case. Seconds by wall clock and of processor time, per frame; stages in seconds {p50, p95, max}.

    ahead_wall_s: by wall clock when a second thread prepares the next frames, as overfly map does.
    """

    name: str
    size: tuple[int, int]
    stereo: bool
    features: str
    frames: int
    located: int
    nodes: int
    wall_s: float
    cpu_s: float
    ahead_wall_s: float
    stages: dict[str, dict[str, float]]

    @property
    def frames_per_second(self) -> float:
        """By the clock, with frames prepared ahead."""
        return 1.0 / self.ahead_wall_s


@dataclass(frozen=True, slots=True)
class Growth:
    """Processor seconds per frame over the first and over the last ``share`` frames of a long flight."""

    frames: int
    share: int
    nodes: int
    first_s: float
    last_s: float


def film_simulation(scenario: str, size: tuple[int, int], count: int) -> Film:
    """The first count frames of a scenario, gray, taken RATE_HZ times a second."""
    base = declared(scenario).build(1)
    cameras = tuple(
        dataclasses.replace(setup, camera=setup.camera.scaled(*size), color=False) for setup in base.cameras
    )
    flight = SimulatedFlight(dataclasses.replace(base, cameras=cameras, rate_hz=RATE_HZ), 1)
    frames = [flight.frame(index) for index in range(min(count, len(flight)))]
    return Film(f"{scenario} {size[0]}x{size[1]}", flight.rig, frames)


def film_source(source: Path, count: int, options: ReadOptions) -> Film:
    """The first count frames of a recorded flight. Raises SourceError when there are none."""
    flight = open_flight(source, options)
    frames = [frame for frame, _ in zip(flight, range(count), strict=False)]
    if not frames:
        raise SourceError(f"{source}: no frame could be read")
    return Film(source.name, flight.rig, frames)


def measure(film: Film, config: Config) -> Measured:
    """Slam over all frames, features and graph included; the fastest of some repeats."""
    runs = [_run(film, config) for _ in range(REPEATS)]
    ahead_s = min(_seconds_ahead(film, config) for _ in range(REPEATS))
    return dataclasses.replace(min(runs, key=lambda run: run.cpu_s), ahead_wall_s=ahead_s)


def _seconds_ahead(film: Film, config: Config) -> float:
    """Wall clock per frame with a second thread that prepares the next frames."""
    slam = Slam(film.rig, config)
    begin = time.perf_counter()
    for view in read_ahead(film.frames, slam.observe):
        slam.process(view)
    return (time.perf_counter() - begin) / len(film.frames)


def _run(film: Film, config: Config) -> Measured:
    slam = Slam(film.rig, config)
    wall, cpu = time.perf_counter(), time.process_time()
    results = [slam.process(frame) for frame in film.frames]
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    count = len(film.frames)
    return Measured(
        film.name,
        film.size,
        film.rig.is_stereo,
        config.features.extractor,
        count,
        len(slam.records),
        len(slam.map),
        wall / count,
        cpu / count,
        math.nan,
        stage_seconds(result.timings_s for result in results),
    )


def there_and_back(frames: Sequence[Frame], count: int) -> Iterable[Frame]:
    """count frames by flying the same way forth and back, with stamps that go on."""
    period_ns = frames[1].t_ns - frames[0].t_ns
    turn = 2 * (len(frames) - 1)
    for index in range(count):
        place = index % turn
        shown = frames[min(place, turn - place)]
        yield dataclasses.replace(shown, index=index, t_ns=frames[0].t_ns + index * period_ns)


def measure_growth(film: Film, count: int) -> Growth:
    """Whether a frame costs more the longer the flight has lasted."""
    slam = Slam(film.rig, Config())
    spent = []
    for frame in there_and_back(film.frames, count):
        begin = time.process_time()
        slam.process(frame)
        spent.append(time.process_time() - begin)
    share = max(1, count // 4)
    return Growth(count, share, len(slam.map), float(np.mean(spent[:share])), float(np.mean(spent[-share:])))


def run_bench(
    out: Path, count: int, long_count: int, source: Path | None, reading: ReadOptions, say: Say
) -> dict[str, Any]:
    """Measure everything; writes bench.json and bench.html into out and returns what the first holds."""
    prepare_folder(out)
    films: list[tuple[Film, tuple[str, ...]]]
    if source is not None:
        film = film_source(source, count, reading)
        films, growth_film = [(film, ("hessian-teblid", "orb", "sift", "surf"))], None
    else:
        say("simulating flights ...")
        growth_film = film_simulation("demo", SMALL, count)
        films = [
            (growth_film, ("hessian-teblid", "orb", "sift", "surf")),
            (film_simulation("corridor", SMALL, count), ("hessian-teblid",)),
            (film_simulation("demo", LARGE, max(2, count // LARGE_SHARE)), ("hessian-teblid",)),
        ]
    cases, beside = [], []
    for film, extractors in films:
        for extractor in extractors:
            say(f"{film.name}, {extractor} ...")
            cases.append(measure(film, load_config(None, [f"features.extractor={extractor}"])))
        beside += _beside(film, cases[-len(extractors)], say)
    growth = None
    if growth_film is not None and long_count:
        say(f"a flight of {long_count} frames ...")
        growth = measure_growth(growth_film, long_count)
    report: dict[str, Any] = {
        "cases": [asdict(case) | {"frames_per_second": case.frames_per_second} for case in cases],
        "alternatives": beside,
        "growth": asdict(growth) if growth else None,
        "installed_but_not_measured": [name for name in NOT_MEASURED if find_spec(name) is not None],
        "versions": {library: version(library) for library in LIBRARIES},
    }
    write_json(out / "bench.json", report)
    write_text(out / "bench.html", page(report))
    return report


def _beside(film: Film, ours: Measured, say: Say) -> list[dict[str, Any]]:
    """Other ways from picture to motion over the same frames, with their time as a multiple of ours."""
    grays = [frame.images[0] for frame in film.frames]
    rows = []
    for name, run in ALTERNATIVES.items():
        say(f"{film.name}, {name} ...")
        begin = time.process_time()
        found = run(grays, film.rig.cam0.camera)
        cpu_s = (time.process_time() - begin) / max(1, len(grays) - 1)
        rows.append(
            {
                "flight": film.name,
                "name": name,
                "cpu_s": cpu_s,
                "found": found,
                "times_ours": cpu_s / ours.cpu_s,
            }
        )
    return rows


def page(report: dict[str, Any]) -> str:
    """bench.html: the tables of a report."""
    cases = [
        [
            case["name"], "stereo" if case["stereo"] else "mono", case["features"],
            f"{case['frames_per_second']:.0f}", f"{1.0 / case['wall_s']:.0f}", f"{1.0 / case['cpu_s']:.0f}",
            f"{case['located']}/{case['frames']}",
            str(case["nodes"]),
            ", ".join(
                f"{stage} {1e3 * value['p50']:.1f}/{1e3 * value['p95']:.1f}"
                for stage, value in case["stages"].items()
            ),
        ]
        for case in report["cases"]
    ]  # fmt: skip
    others = [
        [row["flight"], row["name"], f"{1e3 * row['cpu_s']:.1f}", f"{row['times_ours']:.2f}"]
        for row in report["alternatives"]
    ]
    parts = [
        _table(
            ["flight", "cameras", "features", "frames/s", "on one core", "frames per CPU second",
             "located", "nodes", "stages, ms p50/p95"], cases,
        ),
        "<h2>Beside</h2><p>From one picture to the next only: no map, no graph.</p>",
        _table(["flight", "method", "CPU ms per frame", "times ours"], others),
    ]  # fmt: skip
    growth = report["growth"]
    if growth:
        parts.append(
            f"<h2>Long flight</h2><p>{growth['frames']} frames, {growth['nodes']} nodes: "
            f"{1e3 * growth['first_s']:.1f} ms per frame over the first {growth['share']}, "
            f"{1e3 * growth['last_s']:.1f} ms over the last.</p>"
        )
    style = "body{font-family:sans-serif}td,th{padding:2px 8px;text-align:left;border-bottom:1px solid #ccc}"
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>overfly bench</title>'
        f"<style>{style}</style>"
        f"<h1>overfly bench</h1>{''.join(parts)}</html>\n"
    )


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    cells = "".join(f"<th>{escape(text)}</th>" for text in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(text)}</td>" for text in row) + "</tr>" for row in rows)
    return f"<table><tr>{cells}</tr>{body}</table>"
