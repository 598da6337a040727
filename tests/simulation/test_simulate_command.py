"""overfly simulate, as a user calls it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer

from overfly.cli.simulate_command import command
from overfly.errors import OutputError, UsageError


def run(*arguments: str) -> None:
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(command)
    app(args=list(arguments), standalone_mode=False)


def test_it_writes_a_flight_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("blimp", "-o", str(tmp_path / "out"), "--frames", "2", "--size", "160x120", "--seed", "3", "--json")
    result = json.loads(capsys.readouterr().out)
    assert result["frames"] == 2
    assert result["seed"] == 3
    assert len(list((tmp_path / "out/mav0/cam0/data").iterdir())) == 2
    with pytest.raises(OutputError, match="empty folder"):
        run("blimp", "-o", str(tmp_path / "out"), "--frames", "2")


def test_the_users_own_camera_is_flown(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(
        "cam0:\n  camera_model: pinhole\n  intrinsics: [410.0, 411.0, 159.0, 121.0]\n"
        "  distortion_model: radtan\n  distortion_coeffs: [-0.1, 0.01, 0.0, 0.0]\n  resolution: [320, 240]\n"
    )
    run("blimp", "-o", str(tmp_path / "out"), "--frames", "1", "--camera", str(tmp_path / "camera.yaml"))
    assert "intrinsics: [410, 411, 159, 121]" in (tmp_path / "out/mav0/cam0/sensor.yaml").read_text()


def test_list_names_every_scenario(capsys: pytest.CaptureFixture[str]) -> None:
    run("list")
    printed = capsys.readouterr().out
    for name in ("demo", "outdoor", "corridor", "blimp", "hold", "helicopter", "survey", "kidnap"):
        assert f"\n{name} " in f"\n{printed}"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("atlantis", "-o", "x"), "no scenario is called 'atlantis'"),
        (("demo",), "-o FOLDER"),
        (("demo", "-o", "x", "--size", "large"), "640x480"),
        (("demo", "-o", "x", "--frames", "100000"), "frames"),
        (("demo", "-o", "x", "--dsm", "heights.tif"), "--ortho"),
        (("demo", "-o", "x", "--height-m", "30"), "--ortho"),
    ],
)
def test_what_cannot_be_meant_is_refused(arguments: tuple[str, ...], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        run(*arguments)
