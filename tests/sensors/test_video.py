"""Videos with the telemetry beside them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from overfly.errors import CalibrationError, SourceError, UsageError
from overfly.sensors import Quantity, ReadOptions, ScaleSource, SourceKind, choose_scale_source, open_flight
from overfly.types import AltitudeKind

from .recordings import HEIGHT, WIDTH, number_of, write_dataflash, write_ulog, write_video

NEW_CUE = """\
{number}
00:00:{seconds:06.3f} --> 00:00:{later:06.3f}
<font size="28">FrameCnt: {number}, DiffTime: 40ms
2024-06-01 10:11:12.345
[iso: 100] [shutter: 1/500.0] [fnum: 1.7] [focal_len: {focal}] [latitude: {latitude:.6f}] \
[longitude: 8.500000] [rel_alt: {height:.3f} abs_alt: 450.100] \
[gb_yaw: {yaw} gb_pitch: {pitch} gb_roll: 0.0]</font>

"""


def subtitles(
    path: Path, frames: int = 40, pitch: float = -90.0, yaw: float = 90.0, focal: float = 24.0, every: int = 1
) -> Path:
    text = "".join(
        NEW_CUE.format(
            number=n + 1, seconds=0.04 * n, later=0.04 * (n + 1),
            latitude=47.0 + 1e-6 * n, height=30.0 + 0.1 * n, yaw=yaw, pitch=pitch, focal=focal,
        )
        for n in range(0, frames, every)
    )  # fmt: skip
    path.write_text(text.replace(".000 -->", ",000 -->"))
    return path


def test_frames_are_those_of_the_video_at_their_times(tmp_path: Path) -> None:
    flight = open_flight(write_video(tmp_path / "a.mp4"))
    assert flight.kind is SourceKind.VIDEO
    assert len(flight) == 40
    frames = list(flight)
    assert [number_of(frame.images[0]) for frame in frames] == list(range(40))
    np.testing.assert_allclose([frame.t_ns * 1e-9 for frame in frames], 0.04 * np.arange(40), atol=1e-6)
    assert frames[0].images[0].shape == (HEIGHT, WIDTH, 3)
    assert frames[31].images[0][0, 0, 0] > 150
    assert frames[31].images[0][0, 0, 2] < 60  # RGB: blue is dark
    assert flight.rig.calibration_source == "default"
    assert not flight.problems


def test_frames_come_in_any_order(tmp_path: Path) -> None:
    flight = open_flight(write_video(tmp_path / "a.mp4"), ReadOptions(every=3, start_s=0.4, stop_s=1.2))
    numbers = []
    for index in (5, 2, 2, 6, 0):
        frame = flight.read_frame(index)
        assert frame is not None
        numbers.append(number_of(frame.images[0]))
    assert numbers == [10 + 3 * index for index in (5, 2, 2, 6, 0)]


@pytest.mark.parametrize(("name", "code"), [("a.avi", "MJPG"), ("a.MOV", "mp4v"), ("a.mkv", "mp4v")])
def test_containers(tmp_path: Path, name: str, code: str) -> None:
    flight = open_flight(write_video(tmp_path / name, 12, 10.0, code))
    assert [number_of(frame.images[0]) for frame in flight] == list(range(12))
    assert float(np.diff(flight.t_ns).mean()) == pytest.approx(1e8, rel=0.02)


def test_dji_subtitles(tmp_path: Path) -> None:
    subtitles(tmp_path / "DJI_0001.SRT")
    flight = open_flight(write_video(tmp_path / "DJI_0001.mp4"))
    frames = list(flight)
    for n in (0, 7, 39):
        attitude, altitude, position = frames[n].attitude, frames[n].altitude, frames[n].position
        assert attitude is not None and altitude is not None and position is not None
        assert (attitude.roll_rad, attitude.pitch_rad) == pytest.approx((0.0, 0.0), abs=1e-9)
        assert attitude.yaw_rad == pytest.approx(0.0, abs=1e-9)  # nose to the east
        assert altitude.kind is AltitudeKind.ABOVE_START
        assert altitude.value_m == pytest.approx(30.0 + 0.1 * n)
        assert position.latitude_deg == pytest.approx(47.0 + 1e-6 * n, abs=1e-9)
        assert position.altitude_m == pytest.approx(450.1)
    assert choose_scale_source(flight) is ScaleSource.GPS
    assert flight.rig.calibration_source == "exif"
    # 24 mm, on a picture whose diagonal stands for 43.3 mm
    assert flight.rig.cam0.camera.fx == pytest.approx(24.0 * math.hypot(WIDTH, HEIGHT) / math.hypot(36, 24))


def test_a_gimbal_that_looks_ahead_is_passed_over(tmp_path: Path) -> None:
    subtitles(tmp_path / "a.srt", pitch=-20.0)
    with pytest.raises(SourceError, match="35 degrees"):
        open_flight(write_video(tmp_path / "a.mp4"))
    subtitles(tmp_path / "a.srt", pitch=-80.0)
    flight = open_flight(tmp_path / "a.mp4")
    attitude = next(iter(flight)).attitude
    assert attitude is not None
    assert attitude.pitch_rad == pytest.approx(math.radians(-10.0))  # nose up, as the conventions have it


def test_older_subtitles(tmp_path: Path) -> None:
    cue = (
        "{n}\n00:00:0{n},000 --> 00:00:0{m},000\nHOME(8.5,47.0) 2017.08.05 14:11:51\n"
        "GPS(8.500{n},47.1,16) {height}\n\n"
    )
    (tmp_path / "a.srt").write_text(
        "".join(cue.format(n=n, m=n + 1, height=f"BAROMETER:{20 + n}.5") for n in range(4))
    )
    frame = list(open_flight(write_video(tmp_path / "a.mp4", 40, 20.0)))[20]  # one second
    assert frame.position is not None and frame.altitude is not None
    assert (frame.position.longitude_deg, frame.position.latitude_deg) == pytest.approx((8.5001, 47.1))
    assert frame.altitude.value_m == pytest.approx(21.5)
    assert math.isinf(frame.position.sigma_vertical_m)


def test_subtitles_of_a_film_are_no_telemetry(tmp_path: Path) -> None:
    (tmp_path / "a.srt").write_text("1\n00:00:00,000 --> 00:00:01,000\nA bird.\n")
    flight = open_flight(write_video(tmp_path / "a.mp4", 5))
    assert [problem.where for problem in flight.problems] == ["a.srt"]
    (tmp_path / "a.srt").write_text("nothing")
    with pytest.raises(SourceError, match=r"a\.srt"):
        open_flight(tmp_path / "a.mp4")


def test_a_table_in_the_videos_time(tmp_path: Path) -> None:
    rows = [f"{0.1 * n:.1f},{n},{-n},{5 + n}" for n in range(20)]
    (tmp_path / "a.csv").write_text("#time [s],roll [deg],pitch [deg],range [cm]\n" + "\n".join(rows))
    frames = list(open_flight(write_video(tmp_path / "a.mp4")))
    attitude, altitude = frames[10].attitude, frames[10].altitude  # 0.4 s
    assert attitude is not None and altitude is not None
    assert (attitude.roll_rad, attitude.pitch_rad) == pytest.approx((math.radians(4), math.radians(-4)))
    assert attitude.yaw_rad is None
    assert altitude.kind is AltitudeKind.RANGE
    assert altitude.value_m == pytest.approx(0.09)


def test_cells_without_a_value_are_sensors_that_were_silent(tmp_path: Path) -> None:
    gps = ["47,8.5", ",", ",", ",", ","]
    rows = [f"{0.1 * n:.1f},{n},0,{gps[n % 5]}" for n in range(21)]
    (tmp_path / "a.csv").write_text("#time [s],roll [deg],pitch [deg],lat,lon\n" + "\n".join(rows))
    flight = open_flight(write_video(tmp_path / "a.mp4"))
    samples = {sensor.quantity: sensor.samples for sensor in flight.sensors}
    assert samples == {Quantity.ATTITUDE: 21, Quantity.POSITION: 5}
    assert all(frame.position is not None and frame.attitude is not None for frame in flight)
    assert not flight.problems


def ardupilot_log(path: Path) -> Path:
    """From 100 s after boot: rolling at one degree a second."""
    seconds = [100.0 + 0.05 * n for n in range(100)]
    return write_dataflash(
        path,
        {
            "ATT": ("QccC", "TimeUS,Roll,Pitch,Yaw", [(s * 1e6, s - 100, 5.0, 90.0) for s in seconds]),
            "RFND": ("QBfBB", "TimeUS,I,Dist,Stat,Orient", [(s * 1e6, 0, 7.5, 4, 25) for s in seconds]
                     + [(s * 1e6 + 1, 1, 1.0, 4, 0) for s in seconds]),
            "GPS": ("QBBLLe", "TimeUS,I,Status,Lat,Lng,Alt",
                    [(s * 1e6, 0, 3, 47.0, 8.5, 400.0) for s in seconds[::4]]),
            "BARO": ("QBf", "TimeUS,I,Alt", [(s * 1e6, 0, 3.0) for s in seconds]),
        },
    )  # fmt: skip


def test_an_ardupilot_log(tmp_path: Path) -> None:
    ardupilot_log(tmp_path / "a.bin")
    video = write_video(tmp_path / "a.mp4")
    flight = open_flight(video, ReadOptions(time_offset_s=1.5))
    frame = list(flight)[25]  # one second into the video, 2.5 s into the log
    assert frame.attitude is not None and frame.altitude is not None and frame.position is not None
    assert frame.attitude.roll_rad == pytest.approx(math.radians(2.5), abs=2e-4)
    assert frame.attitude.pitch_rad == pytest.approx(math.radians(-5.0), abs=2e-4)
    assert frame.attitude.yaw_rad == pytest.approx(0.0, abs=2e-4)
    assert frame.altitude.value_m == pytest.approx(7.5)
    assert frame.position.latitude_deg == pytest.approx(47.0, abs=1e-6)
    assert {sensor.quantity for sensor in flight.sensors} == {
        Quantity.ATTITUDE,
        Quantity.RANGE,
        Quantity.POSITION,
    }
    assert not flight.problems
    assert any("--time-offset" in problem.what for problem in open_flight(video).problems)


def test_a_px4_log(tmp_path: Path) -> None:
    seconds = [7.0 + 0.02 * n for n in range(200)]
    half = math.radians(30.0) / 2
    write_ulog(
        tmp_path / "a.ulg",
        {
            "vehicle_attitude": (
                "uint64_t timestamp;float[4] q",
                [(round(s * 1e6), math.cos(half), 0.0, 0.0, math.sin(half)) for s in seconds]
            ),
            "distance_sensor": (
                "uint64_t timestamp;float min_distance;float max_distance;float current_distance;"
                "float h_fov;float v_fov;uint8_t type;uint8_t orientation",
                [
                    (round(s * 1e6), 0.1, 40.0, 12.0 if n % 2 else 99.0, 0.6, 0.4, 1, 25)
                    for n, s in enumerate(seconds)
                ],
            ),
            "vehicle_gps_position": (
                "uint64_t timestamp;int32_t lat;int32_t lon;int32_t alt;float eph;float epv;uint8_t fix_type",
                [(round(s * 1e6), 470_000_000, 85_000_000, 400_000, 0.7, 1.1, 3) for s in seconds[::10]],
            ),
        },
    )  # fmt: skip
    frame = list(open_flight(write_video(tmp_path / "a.mp4"), ReadOptions(time_offset_s=0.0)))[20]
    assert frame.attitude is not None and frame.altitude is not None and frame.position is not None
    assert frame.attitude.yaw_rad == pytest.approx(math.radians(60.0), abs=1e-6)  # clockwise from north
    assert frame.altitude.value_m == pytest.approx(12.0)
    assert frame.altitude.half_angle_rad == pytest.approx(0.2)  # the narrower view of a sonar's two
    assert frame.position.sigma_horizontal_m == pytest.approx(0.7)
    assert frame.position.altitude_m == pytest.approx(400.0)


@pytest.mark.parametrize("name", ["a.ulg", "a.bin", "a.csv"])
@pytest.mark.parametrize("content", [b"", b"\xa3\x95nonsense" * 20, b"ULog\x01\x12\x35\x01junk"])
def test_damaged_telemetry_is_one_line(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(SourceError, match=name) as failure:
        open_flight(write_video(tmp_path / "a.mp4", 3))
    assert "\n" not in str(failure.value)


def test_what_is_no_video_is_one_line(tmp_path: Path) -> None:
    for content in (b"", b"not a video at all" * 100):
        (tmp_path / "a.mp4").write_bytes(content)
        with pytest.raises(SourceError, match=r"a\.mp4"):
            open_flight(tmp_path / "a.mp4")
    whole = write_video(tmp_path / "b.mp4").read_bytes()
    (tmp_path / "b.mp4").write_bytes(whole[: len(whole) // 2])  # the power went before it was finished
    with pytest.raises(SourceError, match=r"b\.mp4"):
        open_flight(tmp_path / "b.mp4")


def test_options_that_cannot_be_meant(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4", 5)
    with pytest.raises(SourceError, match="stereo"):
        open_flight(video, ReadOptions(stereo=True))
    with pytest.raises(UsageError, match="offset"):
        open_flight(video, ReadOptions(time_offset_s=1.0))
    (tmp_path / "camera.yaml").write_text(
        "camera_model: pinhole\nintrinsics: [100, 100, 50, 50]\nresolution: [100, 100]\n"
        "distortion_model: radtan\ndistortion_coefficients: [0, 0, 0, 0]\n"
    )
    with pytest.raises(CalibrationError, match="another shape"):
        open_flight(video, ReadOptions(camera_file=tmp_path / "camera.yaml"))
