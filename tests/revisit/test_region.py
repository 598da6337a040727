"""Footprints and covariances: where the camera may be, against plain search and against drawn samples."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import Pose, rotation_from_euler, rotation_x
from overfly.graph.pose_graph import PoseGraph
from overfly.revisit.region import FootprintIndex, footprint_radius, ground_places, ground_sigma, on_ground
from overfly.revisit.uncertainty import pixel_sigmas, region_bound

CAMERA = Camera(320, 240, 250.0, 250.0, 160.0, 120.0)
DOWN = rotation_x(np.pi)  # a camera that looks down, picture's right along the world's x


@given(st.integers(0, 10_000))
def test_the_index_finds_what_a_search_through_all_finds(seed: int) -> None:
    generator = np.random.default_rng(seed)
    index = FootprintIndex()
    centres, radii, sigmas = np.empty((0, 2)), np.empty(0), np.empty(0)
    for _ in range(4):
        count = int(generator.integers(1, 120))
        new = (
            generator.uniform(-50, 50, (count, 2)),
            generator.uniform(1, 3, count),
            generator.uniform(0, 2, count),
        )
        centres, radii, sigmas = (
            np.concatenate(pair) for pair in zip((centres, radii, sigmas), new, strict=True)
        )
        for row in zip(*new, strict=True):
            index.add(row[0], float(row[1]), float(row[2]))
        moved = np.unique(generator.integers(0, len(centres), 10))
        centres[moved] += generator.normal(size=(len(moved), 2))
        index.move(moved, centres[moved])
        place = generator.uniform(-50, 50, 2)
        found = index.within(place, 2.0, 1.0, 3.0)
        distance = np.linalg.norm(centres - place, axis=1)
        expected = np.flatnonzero(distance < 2.0 + radii + 3.0 * (1.0 + sigmas))
        assert sorted(found.tolist()) == expected.tolist()
        assert np.all(np.diff(distance[found]) >= 0)


def test_an_empty_index_finds_nothing() -> None:
    assert len(FootprintIndex().within(np.zeros(2), 1.0, 1.0, 3.0)) == 0


@given(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-3, 3), st.floats(0.5, 100))
def test_middles_of_views_in_one_go_and_one_by_one(
    roll: float, pitch: float, yaw: float, height: float
) -> None:
    pose = Pose(rotation_from_euler(roll, pitch, yaw) @ DOWN, np.array([3.0, -4.0, height]))
    graph = PoseGraph()
    graph.add_node(pose)
    one = on_ground(pose, height)
    assert np.allclose(ground_places(graph, np.array([0]), np.array([height]))[0], one, atol=1e-9 * height)
    # along the optical axis, height metres on
    assert np.allclose(one, pose.transform(np.array([0.0, 0.0, height]))[:2])


def test_the_radius_reaches_the_corners() -> None:
    corners = CAMERA.rays_from_pixels(np.array([[0.0, 0.0], [320.0, 240.0]]))
    assert np.isclose(footprint_radius(CAMERA, 2.0), np.linalg.norm(corners[1] - corners[0]), rtol=0.01)


def test_standard_deviations_are_those_of_drawn_samples() -> None:
    generator = np.random.default_rng(4)
    root = generator.normal(size=(6, 6)) * np.array([0.02] * 3 + [0.004] * 3)[:, None]
    covariance = root @ root.T
    pose = Pose(rotation_from_euler(0.05, -0.03, 1.0) @ DOWN, np.array([1.0, 2.0, 3.0]))
    moved = [pose @ Pose.exp(x) for x in generator.multivariate_normal(np.zeros(6), covariance, 4000)]
    middles = np.array([on_ground(one, 3.0) for one in moved])
    sampled = np.sqrt(np.linalg.eigvalsh(np.cov(middles.T))[-1])
    assert 0.93 < ground_sigma(covariance, pose.rotation, 3.0) / sampled < 1.07
    point = pose.transform(np.array([0.6, -0.4, 2.8]))
    seen = np.array([CAMERA.project(one.inverse().transform(point[None]))[0] for one in moved])
    sampled = np.sqrt(np.linalg.eigvalsh(np.cov(seen.T))[-1])
    predicted = pixel_sigmas(pose.inverse().transform(point[None]), covariance, CAMERA)[0]
    assert 0.93 < predicted / sampled < 1.07


def test_points_behind_the_camera_are_seen_nowhere() -> None:
    sigmas = pixel_sigmas(np.array([[0.1, 0.2, -1.0], [0.1, 0.2, 1.0]]), np.eye(6) * 1e-6, CAMERA)
    assert np.isnan(sigmas[0])
    assert np.isfinite(sigmas[1])


@given(st.floats(1.0, 4.0))
def test_the_bound_holds_its_share_of_normal_samples(sigmas: float) -> None:
    generator = np.random.default_rng(5)
    inside = (generator.normal(size=(20_000, 6)) ** 2).sum(axis=1) <= region_bound(sigmas)
    in_one = np.abs(generator.normal(size=20_000)) <= sigmas
    assert abs(inside.mean() - in_one.mean()) < 0.015
