"""Flights in the EuRoC layout: what is read is what was written."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from overfly.errors import CalibrationError, SourceError, UsageError
from overfly.geometry.cameras import Distortion
from overfly.geometry.poses import euler_from_rotation, rotation_from_euler
from overfly.sensors import ReadOptions, open_flight
from overfly.sensors.euroc_sensors import read_attitude
from overfly.sensors.flight import Problems
from overfly.types import AltitudeKind

START = 1_700_000_000_000_000_000
PERIOD = 100_000_000
WriteFlight = Callable[..., Path]


def rows(header: str, values: list[str], period_ns: int = PERIOD // 2) -> str:
    """A sensor's file whose samples start one and a half periods before the first frame."""
    lines = [f"{START + n * period_ns - 3 * period_ns // 2},{value}" for n, value in enumerate(values)]
    return "\n".join([header, *lines]) + "\n"


def test_frames_come_as_they_were_written_as_often_as_asked(write_flight: WriteFlight) -> None:
    flight = open_flight(write_flight(frames=5, cameras=2))
    assert len(flight) == 5
    for _ in range(2):
        frames = list(flight)
        assert [frame.index for frame in frames] == [0, 1, 2, 3, 4]
        assert [frame.t_ns for frame in frames] == [START + n * PERIOD for n in range(5)]
        for n, frame in enumerate(frames):
            for camera, image in enumerate(frame.images):
                assert image.dtype == np.uint8
                assert image.shape == (24, 32)
                assert image[0, 0] == 3 * n + 60 * camera
        assert frames[0].attitude is None
        assert frames[0].altitude is None
        assert frames[0].position is None
    assert flight.problems == []
    assert flight.imu is None


def test_rig_and_mounts(write_flight: WriteFlight) -> None:
    path = write_flight(cameras=2)
    flight = open_flight(path / "mav0")
    camera = flight.rig.cam0.camera
    assert (camera.width, camera.height, camera.fx, camera.fy) == (32, 24, 30.0, 31.0)
    assert camera.distortion is Distortion.RADIAL_TANGENTIAL
    assert camera.coefficients == (-0.1, 0.05, 0.001, -0.0004)
    np.testing.assert_allclose(flight.rig.cam0.body_from_cam.translation, [0.05, 0.06, -0.03])
    # the second camera is 12 cm to starboard, which is image right
    np.testing.assert_allclose(flight.rig.cam1_from_cam0.translation, [-0.12, 0.0, 0.0], atol=1e-15)
    assert not open_flight(path, ReadOptions(stereo=False)).rig.is_stereo


def test_sensors_are_interpolated_to_the_frames(write_flight: WriteFlight) -> None:
    n = 13  # frames lie midway between the samples 1 and 2, 3 and 4 ...
    yaws = [math.degrees(math.remainder(3.0 + 0.1 * k, 2 * math.pi)) for k in range(n)]
    files = {
        "attitude0/data.csv": rows(
            "#timestamp [ns],pitch [rad],roll [rad],yaw [deg]",
            [f"{0.02 * k},{-0.01 * k},{yaws[k]}" for k in range(n)],
        ),
        "attitude0/sensor.yaml": "sigma_deg: 0.3\nbias_sigma_deg: 0.4\n",
        "altitude0/data.csv": rows("#timestamp [ns],range [cm]", [f"{200 + 10 * k}" for k in range(n)]),
        "altitude0/sensor.yaml": "sigma_m: 0.015\n",
        "gps0/data.csv": rows(
            "#timestamp [ns],lat [deg],lon [deg],alt [m],sigma_h [m],sigma_v [m]",
            [f"{60 + 1e-6 * k},{math.remainder(179.9995 + 1e-4 * k, 360)},{90 + k},0.5,2" for k in range(n)],
        ),
    }
    flight = open_flight(write_flight(frames=6, files=files))
    for index, frame in enumerate(flight):
        k = 2 * index + 1.5
        assert frame.attitude is not None and frame.altitude is not None and frame.position is not None
        assert frame.attitude.roll_rad == pytest.approx(-0.01 * k)
        assert frame.attitude.pitch_rad == pytest.approx(0.02 * k)
        assert frame.attitude.sigma_rad == pytest.approx(math.radians(0.5))
        assert frame.attitude.yaw_rad is not None
        assert abs(math.remainder(frame.attitude.yaw_rad - 3.0 - 0.1 * k, 2 * math.pi)) < 1e-9
        assert abs(frame.attitude.yaw_rad) <= math.pi
        assert frame.altitude.value_m == pytest.approx(2.0 + 0.1 * k)
        assert frame.altitude.sigma_m == pytest.approx(0.015)
        assert frame.altitude.kind is AltitudeKind.RANGE
        assert abs(math.remainder(frame.position.longitude_deg - 179.9995 - 1e-4 * k, 360)) < 1e-9
        assert abs(frame.position.longitude_deg) <= 180.0
        assert frame.position.sigma_horizontal_m == pytest.approx(0.5)
    assert {sensor.name: sensor.frames for sensor in flight.sensors} == {
        "attitude0": 6,
        "altitude0": 6,
        "gps0": 6,
    }


def test_values_lie_between_the_samples_not_on_the_nearest(write_flight: WriteFlight) -> None:
    table = f"#timestamp [ns],range [m]\n{START - PERIOD // 4},1\n{START + 3 * PERIOD // 4},2\n"
    flight = open_flight(write_flight(files={"altitude0/data.csv": table}))
    values = [frame.altitude.value_m if frame.altitude else None for frame in flight]
    assert values == [pytest.approx(1.25), None, None, None, None, None]


@given(st.tuples(*[st.floats(-0.5, 0.5)] * 6), st.booleans())
def test_attitude_is_that_of_the_body_whatever_the_sensors_mount(
    tmp_path_factory: pytest.TempPathFactory, angles: tuple[float, ...], has_yaw: bool
) -> None:
    body = rotation_from_euler(*angles[:3])
    mount = rotation_from_euler(*angles[3:])
    roll, pitch, yaw = euler_from_rotation(body @ mount)
    folder = tmp_path_factory.mktemp("flight") / "attitude0"
    folder.mkdir()
    matrix = np.eye(4)
    matrix[:3, :3] = mount
    heading = ",yaw [rad]" if has_yaw else ""
    value = f",{yaw!r}" if has_yaw else ""
    text = f"#timestamp [ns],roll [rad],pitch [rad]{heading}\n5,{roll!r},{pitch!r}{value}\n"
    (folder / "data.csv").write_text(text)
    (folder / "sensor.yaml").write_text(f"T_BS: {{data: {matrix.ravel().tolist()}}}\n")
    record = read_attitude(folder, np.array([5]), 2.0, Problems())
    assert record is not None
    attitude = record.at(np.array([5]), 2.0)[0]
    assert attitude is not None
    assert attitude.roll_rad == pytest.approx(angles[0], abs=1e-9)
    assert attitude.pitch_rad == pytest.approx(angles[1], abs=1e-9)
    if has_yaw:
        assert attitude.yaw_rad == pytest.approx(angles[2], abs=1e-9)
    else:
        assert attitude.yaw_rad is None


@pytest.mark.parametrize(
    ("says", "degrees"),
    [("sensor_type: sonar\ncone_half_angle_deg: 9", 9.0), ("cone_half_angle_rad: 0.1", math.degrees(0.1)),
     ("sensor_type: ultrasonic", 12.0), ("sensor_type: lidar", 0.0), ("rate_hz: 10", 0.0)],
)  # fmt: skip
def test_the_cone_of_a_sonar(write_flight: WriteFlight, says: str, degrees: float) -> None:
    files = {
        "altitude0/data.csv": rows("#timestamp [ns],range [m]", ["1.5"] * 13),
        "altitude0/sensor.yaml": says + "\n",
    }
    altitude = next(iter(open_flight(write_flight(files=files)))).altitude
    assert altitude is not None
    assert math.degrees(altitude.half_angle_rad) == pytest.approx(degrees)


def test_range_is_measured_from_the_body_and_height_is_another_kind(write_flight: WriteFlight) -> None:
    below = "T_BS: {data: [1,0,0,0, 0,1,0,0, 0,0,1,-0.2, 0,0,0,1]}\n"
    files = {
        "altitude0/data.csv": rows("#timestamp [ns],range [m]", ["1.5"] * 13),
        "altitude0/sensor.yaml": below,
    }
    path = write_flight(files=files)
    altitude = next(iter(open_flight(path))).altitude
    assert altitude is not None
    assert altitude.value_m == pytest.approx(1.7)
    (path / "mav0/altitude0/data.csv").write_text(rows("#timestamp [ns],height [m]", ["1.5"] * 13))
    altitude = next(iter(open_flight(path))).altitude
    assert altitude is not None
    assert altitude.value_m == pytest.approx(1.5)
    assert altitude.kind is AltitudeKind.ABOVE_START


def test_a_barometer_serves_where_there_is_no_range(write_flight: WriteFlight) -> None:
    files = {
        "barometer0/data.csv": rows("#timestamp [ns],above_start [m]", ["30"] * 13),
        "barometer0/sensor.yaml": "sigma_m: 0.4\n",
        "attitude0/data.csv": rows("#timestamp [ns],roll [rad],pitch [rad]", ["0,0"] * 13),
        "attitude0/sensor.yaml": "sigma_rad: 0.02\n",
    }
    path = write_flight(files=files)
    frame = next(iter(open_flight(path)))
    assert frame.altitude is not None and frame.attitude is not None
    assert (frame.altitude.value_m, frame.altitude.sigma_m) == pytest.approx((30.0, 0.4))
    assert frame.altitude.kind is AltitudeKind.ABOVE_START
    assert frame.attitude.sigma_rad == pytest.approx(0.02)
    (path / "mav0/altitude0").mkdir()
    (path / "mav0/altitude0/data.csv").write_text(rows("#timestamp [ns],range [m]", ["28"] * 13))
    frame = next(iter(open_flight(path)))
    assert frame.altitude is not None
    assert frame.altitude.kind is AltitudeKind.RANGE


def test_imu_is_turned_into_the_body(write_flight: WriteFlight) -> None:
    header = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    header += "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
    # its x axis is the body's y, its y the body's -x
    turned = "T_BS: {data: [0,-1,0,0, 1,0,0,0, 0,0,1,0, 0,0,0,1]}\n"
    files = {
        "imu0/data.csv": rows(header, ["0.1,0.2,0.3,1,2,9.8"] * 13, 1000),
        "imu0/sensor.yaml": turned,
    }
    imu = open_flight(write_flight(files=files)).imu
    assert imu is not None
    assert imu.t_ns[0] == START - 1500
    np.testing.assert_allclose(imu.gyro[5], [-0.2, 0.1, 0.3])
    np.testing.assert_allclose(imu.accel[5], [-2.0, 1.0, 9.8])


def test_landmarks(write_flight: WriteFlight) -> None:
    corners = "".join(
        f"book,{n},{x},{y},{START},cam0,{10 + n},{5 + n}\n"
        for n, (x, y) in enumerate([(-0.15, 0.1), (0.15, 0.1), (0.15, -0.1)])
    )
    header = "#name,corner,x_local [m],y_local [m],timestamp [ns],camera,u [px],v [px]\n"
    clicks = f"#name,timestamp [ns],camera,u [px],v [px]\nA,{START},cam0,1.5,2.5\n"
    files = {"landmark0/data.csv": header + corners, "landmarks0/data.csv": clicks}
    flight = open_flight(write_flight(files=files))
    assert flight.scale_landmark is not None
    assert flight.scale_landmark.name == "book"
    np.testing.assert_allclose(flight.scale_landmark.corners_m[1], [0.15, 0.1])
    np.testing.assert_allclose(flight.scale_landmark.corners_px[2], [12.0, 7.0])
    assert [(click.name, click.px) for click in flight.landmark_clicks] == [("A", (1.5, 2.5))]


def test_from_to_and_every(write_flight: WriteFlight) -> None:
    path = write_flight(frames=10)
    flight = open_flight(path, ReadOptions(start_s=0.2, stop_s=0.8, every=2))
    assert [frame.t_ns - START for frame in flight] == [n * PERIOD for n in (2, 4, 6, 8)]
    assert [frame.index for frame in flight] == [0, 1, 2, 3]
    with pytest.raises(SourceError) as error:
        open_flight(path, ReadOptions(start_s=5.0))
    assert "0.9 s" in str(error.value)
    for options in (ReadOptions(every=0), ReadOptions(start_s=2.0, stop_s=1.0)):
        with pytest.raises(UsageError):
            open_flight(path, options)


def test_colour_is_rgb_and_sixteen_bit_is_scaled(write_flight: WriteFlight) -> None:
    path = write_flight(frames=2)
    colour = np.zeros((24, 32, 3), np.uint8)
    colour[:, :, 0] = 200
    Image.fromarray(colour).save(path / f"mav0/cam0/data/{START}.png")
    deep = np.full((24, 32), 0x7F10, np.uint16)
    Image.fromarray(deep).save(path / f"mav0/cam0/data/{START + PERIOD}.png")
    first, second = (frame.images[0] for frame in open_flight(path))
    np.testing.assert_array_equal(first, colour)
    np.testing.assert_array_equal(second, np.full((24, 32), 0x7F, np.uint8))


def test_stereo_pairs_are_of_one_time(write_flight: WriteFlight) -> None:
    path = write_flight(frames=5, cameras=2)
    listing = path / "mav0/cam1/data.csv"
    lines = listing.read_text().splitlines()
    # second row missing, third row 20 ms late, fourth as good as there, and a picture 60 ms late
    stamp = START + 2 * PERIOD
    late = f"{START + 4 * PERIOD + 60_000_000},late.png"
    lines = [lines[0], lines[1], f"{stamp + 20_000_000},{stamp}.png", lines[4], late]
    listing.write_text("\n".join(lines))
    flight = open_flight(path)
    assert flight.t_ns.tolist() == [START, stamp, START + 3 * PERIOD]
    assert [int(frame.images[1][0, 0]) for frame in flight] == [60, 66, 69]
    assert {problem.where for problem in flight.problems} == {
        f"cam0/{START + PERIOD}.png",
        f"cam0/{START + 4 * PERIOD}.png",
        "cam1/late.png",
    }


def test_pictures_named_by_time_need_no_list(write_flight: WriteFlight) -> None:
    path = write_flight(frames=3)
    (path / "mav0/cam0/data.csv").unlink()
    flight = open_flight(path)
    assert flight.t_ns.tolist() == [START + n * PERIOD for n in range(3)]
    assert len(list(flight)) == 3
    assert "missing" in flight.problems[0].what


def test_a_calibration_file_replaces_the_flights_own(write_flight: WriteFlight, tmp_path: Path) -> None:
    path = write_flight()
    file = tmp_path / "camera.yaml"
    file.write_text("image_width: 64\nimage_height: 48\ncamera_matrix: {data: [80,0,33,0,80,23,0,0,1]}\n")
    rig = open_flight(path, ReadOptions(camera_file=file)).rig
    assert rig.cam0.camera.fx == pytest.approx(40.0)
    np.testing.assert_allclose(rig.cam0.body_from_cam.translation, [0.05, 0.06, -0.03])
    (path / "mav0/cam0/sensor.yaml").unlink()
    rig = open_flight(path, ReadOptions(camera_file=file)).rig
    assert rig.cam0.camera.fx == pytest.approx(40.0)


def test_a_camchain_replaces_both_cameras_and_their_baseline(
    write_flight: WriteFlight, tmp_path: Path
) -> None:
    path = write_flight(cameras=2)
    cameras = [
        f"cam{n}: {{camera_model: pinhole, distortion_model: equidistant, distortion_coeffs: [0.1, 0, 0, 0], "
        f"intrinsics: [{40 + n}, 40, 16, 12], resolution: [32, 24]"
        for n in range(2)
    ]
    file = tmp_path / "camchain.yaml"
    apart = ", T_cn_cnm1: [[1, 0, 0, -0.3], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    file.write_text(f"{cameras[0]}}}\n{cameras[1]}{apart}}}\n")
    rig = open_flight(path, ReadOptions(camera_file=file)).rig
    assert [mounted.camera.fx for mounted in rig.cameras] == [40.0, 41.0]
    np.testing.assert_allclose(rig.cam1_from_cam0.translation, [-0.3, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(rig.cam0.body_from_cam.translation, [0.05, 0.06, -0.03])
    file.write_text(f"{cameras[0]}}}\n")
    with pytest.raises(CalibrationError, match="--mono"):
        open_flight(path, ReadOptions(camera_file=file))
    assert not open_flight(path, ReadOptions(camera_file=file, stereo=False)).rig.is_stereo
