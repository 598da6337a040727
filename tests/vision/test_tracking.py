"""Points followed over a textured plane: the pose to a small part of a pixel, or a reason."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from overfly.config import Config
from overfly.geometry.poses import FloatArray, Pose
from overfly.types import Frame, NotFound, UInt8Array
from overfly.vision.alignment import build_pyramid
from overfly.vision.features import create_extractor
from overfly.vision.observation import Observation
from overfly.vision.odometry import Located
from overfly.vision.refine import TiltPrior
from overfly.vision.registration import create_registrar
from overfly.vision.spread import spread_choice
from overfly.vision.tracking import Anchor, TrackedPoints, Tracker

from .scenes import (
    CAMERA,
    camera_pose,
    ground_texture,
    level,
    mono_rig,
    picture_of_ground,
    pose_error,
)

TEXTURE_SEED = 21
NODE = camera_pose(0.0, 0.0, 2.0, 0.02, -0.03, 0.1)
REGISTRAR = create_registrar(mono_rig(), Config(), 64.0)


# -- the choice of points


@given(st.integers(0, 400), st.integers(1, 120), st.integers(0, 10**6))
def test_choice_is_a_subset_of_at_most_that_many(n: int, count: int, seed: int) -> None:
    px = np.random.default_rng(seed).uniform([0, 0], [319, 239], (n, 2)).astype(np.float32)
    chosen = spread_choice(px, (320, 240), count)
    assert len(chosen) == min(n, count)
    assert len(np.unique(chosen)) == len(chosen)
    assert (np.diff(chosen) > 0).all()


def test_choice_prefers_empty_cells_and_earlier_points() -> None:
    """A crowd in one corner and a few elsewhere: all of the few are kept, and of the crowd the first."""
    rng = np.random.default_rng(0)
    crowd = rng.uniform(0, 20, (500, 2))
    few = np.array([[300.0, 20.0], [300.0, 220.0], [20.0, 220.0], [160.0, 120.0]])
    px = np.concatenate([crowd, few]).astype(np.float32)
    chosen = spread_choice(px, (320, 240), 24)
    assert {500, 501, 502, 503} <= set(chosen.tolist())
    alone = spread_choice(crowd.astype(np.float32), (320, 240), 5)
    cell = math.sqrt(320 * 240 / 5)
    assert crowd.max() < cell  # one cell holds them all
    np.testing.assert_array_equal(alone, np.arange(5))


def test_choice_spreads_evenly() -> None:
    px = np.random.default_rng(1).uniform([0, 0], [319, 239], (2000, 2)).astype(np.float32)
    chosen = px[spread_choice(px, (320, 240), 192)]
    counts, _, _ = np.histogram2d(chosen[:, 0], chosen[:, 1], bins=[4, 3], range=[[0, 320], [0, 240]])
    assert counts.min() >= 0.5 * counts.mean()


# -- following


def picture(pose: Pose) -> UInt8Array:
    return picture_of_ground(ground_texture(TEXTURE_SEED), pose)


def view_from(pose: Pose, index: int = 1, image: UInt8Array | None = None) -> Observation:
    shown = picture(pose) if image is None else image
    frame = Frame(index, index * 100_000_000, str(index), (shown,))
    return Observation(frame, mono_rig(), create_extractor("orb", 200), TiltPrior(level(), math.radians(3)))


def points_of_node(features_px: FloatArray) -> TrackedPoints:
    """Where the node's features meet the ground z = 0."""
    rays = CAMERA.rays_from_pixels(features_px)
    directions = np.column_stack([rays, np.ones(len(rays))]) @ NODE.rotation.T
    world = NODE.translation - directions * (NODE.translation[2] / directions[:, 2])[:, None]
    zeros = np.zeros(len(world), np.int64)
    return TrackedPoints(world, np.zeros_like(world), zeros, features_px, zeros, np.arange(len(world)))


def begun() -> tuple[Tracker, TrackedPoints, dict[int, Anchor]]:
    """A tracker that has just seen the node itself."""
    view = view_from(NODE, 0)
    points = points_of_node(view.features.px.astype(np.float64))
    anchors = {0: Anchor(build_pyramid(view.gray), NODE)}
    tracker = Tracker(CAMERA, REGISTRAR, Config().tracking)
    first = tracker.settle(view, points, anchors, NODE, None)
    assert isinstance(first, Located)
    tracker.remember(view, first)
    return tracker, points, anchors


@pytest.mark.parametrize(
    "now",
    [
        camera_pose(0.05, 0.02, 2.0, 0.02, -0.02, 0.12),
        camera_pose(-0.02, 0.01, 2.04, 0.025, -0.025, 0.09),
        camera_pose(0.0, 0.0, 1.9, -0.02, -0.06, 0.2),
    ],
    ids=["a step", "up and tilted", "down and turned"],
)
def test_pose_over_a_plane_is_recovered(now: Pose) -> None:
    tracker, points, anchors = begun()
    outcome = tracker.track(view_from(now), points, anchors, NODE, None, None)
    assert isinstance(outcome, Located)
    error = pose_error(outcome.pose, now)
    # a twentieth of a pixel in 100 points, over 2 m at 288 px: below a millimetre; and never exact
    assert 1e-6 < np.linalg.norm(error[:3]) < 2e-3
    assert 1e-7 < np.linalg.norm(error[3:]) < 1e-3
    assert outcome.estimate.rms_px < 0.2
    assert outcome.px is not None
    seen = CAMERA.project(now.inverse().transform(outcome.matches.correspondences.points))
    assert np.median(np.linalg.norm(outcome.px - seen, axis=1)) < 0.1
    assert outcome.main_node == 0


def test_a_far_step_is_followed_where_it_was_foreseen() -> None:
    """A third of the picture in one step: found from a prediction that is some pixels off, not from none."""
    now = camera_pose(0.45, -0.3, 2.1, 0.0, 0.0, 0.3)
    predicted = now @ Pose.exp(np.array([0.02, -0.015, 0.02, 0.002, -0.003, 0.01]))
    tracker, points, anchors = begun()
    assert isinstance(tracker.track(view_from(now), points, anchors, NODE, None, None), NotFound)
    outcome = tracker.track(view_from(now), points, anchors, NODE, predicted, None)
    assert isinstance(outcome, Located)
    assert np.linalg.norm(pose_error(outcome.pose, now)[:3]) < 3e-3


@pytest.mark.parametrize(("east", "north"), [(0.12, 0.0), (-0.08, 0.1), (0.0, -0.16)])
def test_a_shift_that_nobody_foresaw_is_followed(east: float, north: float) -> None:
    """17 to 23 pixels, far beyond what points may disagree: a gust, or a frame that is missing."""
    now = camera_pose(east, north, 2.0, 0.02, -0.03, 0.1)
    tracker, points, anchors = begun()
    outcome = tracker.track(view_from(now), points, anchors, NODE, None, None)
    assert isinstance(outcome, Located)
    assert np.linalg.norm(pose_error(outcome.pose, now)[:3]) < 3e-3


def test_following_from_picture_to_picture_does_not_drift() -> None:
    """Eight steps out the error is as small as after one: patches are compared with the node's."""
    tracker, points, anchors = begun()
    last, errors = NODE, []
    for n in range(1, 9):
        now = camera_pose(0.04 * n, 0.02 * n, 2.0, 0.02, -0.03, 0.1 + 0.02 * n)
        view = view_from(now, n)
        outcome = tracker.track(view, points, anchors, last, None, None)
        assert isinstance(outcome, Located)
        tracker.remember(view, outcome)
        last = outcome.pose
        errors.append(float(np.linalg.norm(pose_error(last, now)[:3])))
    assert max(errors) < 3e-3
    assert errors[-1] < 2e-3


def test_settling_makes_a_rough_pose_exact() -> None:
    tracker, points, anchors = begun()
    now = camera_pose(0.1, 0.05, 2.05, 0.0, 0.02, 0.15)
    rough = now @ Pose.exp(np.array([0.006, -0.004, 0.01, 0.001, 0.001, 0.003]))
    outcome = tracker.settle(view_from(now), points, anchors, rough, None)
    assert isinstance(outcome, Located)
    assert np.linalg.norm(pose_error(outcome.pose, now)[:3]) < 0.2 * 0.006


def test_other_ground_is_not_followed() -> None:
    tracker, points, anchors = begun()
    elsewhere = picture_of_ground(ground_texture(TEXTURE_SEED + 1), NODE)
    outcome = tracker.track(view_from(NODE, 1, elsewhere), points, anchors, NODE, None, None)
    assert isinstance(outcome, NotFound)


@pytest.mark.parametrize("level_", [0, 255])
def test_blank_pictures_are_not_followed(level_: int) -> None:
    tracker, points, anchors = begun()
    blank = np.full((240, 320), level_, np.uint8)
    outcome = tracker.track(view_from(NODE, 1, blank), points, anchors, NODE, None, None)
    assert isinstance(outcome, NotFound)
    assert isinstance(tracker.settle(view_from(NODE, 1, blank), points, anchors, NODE, None), NotFound)


def test_nothing_is_followed_from_nothing() -> None:
    tracker, points, anchors = begun()
    tracker.forget()
    outcome = tracker.track(view_from(NODE), points, anchors, NODE, None, None)
    assert isinstance(outcome, NotFound)


def test_when_the_map_moves_the_followed_points_move_with_it() -> None:
    tracker, points, anchors = begun()
    moved = Pose.exp(np.array([3.0, -2.0, 0.0, 0.0, 0.0, 0.5]))
    now = camera_pose(0.05, 0.02, 2.0, 0.02, -0.02, 0.12)
    tracker.move(moved)
    shifted = TrackedPoints(
        moved.transform(points.world),
        points.spread,
        points.anchor,
        points.anchor_px,
        points.main_node,
        points.row,
    )
    turned = {0: Anchor(anchors[0].pyramid, moved @ NODE)}
    outcome = tracker.track(view_from(now), shifted, turned, moved @ NODE, None, None)
    assert isinstance(outcome, Located)
    assert np.linalg.norm(pose_error(outcome.pose, moved @ now)[:3]) < 2e-3


def test_a_lost_picture_is_compared_as_a_whole_with_the_last_one() -> None:
    tracker, points, anchors = begun()
    now = NODE @ Pose.exp(np.array([0.05, -0.03, 0.0, 0.0, 0.0, 0.02]))
    fresh = Tracker(CAMERA, REGISTRAR, Config().tracking)
    assert fresh.by_whole_picture(view_from(now), points, anchors, NODE, NODE, None) is None
    tracker.forget()
    assert isinstance(tracker.track(view_from(now), points, anchors, NODE, None, None, NODE), NotFound)
    found = tracker.by_whole_picture(view_from(now), points, anchors, NODE, NODE, None)
    assert found is not None
    assert 1e-7 < np.linalg.norm(pose_error(found.pose, now)[:3]) < 0.01
    assert tracker.by_whole_picture(view_from(now), points, anchors, NODE, None, None) is None
    far = NODE @ Pose.exp(np.array([0.6, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert tracker.by_whole_picture(view_from(far), points, anchors, NODE, far, None) is None


def test_where_the_node_shows_other_ground_the_last_picture_decides() -> None:
    """The node's picture has nothing in common with the present one; the last one has."""
    tracker, points, anchors = begun()
    elsewhere = {0: Anchor(build_pyramid(picture_of_ground(ground_texture(77), NODE)), NODE)}
    now = NODE @ Pose.exp(np.array([0.03, 0.02, 0.0, 0.0, 0.0, 0.01]))
    found = tracker.by_whole_picture(view_from(now), points, elsewhere, NODE, NODE, None)
    assert found is not None
    assert 1e-7 < np.linalg.norm(pose_error(found.pose, now)[:3]) < 0.02
    moved = Pose(np.eye(3), np.array([1.0, 2.0, 0.0]))  # the map moves, and the last picture with it
    tracker.move(moved)
    there = points_of_node(points.anchor_px)
    there = TrackedPoints(
        moved.transform(there.world), there.spread, there.anchor, there.anchor_px, there.main_node, there.row
    )
    anchors = {0: Anchor(elsewhere[0].pyramid, moved @ NODE)}
    again = tracker.by_whole_picture(view_from(now), there, anchors, moved @ NODE, moved @ NODE, None)
    assert again is not None
    assert 1e-7 < np.linalg.norm(pose_error(again.pose, moved @ now)[:3]) < 0.02
