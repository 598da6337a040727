"""overfly evaluate: what it prints, what it refuses."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from overfly.cli import evaluate_command
from overfly.errors import GraphFileError, UsageError
from overfly.evaluation import Align, evaluate
from overfly.trajectory import Trajectory, write_tum


def random_path(seed: int) -> Trajectory:
    generator = np.random.default_rng(seed)
    positions = np.cumsum(generator.normal([0.5, 0, 0], 0.1, (60, 3)), axis=0)
    return Trajectory(np.arange(60) * 100_000_000, positions, np.tile([1.0, 0, 0, 0], (60, 1)))


def test_command_prints_json_that_agrees_with_the_function(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = random_path(6)
    estimate = random_path(7)
    write_tum(tmp_path / "truth.tum", truth)
    write_tum(tmp_path / "out" / "trajectory.tum", estimate)
    evaluate_command.command(tmp_path / "out", tmp_path / "truth.tum", align="sim3", json_output=True)
    printed = json.loads(capsys.readouterr().out)
    result = evaluate(estimate, truth, Align.SIM3)
    assert printed["ate_m"]["rmse"] == pytest.approx(result.ate_m.rmse, abs=1e-8)
    assert printed["coverage"] == result.coverage
    assert len(printed["relative"]) == len(result.relative)
    assert math.isfinite(printed["truth_from_estimate"]["scale"])


def test_command_prints_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = random_path(6)
    write_tum(tmp_path / "truth.tum", truth)
    evaluate_command.command(tmp_path / "truth.tum", tmp_path / "truth.tum")
    printed = capsys.readouterr().out
    assert "60 of 60 true frames (100.0 %)" in printed
    assert "horizontal (m)" in printed


def test_command_refuses_what_it_cannot_mean(tmp_path: Path) -> None:
    truth = random_path(6)
    path = tmp_path / "truth.tum"
    write_tum(path, truth)
    with pytest.raises(UsageError, match="--align affine"):
        evaluate_command.command(path, path, align="affine")
    with pytest.raises(UsageError, match="--plot"):
        evaluate_command.command(path, path, plot=tmp_path / "plot.pdf")
    later = Trajectory(truth.t_ns + 10**12, truth.positions, truth.quaternions_xyzw)
    write_tum(tmp_path / "later.tum", later)
    with pytest.raises(GraphFileError, match=r"later\.tum.*same clock"):
        evaluate_command.command(tmp_path / "later.tum", path)


@pytest.mark.parametrize("suffix", ["svg", "png"])
def test_command_draws(tmp_path: Path, suffix: str) -> None:
    write_tum(tmp_path / "truth.tum", random_path(6))
    write_tum(tmp_path / "out" / "odometry.tum", random_path(7))
    plot = tmp_path / "plots" / f"error.{suffix}"
    evaluate_command.command(tmp_path / "out", tmp_path / "truth.tum", which="odometry", plot=plot)
    assert plot.stat().st_size > 3000
