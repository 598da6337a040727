"""The map: points that follow their nodes, identities that last, lengths that scale together."""

from __future__ import annotations

import numpy as np
import pytest

from overfly.geometry.levelling import NADIR_BODY_FROM_CAM
from overfly.geometry.poses import FloatArray, Pose, rotation_from_euler
from overfly.types import Constraint, Features
from overfly.vision.odometry import information_of_constraint
from overfly.vision.refine import HeightPrior, TiltPrior
from overfly.visual_map import PICTURED_NODES, Node, VisualMap

N = 12


def pose_of(index: int) -> Pose:
    return Pose(
        rotation_from_euler(0.02 * index, -0.03, 0.3 * index) @ NADIR_BODY_FROM_CAM,
        np.array([0.4 * index, 0.1 * index, 2.0 + 0.05 * index]),
    )


def node_of(visual_map: VisualMap, index: int, tracks: np.ndarray | None = None) -> Node:
    """A node with N features; its points are 2 m away on their rays, the last one without depth."""
    rng = np.random.default_rng(index)
    px = rng.uniform([0, 0], [319, 239], (N, 2))
    rays = (px - [159.5, 119.5]) / 288.0
    points = np.column_stack([rays, np.ones(N)]) * rng.uniform(1.8, 2.2, (N, 1))
    points[-1] = np.nan
    ones = np.ones(N, np.float32)
    return Node(
        index=index,
        frame_index=10 * index,
        t_ns=index,
        features=Features(px.astype(np.float32), np.zeros((N, 32), np.uint8), ones, ones, ones),
        rays=rays,
        points_in_cam=points,
        depth_sigma_m=np.linspace(0.01, 0.1, N),
        inverse_depth=1.0 / points[:, 2],
        ray_sigma=np.full(N, 1e-3),
        tracks=visual_map.new_tracks(N) if tracks is None else tracks,
        anchor=np.full(N, index),
        anchor_row=np.arange(N),
        tilt=TiltPrior(np.eye(3), 0.01),
        height=HeightPrior(2.0 + 0.05 * index, 0.02),
        parent=index - 1,
        pyramid=(np.zeros((4, 4), np.uint8),),
    )


def chain(count: int) -> VisualMap:
    visual_map = VisualMap()
    for index in range(count):
        node = node_of(visual_map, index)
        visual_map.add_node(node, pose_of(index))
        if index:
            i_from_j = pose_of(index - 1).inverse() @ pose_of(index)
            information = information_of_constraint(np.diag([1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6]))
            node.constraint = visual_map.graph.add_constraint(
                Constraint(index - 1, index, i_from_j, information)
            )
    return visual_map


def assert_same(a: Pose, b: Pose) -> None:
    np.testing.assert_allclose(a.matrix(), b.matrix(), atol=1e-9)


def test_points_follow_their_node() -> None:
    visual_map = chain(2)
    before = visual_map.points_in_world(visual_map.nodes[1])
    moved = Pose.exp(np.array([1.0, 2.0, 0.5, 0.0, 0.1, 0.4]))
    visual_map.graph.set_pose(1, moved @ visual_map.graph.pose(1))
    np.testing.assert_allclose(
        visual_map.points_in_world(visual_map.nodes[1])[:-1], moved.transform(before[:-1]), atol=1e-9
    )


def test_spread_is_along_the_ray_and_a_sigma_deep() -> None:
    visual_map = chain(1)
    node = visual_map.nodes[0]
    spread = visual_map.spread_in_world(node)[:-1] @ visual_map.graph.pose(0).rotation
    np.testing.assert_allclose(spread[:, 2], node.depth_sigma_m[:-1], atol=1e-12)
    np.testing.assert_allclose(spread[:, :2] / spread[:, 2:], node.rays[:-1], atol=1e-9)


def test_nodes_come_in_order_and_only_the_last_used_keep_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("overfly.visual_map.PICTURE_BYTES", 0)
    visual_map = chain(PICTURED_NODES + 3)
    with pytest.raises(ValueError, match="node 3"):
        visual_map.add_node(node_of(visual_map, 3), pose_of(3))
    kept = [node.index for node in visual_map.nodes if node.pyramid is not None]
    assert kept == [node.index for node in visual_map.pictured()]
    assert len(kept) == PICTURED_NODES
    assert kept[-1] == PICTURED_NODES + 2


def test_odometry_goes_on_from_the_nodes_that_it_used_last() -> None:
    visual_map = chain(5)
    visual_map.use(1)
    assert [node.index for node in visual_map.previous(3)] == [1, 4, 3]
    assert [node.index for node in visual_map.left_behind(3)] == [0, 2]
    visual_map.add_node(node_of(visual_map, 5), pose_of(5))
    assert [node.index for node in visual_map.previous(3)] == [5, 1, 4]
    assert all(node.pyramid is not None for node in visual_map.nodes)


def test_previous_nodes_newest_first() -> None:
    visual_map = chain(5)
    assert [node.index for node in visual_map.previous(3)] == [4, 3, 2]
    assert [node.index for node in visual_map.previous(9)] == [4, 3, 2, 1, 0]


def test_tracks_are_never_given_twice() -> None:
    visual_map = VisualMap()
    first, second = visual_map.new_tracks(5), visual_map.new_tracks(3)
    np.testing.assert_array_equal(np.concatenate([first, second]), np.arange(8))


def test_each_ground_point_is_followed_once_from_its_newest_node() -> None:
    visual_map = chain(2)
    older = visual_map.nodes[1]
    tracks = np.concatenate([older.tracks[:4], visual_map.new_tracks(N - 4)])
    newest = node_of(visual_map, 2, tracks)
    newest.anchor[:4], newest.anchor_row[:4] = 1, np.arange(4)
    visual_map.add_node(newest, pose_of(2))
    nodes = [visual_map.nodes[2], visual_map.nodes[1]]
    points = visual_map.points_to_follow(nodes, retained={1, 2})
    assert len(points.world) == (N - 1) + (N - 1 - 4)  # neither twice nor without depth
    shared = (points.main_node == 2) & (points.row < 4)
    assert shared.sum() == 4
    np.testing.assert_array_equal(points.anchor[shared], 1)
    np.testing.assert_allclose(points.anchor_px[shared], older.features.px[:4])
    np.testing.assert_allclose(
        points.world[shared], visual_map.points_in_world(newest)[points.row[shared]], atol=1e-12
    )
    assert not ((points.main_node == 1) & (points.row < 4)).any()


def test_a_lost_picture_is_replaced_by_the_nodes_own() -> None:
    visual_map = chain(2)
    newest = node_of(visual_map, 2)
    newest.anchor[:4], newest.anchor_row[:4] = 0, np.arange(4)
    visual_map.add_node(newest, pose_of(2))
    points = visual_map.points_to_follow([newest], retained={2})
    np.testing.assert_array_equal(points.anchor, 2)
    np.testing.assert_allclose(points.anchor_px, newest.features.px[points.row])


def lengths_of(visual_map: VisualMap) -> dict[str, FloatArray]:
    points, sigmas = visual_map.all_points()
    return {
        "positions": visual_map.graph.positions.copy(),
        "measured": visual_map.graph.measured_positions.copy(),
        "points": points,
        "sigmas": sigmas,
        "odometry": np.array([pose.translation for pose in visual_map.odometry_poses()]),
    }


def test_scaling_multiplies_every_length_and_nothing_else() -> None:
    visual_map, twin = chain(4), chain(4)
    visual_map.rescale(
        2.5,
    )
    scaled, plain = lengths_of(visual_map), lengths_of(twin)
    for name, lengths in plain.items():
        np.testing.assert_allclose(scaled[name], 2.5 * lengths, atol=1e-9, err_msg=name)
    np.testing.assert_array_equal(visual_map.graph.quaternions, twin.graph.quaternions)
    np.testing.assert_array_equal(visual_map.graph.measured_quaternions, twin.graph.measured_quaternions)
    for node, before in zip(visual_map.nodes, twin.nodes, strict=True):
        np.testing.assert_allclose(node.inverse_depth, before.inverse_depth / 2.5)
        np.testing.assert_array_equal(node.rays, before.rays)


def test_errors_weigh_after_scaling_what_they_weighed_before() -> None:
    """e' Omega e is a number without unit: it must not change when all lengths do."""
    visual_map, twin = chain(3), chain(3)
    visual_map.rescale(0.4)
    error = np.array([0.01, -0.02, 0.005, 0.001, 0.002, -0.003])
    shrunk = error * [0.4, 0.4, 0.4, 1, 1, 1]
    for number in range(2):
        before = error @ twin.graph.constraint(number).information @ error
        after = shrunk @ visual_map.graph.constraint(number).information @ shrunk
        assert after == pytest.approx(before, rel=1e-12)


def test_scaling_there_and_back_is_nothing() -> None:
    visual_map, twin = chain(3), chain(3)
    visual_map.rescale(3.0)
    visual_map.rescale(1.0 / 3.0)
    for name, lengths in lengths_of(twin).items():
        np.testing.assert_allclose(lengths_of(visual_map)[name], lengths, atol=1e-12)
    np.testing.assert_allclose(visual_map.graph.information, twin.graph.information, rtol=1e-12)


def test_measured_heights_keep_their_metre_but_assumed_ones_scale() -> None:
    for measured, expected in ((True, [2.0, 2.05, 2.10]), (False, [4.0, 4.10, 4.20])):
        visual_map = chain(3)
        visual_map.rescale(2.0, heights_are_measured=measured)
        heights = [node.height.z_m for node in visual_map.nodes if node.height is not None]
        assert heights == pytest.approx(expected)


def test_odometry_knows_no_loops() -> None:
    """Along the constraints to the parents, whatever the graph's poses have become."""
    visual_map = chain(5)
    for index in range(1, 5):
        visual_map.graph.set_pose(index, Pose.identity())
    visual_map.graph.add_constraint(Constraint(0, 4, Pose.identity(), np.eye(6)))
    for index, pose in enumerate(visual_map.odometry_poses()):
        assert_same(pose, pose_of(index))


def test_an_empty_map_has_no_points() -> None:
    points, sigmas = VisualMap().all_points()
    assert points.shape == (0, 3) and sigmas.shape == (0,)
    assert VisualMap().odometry_poses() == []


def test_followable_points_are_gathered_anew_whenever_the_map_changed() -> None:
    visual_map = chain(4)
    points, anchors = visual_map.followable(2)
    assert visual_map.followable(2)[0] is points  # nothing changed
    assert set(anchors) == {0, 1, 2, 3} and set(points.main_node.tolist()) == {2, 3}
    up = Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    for node in (3, 0):  # one that points come from, and one that is only an anchor
        visual_map.graph.set_pose(node, up @ visual_map.graph.pose(node))
        moved, now = visual_map.followable(2)
        assert moved is not points
        assert_same(now[node].world_from_cam, visual_map.graph.pose(node))
        points = moved
    visual_map.rescale(2.0)
    scaled, _ = visual_map.followable(2)
    np.testing.assert_allclose(scaled.world, 2.0 * points.world)
    visual_map.add_node(node_of(visual_map, 4), pose_of(4))
    assert set(visual_map.followable(2)[0].main_node.tolist()) == {3, 4}
