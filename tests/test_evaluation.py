"""Trajectory errors: against evo on public flights, and against what a known disturbance must give."""

from __future__ import annotations

import os
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from overfly.errors import GraphFileError, OutputError
from overfly.evaluation import (
    Align,
    alignment,
    associate,
    evaluate,
    horizontal_rms_against_gps,
    pairs_along_path,
)
from overfly.files import atomic_path
from overfly.geometry.poses import Pose, rotation_from_vector, rotation_z
from overfly.trajectory import Trajectory, read_tum, write_tum

FLIGHTS = ("blimp", "corridor", "helicopter", "outdoor", "survey")


def wander(seed: int, n: int = 60, step_m: float = 0.4) -> Trajectory:
    """A smooth random path in all three axes, at 10 Hz."""
    generator = np.random.default_rng(seed)
    heading = np.cumsum(generator.normal(0, 0.2, n))
    steps = step_m * np.stack([np.cos(heading), np.sin(heading), generator.normal(0, 0.2, n)], axis=1)
    turns = Rotation.from_rotvec(np.cumsum(generator.normal(0, 0.05, (n, 3)), axis=0))
    return Trajectory(np.arange(n) * 100_000_000, np.cumsum(steps, axis=0), turns.as_quat())


def disturbed(truth: Trajectory, seed: int, keep: float = 0.9) -> Trajectory:
    """The truth scaled, turned, shifted, with noise and with frames missing."""
    generator = np.random.default_rng(seed)
    rows = np.flatnonzero(generator.random(len(truth)) < keep)
    spread = truth.positions.std()
    turn = Rotation.from_rotvec(generator.normal(0, 0.3, 3))
    noise = np.cumsum(generator.normal(0, 0.003 * spread, (len(rows), 3)), axis=0)
    shake = Rotation.from_rotvec(generator.normal(0, 0.02, (len(rows), 3)))
    return Trajectory(
        truth.t_ns[rows],
        turn.apply(1.07 * truth.positions[rows] + noise) + generator.normal(0, spread, 3),
        (turn * Rotation.from_quat(truth.quaternions_xyzw[rows]) * shake).as_quat(),
    )


# --- agreement with evo ----------------------------------------------------------------------------


def evo_trajectory(trajectory: Trajectory):
    from evo.core.trajectory import PoseTrajectory3D

    return PoseTrajectory3D(
        positions_xyz=trajectory.positions,
        orientations_quat_wxyz=np.roll(trajectory.quaternions_xyzw, 1, axis=1),
        timestamps=trajectory.t_ns / 1e9,
    )


def evo_figures(estimate: Trajectory, truth: Trajectory, align: Align) -> dict[str, float]:
    """The same figures as evo_ape and evo_rpe give them."""
    from evo.core import metrics, sync

    reference, estimated = sync.associate_trajectories(
        evo_trajectory(truth), evo_trajectory(estimate), max_diff=0.01
    )
    if align in (Align.SE3, Align.SIM3):
        estimated.align(reference, correct_scale=align is Align.SIM3)
    figures: dict[str, float] = {}
    for name, relation in (
        ("translation", metrics.PoseRelation.translation_part),
        ("rotation", metrics.PoseRelation.rotation_angle_rad),
    ):
        absolute = metrics.APE(relation)
        absolute.process_data((reference, estimated))
        figures |= {f"ate {name} {key}": value for key, value in absolute.get_all_statistics().items()}
        for length_m in (None, 5.0, 10.0, 100.0):
            unit = metrics.Unit.frames if length_m is None else metrics.Unit.meters
            relative = metrics.RPE(relation, length_m or 1, unit, 0.1, True, True)
            try:
                relative.process_data((reference, estimated))
            except Exception as error:  # evo refuses lengths that the path does not have
                assert "delta" in str(error) or "index" in str(error)
                continue
            figures[f"rpe {name} {length_m}"] = relative.get_statistic(metrics.StatisticsType.rmse)
    return figures


@pytest.mark.data
@pytest.mark.parametrize("flight", FLIGHTS)
@pytest.mark.parametrize("align", [Align.NONE, Align.SE3, Align.SIM3])
def test_same_figures_as_evo_on_public_flights(data_dir: Path, flight: str, align: Align) -> None:
    truth = read_tum(data_dir / "flights" / flight / "truth" / "groundtruth_cam0.tum")
    assert_same_as_evo(disturbed(truth, seed=3), truth, align)


@pytest.mark.parametrize("align", [Align.NONE, Align.SE3, Align.SIM3])
def test_same_figures_as_evo_on_a_random_path(align: Align) -> None:
    truth = wander(8, n=300)
    assert_same_as_evo(disturbed(truth, seed=5), truth, align)


def assert_same_as_evo(estimate: Trajectory, truth: Trajectory, align: Align) -> None:
    ours, theirs = evaluate(estimate, truth, align), evo_figures(estimate, truth, align)
    for name, statistics in (("translation", ours.ate_m), ("rotation", ours.rotation_rad)):
        for key in ("rmse", "mean", "median", "max"):
            assert getattr(statistics, key) == pytest.approx(theirs[f"ate {name} {key}"], abs=1e-6), key
    relative = {error.length_m: error for error in ours.relative}
    compared = 0
    for length_m, error in relative.items():
        if f"rpe translation {length_m}" in theirs:
            compared += 1
            assert error.translation_m.rmse == pytest.approx(theirs[f"rpe translation {length_m}"], abs=1e-6)
            assert error.rotation_rad.rmse == pytest.approx(theirs[f"rpe rotation {length_m}"], abs=1e-6)
    assert compared >= 2


# --- properties ------------------------------------------------------------------------------------


@given(st.integers(0, 10_000), st.sampled_from(list(Align)))
@settings(max_examples=40, deadline=None)
def test_an_alignment_takes_out_what_it_may_and_nothing_else(seed: int, align: Align) -> None:
    generator = np.random.default_rng(seed)
    truth = wander(seed)
    free_turn = rotation_from_vector(generator.normal(0, 1, 3))
    rotation = {
        Align.NONE: np.eye(3),
        Align.YAW: rotation_z(float(generator.uniform(-3, 3))),
        Align.SE3: free_turn,
        Align.SIM3: free_turn,
    }[align]
    scale = float(generator.uniform(0.2, 5)) if align is Align.SIM3 else 1.0
    shift = np.zeros(3) if align is Align.NONE else generator.normal(0, 10, 3)
    moved = Trajectory(
        truth.t_ns,
        scale * truth.positions @ rotation.T + shift,
        (Rotation.from_matrix(rotation) * Rotation.from_quat(truth.quaternions_xyzw)).as_quat(),
    )
    result = evaluate(moved, truth, align)
    assert result.ate_m.max < 1e-9
    assert result.rotation_rad.max < 1e-7
    assert result.final_error_m < 1e-9
    assert result.scale_error == pytest.approx(scale - 1, abs=1e-9)


@given(st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_more_freedom_never_makes_the_error_larger(seed: int) -> None:
    truth = wander(seed)
    estimate = disturbed(truth, seed + 1)
    rmse = [evaluate(estimate, truth, align).ate_m.rmse for align in Align]
    assert all(later <= earlier + 1e-12 for earlier, later in pairwise(rmse))


@given(st.integers(0, 10_000), st.floats(-2, 2), st.floats(-2, 2))
@settings(max_examples=25, deadline=None)
def test_no_small_turn_improves_the_yaw_alignment(seed: int, d_yaw: float, d_x: float) -> None:
    truth = wander(seed).positions
    points = disturbed(wander(seed), seed + 1, keep=1.1).positions
    best = alignment(points, truth, Align.YAW)
    other = points @ (rotation_z(d_yaw) @ best.rotation).T
    other += (truth - other).mean(axis=0) + np.array([d_x, 0, 0])
    assert np.sum((best.transform(points) - truth) ** 2) <= np.sum((other - truth) ** 2) + 1e-9


def test_a_known_shift_is_the_error_and_splits_by_axis() -> None:
    truth = wander(1)
    moved = Trajectory(truth.t_ns, truth.positions + np.array([3.0, 4.0, 12.0]), truth.quaternions_xyzw)
    result = evaluate(moved, truth, Align.NONE)
    assert result.ate_m.rmse == pytest.approx(13.0)
    assert result.ate_horizontal_m.median == pytest.approx(5.0)
    assert result.ate_vertical_m.p95 == pytest.approx(12.0)
    assert result.final_error_m == pytest.approx(0.0, abs=1e-9)


def test_drift_in_percent_of_the_path() -> None:
    n = 501
    x = np.linspace(0, 50, n)
    level = np.tile([1.0, 0, 0, 0], (n, 1))
    truth = Trajectory(np.arange(n) * 100_000_000, np.stack([x, 0 * x, 0 * x], axis=1), level)
    estimate = Trajectory(
        truth.t_ns, truth.positions * [1.0, 1.0, 1.0] + np.outer(0.02 * x, [0, 1, 0]), level
    )
    result = evaluate(estimate, truth, Align.NONE)
    assert result.path_m == pytest.approx(50)
    assert result.final_error_percent == pytest.approx(2.0)
    by_length = {error.length_m: error for error in result.relative}
    assert by_length[10.0].translation_percent == pytest.approx(2.0, rel=1e-6)
    assert by_length[None].translation_m.mean == pytest.approx(0.002)
    assert 100.0 not in by_length


def test_coverage_counts_frames_of_the_truth() -> None:
    truth = wander(2, n=100)
    estimate = truth.at(np.arange(0, 100, 4))
    result = evaluate(estimate, truth, Align.SE3)
    assert (result.n_frames, result.n_truth, result.coverage) == (25, 100, 0.25)
    assert result.path_m == pytest.approx(truth.path_m()[96])


def test_a_flight_that_hovers_has_no_scale() -> None:
    truth = wander(3)
    still = Trajectory(truth.t_ns, np.zeros_like(truth.positions), truth.quaternions_xyzw)
    assert evaluate(still, truth, Align.SE3).scale_error is None
    with pytest.raises(GraphFileError, match="does not move"):
        evaluate(still, truth, Align.SIM3)


@given(st.integers(0, 1000), st.integers(1, 60), st.integers(1, 60))
@settings(max_examples=40, deadline=None)
def test_association_is_one_to_one_and_within_tolerance(seed: int, n: int, m: int) -> None:
    generator = np.random.default_rng(seed)
    first = np.unique(generator.integers(0, 10**9, n))
    second = np.unique(generator.integers(0, 10**9, m))
    i, j = associate(first, second, 0.02)
    assert len(np.unique(i)) == len(i) == len(np.unique(j)) == len(j)
    assert (np.abs(first[i] - second[j]) <= 20_000_000).all()
    distance = np.abs(first[:, None] - second[None, :])
    closest = np.unravel_index(np.argmin(distance), distance.shape)
    if distance[closest] <= 20_000_000:  # the closest pair of all can never be left out
        assert closest[0] in i


def test_pairs_along_a_path_have_about_the_length() -> None:
    path = np.cumsum(np.random.default_rng(0).uniform(0, 0.6, 200))
    first, second = pairs_along_path(path, 5.0)
    assert len(first) > 150
    assert (np.abs(path[second] - path[first] - 5.0) <= 0.5 + 1e-12).all()


def test_horizontal_rms_ignores_scale_heading_and_height() -> None:
    truth = wander(4, n=200)
    turn = rotation_z(1.1)
    gps = 2.5 * truth.positions @ turn.T + np.array([100.0, -50.0, 30.0])
    gps[:, 2] += np.random.default_rng(0).normal(0, 40, 200)
    assert horizontal_rms_against_gps(truth, truth.t_ns, gps) < 1e-9
    noisy = gps + np.random.default_rng(1).normal(0, 0.5, gps.shape)
    assert 0.6 < horizontal_rms_against_gps(truth, truth.t_ns, noisy) < 0.8  # 0.5 sqrt(2) = 0.71


def test_horizontal_rms_interpolates_but_not_across_gaps() -> None:
    t_ns = np.arange(0, 30) * 1_000_000_000
    straight = np.stack([np.arange(30.0), 0.5 * np.arange(30.0), np.ones(30)], axis=1)
    frames = Trajectory(
        t_ns[1:-1] + 300_000_000,
        straight[1:-1] + 0.3 * (straight[1] - straight[0]),
        np.tile([0, 0, 0, 1.0], (28, 1)),
    )
    assert horizontal_rms_against_gps(frames, t_ns, straight) < 1e-9
    sparse = slice(None, None, 5)
    with pytest.raises(GraphFileError, match="fewer than three frames"):
        horizontal_rms_against_gps(frames, t_ns[sparse], straight[sparse])


# --- files -----------------------------------------------------------------------------------------


@given(st.lists(st.integers(-(10**18), 4 * 10**18), min_size=1, max_size=20, unique=True), st.integers(0, 99))
@settings(max_examples=30, deadline=None)
def test_tum_files_keep_nanoseconds_and_poses(
    tmp_path_factory: pytest.TempPathFactory, stamps: list[int], seed: int
) -> None:
    generator = np.random.default_rng(seed)
    poses = [Pose.exp(generator.normal(0, 2, 6)) for _ in stamps]
    trajectory = Trajectory.from_poses(sorted(stamps), poses)
    path = tmp_path_factory.mktemp("tum") / "deep" / "trajectory.tum"
    write_tum(path, trajectory)
    back = read_tum(path)
    assert (back.t_ns == trajectory.t_ns).all()
    np.testing.assert_allclose(back.positions, trajectory.positions, atol=1e-9)
    np.testing.assert_allclose(back.quaternions_xyzw, trajectory.quaternions_xyzw, atol=1e-11)
    assert [entry.name for entry in path.parent.iterdir()] == ["trajectory.tum"]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("# t\n1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1\n", "row 3: 7 columns"),
        ("1 0 0 0 0 0 0 1\n2 0 x 0 0 0 0 1\n", "row 2: a word that is not a number"),
        ("1 0 0 nan 0 0 0 1\n", "row 1: a number that is not finite"),
        ("1 0 0 0 0 0 0 0\n", "row 1: the quaternion is zero"),
        ("2 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n", "row 2: time does not increase"),
        ("nan 0 0 0 0 0 0 1\n", "row 1"),
        ("1e30 0 0 0 0 0 0 1\n", "row 1: time 1e30"),
        ("# nothing\n", "holds no pose"),
    ],
)
def test_a_bad_trajectory_file_is_named_with_its_row(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "bad.tum"
    path.write_text(text)
    with pytest.raises(GraphFileError, match=complaint) as caught:
        read_tum(path)
    assert "bad.tum" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_and_binary_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(GraphFileError, match=r"none\.tum"):
        read_tum(tmp_path / "none.tum")
    (tmp_path / "picture.tum").write_bytes(bytes(range(128, 256)))
    with pytest.raises(GraphFileError, match="not a text file"):
        read_tum(tmp_path / "picture.tum")


def test_a_broken_write_leaves_the_old_file_and_no_rubbish(tmp_path: Path) -> None:
    path = tmp_path / "result.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), atomic_path(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    with pytest.raises(OutputError, match=r"result\.txt.*No space"), atomic_path(path) as temporary:
        raise OSError(28, "No space left on device")
    assert os.listdir(tmp_path) == ["result.txt"]  # noqa: PTH208
