"""Speed: reading ahead changes nothing, the same flight gives the same bytes, the bench measures."""

from __future__ import annotations

import dataclasses
import json
import os
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from overfly.cli.console import FrameProgress, announce_compiling
from overfly.config import Config
from overfly.frame_result import FrameResult
from overfly.localizer import Localizer
from overfly.mapstore import Map
from overfly.mapstore.live import Slam as LiveSlam
from overfly.pipeline.alternatives import ALTERNATIVES
from overfly.pipeline.bench import Film, film_simulation, measure, page, run_bench, there_and_back
from overfly.pipeline.prefetch import FRAMES_AHEAD, read_ahead
from overfly.pipeline.recording import record_flight
from overfly.sensors import ReadOptions
from overfly.slam import Slam
from overfly.threads import one_opencv_thread
from overfly.types import Frame


@pytest.fixture(scope="module")
def film() -> Film:
    return film_simulation("demo", (160, 120), 24)


def trajectory_bytes(film: Film, *, ahead: bool) -> bytes:
    slam = Slam(film.rig, Config())
    for frame in read_ahead(film.frames, slam.observe) if ahead else film.frames:
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


def same(frame: Frame) -> Frame:
    return frame


def test_frames_come_in_order_and_are_read_before_they_are_asked_for(film: Film) -> None:
    read: list[int] = []
    enough = threading.Event()

    def source() -> Iterator[Frame]:
        for frame in film.frames:
            read.append(frame.index)
            if len(read) > FRAMES_AHEAD:
                enough.set()
            yield frame

    frames = read_ahead(source(), same)
    assert next(frames) is film.frames[0]
    assert enough.wait(5.0)  # the first was taken; so many more were read meanwhile
    assert len(read) <= FRAMES_AHEAD + 2
    assert [frame.index for frame in frames] == [frame.index for frame in film.frames[1:]]


def test_what_reading_raises_is_raised_after_the_frames_before_it(film: Film) -> None:
    def source() -> Iterator[Frame]:
        yield film.frames[0]
        raise ValueError("no second frame")

    frames = read_ahead(source(), same)
    assert next(frames) is film.frames[0]
    with pytest.raises(ValueError, match="no second frame"):
        next(frames)


def test_closing_ends_the_reader(film: Film) -> None:
    before = threading.active_count()
    frames = read_ahead(film.frames, same)
    next(frames)
    assert threading.active_count() == before + 1
    frames.close()
    assert threading.active_count() == before


def test_what_preparing_raises_is_raised_too(film: Film) -> None:
    def prepare(frame: Frame) -> int:
        return 1 // (2 - frame.index)

    indices = read_ahead(film.frames, prepare)
    assert [next(indices), next(indices)] == [0, 1]
    with pytest.raises(ZeroDivisionError):
        next(indices)


def test_a_recording_is_that_of_frames_processed_one_after_the_other(film: Film) -> None:
    slam = Slam(film.rig, Config())
    results = [slam.process(frame) for frame in film.frames]
    slam.finish()
    recording = record_flight(film.frames, Slam(film.rig, Config()), lambda *_: None)
    assert [frame.t_ns for frame in recording.frames] == [result.t_ns for result in results]
    assert [frame.made_node for frame in recording.frames] == [result.node is not None for result in results]
    for ours, theirs in zip(recording.slam.records, slam.records, strict=True):
        assert ours.online.matrix().tobytes() == theirs.online.matrix().tobytes()
        assert recording.slam.pose_of(ours).matrix().tobytes() == slam.pose_of(theirs).matrix().tobytes()


def test_fixes_are_those_of_frames_located_one_after_the_other(film: Film, tmp_path: Path) -> None:
    flown = LiveSlam(film.rig, Config())
    for frame in film.frames[::2]:
        flown.process(frame)
    flown.map.save(tmp_path / "map.overfly")
    known = Map.open(tmp_path / "map.overfly")
    alone = Localizer(known, film.rig)
    expected = [alone.locate(frame) for frame in film.frames]
    with closing(read_ahead(film.frames, Localizer(known, film.rig).observe)) as views:
        second = Localizer(known, film.rig)
        fixes = [second.locate(view) for view in views]
    assert sum(fix.pose is not None for fix in fixes) > 0.8 * len(fixes)
    for fix, other in zip(fixes, expected, strict=True):
        assert (fix.pose is None) == (other.pose is None)
        if fix.pose is not None and other.pose is not None:
            assert fix.pose.matrix().tobytes() == other.pose.matrix().tobytes()
        assert fix.latency_ms > 0.0


def test_opencv_has_one_thread_only_inside() -> None:
    before = cv2.getNumThreads()
    with one_opencv_thread():
        assert cv2.getNumThreads() == 1
    assert cv2.getNumThreads() == before


def test_a_first_start_says_that_it_compiles(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    index = tmp_path / "alignment._align-78.py311.nbi"
    monkeypatch.setattr("overfly.vision.alignment.kernel_cache_folder", lambda: str(tmp_path))
    announce_compiling()
    assert "compiling" in capsys.readouterr().err
    index.write_bytes(b"")
    announce_compiling()
    assert capsys.readouterr().err == ""
    os.utime(index, (0, 0))  # of kernels that have changed since
    announce_compiling()
    assert "compiling" in capsys.readouterr().err


def test_a_first_start_says_so_only_while_it_waits_for_its_first_frame(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("overfly.cli.console.PATIENCE_S", 0.05)
    monkeypatch.setattr("overfly.threads.is_compiled", lambda: False)
    with FrameProgress() as progress:
        progress(1, FrameResult(0, None))
        time.sleep(0.2)
    assert capsys.readouterr().err == ""
    with FrameProgress():
        time.sleep(0.3)
    assert "compiling" in capsys.readouterr().err


# -- the bench


def test_a_case_counts_its_frames_and_stages(film: Film) -> None:
    case = measure(film, Config())
    assert case.frames == len(film.frames)
    assert 0.8 * case.frames < case.located <= case.frames
    assert 1 <= case.nodes <= case.located
    assert 0.0 < case.stages["tracking"]["p50"] <= case.stages["tracking"]["p95"]
    assert sum(stage["p50"] for stage in case.stages.values()) > 0.0
    assert 0.0 < case.ahead_wall_s < 10 * case.wall_s
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
