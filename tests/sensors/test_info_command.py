"""overfly info: what it says of a flight, for people and for programs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from overfly.cli import info_command
from overfly.errors import SourceError

WriteFlight = Callable[..., Path]


def test_json_names_everything(write_flight: WriteFlight, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_flight(frames=6, cameras=2)
    broken = sorted((path / "mav0/cam1/data").iterdir())[2]
    broken.write_bytes(b"")
    info_command.command(path, json_output=True)
    facts = json.loads(capsys.readouterr().out)
    assert facts["kind"] == "EuRoC folder"
    assert (facts["frames"], facts["frames_readable"]) == (6, 5)
    assert facts["duration_s"] == pytest.approx(0.5)
    assert facts["rate_hz"] == pytest.approx(10.0)
    assert [camera["name"] for camera in facts["cameras"]] == ["cam0", "cam1"]
    assert facts["stereo_baseline_m"] == pytest.approx(0.12)
    assert facts["scale_source"] == "stereo"
    assert facts["problems"] == [{"where": f"cam1/data/{broken.name}", "what": "empty file; passed over"}]
    assert any(line.startswith("attitude") for line in facts["missing"])


def test_text_names_what_is_missing_and_broken(
    write_flight: WriteFlight, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_flight(frames=6)
    sorted((path / "mav0/cam0/data").iterdir())[2].unlink()
    info_command.command(path)
    text = capsys.readouterr().out
    for words in (
        "EuRoC folder",
        "6 (5 readable)",
        "32x24",
        "scale from",
        "none",
        "--height-m",
        "file is missing",
    ):
        assert words in text
    info_command.command(path, quick=True)
    assert "readable" not in capsys.readouterr().out


def test_photographs_without_metadata(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Image.new("L", (64, 48)).save(tmp_path / "a.png")
    info_command.command(tmp_path, json_output=True)
    facts = json.loads(capsys.readouterr().out)
    assert facts["calibration_source"] == "default"
    assert facts["rate_hz"] is None
    assert any("--camera" in line for line in facts["missing"])


def test_a_long_list_of_problems_is_cut(
    write_flight: WriteFlight, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_flight(frames=40)
    for file in sorted((path / "mav0/cam0/data").iterdir())[1:]:
        file.write_bytes(b"")
    info_command.command(path)
    text = capsys.readouterr().out
    assert text.count("empty file") == info_command.PROBLEMS_SHOWN
    assert "19 more" in text


def test_nothing_to_read(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="nowhere"):
        info_command.command(tmp_path / "nowhere")
