"""Visual odometry: pooled matches, one pose for all of them, a constraint for each node."""

from __future__ import annotations

import math

import numpy as np
import pytest

from overfly.config import Config
from overfly.geometry.poses import FloatArray, Pose, rotation_from_vector
from overfly.types import Features, Frame, NotFound, PoseEstimate, Reason
from overfly.vision.features.interface import Metric
from overfly.vision.observation import Observation
from overfly.vision.odometry import (
    Located,
    PooledMatches,
    Reference,
    constraints_to_nodes,
    information_of_constraint,
    locate_against,
    match_references,
    subset,
)
from overfly.vision.refine import TiltPrior
from overfly.vision.registration import create_registrar

from .scenes import CAMERA, camera_pose, ground_in_view, level, mono_rig, pose_error, rays_of


class Painted:
    """An extractor that is told what there is to see: features at px with their own descriptors."""

    name, metric, max_distance = "painted", Metric.HAMMING, 40.0

    def __init__(self, features: Features) -> None:
        self._features = features

    def extract(self, gray: np.ndarray) -> Features:
        assert gray.ndim == 2
        return self._features


def features_at(px: FloatArray, descriptors: np.ndarray) -> Features:
    ones = np.ones(len(px), np.float32)
    return Features(px.astype(np.float32), descriptors, ones, ones, ones)


class World:
    """Points with descriptors of their own, and cameras over them."""

    def __init__(self, seed: int, count: int = 150) -> None:
        rng = np.random.default_rng(seed)
        self.points = ground_in_view(rng, camera_pose(0.2, 0.0, 2.6), count, 0.1)
        self.descriptors = rng.integers(0, 256, (count, 32), np.uint8)
        self.rng = rng

    def features(self, pose: Pose, noise_px: float = 0.0) -> tuple[Features, np.ndarray]:
        """What the camera sees, with one bit in thirty wrong, and which points they are."""
        px = CAMERA.project(pose.inverse().transform(self.points))
        px = px + self.rng.normal(0.0, 1.0, px.shape) * noise_px
        inside = np.flatnonzero(((px > 0) & (px < [319, 239])).all(axis=1))
        bits = np.unpackbits(self.descriptors[inside], axis=1)
        bits ^= (self.rng.random(bits.shape) < 1 / 30).astype(np.uint8)
        return features_at(px[inside], np.packbits(bits, axis=1)), inside

    def reference(self, node: int, pose: Pose, unknown: int = 0) -> Reference:
        features, which = self.features(pose)
        points = self.points[which].copy()
        points[:unknown] = np.nan
        return Reference(node, features, points, np.zeros_like(points))

    def view(self, pose: Pose, noise_px: float = 0.0) -> tuple[Observation, Painted]:
        features, _ = self.features(pose, noise_px)
        painted = Painted(features)
        frame = Frame(0, 0, "", (np.zeros((240, 320), np.uint8),))
        return Observation(frame, mono_rig(), painted, TiltPrior(level(), math.radians(3))), painted


REGISTRAR = create_registrar(mono_rig(), Config(), Painted.max_distance)
NOW = camera_pose(0.3, 0.1, 2.1, yaw=0.4)
NODES = {
    3: camera_pose(0.0, 0.0, 2.0),
    4: camera_pose(0.3, 0.0, 2.05, yaw=0.2),
    5: camera_pose(0.5, 0.1, 2.0),
}


def located(world: World, noise_px: float = 0.3) -> tuple[Located, Observation, Painted]:
    view, painted = world.view(NOW, noise_px)
    references = [world.reference(node, pose) for node, pose in NODES.items()]
    outcome = locate_against(view, references, painted, REGISTRAR, None, (0.5, 10.0), None)
    assert isinstance(outcome, Located)
    return outcome, view, painted


@pytest.mark.parametrize("predicted", [None, NOW], ids=["everywhere", "near the prediction"])
def test_matches_belong_to_the_same_points(predicted: Pose | None) -> None:
    world = World(1)
    view, painted = world.view(NOW)
    references = [world.reference(node, pose, unknown=5) for node, pose in NODES.items()]
    pooled = match_references(view, references, painted, predicted)
    matches = pooled.correspondences
    assert len(matches) > 100
    assert (np.diff(matches.distance) >= 0).all()  # the order of Eq. 2
    assert set(pooled.node) == set(NODES)
    np.testing.assert_allclose(rays_of(NOW, matches.points), matches.rays, atol=1e-5)
    for node in NODES:
        mine = pooled.node == node
        rows = matches.map_index[mine]
        reference = next(r for r in references if r.node == node)
        np.testing.assert_array_equal(reference.points[rows], matches.points[mine])
        assert (rows >= 5).all()  # features without a point are of no use
    np.testing.assert_array_equal(view.rays[matches.frame_index], matches.rays)


def test_a_wrong_prediction_is_given_up() -> None:
    world = World(2)
    view, painted = world.view(NOW, 0.3)
    references = [world.reference(node, pose) for node, pose in NODES.items()]
    off = camera_pose(1.2, -0.8, 2.1, yaw=-1.0)
    outcome = locate_against(view, references, painted, REGISTRAR, off, (0.5, 10.0), None)
    assert isinstance(outcome, Located)
    assert np.linalg.norm(pose_error(outcome.pose, NOW)[:3]) < 0.02


def test_pose_and_who_supports_it() -> None:
    world = World(3)
    outcome, _, _ = located(world)
    error = np.linalg.norm(pose_error(outcome.pose, NOW)[:3])
    assert 1e-5 < error < 0.01
    nodes = outcome.nodes()
    assert nodes == sorted(NODES, reverse=True)
    counts = {node: len(outcome.inliers_of(node)) for node in nodes}
    assert sum(counts.values()) == len(outcome.estimate.inliers)
    assert counts[outcome.main_node] == max(counts.values())


def test_the_newest_of_equal_nodes_is_the_main_one() -> None:
    world = World(4)
    outcome, _, _ = located(world)
    rows = np.concatenate([outcome.inliers_of(node)[:20] for node in NODES])
    estimate = PoseEstimate(outcome.pose, np.eye(6), np.sort(rows), 1.0, 0.3)
    assert Located(estimate, outcome.matches).main_node == 5


def test_too_few_features_are_named() -> None:
    world = World(5)
    few = features_at(np.array([[10.0, 10.0]]), world.descriptors[:1])
    frame = Frame(0, 0, "", (np.zeros((240, 320), np.uint8),))
    view = Observation(frame, mono_rig(), Painted(few), TiltPrior(level(), 0.05))
    outcome = locate_against(
        view, [world.reference(3, NODES[3])], Painted(few), REGISTRAR, None, (0.5, 10.0), None
    )
    assert isinstance(outcome, NotFound)
    assert outcome.reason is Reason.FEW_FEATURES


def test_constraints_are_the_relative_poses() -> None:
    world = World(6)
    outcome, view, _ = located(world)
    constraints = constraints_to_nodes(outcome, NODES, 9, REGISTRAR, view.tilt, 0.6)
    assert {c.i for c in constraints} == set(outcome.nodes())
    for constraint in constraints:
        assert constraint.j == 9
        truth = NODES[constraint.i].inverse() @ NOW
        error = pose_error(constraint.i_from_j, truth)
        assert 1e-7 < np.linalg.norm(error[:3]) < 0.03
        # in g2o's coordinates: (translation, vector part of the quaternion)
        e = np.concatenate([error[:3], 0.5 * error[3:]])
        assert 0.01 < e @ constraint.information @ e / 6 < 5.0


def test_nodes_with_few_inliers_give_no_constraint() -> None:
    world = World(7)
    outcome, view, _ = located(world)
    main = outcome.main_node
    other = next(node for node in NODES if node != main)
    rows = np.concatenate([outcome.inliers_of(main), outcome.inliers_of(other)[:5]])
    thin = Located(PoseEstimate(outcome.pose, np.eye(6), np.sort(rows), 1.0, 0.3), outcome.matches)
    assert [c.i for c in constraints_to_nodes(thin, NODES, 9, REGISTRAR, view.tilt, 0.6)] == [main]


def test_the_main_node_always_gives_a_constraint() -> None:
    """Too few inliers for a refinement of their own: then the pose that was found for all."""
    world = World(8)
    outcome, view, _ = located(world)
    rows = np.sort(outcome.inliers_of(outcome.main_node)[:5])
    thin = Located(PoseEstimate(outcome.pose, np.eye(6) * 1e-4, rows, 1.0, 0.3), outcome.matches)
    (constraint,) = constraints_to_nodes(thin, NODES, 9, REGISTRAR, view.tilt, 0.6)
    expected = NODES[outcome.main_node].inverse() @ outcome.pose
    np.testing.assert_allclose(pose_error(constraint.i_from_j, expected), np.zeros(6), atol=1e-12)


def test_information_is_of_the_quaternion_not_of_the_rotation_vector() -> None:
    """x' C^-1 x with x = (t, theta) is e' Omega e with e = (t, vector part of q(theta)), for small theta."""
    rng = np.random.default_rng(1)
    root = rng.normal(0.0, 1.0, (6, 6))
    covariance = root @ root.T + np.eye(6)
    information = information_of_constraint(covariance)
    np.testing.assert_allclose(information, information.T, atol=1e-9)
    for _ in range(5):
        x = 1e-4 * rng.normal(0.0, 1.0, 6)
        quaternion = Pose(rotation_from_vector(x[3:]), np.zeros(3)).quaternion()
        e = np.concatenate([x[:3], quaternion[:3]])
        assert e @ information @ e == pytest.approx(x @ np.linalg.solve(covariance, x), rel=1e-6)


def test_subset_keeps_columns_together() -> None:
    world = World(9)
    view, painted = world.view(NOW)
    matches = match_references(view, [world.reference(3, NODES[3])], painted, None).correspondences
    rows = np.array([7, 2, 11])
    part = subset(matches, rows)
    for name in ("points", "rays", "distance", "map_index", "frame_index", "spread"):
        np.testing.assert_array_equal(getattr(part, name), getattr(matches, name)[rows])
    assert isinstance(PooledMatches(part, np.array([3, 3, 3])), PooledMatches)
