"""What ``overfly map`` leaves behind, read back by others than its writers; how it ends early."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rasterio
from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.tools import file_interface

from overfly.cli import main
from overfly.config import Config, load_config
from overfly.errors import OutputError, SourceError
from overfly.frame_result import FrameResult
from overfly.pipeline.mapping import MapOutcome, MapRequest, run
from overfly.pipeline.recording import record_flight
from overfly.sensors import ReadOptions, open_flight
from overfly.simulation import simulate, write_flight
from overfly.slam import Slam

FRAMES = 36
FILES = {
    "trajectory.tum", "online.tum", "odometry.tum", "graph.g2o", "mosaic.tif", "report.html", "metrics.json",
}  # fmt: skip


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flight")
    write_flight(simulate("demo", 1, FRAMES), folder / "demo")
    return folder / "demo"


def quiet(_: int, __: FrameResult) -> None:
    """No progress."""


@pytest.fixture(scope="module")
def mapped(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, MapOutcome]:
    out = tmp_path_factory.mktemp("map") / "deep" / "out"
    return out, run(MapRequest(flight, out, command="overfly map flight"), quiet)


def test_everything_promised_is_there_and_nothing_half_written(mapped: tuple[Path, MapOutcome]) -> None:
    out, outcome = mapped
    names = {path.name for path in out.iterdir()}
    assert names >= FILES
    assert not [name for name in names if name.startswith(".") or "partial" in name]
    assert not outcome.interrupted


def test_trajectories_are_what_evo_reads(mapped: tuple[Path, MapOutcome], flight: Path) -> None:
    out, _ = mapped
    truth = file_interface.read_tum_trajectory_file(str(flight / "truth" / "groundtruth_cam0.tum"))
    for name in ("trajectory.tum", "online.tum", "odometry.tum"):
        estimate = file_interface.read_tum_trajectory_file(str(out / name))
        assert estimate.num_poses == FRAMES
        reference, estimate = sync.associate_trajectories(truth, estimate, max_diff=0.01)
        estimate.align(reference)
        error = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
        error.process_data((reference, estimate))
        rmse = float(error.get_statistic(evo_metrics.StatisticsType.rmse))
        assert 1e-4 < rmse < 0.01 * reference.path_length


def test_stamps_are_those_of_the_source(mapped: tuple[Path, MapOutcome], flight: Path) -> None:
    out, _ = mapped
    rows = (flight / "mav0" / "cam0" / "data.csv").read_text().splitlines()
    stamps = [int(row.split(",")[0]) for row in rows if not row.startswith("#")]
    lines = [row for row in (out / "trajectory.tum").read_text().splitlines() if not row.startswith("#")]
    written = [int(line.split()[0].replace(".", "")) for line in lines]
    assert written == stamps


def test_the_graph_file_is_g2o_with_odometry_first(mapped: tuple[Path, MapOutcome]) -> None:
    out, outcome = mapped
    lines = [line.split() for line in (out / "graph.g2o").read_text().splitlines() if line]
    vertices = [line for line in lines if line[0] == "VERTEX_SE3:QUAT"]
    edges = [line for line in lines if line[0] == "EDGE_SE3:QUAT"]
    assert len(vertices) == outcome.metrics["nodes"] > 2
    assert len(edges) == outcome.metrics["constraints"] >= len(vertices) - 1
    assert all(len(vertex) == 9 for vertex in vertices)
    assert all(len(edge) == 3 + 7 + 21 for edge in edges)
    numbers = {int(vertex[1]) for vertex in vertices}
    poses = {int(v[1]): np.array(v[2:], float) for v in vertices}
    for edge in edges:
        i, j = int(edge[1]), int(edge[2])
        assert {i, j} <= numbers
        information = np.zeros((6, 6))
        information[np.triu_indices(6)] = np.array(edge[10:], float)
        information = information + np.triu(information, 1).T
        assert np.linalg.eigvalsh(information).min() > 0
        assert np.linalg.norm(poses[j][3:]) == pytest.approx(1.0, abs=1e-6)


def test_the_mosaic_is_a_geotiff_of_the_ground_that_was_seen(mapped: tuple[Path, MapOutcome]) -> None:
    out, outcome = mapped
    with rasterio.open(out / "mosaic.tif") as mosaic:
        assert mosaic.count == 4
        assert set(mosaic.dtypes) == {"uint8"}
        alpha = mosaic.read(4)
        bounds = mosaic.bounds
        assert 0.2 < (alpha > 0).mean() <= 1.0
        assert mosaic.read(1)[alpha > 0].std() > 5  # something is to be seen
        assert mosaic.res[0] == pytest.approx(outcome.metrics["mosaic_gsd_m"], rel=1e-6)
    path = np.loadtxt(out / "trajectory.tum")
    assert bounds.left < path[:, 1].min() and path[:, 1].max() < bounds.right
    assert bounds.bottom < path[:, 2].min() and path[:, 2].max() < bounds.top


def test_metrics_are_json_with_what_the_contract_names(mapped: tuple[Path, MapOutcome]) -> None:
    out, outcome = mapped
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics == json.loads(json.dumps(outcome.metrics))
    assert metrics["frames"] == metrics["located"] == FRAMES
    assert metrics["scale_source"] == "range"
    assert set(metrics["revisits"]) >= {"tried", "accepted", "rejected"}
    for stage in metrics["seconds_per_stage"].values():
        assert 0 <= stage["p50"] <= stage["p95"] <= stage["max"]
    assert metrics["frames_per_second"] > 0
    assert metrics["peak_memory_mb"] > 50
    assert metrics["versions"]["overfly"]
    assert metrics["config_hash"] == Config().hash()
    assert metrics["interrupted"] is False


def test_settings_that_were_used_are_kept_beside_the_map(mapped: tuple[Path, MapOutcome]) -> None:
    out, _ = mapped
    assert load_config(out / "config.yaml") == Config()


def test_the_report_is_one_page_that_needs_no_other(mapped: tuple[Path, MapOutcome]) -> None:
    page = (mapped[0] / "report.html").read_text()
    assert page.lstrip().lower().startswith("<!doctype html>")
    assert 'src="http' not in page and "<link" not in page
    assert "overfly map flight" in page


def test_landmarks_are_where_they_were_measured(mapped: tuple[Path, MapOutcome], flight: Path) -> None:
    """Distances between named points, whose positions the simulator knows."""
    path = mapped[0] / "landmarks.json"
    if not (flight / "mav0" / "landmarks0" / "data.csv").exists():
        assert not path.exists()
        return
    found = json.loads(path.read_text())
    for landmark in found.values():
        assert landmark["views"] >= 1
        assert all(0 < sigma < 1.0 for sigma in landmark["sigma_m"])
        assert abs(landmark["z_m"]) < 0.3


def test_same_flight_same_bytes(mapped: tuple[Path, MapOutcome], flight: Path, tmp_path: Path) -> None:
    out, _ = mapped
    run(MapRequest(flight, tmp_path / "again"), quiet)
    for name in ("trajectory.tum", "online.tum", "odometry.tum", "graph.g2o"):
        assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes(), name


# -- ends before the end


def test_ctrl_c_keeps_what_was_finished(flight: Path, tmp_path: Path) -> None:
    def stop(count: int, _: FrameResult) -> None:
        if count == 12:
            raise KeyboardInterrupt

    outcome = run(MapRequest(flight, tmp_path / "out"), stop)
    assert outcome.interrupted
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names >= FILES
    assert len(np.loadtxt(tmp_path / "out" / "trajectory.tum")) == 12
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["interrupted"] is True


def test_ctrl_c_in_the_middle_of_a_frame_finishes_the_frame(flight: Path) -> None:
    """A real signal while a frame is processed: the map must not be left with half a node."""
    source = open_flight(flight)

    class Interrupted(Slam):
        def process(self, frame):  # type: ignore[no-untyped-def]
            if len(self.records) == 7:
                os.kill(os.getpid(), signal.SIGINT)
            return super().process(frame)

    before = signal.getsignal(signal.SIGINT)
    slam = Interrupted(source.rig)
    recording = record_flight(source, slam, quiet)
    assert recording.interrupted
    assert len(recording.frames) == len(slam.records) == 8
    assert len(slam.map.nodes) == len(slam.map.graph)
    assert signal.getsignal(signal.SIGINT) is before


def test_cli_says_that_it_was_interrupted(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from overfly.cli.console import FrameProgress

    def stop(_: FrameProgress, count: int, __: FrameResult) -> None:
        if count == 5:
            raise KeyboardInterrupt

    monkeypatch.setattr(FrameProgress, "__call__", stop)
    assert main(["map", str(flight), "-o", str(tmp_path / "out"), "--json"]) == 130
    printed = capsys.readouterr()
    assert json.loads(printed.out)["frames"] == 5
    assert "interrupted" in printed.err


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    err = capsys.readouterr().err.strip()
    assert "Traceback" not in err
    assert len(err.splitlines()) == 1, err
    return err


@pytest.fixture
def read_only(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "locked"
    folder.mkdir()
    folder.chmod(0o500)
    yield folder
    folder.chmod(0o700)


@pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written_is_named_before_any_work(
    flight: Path, read_only: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["map", str(flight), "-o", str(read_only / "out")]) == 1
    assert "locked" in one_line(capsys)


def test_a_file_where_the_folder_should_be_is_named(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").write_text("in the way")
    assert main(["map", str(flight), "-o", str(tmp_path / "out")]) == 1
    assert str(tmp_path / "out") in one_line(capsys)
    with pytest.raises(OutputError):
        run(MapRequest(flight, tmp_path / "out"), quiet)


def test_a_flight_that_is_not_there_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", str(tmp_path / "nowhere"), "-o", str(tmp_path / "out")]) == 1
    assert "nowhere" in one_line(capsys)
    assert not (tmp_path / "out").exists()


def test_a_flight_in_the_dark_is_no_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from PIL import Image

    write_flight(simulate("demo", 1, 3), tmp_path / "dark")
    for picture in (tmp_path / "dark" / "mav0" / "cam0" / "data").iterdir():
        with Image.open(picture) as image:
            size = image.size
        Image.new("RGB", size).save(picture)
    with pytest.raises(SourceError, match="too few features"):
        run(MapRequest(tmp_path / "dark", tmp_path / "out"), quiet)
    assert main(["map", str(tmp_path / "dark"), "-o", str(tmp_path / "out")]) == 1
    assert "no frame could be located" in one_line(capsys)


def test_options_choose_what_is_read(flight: Path, tmp_path: Path) -> None:
    reading = ReadOptions(start_s=0.5, stop_s=2.0, every=2)
    outcome = run(MapRequest(flight, tmp_path / "out", reading=reading), quiet)
    assert outcome.metrics["frames"] == 8  # 10 Hz: 0.5, 0.7, ... 1.9
