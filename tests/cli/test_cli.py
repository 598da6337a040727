"""The command line: exit codes, one line for what failed, quick help."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from overfly.cli import VERBS, main
from overfly.cli.console import FrameProgress, exit_interrupted
from overfly.cli.map_command import settings_of, summary
from overfly.config import AttitudeUse
from overfly.errors import UsageError
from overfly.frame_result import FrameResult
from overfly.types import Reason

HEAVY = ("numba", "cv2", "scipy", "rasterio", "pydantic", "pandas", "matplotlib")


def test_help_exits_well_and_names_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    for verb in VERBS:
        assert f" {verb} " in text


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([verb, "--help"]) == 0
    assert verb in capsys.readouterr().out


def test_help_does_not_wait_for_heavy_parts() -> None:
    code = f"import sys, overfly.cli; print([m for m in {HEAVY!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "arguments",
    [
        ["no-such-verb"],
        ["map"],
        ["map", "somewhere"],
        ["map", "somewhere", "-o", "out", "--no-such-option"],
        ["map", "somewhere", "-o", "out", "--every", "often"],
        ["map", "somewhere", "-o", "out", "--attitude", "sometimes"],
        ["map", "somewhere", "-o", "out", "--set", "features.count=-1"],
        ["map", "somewhere", "-o", "out", "--set", "nonsense"],
        ["map", "somewhere", "-o", "out", "--height-m", "-3"],
        ["map", "somewhere", "-o", "out", "--config", "absent.yaml"],
        ["simulate", "no-such-scenario", "-o", "out"],
    ],
    ids=" ".join,
)
def test_wrong_usage_is_two(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    printed = capsys.readouterr()
    assert printed.err
    assert "Traceback" not in printed.err
    assert printed.out == ""
    assert not (tmp_path / "out").exists()


def test_failed_work_is_one_and_names_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (
        ["map", str(tmp_path / "gone"), "-o", str(tmp_path / "out")],
        ["info", str(tmp_path / "gone")],
    ):
        assert main(arguments) == 1
        err = capsys.readouterr().err.strip()
        assert len(err.splitlines()) == 1
        assert "gone" in err


def test_the_program_is_installed_under_its_name(tmp_path: Path) -> None:
    program = Path(sys.executable).parent / "overfly"
    if not program.exists():
        program = Path(sys.executable)
        pytest.skip(f"overfly is not installed beside {program}")
    done = subprocess.run(
        [str(program), "map", str(tmp_path / "gone"), "-o", str(tmp_path / "out")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stdout == ""
    assert len(done.stderr.strip().splitlines()) == 1


def test_named_options_come_after_files_and_assignments(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text("attitude: {use: none}\nheight: {given_m: 9}\nfeatures: {count: 50}\n")
    settings = settings_of(path, ["features.count=60", "attitude.use=fixed"], "prior", 3.25)
    assert settings.attitude.use is AttitudeUse.PRIOR
    assert settings.height.given_m == 3.25
    assert settings.features.count == 60
    assert settings_of(path, None, None, None).height.given_m == 9
    with pytest.raises(UsageError, match="prior, fixed, none"):
        settings_of(None, None, "often", None)


def test_summary_is_for_a_person() -> None:
    metrics = {
        "located": 9, "frames": 10, "nodes": 3, "constraints": 4, "frames_per_second": 123.456,
        "scale_source": "gps", "gps_horizontal_rms_m": 1.234, "warnings": ["It was dark."],
        "compiled_first": False,
    }  # fmt: skip
    text = summary(metrics, Path("out"))
    assert "9 of 10 frames" in text and "123.5" in text and "1.23 m" in text and "It was dark." in text
    assert "report.html" in text
    assert "GPS" not in summary(metrics | {"gps_horizontal_rms_m": None}, Path("out"))
    assert "compiling" not in text
    assert "123.5 frames/s, compiling included" in summary(metrics | {"compiled_first": True}, Path("out"))


def test_progress_counts_on_stderr_only(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = iter(range(0, 1000, 6))
    monkeypatch.setattr("overfly.cli.console.time.monotonic", lambda: float(next(clock)))
    with FrameProgress() as progress:
        progress(1, FrameResult(0, None, Reason.FEW_FEATURES))
        progress(2, FrameResult(0, None, Reason.FEW_FEATURES))
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "2 frames, 0 located" in printed.err
    assert "\r" not in printed.err  # not a terminal: plain lines


def test_interrupted_says_what_is_kept(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_interrupted() == 130
    assert "kept" in capsys.readouterr().err


def test_json_is_one_object_on_stdout(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        main(["simulate", "demo", "-o", str(tmp_path / "f"), "--frames", "2", "--size", "80x60", "--json"])
        == 0
    )
    printed = capsys.readouterr()
    assert json.loads(printed.out)["frames"] == 2
