"""The window: relative covariances against draws, and a crooked map that is set straight."""

from __future__ import annotations

import numpy as np
import pytest

from overfly.config import WindowSettings
from overfly.geometry.cameras import Camera
from overfly.geometry.levelling import NADIR_BODY_FROM_CAM
from overfly.geometry.poses import FloatArray, Pose, rotation_from_euler
from overfly.types import Constraint, ConstraintKind, Features
from overfly.vision.refine import HeightPrior, TiltPrior
from overfly.visual_map import Node, VisualMap
from overfly.window import _relative_covariance, _together, adjust_window

CAMERA = Camera(320, 240, 288.0, 288.0, 159.5, 119.5)
SIGMA = 0.3 / CAMERA.focal_px
RELIEF_M = 0.02


def camera_at(index: int) -> Pose:
    return Pose(
        rotation_from_euler(0.02 * np.sin(index), 0.02 * np.cos(index), 0.05 * index) @ NADIR_BODY_FROM_CAM,
        np.array([0.35 * index, 0.05 * np.sin(index), 2.0 + 0.03 * np.cos(index)]),
    )


# -- relative covariance


@pytest.mark.parametrize("fixed_parent", [False, True])
def test_relative_covariance_against_draws(fixed_parent: bool) -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(0.0, 1.0, (12, 12)) * np.tile([0.02, 0.02, 0.02, 0.004, 0.004, 0.004], 2)[:, None]
    joint = 0.05 * root @ root.T
    if fixed_parent:
        joint = joint[6:, 6:]
    world_from_i, world_from_j = camera_at(0), camera_at(2)
    i_from_j = world_from_i.inverse() @ world_from_j
    stated = _relative_covariance(joint, [None, 0] if fixed_parent else [0, 1], i_from_j)
    draws = rng.multivariate_normal(np.zeros(len(joint)), joint, 40_000)
    seen = []
    for draw in draws[:4000]:
        moved_i = world_from_i if fixed_parent else world_from_i @ Pose.exp(draw[:6])
        moved_j = world_from_j @ Pose.exp(draw[-6:])
        seen.append((i_from_j.inverse() @ moved_i.inverse() @ moved_j).log())
    scale = np.sqrt(np.diag(stated))
    difference = (np.cov(np.array(seen).T) - stated) / np.outer(scale, scale)
    # 4000 draws know a covariance to 2.2 %; the largest of 36 entries to some three times that
    assert np.abs(difference).max() < 0.08


def test_nodes_that_move_together_are_certain_of_each_other() -> None:
    """A common error of the whole map is none of the relative pose."""
    world_from_i, world_from_j = camera_at(0), camera_at(3)
    i_from_j = world_from_i.inverse() @ world_from_j
    shift = np.diag([0.04, 0.03, 0.02, 1e-3, 2e-3, 3e-3])
    # one perturbation of the world seen in both cameras' axes
    to_i, to_j = world_from_i.inverse().adjoint(), world_from_j.inverse().adjoint()
    both = np.vstack([to_i, to_j])
    stated = _relative_covariance(both @ shift @ both.T, [0, 1], i_from_j)
    assert np.abs(stated).max() < 1e-9
    assert np.linalg.eigvalsh(stated).min() > 0  # and still a covariance


# -- the adjustment of a map


class SmallWorld:
    """A strip of ground with named points, and nodes along it that see them exactly."""

    def __init__(self, count: int, seed: int = 3, total: int = 240) -> None:
        rng = np.random.default_rng(seed)
        length = 0.35 * count + 2.0
        self.points = np.column_stack(
            [rng.uniform(-1.0, length, total), rng.uniform(-1, 1, total), rng.normal(0.0, RELIEF_M, total)]
        )
        self.map = VisualMap()
        self.map.new_tracks(len(self.points))
        self.truth = [camera_at(index) for index in range(count)]

    def add(self, index: int, guess: Pose, wrong: int = 0) -> Node:
        """Node with the truth's rays at a guessed pose; the first ``wrong`` features are mistaken."""
        truth = self.truth[index]
        seen = truth.inverse().transform(self.points)
        px = CAMERA.project(seen)
        inside = np.flatnonzero(((px > 0) & (px < [319, 239])).all(axis=1))
        rays = seen[inside, :2] / seen[inside, 2:]
        rays[:wrong] += 0.05
        assumed = np.column_stack([rays, np.ones(len(rays))])
        down = guess.rotation[2] @ assumed.T
        points = assumed * (-guess.translation[2] / down)[:, None]  # flat ground
        ones = np.ones(len(inside), np.float32)
        up = truth.rotation.T @ np.array([0.0, 0.0, 1.0])
        node = Node(
            index=index,
            frame_index=index,
            t_ns=index,
            features=Features(
                px[inside].astype(np.float32), np.zeros((len(inside), 32), np.uint8), ones, ones, ones
            ),
            rays=rays,
            points_in_cam=points,
            depth_sigma_m=np.full(len(inside), 0.05),
            inverse_depth=np.full(len(inside), np.nan),
            ray_sigma=np.full(len(inside), SIGMA),
            tracks=inside.copy(),
            anchor=np.full(len(inside), index),
            anchor_row=np.arange(len(inside)),
            tilt=TiltPrior(_level_of(up), 0.005),
            height=HeightPrior(float(truth.translation[2]), 0.02),
            parent=index - 1,
        )
        self.map.add_node(node, guess)
        if index:
            i_from_j = self.map.graph.pose(index - 1).inverse() @ guess
            node.constraint = self.map.graph.add_constraint(Constraint(index - 1, index, i_from_j, np.eye(6)))
        return node


def _level_of(up: FloatArray) -> FloatArray:
    side = np.cross([0.0, 1.0, 0.0], up)
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(up, side), up])


def crooked(seed: int, count: int = 6) -> SmallWorld:
    """All but the first node are guessed with errors of a few centimetres and half a degree."""
    world, rng = SmallWorld(count), np.random.default_rng(seed)
    for index, truth in enumerate(world.truth):
        off = rng.normal(0.0, 1.0, 6) * [0.03, 0.03, 0.03, 0.008, 0.008, 0.008] * (index > 0)
        world.add(index, truth @ Pose.exp(off))
    return world


def worst_error(world: SmallWorld) -> float:
    """Of the nodes against the truth, relative to the first node, metres."""
    first, true_first = world.map.graph.pose(0).inverse(), world.truth[0].inverse()
    errors = []
    for index, truth in enumerate(world.truth):
        there, expected = first @ world.map.graph.pose(index), true_first @ truth
        errors.append(np.linalg.norm(there.translation - expected.translation))
    return float(max(errors))


@pytest.mark.parametrize("seed", range(3))
def test_a_crooked_map_is_set_straight(seed: int) -> None:
    world = crooked(seed)
    before = worst_error(world)
    relief = adjust_window(world.map, WindowSettings(), 1.0, RELIEF_M)
    assert before > 0.03
    assert worst_error(world) < 0.15 * before
    assert relief is not None
    assert 0.5 * RELIEF_M < relief < 2.0 * RELIEF_M


def test_points_and_constraints_follow_the_adjusted_nodes() -> None:
    world = crooked(5)
    adjust_window(world.map, WindowSettings(), 1.0, RELIEF_M)
    graph = world.map.graph
    for node in world.map.nodes:
        # every shared point is one place in the world, whoever sees it
        there = world.map.points_in_world(node)
        moved = np.linalg.norm(there - world.points[node.tracks], axis=1)
        assert np.median(moved) < 0.05
        if node.index:
            i_from_j = graph.pose(node.index - 1).inverse() @ graph.pose(node.index)
            measured = graph.constraint(node.constraint).i_from_j
            np.testing.assert_allclose(measured.matrix(), i_from_j.matrix(), atol=1e-9)
            information = graph.information[node.constraint]
            assert np.linalg.eigvalsh(information).min() > 0
            assert not np.array_equal(information, np.eye(6))


def test_shared_points_agree_after_the_adjustment() -> None:
    world = crooked(6)
    adjust_window(world.map, WindowSettings(), 1.0, RELIEF_M)
    a, b = world.map.nodes[2], world.map.nodes[3]
    shared, in_a, in_b = np.intersect1d(a.tracks, b.tracks, return_indices=True)
    assert len(shared) > 10
    gap = world.map.points_in_world(a)[in_a] - world.map.points_in_world(b)[in_b]
    assert np.abs(gap).max() < 1e-9


def test_older_nodes_stay_where_they_are() -> None:
    world = crooked(7, count=8)
    before = world.map.graph.positions.copy()
    adjust_window(world.map, WindowSettings(nodes=3, fixed_nodes=2), 1.0, RELIEF_M)
    np.testing.assert_array_equal(world.map.graph.positions[:5], before[:5])
    assert np.abs(world.map.graph.positions[5:] - before[5:]).max() > 1e-3


def test_wrong_matches_become_points_of_their_own() -> None:
    world = SmallWorld(5)
    for index, truth in enumerate(world.truth):
        world.add(index, truth, wrong=3 if index == 4 else 0)
    before = world.map.nodes[4].tracks.copy()
    known = world.map.n_tracks
    adjust_window(world.map, WindowSettings(), 1.0, RELIEF_M)
    changed = np.flatnonzero(world.map.nodes[4].tracks != before)
    assert set(changed) <= {0, 1, 2}
    assert len(changed) >= 2  # one that nobody else sees needs no new name
    assert (world.map.nodes[4].tracks[changed] >= known).all()
    assert worst_error(world) < 0.02


def test_there_is_nothing_to_adjust_in_one_node_or_without_common_points() -> None:
    world = SmallWorld(2)
    world.add(0, world.truth[0])
    assert adjust_window(world.map, WindowSettings(), 1.0, RELIEF_M) is None
    second = world.add(1, world.truth[1])
    second.tracks = world.map.new_tracks(len(second.tracks))
    before = world.map.graph.positions.copy()
    assert adjust_window(world.map, WindowSettings(), 1.0, RELIEF_M) is None
    np.testing.assert_array_equal(world.map.graph.positions, before)


def test_nodes_elsewhere_are_left_alone_and_the_new_one_does_not_float() -> None:
    """Back over known ground: the newest node hangs on node 2, the others before it lie far off."""
    world = SmallWorld(17)
    rng = np.random.default_rng(8)
    world.truth[16] = world.truth[2] @ Pose.exp(np.array([0.1, 0.05, 0.02, 0.0, 0.0, 0.1]))
    for index, truth in enumerate(world.truth):
        off = rng.normal(0.0, 1.0, 6) * [0.02, 0.02, 0.02, 0.005, 0.005, 0.005] * (index > 8)
        node = world.add(index, truth @ Pose.exp(off))
    node.parent, node.constraint = 2, -1
    before = [world.map.graph.pose(index).matrix() for index in range(16)]
    adjust_window(world.map, WindowSettings(nodes=8, fixed_nodes=1), 1.0, RELIEF_M)
    for index in range(16):
        np.testing.assert_array_equal(world.map.graph.pose(index).matrix(), before[index])
    error = (world.truth[16].inverse() @ world.map.graph.pose(16)).log()
    assert 0.0 < np.linalg.norm(error[:3]) < 0.02


def test_what_lies_before_a_bridge_takes_no_part() -> None:
    """A bridge ties no points: nodes on both sides of it would float against each other."""
    world = SmallWorld(8)
    for index, truth in enumerate(world.truth):
        world.add(index, truth)
    graph = world.map.graph
    newest = world.map.newest(6)
    assert [node.index for node in _together(world.map, newest)] == [2, 3, 4, 5, 6, 7]
    bridge = Constraint(4, 5, graph.pose(4).inverse() @ graph.pose(5), np.eye(6), ConstraintKind.BRIDGE)
    world.map.nodes[5].constraint = graph.add_constraint(bridge)
    assert world.map.is_bridged(world.map.nodes[5]) and not world.map.is_bridged(world.map.nodes[6])
    assert [node.index for node in _together(world.map, newest)] == [5, 6, 7]
    assert [world.map.after_gap(index) for index in (0, 4, 5, 7)] == [0, 0, 5, 5]
