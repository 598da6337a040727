"""Flights in the EuRoC layout that are damaged or cannot be used: what is broken is named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from overfly.errors import CalibrationError, OverflyError, SourceError
from overfly.sensors import ReadOptions, open_flight

START = 1_700_000_000_000_000_000
PERIOD = 100_000_000
WriteFlight = Callable[..., Path]


def one_line(error: pytest.ExceptionInfo[OverflyError], *words: str) -> None:
    message = str(error.value)
    assert "\n" not in message
    for word in words:
        assert word in message


def test_damaged_pictures_are_named_and_passed_over(write_flight: WriteFlight) -> None:
    path = write_flight(frames=7)
    data = path / "mav0/cam0/data"
    files = [data / f"{START + n * PERIOD}.png" for n in range(7)]
    whole = files[1].read_bytes()
    files[1].write_bytes(whole[: len(whole) // 2])
    files[2].write_bytes(b"")
    files[3].unlink()
    files[4].write_text("not a picture")
    Image.new("L", (16, 12)).save(files[5])
    flight = open_flight(path)
    assert len(flight) == 7
    for _ in range(2):
        assert [frame.index for frame in flight] == [0, 6]
        assert [problem.where for problem in flight.problems] == [
            f"cam0/data/{file.name}" for file in files[1:6]
        ]


def test_a_truncated_jpeg_is_not_filled_up(write_flight: WriteFlight) -> None:
    path = write_flight(frames=2)
    file = path / f"mav0/cam0/data/{START}.png"
    noise = np.random.default_rng(1).integers(0, 255, (24, 32), dtype=np.uint8)
    Image.fromarray(noise).save(file, format="JPEG", quality=95)
    file.write_bytes(file.read_bytes()[:-200])
    flight = open_flight(path)
    assert [frame.index for frame in flight] == [1]
    assert "damaged" in flight.problems[0].what


@pytest.mark.parametrize("content", ["", "\n", "#timestamp [ns],range [m]\n", None])
def test_a_silent_sensor_is_named_and_left_out(write_flight: WriteFlight, content: str | None) -> None:
    path = write_flight(files={"altitude0/data.csv": content or ""})
    if content is None:
        (path / "mav0/altitude0/data.csv").unlink()
    flight = open_flight(path)
    assert next(iter(flight)).altitude is None
    assert flight.problems[0].where == "altitude0/data.csv"


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("cam0/sensor.yaml", None, ("cam0/sensor.yaml", "--camera")),
        ("cam0/sensor.yaml", "a: [1, 2", ("cam0/sensor.yaml", "line")),
        ("cam0/sensor.yaml", "just text", ("cam0/sensor.yaml",)),
        ("cam0/sensor.yaml", "rate_hz: 10\n", ("cam0/sensor.yaml",)),
        ("cam0/data.csv", "#timestamp [ns],filename\n", ("cam0/data.csv",)),
        ("cam0/data.csv", "#timestamp [ns],filename\n5,nowhere.png\n", ("cam*/data",)),
        ("altitude0/data.csv", "#timestamp [ns],range [ft]\n5,1\n", ("altitude0/data.csv", "[ft]")),
        ("altitude0/data.csv", "#timestamp [ns],depth [m]\n5,1\n", ("altitude0/data.csv", "range")),
        (
            "attitude0/data.csv",
            "#timestamp [ns],roll [m],pitch [rad]\n5,1,1\n",
            ("attitude0/data.csv", "[m]"),
        ),
    ],
)
def test_a_flight_that_cannot_be_used_says_so_in_one_line(
    write_flight: WriteFlight, name: str, content: str | None, words: tuple[str, ...]
) -> None:
    path = write_flight(files={name: content or ""})
    if content is None:
        (path / "mav0" / name).unlink()
    with pytest.raises(SourceError) as error:
        open_flight(path)
    one_line(error, *words)


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("radial-tangential", "magic", "magic"),
        ("[30, 31, 16.5, 11.5]", "[30, 31, 16.5]", "3 intrinsics"),
        ("[30, 31, 16.5, 11.5]", "[30, .nan, 16.5, 11.5]", "nan"),
        ("[30, 31, 16.5, 11.5]", "[-30, 31, 16.5, 11.5]", "positive"),
        ("[32, 24]", "[32, 32]", "32x24"),
        ("0, 0, -1, -0.03", "0, 0, 1, -0.03", "rotation"),
        ("pinhole", "omni", "omni"),
    ],
)
def test_a_calibration_that_cannot_be_true_is_refused(
    write_flight: WriteFlight, old: str, new: str, word: str
) -> None:
    path = write_flight()
    file = path / "mav0/cam0/sensor.yaml"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(CalibrationError) as error:
        open_flight(path)
    one_line(error, "cam0/sensor.yaml", word)


def test_stereo_that_is_not_there(write_flight: WriteFlight) -> None:
    with pytest.raises(SourceError, match="cam1"):
        open_flight(write_flight(), ReadOptions(stereo=True))


@pytest.mark.parametrize("make", ["nothing", "file", "empty"])
def test_paths_that_hold_no_flight(tmp_path: Path, make: str) -> None:
    path = tmp_path / "somewhere"
    if make == "file":
        path.write_text("hello")
    if make == "empty":
        path.mkdir()
    with pytest.raises(SourceError) as error:
        open_flight(path)
    one_line(error, str(path))


def test_two_cameras_at_one_place_are_no_stereo_rig(write_flight: WriteFlight) -> None:
    path = write_flight(cameras=2)
    first = (path / "mav0/cam0/sensor.yaml").read_text()
    (path / "mav0/cam1/sensor.yaml").write_text(first)
    with pytest.raises(CalibrationError, match="same place"):
        open_flight(path)
