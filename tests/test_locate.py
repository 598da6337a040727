"""Maps that outlive their flight: resumed after a kill, searched by later flights, joined with them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.mapstore.flights import FRAMES, write_first, write_second
from tests.mapstore.maps import assert_same

import overfly
from overfly.cli import main
from overfly.errors import MapFileError, OutputError, SourceError, UsageError
from overfly.frame_result import FrameResult
from overfly.geometry.poses import Pose
from overfly.graph.pose_graph import PoseGraph
from overfly.localizer import Fix, Localizer
from overfly.mapstore import Map
from overfly.pipeline.mapping import MapRequest, run
from overfly.sensors import ReadOptions, open_flight
from overfly.trajectory import read_tum
from overfly.types import Reason

CHI2_6_AT_3_SIGMA = 20.06


@dataclass(frozen=True)
class Ground:
    """Three flights over one piece of ground with their truth, and the map of the first."""

    first: Path
    first_truth: tuple[Pose, ...]
    lower: Path
    lower_truth: tuple[Pose, ...]
    higher: Path
    higher_truth: tuple[Pose, ...]
    folder: Path

    @property
    def map_file(self) -> Path:
        return self.folder / "map.overfly"


def quietly(count: int, result: FrameResult) -> None:
    """No progress is shown."""


@pytest.fixture(scope="module")
def ground(tmp_path_factory: pytest.TempPathFactory) -> Ground:
    base = tmp_path_factory.mktemp("ground")
    truth = write_first(base / "first")
    lower = write_second(base / "lower", 2.0, 25)
    higher = write_second(base / "higher", 5.0, 25)
    run(MapRequest(base / "first", base / "map"), quietly)
    return Ground(base / "first", truth, base / "lower", lower, base / "higher", higher, base / "map")


def errors_of(fixes: list[Fix], truth: tuple[Pose, ...], known: Map, ground: Ground) -> list[np.ndarray]:
    """(6,) for each fix: how far it is from where the true place of its node puts it."""
    errors = []
    for fix, pose in zip(fixes, truth, strict=True):
        assert fix.pose is not None
        assert fix.node is not None
        node = known.visual.nodes[fix.node]
        true_place = ground.first_truth[node.frame_index].inverse() @ pose
        errors.append((fix.pose.inverse() @ known.visual.graph.pose(fix.node) @ true_place).log())
    return errors


@pytest.mark.parametrize("flight", ["lower", "higher"])
def test_later_flights_are_found_without_a_prior(ground: Ground, flight: str) -> None:
    """Two thirds and one and two thirds of the height, the other way round: each frame on its own."""
    known = Map.open(ground.map_file)
    localizer = Localizer(known)
    truth: tuple[Pose, ...] = getattr(ground, f"{flight}_truth")
    fixes = []
    for frame in open_flight(getattr(ground, flight)):
        localizer.forget()
        fixes.append(localizer.locate(frame))
    located = [n for n, fix in enumerate(fixes) if fix.pose is not None]
    assert len(located) >= 0.8 * len(fixes)
    assert all(fix.searched for fix in fixes)
    errors = errors_of([fixes[n] for n in located], tuple(truth[n] for n in located), known, ground)
    shift = [float(np.linalg.norm(error[:3])) / truth[0].translation[2] for error in errors]
    assert 1e-4 < np.median(shift) < 0.02
    assert max(shift) < 0.06
    chi2 = [
        float(error @ np.linalg.solve(fixes[n].covariance, error))
        for n, error in zip(located, errors, strict=True)
    ]
    assert np.mean(np.array(chi2) < CHI2_6_AT_3_SIGMA) > 0.95
    assert np.median(chi2) > 0.1, "a covariance that is far too large says nothing"


def test_frames_are_followed_once_found(ground: Ground) -> None:
    localizer = Localizer(Map.open(ground.map_file))
    fixes = [localizer.locate(frame) for frame in open_flight(ground.lower)]
    assert sum(fix.pose is not None for fix in fixes) >= 0.9 * len(fixes)
    assert sum(fix.searched for fix in fixes) < 0.3 * len(fixes)


def test_other_ground_is_nowhere_in_the_map(ground: Ground) -> None:
    """Noise, darkness, and the garden turned upside down, which is another garden."""
    localizer = Localizer(Map.open(ground.map_file))
    frame = next(iter(open_flight(ground.lower)))
    generator = np.random.default_rng(0)
    image = frame.images[0]
    noise = generator.integers(0, 255, image.shape, dtype=np.uint8)
    for picture in (np.zeros_like(image), noise, np.ascontiguousarray(image[:, ::-1])):
        fix = localizer.locate(overfly.types.Frame(0, frame.t_ns, "", (picture,), frame.attitude))
        assert fix.pose is None
        assert isinstance(fix.reason, Reason)
        assert fix.latency_ms > 0


def test_locate_writes_what_the_contract_names(
    ground: Ground, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = ground.map_file.read_bytes()
    arguments = ["locate", str(ground.map_file), str(ground.lower), "-o", str(tmp_path), "--json"]
    assert main(arguments) == 0
    numbers = json.loads(capsys.readouterr().out)
    entries = [json.loads(line) for line in (tmp_path / "fixes.jsonl").read_text().splitlines()]
    assert numbers["frames"] == len(entries) == len(ground.lower_truth)
    located = [entry for entry in entries if entry["status"] == "located"]
    assert numbers["located"] == len(located) == len(read_tum(tmp_path / "fixes.tum"))
    for entry in entries:
        assert {"stamp_ns", "status", "inliers", "latency_ms"} <= entry.keys()
        if entry["status"] == "located":
            assert np.array(entry["covariance"]).shape == (6, 6)
            assert np.linalg.norm(entry["world_from_cam"]["quaternion_xyzw"]) == pytest.approx(1.0)
        else:
            assert entry["reason"]
    assert ground.map_file.read_bytes() == before


def test_settings_of_the_map_hold_unless_others_are_given(
    ground: Ground, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["locate", str(ground.map_file), str(ground.lower), "-o", str(tmp_path)]
    assert main([*arguments, "--set", "features.extractor=sift"]) == 2
    assert "cannot be compared" in capsys.readouterr().err
    assert main([*arguments, "--set", "revisit.min_inliers=10000"]) == 0
    assert "0 of 25 frames located" in capsys.readouterr().out


def killing(after: int, source: Path, out: Path) -> None:
    """Map in another process that is killed, as by a power cut, when it has processed so many frames."""
    program = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from overfly.pipeline.mapping import MapRequest, run\n"
        "def progress(count, result):\n"
        f"    if count == {after}: os.kill(os.getpid(), signal.SIGKILL)\n"
        "run(MapRequest(Path(sys.argv[1]), Path(sys.argv[2])), progress)\n"
    )
    search = os.pathsep.join([str(Path(overfly.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", program, str(source), str(out)],
        check=False,
        env=os.environ | {"PYTHONPATH": search},
    )
    assert done.returncode == -signal.SIGKILL


@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
def test_a_killed_run_is_carried_on(ground: Ground, tmp_path: Path) -> None:
    """At most a second of flight is lost, and the trajectory ends as that of a run that was not killed."""
    killing(23, ground.first, tmp_path)
    saved = Map.open(tmp_path / "map.overfly")
    stamps = open_flight(ground.first).t_ns
    assert 0 <= stamps[22] - saved.frames[-1].t_ns < 1_000_000_000
    assert not saved.flights[0].complete
    seen: list[int] = []
    outcome = run(MapRequest(ground.first, tmp_path, resume=True), lambda _, result: seen.append(result.t_ns))
    assert seen == stamps[len(saved.frames) :].tolist()
    assert outcome.metrics["frames"] == FRAMES
    resumed, unbroken = (read_tum(folder / "trajectory.tum") for folder in (tmp_path, ground.folder))
    assert resumed.t_ns.tolist() == unbroken.t_ns.tolist()
    apart = np.linalg.norm(resumed.positions - unbroken.positions, axis=1)
    # Frames between nodes are found again in the adjusted map only by the run that saw them.
    assert apart.max() < 0.01
    assert Map.open(tmp_path / "map.overfly").flights[0].complete
    assert sorted(path.name for path in tmp_path.glob("*.overfly*")) == ["map.overfly"]


def test_resuming_a_finished_run_changes_nothing(ground: Ground, tmp_path: Path) -> None:
    run(MapRequest(ground.first, tmp_path, reading=ReadOptions(stop_s=1.0)), quietly)
    before = Map.open(tmp_path / "map.overfly")
    trajectory = read_tum(tmp_path / "trajectory.tum")
    run(MapRequest(ground.first, tmp_path, reading=ReadOptions(stop_s=1.0), resume=True), quietly)
    again, after = read_tum(tmp_path / "trajectory.tum"), Map.open(tmp_path / "map.overfly")
    np.testing.assert_allclose(again.positions, trajectory.positions, atol=1e-6)  # optimised once more
    after.visual.graph.positions[:] = before.visual.graph.positions
    after.visual.graph.quaternions[:] = before.visual.graph.quaternions
    assert_same(after, before)


def test_resuming_needs_the_same_run(ground: Ground, tmp_path: Path) -> None:
    run(MapRequest(ground.first, tmp_path, reading=ReadOptions(stop_s=0.5)), quietly)
    with pytest.raises(UsageError, match="other frames"):
        run(MapRequest(ground.lower, tmp_path, resume=True), quietly)
    other = overfly.Config.model_validate({"nodes": {"turn_deg": 10.0}})
    with pytest.raises(UsageError, match="other settings"):
        run(MapRequest(ground.first, tmp_path, other, resume=True), quietly)
    (tmp_path / "map.overfly").write_bytes(b"nothing of the kind")
    with pytest.raises(MapFileError):
        run(MapRequest(ground.first, tmp_path, resume=True), quietly)


def test_an_older_map_comes_back_when_the_new_run_finds_nothing(ground: Ground, tmp_path: Path) -> None:
    older = ground.map_file.read_bytes()
    (tmp_path / "map.overfly").write_bytes(older)
    none_fits = overfly.Config.model_validate({"registration": {"min_inliers": 100_000}})
    with pytest.raises(SourceError, match="no frame could be located"):
        run(MapRequest(ground.first, tmp_path, none_fits, ReadOptions(stop_s=0.5)), quietly)
    assert (tmp_path / "map.overfly").read_bytes() == older
    assert [path.name for path in tmp_path.glob("*.overfly*")] == ["map.overfly"]


def test_a_disk_that_fills_up_is_one_line(
    ground: Ground, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from overfly.mapstore import writer

    def small(path: Path) -> Any:
        connection = connect(path)
        connection.execute("PRAGMA max_page_count = 60")
        return connection

    connect = writer.connect_to_write
    monkeypatch.setattr(writer, "connect_to_write", small)
    with pytest.raises(OutputError, match=r"map\.overfly.*full"):
        run(MapRequest(ground.first, tmp_path), quietly)
    monkeypatch.undo()
    assert len(Map.open(tmp_path / "map.overfly").frames) > 0
    run(MapRequest(ground.first, tmp_path, reading=ReadOptions(), resume=True), quietly)
    assert len(Map.open(tmp_path / "map.overfly").frames) == FRAMES


def test_a_second_flight_continues_the_map(ground: Ground, tmp_path: Path) -> None:
    """The seam, by the truth of both flights, is no worse than either flight by itself; neither of them
    suffers, and frames between nodes follow."""
    before = ground.map_file.read_bytes()
    outcome = run(MapRequest(ground.higher, tmp_path, into=ground.map_file), quietly)
    assert any("holds both flights" in warning for warning in outcome.metrics["warnings"])
    assert ground.map_file.read_bytes() == before
    older, joined = Map.open(ground.map_file), Map.open(tmp_path / "map.overfly")
    assert joined.node_flights[: len(older)] == [0] * len(older)
    assert set(joined.node_flights[len(older) :]) == {1}
    assert len(joined.frames) == FRAMES + len(ground.higher_truth)
    truths = (ground.first_truth, ground.higher_truth)
    graph = joined.visual.graph

    def truth_of(index: int) -> Pose:
        return truths[joined.node_flights[index]][joined.visual.nodes[index].frame_index]

    def apart(one: PoseGraph, i: int, j: int) -> float:
        found = one.pose(i).inverse() @ one.pose(j)
        return float(np.linalg.norm((found.inverse() @ truth_of(i).inverse() @ truth_of(j)).translation))

    n_older = len(older)
    across = [apart(graph, i, j) for i in range(n_older) for j in range(n_older, len(joined))]
    inside, alone = (
        [apart(one, i, j) for i in range(n_older) for j in range(i)] for one in (graph, older.visual.graph)
    )
    assert 1e-4 < np.median(across) < max(1.2 * np.median(alone), 0.005 * 5.0)
    assert 1e-4 < np.median(inside) < max(1.2 * np.median(alone), 0.003 * 3.1)
    for flight, truth in enumerate(truths):
        frames = [frame for frame in joined.frames if frame.flight == flight]
        errors = []
        for frame in frames:
            assert frame.node is not None
            assert frame.node_from_cam is not None
            true = truth_of(frame.node).inverse() @ truth[frame.frame_index]
            errors.append(float(np.linalg.norm(frame.node_from_cam.translation - true.translation)))
        assert 1e-5 < np.median(errors) < 0.003 * truth[0].translation[2]
    # On the whole the older nodes lie where they lay; their heights are those of the metre, which two flights
    # know better than one: nearer to the truth than they were.
    moved = graph.positions[:n_older] - older.visual.graph.positions
    assert np.linalg.norm(moved.mean(axis=0)[:2]) < 0.01
    true_z = np.array([truth_of(index).translation[2] for index in range(n_older)])
    off, off_alone = (
        abs(float(np.mean(one.positions[:n_older, 2] - true_z))) for one in (graph, older.visual.graph)
    )
    assert off < max(off_alone, 0.001 * 3.1)
    assert 1e-5 < np.abs(moved).max() < 0.1
    # The trajectory of the new flight is in the world of the older map.
    trajectory = read_tum(tmp_path / "trajectory.tum")
    last = joined.visual.nodes[-1]
    row = int(np.searchsorted(trajectory.t_ns, last.t_ns))
    np.testing.assert_allclose(trajectory.positions[row], graph.positions[-1], atol=1e-6)


def test_a_flight_elsewhere_is_not_joined(ground: Ground, tmp_path: Path) -> None:
    strict = overfly.Config.model_validate({"revisit": {"min_inliers": 5000}})
    with pytest.raises(SourceError, match="not placed"):
        run(MapRequest(ground.higher, tmp_path, strict, into=ground.map_file), quietly)
    assert len(Map.open(tmp_path / "map.overfly").flights) == 1


def test_info_says_what_a_map_is(ground: Ground, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(ground.map_file), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["flights"][0]["frames"] == FRAMES
    assert facts["features"] > 10 * facts["nodes"] > 0
    assert main(["info", str(ground.map_file)]) == 0
    text = capsys.readouterr().out
    assert str(facts["features"]) in text
    assert "broken off" not in text


def test_the_example_of_the_contract(ground: Ground, tmp_path: Path) -> None:
    flight = overfly.open_flight(ground.first)
    slam = overfly.Slam(flight.rig, overfly.Config())
    for frame in flight:
        result = slam.process(frame)
        if frame.index == 12:
            break
    slam.map.save(tmp_path / "map.overfly")
    fix = overfly.Localizer(overfly.Map.open(tmp_path / "map.overfly")).locate(frame)
    assert fix.pose is not None
    assert result.pose is not None
    apart = (fix.pose.inverse() @ result.pose).log()
    assert 0 < np.linalg.norm(apart) < 0.03
    with pytest.raises(AttributeError):
        overfly.Nothing  # noqa: B018
