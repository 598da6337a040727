"""The camera refined with the map: what its unknowns mean, what follows from them, and a whole run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from overfly.adjustment_report import AdjustmentReport
from overfly.config import AdjustmentSettings, Config
from overfly.errors import UsageError
from overfly.evaluation import Align, evaluate
from overfly.frame_records import FrameRecord, Seen, seen_by_another
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import Pose
from overfly.pipeline.mapping import MapRequest, run
from overfly.pipeline.results import camera_yaml
from overfly.self_calibration import (
    EXPECTED_SIGMA,
    as_refined,
    refined_camera,
    refined_rig,
    refines_camera,
    with_changes,
)
from overfly.sensors.calibration_files import read_camera_file
from overfly.simulation import simulate, write_flight
from overfly.slam import Slam
from overfly.trajectory import Trajectory

CAMERA = Camera(640, 480, 533.0, 531.0, 322.0, 236.0, coefficients=(-0.04, 0.012, 0.0004, -0.0003))


def test_changes_mean_the_same_at_every_picture_size() -> None:
    changes = np.array([0.03, -0.01, 0.02, 0.05, -0.02])
    large, small = with_changes(CAMERA, changes), with_changes(CAMERA.scaled(320, 240), changes)
    points = np.random.default_rng(1).uniform(-0.4, 0.4, (50, 2))
    np.testing.assert_allclose(
        large.scaled(320, 240).pixels_from_rays(points), small.pixels_from_rays(points), atol=1e-9
    )
    assert with_changes(CAMERA, np.zeros(5)) == CAMERA


def test_rays_of_frames_follow_the_camera() -> None:
    other = with_changes(CAMERA, np.array([0.05, 0.01, 0.0, 0.02, 0.0]))
    px = np.random.default_rng(2).uniform(30, 450, (40, 2))
    seen = Seen(
        np.zeros(40, np.int32), np.arange(40, dtype=np.int32), CAMERA.rays_from_pixels(px).astype(np.float32)
    )
    record = FrameRecord(0, 0, 0, Pose.identity(), Pose.identity(), 0, seen)
    (turned,) = seen_by_another([record], CAMERA, other)
    assert turned.seen is not None
    np.testing.assert_allclose(other.pixels_from_rays(turned.seen.rays.astype(np.float64)), px, atol=1e-2)


def test_the_refined_camera_can_be_given_to_the_next_run(tmp_path: Path) -> None:
    refined = refined_camera(with_changes(CAMERA, np.array([0.01, 0, 0, 0, 0])), np.diag([1e-6] * 5))
    assert refined.focal_sigma_px == pytest.approx(1e-3 * refined.camera.focal_px)
    (tmp_path / "camera.yaml").write_text(camera_yaml(refined))
    (read,) = read_camera_file(tmp_path / "camera.yaml")
    assert read.camera == refined.camera


@pytest.mark.parametrize(
    ("source", "wished", "refines"),
    [
        ("exif", None, True),
        ("given", None, False),
        ("default", None, False),
        ("exif", False, False),
        ("given", True, True),
    ],
)
def test_a_camera_that_only_exif_tells_is_refined_unless_told_otherwise(
    source: str, wished: bool | None, refines: bool
) -> None:
    rig = replace(simulate("survey", frames=1).rig, calibration_source=source)
    assert refines_camera(rig, AdjustmentSettings(refine_camera=wished)) is refines


def test_two_cameras_are_never_refined_by_themselves() -> None:
    rig = replace(simulate("corridor", frames=1).rig, calibration_source="exif")
    assert not refines_camera(rig, AdjustmentSettings())


def test_a_camera_that_only_exif_tells_is_that_of_the_refined_map() -> None:
    flown = replace(simulate("survey", frames=1).rig, calibration_source="exif")
    known = refined_rig(flown, np.array([0.2, 0.0, 0.0, 0.0, 0.0]))
    assert as_refined(flown, known).cam0.camera == known.cam0.camera
    calibrated = replace(flown, calibration_source="given")
    assert as_refined(calibrated, known) is calibrated
    half = replace(known, cameras=(replace(known.cam0, camera=known.cam0.camera.scaled(320, 240)),))
    assert as_refined(flown, half) is flown


def test_two_cameras_are_refused_in_one_line(tmp_path: Path) -> None:
    write_flight(simulate("corridor", frames=3), tmp_path / "flight")
    config = Config.model_validate({"adjustment": {"refine_camera": True}})
    with pytest.raises(UsageError, match="--mono"):
        run(MapRequest(tmp_path / "flight", tmp_path / "map", config), lambda _count, _result: None)


def test_a_wrong_camera_comes_nearer_to_the_true_one() -> None:
    """A book of known size holds the metre, tilting and climbing tells the focal length."""
    flight = simulate("helicopter", seed=3, frames=220)
    true = flight.rig.cam0.camera
    wrong = with_changes(true, np.array([0.0, 0.012, -0.012, 0.06, 0.0]))
    rig = replace(flight.rig, cameras=(replace(flight.rig.cam0, camera=wrong),))
    slam = Slam(rig, Config.model_validate({"adjustment": {"refine_camera": True}}), flight.scale_landmark)
    for frame in flight:
        slam.process(frame)
    slam.finish()
    assert isinstance(slam.adjustment, AdjustmentReport)
    assert slam.refined_camera is not None
    found = slam.refined_camera.camera
    off = abs(found.coefficients[0] - true.coefficients[0])
    assert off < min(0.03, 3.0 * slam.refined_camera.radial_sigma[0])
    assert 0 < slam.refined_camera.radial_sigma[0] < EXPECTED_SIGMA[3]
    assert slam.rig.cam0.camera == found


def test_with_a_range_sensor_a_wrong_camera_leaves_the_metre_right() -> None:
    """Focal length 3 % too long, mounted a degree and a half askew; heights are measured over the ground."""
    flight = simulate("wrong-calibration", seed=2)
    slam = Slam(flight.rig, Config.model_validate({"adjustment": {"refine_camera": True}}))
    for frame in flight:
        slam.process(frame)
    slam.finish()
    records = slam.placed()
    found = Trajectory.from_poses([r.t_ns for r in records], [slam.pose_of(r) for r in records])
    scale = evaluate(found, Trajectory.from_poses(flight.stamps_ns, flight.truth), Align.SE3).scale_error
    assert scale is not None
    assert abs(scale) < 0.03  # nearer than the camera, which was 3 % too long
    real, refined = flight.scenario.cameras[0].true_camera, slam.refined_camera
    assert real is not None
    assert refined is not None
    off_px = abs(refined.camera.focal_px - real.focal_px)
    assert 1e-3 < off_px < min(3.0 * refined.focal_sigma_px, 0.03 * real.focal_px)
