"""The whole map adjusted when the flight is over: nearer to the truth, at nodes and between them."""

from __future__ import annotations

from array import array
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from overfly.adjustment import ground_heights
from overfly.attitude_hold import CORRELATION_S, tilt_deviations
from overfly.config import Config, load_config
from overfly.evaluation import Align, evaluate
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.map_points import FEWEST_SEEN, MOST_VIEWS, Comparison, Observations, Tie, observe, shared
from overfly.simulation import simulate
from overfly.slam import Slam
from overfly.trajectory import Trajectory
from overfly.types import Features, IntArray
from overfly.vision.features.interface import Metric
from overfly.vision.refine import HeightPrior, TiltPrior
from overfly.visual_map import Node, VisualMap


@dataclass(frozen=True)
class Flown:
    slam: Slam
    truth: Trajectory
    before: Trajectory

    def now(self) -> Trajectory:
        records = self.slam.records
        return Trajectory.from_poses([r.t_ns for r in records], [self.slam.pose_of(r) for r in records])


@pytest.fixture(scope="module")
def survey() -> Flown:
    """The first lines of a photo survey; frames as the graph had them, then adjusted. Nodes are far enough
    apart for frames to lie between them."""
    flight = simulate("survey", seed=2, frames=60, size=(320, 240))
    slam = Slam(flight.rig, load_config(None, ["nodes.displacement=0.3"]))
    for frame in flight:
        slam.process(frame)
    truth = Trajectory.from_poses(flight.stamps_ns, flight.truth)
    flown = Flown(slam, truth, truth)
    flown = Flown(slam, truth, flown.now())
    slam.finish()
    return flown


def test_a_survey_comes_far_nearer_to_the_truth(survey: Flown) -> None:
    assert survey.slam.adjustment is not None
    assert survey.slam.adjustment.joined_pairs > 10
    before = evaluate(survey.before, survey.truth, Align.SIM3).ate_m.rmse
    after = evaluate(survey.now(), survey.truth, Align.SIM3).ate_m.rmse
    assert 0.005 < after < 0.6 * before  # 0.23 to 0.66 of it over eight flights like this


def test_frames_between_nodes_follow(survey: Flown) -> None:
    found = evaluate(survey.now(), survey.truth, Align.SIM3)
    errors = np.linalg.norm(found.errors_m, axis=1)
    node_ns = {node.t_ns for node in survey.slam.map.nodes}
    is_node = np.array([t in node_ns for t in found.truth.t_ns.tolist()])
    assert is_node.sum() > 5
    assert (~is_node).sum() > 5
    assert np.median(errors[~is_node]) < 4.0 * np.median(errors[is_node])


def test_the_metre_stays_that_of_the_whole_flight(survey: Flown) -> None:
    """GPS gave it while flying; the adjustment knows it by the height of the first camera alone."""
    assert survey.slam.start is not None
    assert survey.slam.start.source == "gps"
    scale = evaluate(survey.now(), survey.before, Align.SE3).scale_error
    assert scale is not None
    assert abs(scale) < 0.005


def test_what_takes_no_part_grows_with_the_map() -> None:
    """A range sensor says a fifth more: points of one node, constraints and frames are a fifth longer."""
    flight = simulate("blimp", seed=3, frames=60)
    slam = Slam(flight.rig, Config())
    for frame in flight:
        slam.process(frame)
    slam.adjust()
    for node in slam.map.nodes:
        assert node.height is not None
        node.height = HeightPrior(1.2 * node.height.z_m, node.height.sigma_m)
    slam._ranges._height_m = array("d", [1.2 * height_m for height_m in slam._ranges._height_m])

    def lengths() -> tuple[FloatArray, FloatArray, FloatArray]:
        depths = np.concatenate([node.points_in_cam[:, 2] for node in slam.map.nodes])
        steps = np.array([record.node_from_cam.translation for record in slam.records])
        return (
            depths,
            np.linalg.norm(slam.map.graph.measured_positions, axis=1),
            np.linalg.norm(steps, axis=1),
        )

    before = lengths()
    report = slam.adjust()
    assert report is not None
    assert report.growth == pytest.approx(1.2, rel=0.01)
    for old, new in zip(before, lengths(), strict=True):
        far = old > 0.1
        assert far.sum() >= 3
        np.testing.assert_allclose(new[far] / old[far], 1.2, rtol=0.08)
    again = slam.adjust()
    assert again is not None
    assert again.growth == pytest.approx(1.0, abs=1e-5)


def test_the_ground_under_a_camera_is_what_it_sees() -> None:
    """A hill under the second of three cameras, in points that the others do not see."""
    node, point = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 3, 4, 1])
    places = np.zeros((5, 3))
    places[:, 2] = [0.0, 0.1, -0.1, 4.0, 6.0]
    seen = Observations(
        node, np.arange(6), point, np.zeros(6, np.int64), np.zeros((6, 2)), np.ones(6), np.full(6, np.nan)
    )
    np.testing.assert_allclose(ground_heights(seen, np.arange(3), places), [0.0, 5.0, 0.1])


def test_a_finished_map_is_not_adjusted_again(survey: Flown) -> None:
    before, report = survey.now(), survey.slam.adjustment
    survey.slam.finish()
    assert survey.slam.adjustment is report
    np.testing.assert_array_equal(survey.now().positions, before.positions)


def test_switched_off_the_graph_has_the_last_word() -> None:
    flight = simulate("blimp", seed=3, frames=40)
    slam = Slam(flight.rig, Config.model_validate({"adjustment": {"enabled": False}}))
    for frame in flight:
        slam.process(frame)
    slam.finish()
    assert slam.adjustment is None


@st.composite
def sightings(draw: st.DrawFn) -> Observations:
    generator = np.random.default_rng(draw(st.integers(0, 10_000)))
    n, n_nodes = draw(st.integers(1, 900)), draw(st.integers(1, 60))
    point = generator.integers(0, draw(st.integers(1, 150)), n)
    return Observations(
        generator.integers(0, n_nodes, n), np.arange(n), point, np.zeros(n, np.int64),
        np.zeros((n, 2)), np.ones(n), np.full(n, np.nan),
    )  # fmt: skip


@given(sightings())
def test_who_takes_part(found: Observations) -> None:
    kept = shared(found)
    keys = kept.point * 10**6 + kept.node
    assert (np.diff(keys) > 0).all()  # sorted, each point once from each node
    if len(kept):
        views: IntArray = np.unique(kept.point, return_counts=True)[1]
        assert views.min() >= 2
        assert views.max() <= MOST_VIEWS
        assert np.unique(kept.node, return_counts=True)[1].min() >= FEWEST_SEEN


def two_views(exactness: FloatArray) -> VisualMap:
    """Of the same forty points, described alike; the second's rays have deviations of their own (40,)."""
    generator = np.random.default_rng(4)
    rays = generator.uniform(-0.5, 0.5, (40, 2))
    px = (100.0 * rays + [80.0, 60.0]).astype(np.float32)
    looks = generator.integers(0, 256, (40, 32)).astype(np.uint8)
    ones = np.ones(40, np.float32)
    visual_map = VisualMap()
    tracks = visual_map.new_tracks(40)
    for index, sigma in enumerate((np.full(40, 0.006), exactness)):
        node = Node(
            index, index, index, Features(px, looks, ones, ones, ones), rays,
            np.column_stack([rays, np.ones(40)]), np.ones(40), np.full(40, np.nan), sigma, tracks,
            np.zeros(40, np.int64), np.arange(40),
            TiltPrior(np.diag([1.0, -1.0, -1.0]), 0.1), None, index - 1,
        )  # fmt: skip
        visual_map.add_node(node, Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 1.0])))
    return visual_map


def test_points_that_were_put_where_the_whole_picture_agrees_were_not_seen() -> None:
    """Neither as views of their points, nor as descriptions that match because they were carried along."""
    camera = Camera(160, 120, 100.0, 100.0, 80.0, 60.0)
    comparison = Comparison(camera, Metric.HAMMING, 60.0)
    put = np.arange(40) >= 20
    found, _ = observe(two_views(np.where(put, 0.06, 0.0025)), comparison)
    assert set(found.row.tolist()) == set(range(20))
    followed = found.tie == Tie.FOLLOWED
    assert followed.sum() == 40
    np.testing.assert_allclose(found.sigma[followed], 0.0025)
    np.testing.assert_allclose(found.sigma[~followed], 0.006)
    seen_by_all, _ = observe(two_views(np.full(40, 0.006)), comparison)
    assert set(seen_by_all.row.tolist()) == set(range(40))
    assert set(seen_by_all.tie.tolist()) == {int(Tie.DESCRIBED), int(Tie.JOINED)}


def tilting_map(errors: np.ndarray, sigma: float) -> VisualMap:
    """Level cameras a second apart whose sensor errs so, (n, 2) radians."""
    visual_map = VisualMap()
    for index, (x, y) in enumerate(errors):
        visual_map.graph.add_node(Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3)))
        level = Pose.exp(np.array([0, 0, 0, x, y, 0.0])).rotation @ np.diag([1.0, -1.0, -1.0])
        node = type("Node", (), {})()
        node.index, node.parent, node.t_ns = index, index - 1, index * 10**9
        node.tilt = TiltPrior(level, sigma)
        visual_map.nodes.append(node)
    return visual_map


def test_white_noise_of_the_attitude_counts_each_time_and_slow_errors_once() -> None:
    generator = np.random.default_rng(1)
    white = tilt_deviations(tilting_map(generator.normal(0, 0.01, (200, 2)), 0.01))
    assert 0.009 < np.median(white) < 0.013
    worse = tilt_deviations(tilting_map(generator.normal(0, 0.03, (200, 2)), 0.01))
    assert 0.024 < np.median(worse) < 0.036
    walk = np.cumsum(generator.normal(0, 0.0007, (200, 2)), axis=0)
    slow = tilt_deviations(tilting_map(walk, 0.01))
    assert np.median(slow) == pytest.approx(0.01 * np.sqrt(CORRELATION_S))
