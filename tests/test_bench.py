"""Speed: reading ahead changes nothing, the same flight gives the same bytes, the bench measures."""

from __future__ import annotations

import dataclasses
import json
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from overfly.config import Config
from overfly.pipeline.alternatives import ALTERNATIVES
from overfly.pipeline.bench import Film, film_simulation, measure, page, run_bench, there_and_back
from overfly.pipeline.prefetch import FRAMES_AHEAD, read_ahead
from overfly.sensors import ReadOptions
from overfly.slam import Slam
from overfly.types import Frame


@pytest.fixture(scope="module")
def film() -> Film:
    return film_simulation("demo", (160, 120), 24)


def trajectory_bytes(film: Film, *, ahead: bool) -> bytes:
    slam = Slam(film.rig, Config())
    for frame in read_ahead(film.frames) if ahead else film.frames:
        slam.process(frame)
    poses = [slam.pose_of(record) for record in slam.records]
    assert len(poses) > 0.8 * len(film.frames)
    return b"".join(pose.rotation.tobytes() + pose.translation.tobytes() for pose in poses)


def test_the_same_flight_gives_the_same_bytes_read_ahead_or_not(film: Film) -> None:
    first = trajectory_bytes(film, ahead=False)
    assert trajectory_bytes(film, ahead=False) == first
    assert trajectory_bytes(film, ahead=True) == first


def test_another_flight_gives_other_bytes(film: Film) -> None:
    """The comparison above can fail: one grey level in one picture shows."""
    brighter = film.frames[5].images[0].copy()
    brighter[40:80, 40:80] ^= 1
    frames = list(film.frames)
    frames[5] = dataclasses.replace(frames[5], images=(brighter,))
    changed = dataclasses.replace(film, frames=frames)
    assert trajectory_bytes(changed, ahead=False) != trajectory_bytes(film, ahead=False)


# -- reading ahead


def test_frames_come_in_order_and_are_read_before_they_are_asked_for(film: Film) -> None:
    read: list[int] = []
    enough = threading.Event()

    def source() -> Iterator[Frame]:
        for frame in film.frames:
            read.append(frame.index)
            if len(read) > FRAMES_AHEAD:
                enough.set()
            yield frame

    frames = read_ahead(source())
    assert next(frames) is film.frames[0]
    assert enough.wait(5.0)  # the first was taken; so many more were read meanwhile
    assert len(read) <= FRAMES_AHEAD + 2
    assert [frame.index for frame in frames] == [frame.index for frame in film.frames[1:]]


def test_what_reading_raises_is_raised_after_the_frames_before_it(film: Film) -> None:
    def source() -> Iterator[Frame]:
        yield film.frames[0]
        raise ValueError("no second frame")

    frames = read_ahead(source())
    assert next(frames) is film.frames[0]
    with pytest.raises(ValueError, match="no second frame"):
        next(frames)


def test_closing_ends_the_reader(film: Film) -> None:
    before = threading.active_count()
    frames = read_ahead(film.frames)
    next(frames)
    assert threading.active_count() == before + 1
    frames.close()  # type: ignore[attr-defined]
    assert threading.active_count() == before


# -- the bench


def test_a_case_counts_its_frames_and_stages(film: Film) -> None:
    case = measure(film, Config())
    assert case.frames == len(film.frames)
    assert 0.8 * case.frames < case.located <= case.frames
    assert 1 <= case.nodes <= case.located
    assert 0.0 < case.stages["tracking"]["p50"] <= case.stages["tracking"]["p95"]
    assert sum(stage["p50"] for stage in case.stages.values()) > 0.0
    assert case.stages["tracking"]["p50"] < 10 * max(case.wall_s, case.cpu_s)


@pytest.mark.parametrize("name", ALTERNATIVES)
def test_alternatives_find_the_steps(name: str, film: Film) -> None:
    images = [frame.images[0] for frame in film.frames[::4]]  # a hover is degenerate: five real steps
    assert 4 <= ALTERNATIVES[name](images, film.rig.cam0.camera) <= 5


def test_there_and_back_is_continuous(film: Film) -> None:
    frames = list(there_and_back(film.frames[:4], 9))
    shown = [next(k for k in range(4) if frame.images is film.frames[k].images) for frame in frames]
    assert shown == [0, 1, 2, 3, 2, 1, 0, 1, 2]
    assert len(set(np.diff([frame.t_ns for frame in frames]).tolist())) == 1


@pytest.mark.data
def test_a_recorded_flight_is_measured_and_written(data_dir: Path, tmp_path: Path) -> None:
    said: list[str] = []
    report = run_bench(
        tmp_path, 10, 0, data_dir / "real" / "opticflow", ReadOptions(stereo=False), said.append
    )
    assert json.loads((tmp_path / "bench.json").read_text()) == json.loads(json.dumps(report))
    assert {case["features"] for case in report["cases"]} >= {"hessian-teblid", "orb"}
    assert all(row["times_ours"] > 0 for row in report["alternatives"])
    assert (tmp_path / "bench.html").read_text() == page(report)
    assert "opticflow" in page(report) and len(said) >= 5
