"""Short gaps are bridged: speed before and after tells the way, and the map stays one piece."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from overfly.bridging import MOST_OPEN, Bridge, Course, course_between, course_of, unseen_share
from overfly.config import Config
from overfly.evaluation import Align, evaluate
from overfly.geometry.levelling import NADIR_BODY_FROM_CAM
from overfly.geometry.poses import Pose, rotation_z
from overfly.graph.pose_graph import KINDS
from overfly.simulation import simulate
from overfly.slam import Slam
from overfly.trajectory import Trajectory
from overfly.types import ConstraintKind, Frame, UInt8Array
from overfly.vision.features import create_extractor
from overfly.vision.ground import points_on_ground
from overfly.vision.observation import Observation
from overfly.vision.odometry import Reference
from overfly.vision.refine import TiltPrior
from overfly.vision.registration import create_registrar

from .vision.scenes import camera_pose, ground_texture, level, mono_rig, picture_of_ground

EXTRACTOR = create_extractor("hessian-teblid", 400)
REGISTRAR = create_registrar(mono_rig(), Config(), EXTRACTOR.max_distance)
NS = 1_000_000_000
BLACK = range(24, 31)  # frames of the demo without a picture


def flown(t_s: float) -> Pose:
    """A camera that gets faster and turns ever faster, 2 m above the ground."""
    return camera_pose(0.5 * t_s + 0.3 * t_s**2, -0.2 * t_s, 2.0, yaw=0.2 * t_s + 0.1 * t_s**2)


def seen(t_s: float, image: UInt8Array | None = None) -> Observation:
    shown = picture_of_ground(ground_texture(5, 3000), flown(t_s)) if image is None else image
    frame = Frame(0, round(t_s * NS), "", (shown,))
    return Observation(frame, mono_rig(), EXTRACTOR, TiltPrior(level(), math.radians(2)))


def reference_of(view: Observation, pose: Pose) -> Reference:
    depth = points_on_ground(view.rays, pose, 0.0, 0.0, 0.0)
    points = pose.transform(depth.points_in_cam)
    return Reference(7, view.features, points, np.zeros_like(points))


def bridge() -> Bridge:
    return Bridge(EXTRACTOR, REGISTRAR, reference_of)


def before() -> Course:
    """As two located frames tell it."""
    return course_between(-NS // 5, flown(-0.2), 0, flown(0.0))


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(-1.0, 1.0), st.floats(-math.pi, math.pi))
def test_a_course_is_what_was_flown(east: float, north: float, turn: float, yaw: float) -> None:
    first = camera_pose(1.0, 2.0, 3.0, yaw=yaw)
    now = camera_pose(1.0 + 0.5 * east, 2.0 + 0.5 * north, 3.0, yaw=yaw + 0.5 * turn)
    course = course_between(NS, first, NS + NS // 2, now)
    np.testing.assert_allclose(course.velocity_m_s, [east, north, 0.0], atol=1e-9)
    assert course.turn_rad_s == pytest.approx(turn, abs=1e-9)
    assert course.motion_ns == NS + NS // 4 and course.t_ns == NS + NS // 2


def test_the_speed_is_that_of_the_last_moment() -> None:
    stamps = np.arange(11) * (NS // 10)
    course = course_of(stamps, lambda number: flown(0.1 * number))
    assert course is not None and course.t_ns == NS
    np.testing.assert_allclose(course.velocity_m_s[0], 0.5 + 0.6 * 0.85, atol=1e-6)
    assert course_of(stamps[:1], flown) is None
    assert course_of(np.array([0, 3 * NS]), flown) is None


@pytest.mark.parametrize("gap_s", [0.3, 0.6, 1.0])
def test_two_pictures_after_the_gap_tell_where_the_camera_got_to(gap_s: float) -> None:
    watch = bridge()
    assert watch.span(seen(gap_s - 0.1), before(), None) is None
    found = watch.span(seen(gap_s), before(), None)
    assert found is not None
    truth = flown(gap_s)
    error = (found.pose.inverse() @ truth).log()
    # A steady acceleration is allowed for; the speed of one picture is good to a hundredth of the height.
    assert 1e-6 < np.linalg.norm(found.pose.translation - truth.translation) < 0.03 * gap_s + 0.02
    kept_on = flown(0.0).translation + before().velocity_m_s * gap_s
    assert np.linalg.norm(found.pose.translation - truth.translation) < np.linalg.norm(
        kept_on - truth.translation
    )
    assert error @ np.linalg.solve(found.covariance, error) < 20.0
    sigma = math.sqrt(float(np.linalg.eigvalsh(found.covariance[:3, :3])[-1]))
    assert unseen_share(gap_s) * 1.9 < sigma < 0.3


def test_what_was_not_seen_is_less_certain_the_longer_it_lasted() -> None:
    shares = [unseen_share(gap_s) for gap_s in (0.1, 0.3, 1.0, 2.0, 4.0)]
    assert shares == sorted(shares) and shares[0] < 0.01 < shares[2] < MOST_OPEN < shares[4]


def test_noise_other_ground_and_long_gaps_are_not_bridged() -> None:
    def noise(seed: int) -> UInt8Array:
        return np.random.default_rng(seed).integers(0, 255, (240, 320)).astype(np.uint8)

    watch = bridge()
    assert watch.span(seen(0.2, noise(1)), before(), None) is None
    assert watch.span(seen(0.3, noise(2)), before(), None) is None
    assert watch.span(seen(0.4), before(), None) is None  # nothing to do with the noise before it
    assert watch.span(seen(0.5, picture_of_ground(ground_texture(6), flown(0.5))), before(), None) is None
    watch.found()
    assert watch.span(seen(0.6), before(), None) is None  # the first of a new gap
    late = bridge()
    assert late.span(seen(2.9), before(), None) is None
    assert late.span(seen(3.0), before(), None) is None


def test_a_picture_that_stands_still_is_no_ground_under_a_fast_camera() -> None:
    """Hot pixels, or dirt on a covered lens."""
    fast = replace(before(), velocity_m_s=np.array([6.0, 0.0, 0.0]))
    still = picture_of_ground(ground_texture(5, 3000), flown(0.0))
    watch = bridge()
    assert watch.span(seen(0.1, still), fast, None) is None
    assert watch.span(seen(0.2, still), fast, None) is None


def test_the_heading_of_the_gap_is_the_mean_turn() -> None:
    watch = bridge()
    watch.span(seen(0.5), before(), None)
    found = watch.span(seen(0.6), before(), None)
    assert found is not None
    between = found.pose.rotation @ NADIR_BODY_FROM_CAM.T
    turn = math.atan2(between[1, 0], between[0, 0])
    assert turn == pytest.approx(0.2 * 0.6 + 0.1 * 0.36, abs=0.01)
    np.testing.assert_allclose(rotation_z(-turn) @ between, np.eye(3), atol=0.02)


@pytest.fixture(scope="module")
def blacked_out() -> tuple[Slam, Trajectory]:
    """The demo with 0.7 s of darkness."""
    flight = simulate("demo", 0, 60)
    slam = Slam(flight.rig)
    for number, frame in enumerate(flight):
        images = tuple(np.zeros_like(image) for image in frame.images) if number in BLACK else frame.images
        slam.process(replace(frame, images=images))
    return slam, Trajectory.from_poses(flight.stamps_ns, flight.truth)


def test_a_short_blackout_leaves_one_piece(blacked_out: tuple[Slam, Trajectory]) -> None:
    slam, truth = blacked_out
    graph = slam.map.graph
    assert KINDS.index(ConstraintKind.DEAD_RECKONING) not in graph.kinds
    assert set(slam.map.pieces().tolist()) == {0}
    dark = set(truth.t_ns[list(BLACK)].tolist())
    assert not dark & {record.t_ns for record in slam.records}
    assert len(slam.placed()) == len(slam.records) >= 60 - len(BLACK) - 2
    poses = [slam.pose_of(record) for record in slam.records]
    found = evaluate(Trajectory.from_poses([r.t_ns for r in slam.records], poses), truth, Align.SE3)
    assert 1e-4 < found.ate_m.rmse < 0.12
    slam.finish()
    assert len(slam.placed()) == len(slam.records)
