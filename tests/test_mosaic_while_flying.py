"""mosaic.tif while the flight goes on: there and whole all the time, and no run differs by it."""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import rasterio

from overfly.frame_result import FrameResult
from overfly.pipeline import growing
from overfly.pipeline.growing import MOSAIC_NAME, growing_mosaic
from overfly.pipeline.mapping import MapRequest, run
from overfly.pipeline.recording import Recording, record_flight
from overfly.products.growing_mosaic import GrowingMosaic
from overfly.sensors import open_flight
from overfly.simulation import simulate, write_flight
from overfly.slam import Slam

FRAMES = 60
SAME = ("mosaic.tif", "elevation.tif", "trajectory.tum", "online.tum", "graph.g2o")


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flight")
    write_flight(simulate("demo", 1, FRAMES), folder / "demo")
    return folder / "demo"


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """A drawer that looks, saves and rests hardly longer than a frame takes."""
    for name in ("FIRST_S", "LOOK_EVERY_S", "SAVE_EVERY_S"):
        monkeypatch.setattr(growing, name, 0.03)
    monkeypatch.setattr(growing, "SHARE", 0.9)


def quiet(_: int, __: FrameResult) -> None:
    """No progress."""


def drawers() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "overfly-mosaic"]


@pytest.mark.usefixtures("hasty")
def test_the_file_is_whole_while_flying_and_in_the_end_what_it_is_without(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[float] = []

    def look(_: int, __: FrameResult) -> None:
        time.sleep(0.03)  # as a camera waits
        path = tmp_path / "with" / MOSAIC_NAME
        if path.exists():
            with rasterio.open(path) as raster:
                rgba = raster.read()
                seen.append(np.count_nonzero(rgba[3]) * raster.transform.a**2)
                assert rgba[0][rgba[3] > 0].std() > 5.0

    run(MapRequest(flight, tmp_path / "with", growing_mosaic=True), look)
    assert not drawers()
    assert len(seen) > 5
    assert len(set(seen)) > 2
    monkeypatch.setattr(GrowingMosaic, "lay", None)  # nobody draws if nobody asked for it
    run(MapRequest(flight, tmp_path / "without"), quiet)
    for name in SAME:
        assert (tmp_path / "with" / name).read_bytes() == (tmp_path / "without" / name).read_bytes(), name
    with rasterio.open(tmp_path / "without" / MOSAIC_NAME) as raster:
        whole_m2 = np.count_nonzero(raster.read(4)) * raster.transform.a**2
    assert 0.4 * whole_m2 < seen[-1] < 1.1 * whole_m2
    assert not [path for path in (tmp_path / "with").iterdir() if path.name.startswith(".")]


def flown(flight_path: Path, mosaic: Path, rest_s: float = 0.02) -> Recording:
    flight = open_flight(flight_path)
    slam = Slam(flight.rig, None, flight.scale_landmark, flight.attitude_at)
    with growing_mosaic(mosaic, slam) as drawer:
        return record_flight(flight, slam, lambda _n, _r: time.sleep(rest_s), viewer=drawer)


@pytest.mark.usefixtures("hasty")
def test_a_file_that_cannot_be_written_is_one_line_and_the_flight_goes_on(
    flight: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / MOSAIC_NAME).mkdir()
    with caplog.at_level(logging.WARNING):
        recording = flown(flight, tmp_path / MOSAIC_NAME)
    assert recording.n_located == FRAMES
    told = [record for record in caplog.records if record.name == "overfly.mosaic"]
    assert len(told) == 1
    assert MOSAIC_NAME in told[0].getMessage()
    assert told[0].exc_info is None


@pytest.mark.usefixtures("hasty")
@pytest.mark.parametrize(("name", "raised"), [("draw_next", ValueError), ("lay", MemoryError)])
def test_a_drawing_that_fails_ends_the_drawing_only(
    flight: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    raised: type[Exception],
) -> None:
    def fail(*_: object) -> None:
        raise raised("of a test")

    monkeypatch.setattr(GrowingMosaic, name, fail)
    recording = flown(flight, tmp_path / MOSAIC_NAME)
    assert recording.n_located == FRAMES
    assert not drawers()
    assert [record.levelname for record in caplog.records] == ["ERROR"]


@pytest.mark.usefixtures("hasty")
def test_pictures_that_wait_are_bounded(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(growing, "MOST_WAITING_BYTES", 400_000)
    monkeypatch.setattr(growing.MosaicDrawer, "_step", lambda *_: False)  # a thread that gets nothing done
    opened = open_flight(flight)
    slam = Slam(opened.rig, None, opened.scale_landmark, opened.attitude_at)
    with growing_mosaic(tmp_path / MOSAIC_NAME, slam) as drawer:
        record_flight(opened, slam, quiet, viewer=drawer)
        assert isinstance(drawer, growing.MosaicDrawer)
        sizes = [picture.nbytes for _, picture in drawer._waiting]
    assert 0 < sum(sizes) <= 400_000
    assert len(sizes) < len(slam.map)
