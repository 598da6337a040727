"""From correspondences to a pose that may be believed, or the reason why not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from overfly.config import AttitudeSettings, AttitudeUse, Config, RegistrationSettings
from overfly.geometry.levelling import NADIR_BODY_FROM_CAM
from overfly.geometry.poses import euler_from_rotation
from overfly.types import Attitude, Correspondences, NotFound, PoseEstimate, Reason
from overfly.vision.refine import HeightPrior
from overfly.vision.registration import FIXED_SIGMA_RAD, Registrar, create_registrar

from .scenes import CAMERA, Sight, mono_rig, pose_error, sight

ANYWHERE = (0.0, 100.0)


def registrar(use: AttitudeUse = AttitudeUse.PRIOR, **registration: float) -> Registrar:
    config = Config(
        attitude=AttitudeSettings(use=use),
        registration=RegistrationSettings(**registration),  # type: ignore[arg-type]
    )
    return create_registrar(mono_rig(), config, 0.25)


def attitude_of(scene: Sight, sigma_rad: float = 0.005) -> Attitude:
    """What the sensor said; the scene's tilt is that of the body."""
    roll, pitch, _ = euler_from_rotation(scene.tilt @ NADIR_BODY_FROM_CAM.T)
    return Attitude(roll, pitch, sigma_rad)


def refused(outcome: PoseEstimate | NotFound, reason: Reason) -> None:
    assert isinstance(outcome, NotFound)
    assert outcome.reason is reason
    assert outcome.detail


@pytest.mark.parametrize("outliers", [0.0, 0.5])
def test_pose_among_outliers(outliers: float) -> None:
    shares = []
    for seed in range(20):
        scene = sight(seed, 100, outliers, 0.4, 0.005)
        found = registrar().register(scene.correspondences, attitude_of(scene), ANYWHERE)
        assert isinstance(found, PoseEstimate)
        error = np.linalg.norm(pose_error(found.world_from_cam, scene.pose)[:3])
        shares.append(error / scene.pose.translation[2])
        assert not scene.is_outlier[found.inliers].all()
        right = (~scene.is_outlier[found.inliers]).mean()
        assert right > 0.95
        assert 0.2 < found.rms_px < 1.0  # 0.4 px in each of two coordinates
        assert found.score > 0
    assert 1e-4 < np.median(shares) < 0.005
    assert max(shares) < 0.02


def test_reasons() -> None:
    scene = sight(1, 60, noise_px=0.3)
    matches, attitude = scene.correspondences, attitude_of(scene)
    few = _rows(matches, np.arange(8))
    refused(registrar().register(few, attitude, ANYWHERE), Reason.FEW_MATCHES)
    refused(registrar().register(matches, attitude, (90.0, 91.0)), Reason.NO_HYPOTHESIS)
    rng = np.random.default_rng(0)
    chaos = replace(matches, rays=rng.uniform(-0.4, 0.4, (60, 2)))
    outcome = registrar().register(chaos, attitude, ANYWHERE)
    assert isinstance(outcome, NotFound)
    assert outcome.reason in (Reason.FEW_INLIERS, Reason.NO_HYPOTHESIS)


def test_inliers_in_a_corner_are_not_believed() -> None:
    scene = sight(2, 400, noise_px=0.2)
    rays = scene.correspondences.rays
    corner = np.flatnonzero(np.linalg.norm(rays - rays[0], axis=1) < 0.1)
    assert len(corner) >= 6
    matches = _rows(scene.correspondences, corner)
    strict = registrar(min_inliers=4, min_spread=0.08)
    refused(
        strict.refine(scene.pose, matches, strict.tilt_prior(attitude_of(scene)), None, 1.0),
        Reason.POOR_SPREAD,
    )
    lenient = registrar(min_inliers=4, min_spread=0.0)
    found = lenient.refine(scene.pose, matches, lenient.tilt_prior(attitude_of(scene)), None, 1.0)
    assert isinstance(found, PoseEstimate)


def test_one_feature_matched_many_times_counts_once() -> None:
    scene = sight(3, 40, noise_px=0.2)
    once = replace(scene.correspondences, frame_index=np.arange(40) % 6)
    refused(registrar().register(once, attitude_of(scene), ANYWHERE), Reason.FEW_INLIERS)


def test_limits_leave_room_for_the_sensor_in_the_search_only() -> None:
    exact, loose = registrar(), registrar()
    sharp = exact.limits(exact.tilt_prior(Attitude(0.0, 0.0, 1e-4)))
    wide = loose.limits(loose.tilt_prior(Attitude(0.0, 0.0, 0.05)))
    assert sharp[1] == wide[1] == pytest.approx(2.0 / CAMERA.focal_px)
    assert sharp[0] < 1.1 * sharp[1]
    assert wide[0] > 2.0 * wide[1]


def test_pixels_grow_with_the_picture() -> None:
    """2 px of a picture 320 wide are 8 px of one 1280 wide: the same angle."""
    big = replace(registrar(), camera=CAMERA.scaled(1280, 960))
    assert big.pixels(2.0) == pytest.approx(registrar().pixels(2.0))
    assert registrar().pixels(2.0) == pytest.approx(2.0 / 288.0)


def test_use_of_the_attitude_sensor() -> None:
    said = Attitude(0.1, -0.05, 0.004)
    prior = registrar().tilt_prior(said)
    fixed = registrar(AttitudeUse.FIXED).tilt_prior(said)
    unused = registrar(AttitudeUse.NONE).tilt_prior(said)
    assert prior.sigma_rad == 0.004
    assert fixed.sigma_rad == FIXED_SIGMA_RAD
    np.testing.assert_array_equal(prior.level_from_cam, fixed.level_from_cam)
    np.testing.assert_array_equal(unused.level_from_cam, NADIR_BODY_FROM_CAM)
    assert unused.sigma_rad == pytest.approx(math.radians(3.0))
    assert registrar().tilt_prior(None).sigma_rad == pytest.approx(math.radians(3.0))
    mount = replace(registrar(), rig_level_sigma_rad=0.002)
    assert mount.tilt_prior(None).sigma_rad == 0.002
    # a sensor that claims to be perfect is not believed
    assert registrar().tilt_prior(Attitude(0.0, 0.0, 0.0)).sigma_rad > 0


def test_height_takes_part() -> None:
    scene = sight(4, 40, noise_px=0.3)
    z = float(scene.pose.translation[2])
    held = registrar().register(
        scene.correspondences, attitude_of(scene), ANYWHERE, HeightPrior(1.001 * z, 1e-6)
    )
    assert isinstance(held, PoseEstimate)
    assert held.world_from_cam.translation[2] == pytest.approx(1.001 * z, abs=1e-4)


def _rows(matches: Correspondences, rows: np.ndarray) -> Correspondences:
    return Correspondences(
        matches.points[rows],
        matches.rays[rows],
        matches.distance[rows],
        matches.map_index[rows],
        matches.frame_index[rows],
    )
