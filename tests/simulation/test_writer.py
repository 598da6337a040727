"""What is written can be read again, and is what was simulated."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from overfly.errors import OutputError
from overfly.sensors import open_flight
from overfly.simulation import scene, simulate, write_flight
from overfly.simulation.flight import SimulatedFrame


def table(path: Path) -> tuple[list[str], list[list[str]]]:
    lines = path.read_text().splitlines()
    return lines[0].lstrip("#").split(","), [line.split(",") for line in lines[1:]]


@pytest.fixture(scope="module")
def corridor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("flights") / "corridor"
    assert write_flight(simulate("corridor", 4, frames=14), out) == 14
    return out


def test_layout_is_that_of_the_contract(corridor: Path) -> None:
    files = {str(path.relative_to(corridor)) for path in corridor.rglob("*") if path.is_file()}
    for sensor in ("cam0", "cam1", "attitude0", "imu0"):
        assert {f"mav0/{sensor}/data.csv", f"mav0/{sensor}/sensor.yaml"} <= files
    truth = {"groundtruth.tum", "groundtruth_cam0.tum", "landmarks_gt.csv", "frames_gt.csv",
             "scene/scene.json", "scene/ortho.jpg", "scene/dsm.npz"}  # fmt: skip
    assert {f"truth/{name}" for name in truth} <= files
    assert not [name for name in files if name.endswith(".part")]
    header, rows = table(corridor / "mav0/attitude0/data.csv")
    assert header == ["timestamp [ns]", "roll [rad]", "pitch [rad]"]
    assert len(rows) > 100


def test_pictures_stamps_and_calibration_are_those_of_the_flight(corridor: Path) -> None:
    flight = simulate("corridor", 4, frames=14)
    _, rows = table(corridor / "mav0/cam1/data.csv")
    assert [int(row[0]) for row in rows] == flight.stamps_ns.tolist()
    stored = cv2.imread(str(corridor / "mav0/cam1/data" / rows[5][1]), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(stored, flight.frame(5).images[1])
    facts = yaml.safe_load((corridor / "mav0/cam1/sensor.yaml").read_text())
    mounted = flight.rig.cameras[1]
    assert np.allclose(np.reshape(facts["T_BS"]["data"], (4, 4)), mounted.body_from_cam.matrix(), atol=1e-15)
    camera = mounted.camera
    assert facts["intrinsics"] == [camera.fx, camera.fy, camera.cx, camera.cy]
    assert facts["distortion_coefficients"] == list(camera.coefficients)


def test_truth_is_that_of_the_flight(corridor: Path) -> None:
    flight = simulate("corridor", 4, frames=14)
    numbers = np.loadtxt(corridor / "truth/groundtruth_cam0.tum")
    assert numbers.shape == (14, 8)
    assert np.allclose(numbers[:, 0], flight.stamps_ns * 1e-9, atol=1e-6)
    assert np.allclose(numbers[3, 1:4], flight.truth[3].translation, atol=1e-8)
    assert np.allclose(numbers[3, 4:], flight.truth[3].quaternion(), atol=1e-10)
    _, rows = table(corridor / "truth/landmarks_gt.csv")
    assert rows
    stamps = flight.stamps_ns.tolist()
    for name, x, y, z, stamp, camera, u, v in rows:
        point = np.array([[float(x), float(y), float(z)]])
        assert np.allclose(point[0], flight.landmarks[name], atol=1e-6)
        pose = flight.scenario.path.pose(flight._times[stamps.index(int(stamp))])
        mounted = flight.rig.cameras[int(camera[-1])]
        px = mounted.camera.project((pose @ mounted.body_from_cam).inverse().transform(point))
        assert np.allclose(px[0], [float(u), float(v)], atol=1e-3)


def test_the_scene_is_placed_in_the_world(corridor: Path) -> None:
    facts = json.loads((corridor / "truth/scene/scene.json").read_text())
    ortho = cv2.imread(str(corridor / "truth/scene/ortho.jpg"))
    assert ortho.shape[:2] == (facts["ortho"]["height"], facts["ortho"]["width"])
    # the chequered cross in the middle of landmark B: dark to its upper left and lower right, light elsewhere
    texel = facts["ortho"]["texel_m"]
    mark = next(item for item in facts["landmarks"] if item["name"] == "B")
    col, row = (
        (mark["x"] - facts["ortho"]["x0"]) / texel - 0.5,
        (facts["ortho"]["y1"] - mark["y"]) / texel - 0.5,
    )
    near = round(0.02 / texel)
    quarters = [
        int(ortho[round(row + a * near), round(col + b * near), 1])
        for a, b in ((-1, -1), (1, 1), (-1, 1), (1, -1))
    ]
    assert max(quarters[:2]) < 100
    assert min(quarters[2:]) > 150
    with np.load(corridor / "truth/scene/dsm.npz") as heights:
        assert np.ptp(heights["dsm"]) == 0.0


def test_sonar_book_gps_and_barometer_files(tmp_path: Path) -> None:
    write_flight(simulate("helicopter", 1, frames=1), tmp_path / "h")
    header, rows = table(tmp_path / "h/mav0/landmark0/data.csv")
    assert header[:4] == ["name", "corner", "x_local [m]", "y_local [m]"]
    assert [row[0] for row in rows] == ["book"] * 4
    write_flight(simulate("blimp", 1, frames=3), tmp_path / "b")
    header, rows = table(tmp_path / "b/mav0/altitude0/data.csv")
    assert header == ["timestamp [ns]", "range [m]"]
    assert all(1.0 < float(row[1]) < 3.0 for row in rows)
    assert not (tmp_path / "b/mav0/attitude0").exists()


def test_an_interrupted_flight_is_whole_as_far_as_it_goes(tmp_path: Path) -> None:
    flight = simulate("blimp", 1, frames=20)

    def stop_at_five(done: int, _of: int) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_flight(flight, tmp_path / "out", stop_at_five)
    assert len(table(tmp_path / "out/mav0/cam0/data.csv")[1]) == 5
    assert len(list((tmp_path / "out/mav0/cam0/data").iterdir())) == 5
    assert len(np.loadtxt(tmp_path / "out/truth/groundtruth_cam0.tum")) == 5


def test_folders_that_hold_something_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("irreplaceable")
    with pytest.raises(OutputError, match="empty folder"):
        write_flight(simulate("blimp", frames=1), tmp_path)
    with pytest.raises(OutputError, match="cannot be written"):
        write_flight(simulate("blimp", frames=1), tmp_path / "thesis.txt" / "below")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_memory_does_not_grow_with_the_flight() -> None:
    """The ground that is kept is bounded by the cache, whatever was flown over."""
    flight = simulate("long-haul", 1, size=(64, 48))
    pool = flight.tiles.pool.nbytes
    for index in range(0, len(flight), 900):
        assert isinstance(flight.render(index, store=False), SimulatedFrame)
    assert flight.tiles.pool.nbytes == pool < 250e6
    assert (flight.tiles.keys >= 0).sum() <= len(flight.tiles.pool)


@pytest.mark.parametrize("name", ["corridor", "blimp", "survey"])
def test_read_back_it_is_the_flight_that_was_simulated(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scene, "MOST_PIXELS", 300)  # the orthophoto of a whole survey takes its time
    flight = simulate(name, 2, frames=3, size=(160, 120))
    write_flight(flight, tmp_path / "out")
    read = open_flight(tmp_path / "out")
    assert not read.problems
    for simulated, recorded in zip(flight, read, strict=True):
        assert simulated.t_ns == recorded.t_ns
        for one, two in zip(simulated.images, recorded.images, strict=True):
            assert np.array_equal(one, two)
        assert (simulated.attitude is None) == (recorded.attitude is None)
        if simulated.attitude is not None and recorded.attitude is not None:
            assert recorded.attitude.roll_rad == pytest.approx(simulated.attitude.roll_rad, abs=1e-8)
            assert recorded.attitude.pitch_rad == pytest.approx(simulated.attitude.pitch_rad, abs=1e-8)
        if simulated.altitude is not None and recorded.altitude is not None:
            assert recorded.altitude.value_m == pytest.approx(simulated.altitude.value_m, abs=1e-6)
            assert recorded.altitude.kind == simulated.altitude.kind
        if simulated.position is not None:
            assert recorded.position is not None
            assert recorded.position.latitude_deg == pytest.approx(simulated.position.latitude_deg, abs=1e-7)
    for simulated_camera, camera in zip(flight.rig.cameras, read.rig.cameras, strict=True):
        assert simulated_camera.camera == camera.camera
        assert np.allclose(simulated_camera.body_from_cam.matrix(), camera.body_from_cam.matrix(), atol=1e-12)
