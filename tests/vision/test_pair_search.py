"""The search of section IV-B against a twin that follows the paper word for word, without haste."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.geometry.levelling import level_rays
from overfly.geometry.poses import FloatArray, Pose, rotation_z
from overfly.types import Correspondences
from overfly.vision.pair_search import Hypothesis, SearchSettings, search_pairs
from overfly.vision.two_point import solve_two_point

from .scenes import CAMERA, pose_error, sight

SETTINGS = SearchSettings(
    image_limit=2.0 / CAMERA.focal_px, image_sigma=0.6 / CAMERA.focal_px, descriptor_limit=0.25
)
EVERYTHING = replace(SETTINGS, pairs_without_gain=10**9, satisfying=math.inf)


def score_twin(
    pose: Pose, matches: Correspondences, pair: tuple[int, int], settings: SearchSettings
) -> float:
    """Eq. 3 and 4: the pair itself is left out; distances in the metric of feature and point uncertainty."""
    score = 0.0
    cam_from_world = pose.inverse()
    for k in range(len(matches)):
        point = cam_from_world.transform(matches.points[k])
        if k in pair or matches.distance[k] >= settings.descriptor_limit or point[2] <= 0:
            continue
        residual = point[:2] / point[2] - matches.rays[k]
        squared = float(residual @ residual)
        if matches.spread is not None and squared >= settings.image_limit**2:
            # sigma^2 r' (sigma^2 I + e e')^-1 r with e the image of the spread
            moved = cam_from_world.rotation @ matches.spread[k]
            image = (moved[:2] - point[:2] / point[2] * moved[2]) / point[2]
            covariance = settings.image_sigma**2 * np.eye(2) + np.outer(image, image)
            squared = settings.image_sigma**2 * float(residual @ np.linalg.solve(covariance, residual))
        if squared >= settings.image_limit**2:
            continue
        worse = settings.blend * matches.distance[k] / settings.descriptor_limit
        worse += (1 - settings.blend) * math.sqrt(squared) / settings.image_limit
        score += 1.0 - worse
    return score


def search_twin(
    matches: Correspondences, level_from_cam: FloatArray, settings: SearchSettings
) -> tuple[Pose, float, tuple[int, int]] | None:
    """All pairs in the order (1,2) (1,3) (2,3) (1,4) ...; the first of equal scores stays."""
    levelled = level_rays(matches.rays, level_from_cam)
    best: tuple[Pose, float, tuple[int, int]] | None = None
    for b in range(1, len(matches)):
        for a in range(b):
            rows = [a, b]
            if np.linalg.norm(matches.rays[a] - matches.rays[b]) < settings.smallest_separation:
                continue
            for x, y, z, yaw in solve_two_point(matches.points[rows], levelled[rows]):
                if not settings.height_range_m[0] <= z <= settings.height_range_m[1]:
                    continue
                pose = Pose(rotation_z(yaw) @ level_from_cam, np.array([x, y, z]))
                score = score_twin(pose, matches, (a, b), settings)
                if best is None or score > best[1] + 1e-12:
                    best = pose, score, (a, b)
    return best


def assert_same_winner(
    found: Hypothesis | None, expected: tuple[Pose, float, tuple[int, int]] | None
) -> None:
    assert found is not None and expected is not None
    pose, score, pair = expected
    assert found.pair == pair
    assert found.score == pytest.approx(score, abs=1e-9)
    np.testing.assert_allclose(pose_error(found.world_from_cam, pose), np.zeros(6), atol=1e-8)


@settings(max_examples=25)
@given(
    st.integers(0, 10**6), st.integers(4, 16), st.floats(0.0, 0.6), st.floats(0.1, 1.0), st.floats(0.0, 0.9)
)
def test_the_winner_is_that_of_all_pairs(
    seed: int, count: int, outliers: float, noise_px: float, blend: float
) -> None:
    """With noise, for exact data all pairs win alike."""
    scene = sight(seed, count, outliers, noise_px)
    wanted = replace(EVERYTHING, blend=blend)
    expected = search_twin(scene.correspondences, scene.tilt, wanted)
    found = search_pairs(scene.correspondences, scene.tilt, wanted)
    if expected is None:
        assert found is None
        return
    assert_same_winner(found, expected)
    assert found is not None and found.pairs_tried == count * (count - 1) // 2


@settings(max_examples=15)
@given(st.integers(0, 10**6), st.floats(0.0, 0.3))
def test_uncertain_depths_count_along_their_line_only(seed: int, spread_m: float) -> None:
    scene = sight(seed, 12, 0.2, 0.5)
    rng = np.random.default_rng(seed)
    spread = rng.normal(0.0, 1.0, (12, 3)) * spread_m
    moved = scene.correspondences.points + spread * rng.normal(0.0, 1.0, (12, 1))
    matches = replace(scene.correspondences, points=moved, spread=spread)
    assert_same_winner(
        search_pairs(matches, scene.tilt, EVERYTHING), search_twin(matches, scene.tilt, EVERYTHING)
    )


def test_early_exits_leave_the_winner_alone_where_they_must() -> None:
    """Bounding the score never changes the winner, also with more matches than one block of the bound."""
    for seed in range(3):
        scene = sight(seed, 45, 0.5, 0.7)
        found = search_pairs(scene.correspondences, scene.tilt, EVERYTHING)
        assert_same_winner(found, search_twin(scene.correspondences, scene.tilt, EVERYTHING))


def test_order_of_the_pairs() -> None:
    """With a budget of n pairs, only the first n of the paper's order are looked at."""
    order = [(a, b) for b in range(1, 6) for a in range(b)]
    assert order[:6] == [(0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3)]
    scene = sight(11, 12, noise_px=0.3)
    for budget in (1, 2, 4, 5, 7, 8, 10):
        limited = replace(EVERYTHING, max_pairs=budget)
        found = search_pairs(scene.correspondences, scene.tilt, limited)
        if found is None:
            continue
        assert found.pair in order[:budget]
        scores = {}
        for a, b in order[:budget]:
            two = replace(EVERYTHING, max_pairs=budget)
            subset = [
                score_twin(
                    Pose(rotation_z(yaw) @ scene.tilt, np.array([x, y, z])),
                    scene.correspondences,
                    (a, b),
                    two,
                )
                for x, y, z, yaw in solve_two_point(
                    scene.correspondences.points[[a, b]],
                    level_rays(scene.correspondences.rays[[a, b]], scene.tilt),
                )
                if np.linalg.norm(scene.correspondences.rays[a] - scene.correspondences.rays[b]) >= 0.05
            ]
            scores[a, b] = max(subset, default=-1.0)
        assert found.score == pytest.approx(max(scores.values()), abs=1e-9)


def test_a_satisfying_score_ends_the_search() -> None:
    scene = sight(5, 40)
    found = search_pairs(scene.correspondences, scene.tilt, SETTINGS)
    assert found is not None
    assert found.pairs_tried < 40  # exact data: the first usable pair satisfies
    np.testing.assert_allclose(pose_error(found.world_from_cam, scene.pose), np.zeros(6), atol=1e-9)


def test_the_search_ends_after_so_many_pairs_without_gain() -> None:
    scene = sight(6, 80, outliers=0.5, noise_px=0.8)
    stubborn = replace(SETTINGS, satisfying=math.inf, pairs_without_gain=100)
    found = search_pairs(scene.correspondences, scene.tilt, stubborn)
    whole = search_pairs(scene.correspondences, scene.tilt, EVERYTHING)
    assert found is not None and whole is not None
    assert 100 < found.pairs_tried < whole.pairs_tried == 80 * 79 // 2
    assert found.score <= whole.score


def test_same_input_same_answer_bit_for_bit() -> None:
    scene = sight(7, 100, outliers=0.6, noise_px=0.7)
    first = search_pairs(scene.correspondences, scene.tilt, SETTINGS)
    second = search_pairs(scene.correspondences, scene.tilt, SETTINGS)
    assert first is not None and second is not None
    np.testing.assert_array_equal(first.world_from_cam.matrix(), second.world_from_cam.matrix())
    assert (first.score, first.pair, first.pairs_tried) == (second.score, second.pair, second.pairs_tried)


@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.6])
def test_poses_are_near_the_truth_among_outliers(outliers: float) -> None:
    """At 0.5 px noise two points err by a few percent of the height at most, and are not exact."""
    errors = []
    for seed in range(30):
        scene = sight(100 + seed, 100, outliers, 0.5)
        found = search_pairs(scene.correspondences, scene.tilt, SETTINGS)
        assert found is not None
        error = pose_error(found.world_from_cam, scene.pose)
        errors.append(float(np.linalg.norm(error[:3])) / scene.pose.translation[2])
    assert 1e-5 < np.median(errors) < 0.005
    assert max(errors) < 0.03


def test_height_range_is_kept() -> None:
    scene = sight(8, 30)
    z = float(scene.pose.translation[2])
    outside = replace(SETTINGS, height_range_m=(2.0 * z, 5.0 * z))
    found = search_pairs(scene.correspondences, scene.tilt, outside)
    assert found is None or 2.0 * z <= found.world_from_cam.translation[2] <= 5.0 * z
    inside = replace(SETTINGS, height_range_m=(0.9 * z, 1.1 * z))
    right = search_pairs(scene.correspondences, scene.tilt, inside)
    assert right is not None
    np.testing.assert_allclose(right.world_from_cam.translation, scene.pose.translation, atol=1e-9)


def test_pairs_too_close_in_the_picture_are_passed_over() -> None:
    scene = sight(9, 30)
    picky = replace(EVERYTHING, smallest_separation=0.5)
    found = search_pairs(scene.correspondences, scene.tilt, picky)
    assert found is not None
    rays = scene.correspondences.rays
    assert np.linalg.norm(rays[found.pair[0]] - rays[found.pair[1]]) >= 0.5


def test_descriptors_beyond_their_limit_do_not_count() -> None:
    scene = sight(10, 20)
    cut = float(scene.correspondences.distance[9])
    fewer = replace(EVERYTHING, descriptor_limit=cut)
    found = search_pairs(scene.correspondences, scene.tilt, fewer)
    assert found is not None
    expected = np.clip(1 - 0.5 * scene.correspondences.distance[:9] / cut, 0, None)
    lost = expected[[k for k in found.pair if k < 9]].sum()
    assert found.score == pytest.approx(float(expected.sum() - lost), abs=1e-6)


def test_nothing_to_search_gives_nothing() -> None:
    scene = sight(1, 5)
    none = Correspondences(
        np.empty((0, 3)), np.empty((0, 2)), np.empty(0), np.empty(0, int), np.empty(0, int)
    )
    assert search_pairs(none, scene.tilt, SETTINGS) is None
    blind = replace(scene.correspondences, rays=np.full((5, 2), np.nan))
    assert search_pairs(blind, scene.tilt, SETTINGS) is None
