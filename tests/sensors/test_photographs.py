"""Folders of photographs: camera, order, place and angles from the files themselves."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from overfly.errors import CalibrationError, SourceError
from overfly.sensors import ReadOptions, open_flight
from overfly.sensors.exif import read_exif
from overfly.sensors.photographs import _spread_equal
from overfly.types import AltitudeKind

SECOND = 1_000_000_000
NOON = 1_466_683_200 * SECOND  # 2016-06-23 12:00:00 UTC


def photograph(
    path: Path,
    first: dict[int, Any] | None = None,
    tags: dict[int, Any] | None = None,
    gps: dict[int, Any] | None = None,
    xmp: str = "",
    size: tuple[int, int] = (64, 48),
) -> None:
    """Write a JPEG with these tags of the first, the Exif and the GPS directory, and an XMP packet."""
    exif = Image.Exif()
    exif.update(first or {})
    exif.get_ifd(0x8769).update(tags or {})
    exif.get_ifd(0x8825).update(gps or {})
    image = Image.fromarray(
        np.random.default_rng(len(path.name)).integers(0, 255, (*size[::-1], 3), np.uint8)
    )
    image.save(path, exif=exif)
    if xmp:
        content = b"http://ns.adobe.com/xap/1.0/\x00" + xmp.encode()
        whole = path.read_bytes()
        segment = b"\xff\xe1" + (len(content) + 2).to_bytes(2, "big") + content
        path.write_bytes(whole[:2] + segment + whole[2:])


def dji(**entries: object) -> str:
    return "".join(f'drone-dji:{name}="{value}"\n' for name, value in entries.items())


def at(clock: str) -> dict[int, Any]:
    return {36867: f"2016:06:23 {clock}"}


PLACE = {1: "N", 2: (46.0, 50.0, 24.0), 3: "W", 4: (91.0, 59.0, 42.0), 5: b"\x00", 6: 198.25}


def test_what_a_drone_writes(tmp_path: Path) -> None:
    xmp = dji(GimbalYawDegree="+45.0", GimbalPitchDegree=-90, GimbalRollDegree=0, RelativeAltitude="+39.80")
    photograph(tmp_path / "a.JPG", {272: "FC6310"}, {**at("12:00:00"), 37386: 8.8}, PLACE, xmp)
    flight = open_flight(tmp_path)
    frame = next(iter(flight))
    assert frame.t_ns == NOON
    assert frame.name == "a.JPG"
    assert frame.images[0].shape == (48, 64, 3)
    assert frame.attitude is not None and frame.altitude is not None and frame.position is not None
    assert frame.attitude.yaw_rad == pytest.approx(math.pi / 4)
    assert frame.altitude.value_m == 39.8
    assert frame.altitude.kind is AltitudeKind.ABOVE_START
    assert frame.position.latitude_deg == pytest.approx(46.84)
    assert frame.position.longitude_deg == pytest.approx(-91.995)
    assert frame.position.altitude_m == pytest.approx(198.25)
    assert flight.rig.calibration_source == "exif"
    assert flight.rig.cam0.camera.fx == pytest.approx(8.8 / 13.2 * 64)
    assert (flight.rig.cam0.camera.cx, flight.rig.cam0.camera.cy) == (31.5, 23.5)
    np.testing.assert_array_equal(flight.rig.cam0.body_from_cam.rotation @ [0, 0, 1], [0, 0, -1])


def test_the_drones_own_position_has_more_digits(tmp_path: Path) -> None:
    xmp = dji(GpsLatitude=46.840001, GpsLongtitude=-91.995001, AbsoluteAltitude=200.5, RtkStdLat=0.01)
    xmp += dji(RtkStdLon=0.01, RtkStdHgt=0.03)
    photograph(tmp_path / "a.jpg", gps=PLACE, xmp=xmp)
    position = next(iter(open_flight(tmp_path))).position
    assert position is not None
    assert (position.latitude_deg, position.longitude_deg) == (46.840001, -91.995001)
    assert position.altitude_m == 200.5
    assert position.sigma_horizontal_m == pytest.approx(0.01)
    assert position.sigma_vertical_m == pytest.approx(0.03)


def test_without_metadata_the_camera_is_a_guess_and_says_so(tmp_path: Path) -> None:
    for name in ("b.png", "a.png"):
        Image.new("L", (64, 48)).save(tmp_path / name)
    flight = open_flight(tmp_path)
    assert [frame.name for frame in flight] == ["a.png", "b.png"]
    assert flight.t_ns.tolist() == [0, SECOND]
    frame = next(iter(flight))
    assert frame.attitude is None
    assert frame.altitude is None
    assert frame.position is None
    assert flight.rig.calibration_source == "default"
    assert flight.rig.cam0.camera.fx == pytest.approx(0.85 * 64)
    assert "no time" in flight.problems[0].what


@pytest.mark.parametrize(
    ("model", "tags", "focal_px"),
    [
        # 4.5 mm, 320 pixels of the sensor an inch wide by the tag: 64 stated, 64 in the file
        ("", {37386: 4.5, 41486: 320.0, 41488: 2, 40962: 64}, 4.5 * 320 / 25.4),
        # the same photograph, resized to half by a program that left the tags
        ("", {37386: 4.5, 41486: 640.0, 41488: 2, 40962: 128}, 4.5 * 320 / 25.4),
        ("", {37386: 4.5, 41486: 126.0, 41488: 3, 40962: 64}, 4.5 * 12.6),
        # a resolution that would make a sensor of a metre is nonsense: the film equivalent counts
        ("", {37386: 4.5, 41486: 1.0, 41488: 2, 40962: 64, 41989: 28}, 28 * 80 / math.hypot(36, 24)),
        ("FC330", {37386: 3.61, 41989: 20}, 3.61 / 6.17 * 64),
        ("unheard of", {41989: 24}, 24 * 80 / math.hypot(36, 24)),
    ],
)
def test_focal_length(tmp_path: Path, model: str, tags: dict[int, Any], focal_px: float) -> None:
    photograph(tmp_path / "a.jpg", {272: model}, tags)
    flight = open_flight(tmp_path)
    assert flight.rig.cam0.camera.fx == pytest.approx(focal_px, rel=1e-4)
    assert flight.rig.calibration_source == "exif"


def test_a_calibration_file_comes_first(tmp_path: Path) -> None:
    photograph(tmp_path / "a.jpg", {272: "FC330"}, {37386: 3.61})
    file = tmp_path / "cameras.txt"
    file.write_text("1 PINHOLE 128 96 100 100 64 48\n")
    flight = open_flight(tmp_path, ReadOptions(camera_file=file))
    assert flight.rig.calibration_source == "given"
    assert flight.rig.cam0.camera.fx == pytest.approx(50.0)
    file.write_text("1 PINHOLE 128 128 100 100 64 48\n")
    with pytest.raises(CalibrationError, match="shape"):
        open_flight(tmp_path, ReadOptions(camera_file=file))


def test_order_is_that_of_time_then_name(tmp_path: Path) -> None:
    for name, clock in (
        ("z.jpg", "12:00:00"),
        ("c.jpg", "12:00:05"),
        ("a.jpg", "12:00:05"),
        ("b.jpg", "12:00:09"),
    ):
        photograph(tmp_path / name, tags=at(clock))
    flight = open_flight(tmp_path)
    assert [frame.name for frame in flight] == ["z.jpg", "a.jpg", "c.jpg", "b.jpg"]
    assert (np.diff(flight.t_ns) > 0).all()
    assert flight.t_ns[0] == NOON
    assert flight.t_ns[3] == NOON + 9 * SECOND


@given(st.lists(st.integers(0, 5), min_size=1, max_size=12))
def test_equal_times_are_spread_without_overtaking(seconds: list[int]) -> None:
    t_ns = np.sort(np.array(seconds, dtype=np.int64)) * SECOND
    spread = _spread_equal(t_ns)
    assert (np.diff(spread) > 0).all()
    assert (spread >= t_ns).all()
    assert (spread < t_ns + SECOND).all()


@pytest.mark.parametrize(
    ("tags", "gps", "t_ns"),
    [
        ({**at("12:00:00"), 37521: "25"}, {}, NOON + SECOND // 4),
        ({**at("14:00:00"), 36881: "+02:00"}, {}, NOON),
        ({}, {7: (12.0, 0.0, 0.5), 29: "2016:06:23"}, NOON + SECOND // 2),
        ({36867: "0000:00:00 00:00:00"}, {}, None),
        ({36867: "nonsense"}, {7: (12.0, 0.0)}, None),
    ],
)
def test_times(tmp_path: Path, tags: dict[int, Any], gps: dict[int, Any], t_ns: int | None) -> None:
    photograph(tmp_path / "a.jpg", tags=tags, gps=gps)
    exif = read_exif(tmp_path / "a.jpg")
    assert not isinstance(exif, str)
    assert exif.t_ns == t_ns


def test_what_does_not_look_down_or_has_another_size_is_named_and_passed_over(tmp_path: Path) -> None:
    angles = dict.fromkeys(("GimbalYawDegree", "GimbalRollDegree"), 0)
    photograph(tmp_path / "1.jpg", tags=at("12:00:01"), xmp=dji(GimbalPitchDegree=-80, **angles))
    photograph(tmp_path / "2.jpg", tags=at("12:00:02"), xmp=dji(GimbalPitchDegree=-40, **angles))
    photograph(tmp_path / "3.jpg", tags=at("12:00:03"), size=(48, 64))
    photograph(tmp_path / "4.jpg", tags=at("12:00:04"))
    (tmp_path / "5.jpg").write_bytes(b"")
    (tmp_path / "6.jpg").write_bytes(b"\xff\xd8 no more")
    (tmp_path / "._1.jpg").write_bytes(b"left by a file system")
    (tmp_path / "notes.txt").write_text("windy")
    flight = open_flight(tmp_path)
    assert [frame.name for frame in flight] == ["1.jpg", "4.jpg"]
    assert {problem.where for problem in flight.problems} == {"2.jpg", "3.jpg", "5.jpg", "6.jpg"}
    assert "50 degrees" in next(problem.what for problem in flight.problems if problem.where == "2.jpg")


def test_a_photograph_that_was_changed_since_may_have_been_turned(tmp_path: Path) -> None:
    xmp = dji(GimbalYawDegree=10, GimbalPitchDegree=-88, GimbalRollDegree=0)
    photograph(tmp_path / "1.jpg", {306: "2016:06:23 12:00:02"}, at("12:00:01"), xmp=xmp)
    photograph(tmp_path / "2.jpg", {306: "2016:06:23 15:00:02", 305: "Viewer 1"}, at("12:00:02"), xmp=xmp)
    flight = open_flight(tmp_path)
    first, second = (frame.attitude for frame in flight)
    assert first is not None and second is not None
    assert first.yaw_rad is not None
    assert second.yaw_rad is None
    # turned by half, its pitch is wrong by twice its size
    assert second.sigma_rad == pytest.approx(first.sigma_rad + 2 * abs(first.pitch_rad))
    assert [problem.where for problem in flight.problems] == ["2.jpg"]
    assert "Viewer 1" in flight.problems[0].what


def test_a_truncated_photograph_is_found_when_it_is_read(tmp_path: Path) -> None:
    for n in range(3):
        photograph(tmp_path / f"{n}.jpg", tags=at(f"12:00:0{n}"))
    middle = tmp_path / "1.jpg"
    middle.write_bytes(middle.read_bytes()[:-500])
    flight = open_flight(tmp_path)
    assert [frame.index for frame in flight] == [0, 2]
    assert [problem.where for problem in flight.problems] == ["1.jpg"]


def test_a_picture_turned_by_its_tags_stays_as_recorded(tmp_path: Path) -> None:
    photograph(tmp_path / "a.jpg", {274: 6})
    assert next(iter(open_flight(tmp_path))).images[0].shape == (48, 64, 3)


def test_pictures_in_a_folder_images(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    photograph(tmp_path / "images" / "a.jpg")
    assert len(open_flight(tmp_path)) == 1


def test_folders_that_cannot_be_used(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"")
    with pytest.raises(SourceError, match=r"a\.jpg"):
        open_flight(tmp_path)
    photograph(tmp_path / "a.jpg")
    with pytest.raises(SourceError, match="stereo"):
        open_flight(tmp_path, ReadOptions(stereo=True))


@given(st.binary(max_size=300))
def test_damaged_metadata_never_stops_the_reader(
    tmp_path_factory: pytest.TempPathFactory, junk: bytes
) -> None:
    path = tmp_path_factory.mktemp("photographs") / "a.jpg"
    content = b"Exif\x00\x00II*\x00\x08\x00\x00\x00" + junk
    Image.new("L", (8, 6)).save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[:2] + b"\xff\xe1" + (len(content) + 2).to_bytes(2, "big") + content + whole[2:])
    flight = open_flight(path.parent)
    assert len(list(flight)) == 1
