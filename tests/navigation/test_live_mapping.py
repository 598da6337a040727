"""Mapping while flying, with the autopilot's attitude, and the recording that stays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from overfly.cli import main
from overfly.errors import OutputError
from overfly.navigation.mavlink import Autopilot
from overfly.pipeline import growing
from overfly.pipeline.live_mapping import FlightRecorder, LiveSource, run
from overfly.pipeline.mapping import MapRequest
from overfly.products.growing_mosaic import GrowingMosaic
from overfly.sensors import Quantity, ReadOptions, open_flight
from overfly.sensors.live_camera import LiveCamera
from overfly.simulation import LiveFlight
from overfly.types import Altitude, AltitudeKind, Attitude, Frame

from .fake_autopilot import FakeAutopilot
from .test_autopilot_loop import SimulatedCamera, calibration, hold_scenario


def test_a_map_made_while_flying(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    counts: list[int] = []
    drawn: list[Path] = []  # its mosaic is drawn all along, without being asked for
    monkeypatch.setattr(growing, "FIRST_S", 0.0)
    monkeypatch.setattr(GrowingMosaic, "save", lambda _mosaic, path, _scale: drawn.append(path))
    with FakeAutopilot(Autopilot.ARDUPILOT) as autopilot:
        world = SimulatedCamera(autopilot)
        world.pictures = 40
        reading = ReadOptions(camera_file=calibration(tmp_path), stop_s=60.0)
        request = MapRequest(Path("camera:0"), tmp_path / "out", reading=reading)
        source = LiveSource("camera:0", autopilot.url)
        outcome = run(source, request, lambda n, _result: counts.append(n), LiveCamera(world))
    metrics = outcome.metrics
    assert metrics["scale_source"] == "range"
    assert metrics["located"] >= 0.8 * metrics["frames"] > 5
    assert counts == list(range(1, metrics["frames"] + 1))
    assert set(drawn) == {tmp_path / "out" / "mosaic.tif"}
    for name in ("map.overfly", "mosaic.tif", "trajectory.tum", "report.html"):
        assert (tmp_path / "out" / name).is_file()
    recorded = open_flight(tmp_path / "out" / "flight")
    assert len(list(recorded)) == metrics["frames"]
    covered = {sensor.quantity: sensor.frames for sensor in recorded.sensors}
    assert covered[Quantity.ATTITUDE] >= 0.7 * metrics["frames"]
    assert covered[Quantity.RANGE] >= 0.7 * metrics["frames"]
    # the map's heights are those of the truth: its metre came from the range sensor
    heights = np.loadtxt(tmp_path / "out" / "trajectory.tum")[:, 3]
    mount = LiveFlight(hold_scenario(), 1).rig.cam0.body_from_cam
    truth = np.median([place[2] for _, place in world.truth]) + mount.translation[2]
    assert np.median(heights) == pytest.approx(truth, abs=0.15)


def test_what_is_recorded_is_what_was_seen(tmp_path: Path) -> None:
    mounted = LiveFlight(hold_scenario(), 1).rig.cam0
    recorder = FlightRecorder(tmp_path / "flight", mounted)
    size = (mounted.camera.height, mounted.camera.width)
    generator = np.random.default_rng(0)
    written = []
    for n in range(4):
        image = generator.integers(0, 255, (*size, 3)).astype(np.uint8)
        attitude = Attitude(0.01 * n, -0.02, 0.01, 0.3) if n != 2 else None
        altitude = Altitude(2.0 + 0.1 * n, 0.05, AltitudeKind.RANGE)
        frame = Frame(7 * n, 5_000_000_000 + n * 100_000_000, "", (image,), attitude, altitude)
        written.append(recorder.add(frame))
    assert [frame.index for frame in written] == [0, 1, 2, 3]
    for mine, read in zip(written, open_flight(tmp_path / "flight"), strict=True):
        assert (read.index, read.t_ns, read.name) == (mine.index, mine.t_ns, mine.name)
        np.testing.assert_array_equal(read.images[0], mine.images[0])
        assert read.altitude is not None and mine.altitude is not None
        assert (read.altitude.value_m, read.altitude.sigma_m) == (
            mine.altitude.value_m,
            mine.altitude.sigma_m,
        )
        if mine.attitude is not None:
            assert read.attitude is not None and read.attitude.yaw_rad == pytest.approx(0.3)
            assert read.attitude.roll_rad == mine.attitude.roll_rad
    assert open_flight(tmp_path / "flight").rig.cam0.camera == mounted.camera
    with pytest.raises(OutputError, match="already"):
        FlightRecorder(tmp_path / "flight", mounted)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "SOURCE"),
        (("--camera", "calibration.yaml"), "SOURCE"),
        (("nowhere", "--mavlink", "udpout:127.0.0.1:9"), "camera:0"),
        (("nowhere", "--calibration", "a.yaml"), "live"),
        (("camera:0", "--resume"), "--resume"),
        (("camera:99",), "camera:99"),
        (("--camera", "camera:99"), "camera:99"),
    ],
)
def test_what_cannot_be_meant_is_one_line(
    tmp_path: Path, arguments: tuple[str, ...], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["map", *arguments, "-o", str(tmp_path / "out")]) in (1, 2)
    error = capsys.readouterr().err
    assert words in error
    assert "Traceback" not in error
