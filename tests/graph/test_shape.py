"""How sure the shape of a map is: moving the whole is no error; adjusted maps scatter as they are told to."""

from __future__ import annotations

import numpy as np
from tests.graph.test_points import problem_of, survey
from tests.graph.test_points_jackknife import independent_covariance

from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.points import adjust_points
from overfly.graph.shape import ShapeCovariance, ground_deviations, shape_covariance

HEIGHT_M = 10.0


def poses_of(k: int, seed: int) -> tuple[FloatArray, FloatArray]:
    generator = np.random.default_rng(seed)
    turns = [Pose.exp(np.concatenate([np.zeros(3), generator.normal(0, 1, 3)])).rotation for _ in range(k)]
    places = generator.uniform(-30.0, 30.0, (k, 3)) * [1.0, 1.0, 0.05]
    return np.array(turns), places


def covariance_of(steps: FloatArray, rotations: FloatArray) -> FloatArray:
    """Of modes (m, k, 3), steps of the places in the world, that happen independently with deviation 1."""
    own = np.einsum("iba,mib->mia", rotations, steps)
    k = len(rotations)
    full = np.zeros((len(steps), k, 6))
    full[:, :, :3] = own
    flat = full.reshape(len(steps), 6 * k)
    return flat.T @ flat


def test_moving_and_turning_the_whole_is_no_error_of_shape() -> None:
    rotations, places = poses_of(12, 1)
    generator = np.random.default_rng(2)
    moves = generator.normal(0, 1, (6, 3))
    turns = np.cross(generator.normal(0, 0.1, (6, 1, 3)), places[None] - [3.0, -2.0, 7.0])
    covariance = covariance_of(moves[:, None, :] + turns, rotations)
    assert np.sqrt(np.diag(covariance)).max() > 0.5
    found = ground_deviations(rotations, places, covariance, np.full(12, HEIGHT_M))
    np.testing.assert_allclose(found, 0.0, atol=1e-6)


def test_an_error_of_size_counts_by_the_depth() -> None:
    rotations, places = poses_of(20, 3)
    places[:, 2] = 5.0
    size = 0.01 * (places - places.mean(axis=0))
    depth = np.linspace(4.0, 15.0, 20)
    found = ground_deviations(rotations, places, covariance_of(size[None], rotations), depth)
    np.testing.assert_allclose(found, 0.01 * depth, rtol=1e-6)


def test_heights_that_err_by_themselves_err_by_so_much() -> None:
    k = 60
    rotations, places = poses_of(k, 4)
    steps = np.zeros((k, k, 3))
    steps[np.arange(k), np.arange(k), 2] = 0.2
    found = ground_deviations(rotations, places, covariance_of(steps, rotations), np.full(k, 0.01))
    assert 0.17 < found.min() <= found.max() < 0.21  # 3 of 60 unknowns are the whole map's


def test_adjusted_maps_scatter_as_the_covariance_says() -> None:
    """Squared errors of the places in units of their covariance, over many noises: 1 per unknown."""
    poses, points = survey(2, 4, 5)
    every = np.arange(len(poses))
    values = []
    for seed in range(12):
        problem = problem_of(poses, points, 1e-3, seed)
        solution = adjust_points(problem)
        assert solution is not None
        free = np.setdiff1d(every, [0, len(poses) // 2, len(poses) - 1])  # the others' places are given
        rows = (6 * free[:, None] + np.arange(6)).ravel()
        error = np.concatenate(
            [
                (pose.inverse() @ Pose(solution.rotations[n], solution.translations[n])).log()
                for n, pose in enumerate(poses)
            ]
        )[rows]
        covariance = independent_covariance(problem, solution, every)[np.ix_(rows, rows)]
        values.append(error @ np.linalg.solve(covariance, error) / len(rows))
    assert 0.75 < np.mean(values) < 1.35


def shape_of(rotations: FloatArray, places: FloatArray, modes: FloatArray) -> ShapeCovariance:
    """Of poses that scatter by independent modes (m, k, 6): steps of the places and small turns, in the
    world, with deviation 1."""
    own = np.einsum("iba,mirb->mira", rotations, modes.reshape(len(modes), len(places), 2, 3))
    flat = own.reshape(len(modes), -1)
    every = np.arange(len(places))
    return shape_covariance(every, rotations, places, flat.T @ flat, places[:, 2] - HEIGHT_M)


def test_cameras_and_ground_are_sure_where_only_the_whole_moves_and_turns() -> None:
    rotations, places = poses_of(12, 1)
    generator = np.random.default_rng(2)
    turns = np.repeat(generator.normal(0, 0.1, (6, 1, 3)), 12, axis=1)
    steps = generator.normal(0, 1, (6, 1, 3)) + np.cross(turns, places[None] - [3.0, -2.0, 7.0])
    found = shape_of(rotations, places, np.concatenate([steps, turns], axis=2))
    np.testing.assert_array_equal(found.nodes, np.arange(12))
    np.testing.assert_allclose(found.cameras, 0.0, atol=1e-9)
    np.testing.assert_allclose(found.ground, 0.0, atol=1e-9)


def test_steps_count_alike_for_cameras_and_ground_and_tilts_for_the_ground_alone() -> None:
    k = 60
    rotations, places = poses_of(k, 4)
    steps, tilts = np.zeros((2, 3 * k, k, 6))
    for axis in range(3):
        steps[k * axis + np.arange(k), np.arange(k), axis] = 0.2
        tilts[k * axis + np.arange(k), np.arange(k), 3 + axis] = 0.01
    poses = [Pose(rotation, place) for rotation, place in zip(rotations, places, strict=True)]
    stepped, tilted = shape_of(rotations, places, steps), shape_of(rotations, places, tilts)
    for covariance in (*stepped.cameras, *stepped.ground):
        deviations = np.sqrt(np.linalg.eigvalsh(covariance))
        assert 0.16 < deviations.min() <= deviations.max() < 0.205
    np.testing.assert_allclose(tilted.cameras, 0.0, atol=1e-12)
    below = tilted.of_ground(poses.__getitem__, places[7, :2] + 0.01)
    assert 0.08 < np.sqrt(below[0, 0]) < 0.105  # 0.01 rad from 10 m
    assert 0.08 < np.sqrt(below[1, 1]) < 0.105
    assert np.sqrt(below[2, 2]) < 0.02


def test_nothing_is_said_of_what_the_system_does_not_determine() -> None:
    rotations, places = poses_of(5, 1)
    found = shape_of(rotations, places, np.full((1, 5, 6), np.nan))
    assert len(found.nodes) == 0
    np.testing.assert_array_equal(found.of_ground(lambda _node: Pose.identity(), np.zeros(2)), 0.0)


def test_poses_seen_from_each_other_have_the_covariance_of_what_lies_between() -> None:
    """Against many pairs of poses drawn with a covariance of both."""
    generator = np.random.default_rng(5)
    rotations, places = poses_of(3, 6)
    poses = [Pose(rotation, place) for rotation, place in zip(rotations, places, strict=True)]
    modes = generator.normal(0, 0.02, (25, 18)) * np.tile([0.1, 0.1, 0.1, 0.005, 0.005, 0.005], 3)
    shape = shape_covariance(np.arange(3), rotations, places, modes.T @ modes, places[:, 2] - HEIGHT_M)
    between = poses[2].inverse() @ poses[1]
    drawn = []
    for steps in (generator.normal(0, 1, (4000, 25)) @ modes).reshape(-1, 3, 6):
        one, other = poses[2] @ Pose.exp(steps[2]), poses[1] @ Pose.exp(steps[1])
        drawn.append((between.inverse() @ one.inverse() @ other).log())
    ratio = np.linalg.solve(shape.relative(poses.__getitem__, 2, 1), np.cov(np.array(drawn).T))
    values = np.linalg.eigvals(ratio).real
    assert 0.85 < values.min() <= values.max() < 1.15
