"""The attitude sensor levels a finished map that drifted, and leaves heading and lengths alone."""

from __future__ import annotations

import math

import numpy as np
import pytest

from overfly.attitude_hold import hold_attitude
from overfly.geometry.levelling import NADIR_BODY_FROM_CAM, split_yaw
from overfly.geometry.poses import Pose, rotation_z
from overfly.types import Constraint, Features
from overfly.vision.refine import TiltPrior
from overfly.visual_map import Node, VisualMap

COUNT = 60
DRIFT_RAD = math.radians(0.05)  # of pitch, from each node to the next
SENSOR_SIGMA_RAD = math.radians(0.5)


def bare_node(index: int, tilt: TiltPrior) -> Node:
    """A node of which only its place in time and its attitude matter."""
    empty = np.zeros(0, np.float32)
    rows, numbers = np.zeros((0, 3)), np.zeros(0, np.int64)
    features = Features(np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8), empty, empty, empty)
    return Node(
        index=index,
        frame_index=index,
        t_ns=index * 10**9,
        features=features,
        rays=rows[:, :2],
        ray_sigma=rows[:, 0],
        points_in_cam=rows,
        depth_sigma_m=rows[:, 0],
        inverse_depth=rows[:, 0],
        tracks=numbers,
        anchor=numbers,
        anchor_row=numbers,
        tilt=tilt,
        height=None,
        parent=index - 1,
    )


def drifted_map(seed: int) -> VisualMap:
    """A level flight whose odometry pitches a little more at every node; the sensor is noisy, not biased."""
    rng = np.random.default_rng(seed)
    visual_map = VisualMap()
    step = Pose.exp(np.array([0.5, 0.0, 0.0, 0.0, DRIFT_RAD, 0.0]))
    information = np.diag([1e4, 1e4, 1e4, 4e6, 4e6, 4e6])
    pose = Pose(rotation_z(0.3) @ NADIR_BODY_FROM_CAM, np.array([0.0, 0.0, 2.0]))
    for index in range(COUNT):
        wrong = Pose.exp(np.concatenate([np.zeros(3), rng.normal(0.0, SENSOR_SIGMA_RAD, 2), [0.0]]))
        tilt = TiltPrior(NADIR_BODY_FROM_CAM @ wrong.rotation, SENSOR_SIGMA_RAD)
        visual_map.add_node(bare_node(index, tilt), pose)
        if index:
            visual_map.graph.add_constraint(Constraint(index - 1, index, step, information))
        pose = pose @ step
    return visual_map


def tilts_rad(visual_map: VisualMap) -> np.ndarray:
    """(n,) angle of each node's view against straight down."""
    down = [visual_map.graph.pose(node.index).rotation[2, 2] for node in visual_map.nodes]
    return np.arccos(np.clip(-np.array(down), -1.0, 1.0))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_drifted_map_becomes_level(seed: int) -> None:
    visual_map = drifted_map(seed)
    before = tilts_rad(visual_map)
    assert before.max() > math.radians(2.5)
    hold_attitude(visual_map, NADIR_BODY_FROM_CAM)
    after = tilts_rad(visual_map)
    assert np.sqrt(np.mean(after**2)) < 0.4 * np.sqrt(np.mean(before**2))
    assert after.max() > 0.0  # it is still noisy: the sensor is not taken as truth


def test_heading_and_path_length_stay() -> None:
    visual_map = drifted_map(4)
    hold_attitude(visual_map, NADIR_BODY_FROM_CAM)
    yaws = [
        split_yaw(visual_map.graph.pose(n.index).rotation, NADIR_BODY_FROM_CAM)[0] for n in visual_map.nodes
    ]
    np.testing.assert_allclose(yaws, yaws[0], atol=math.radians(1.0))
    steps = np.linalg.norm(np.diff(visual_map.graph.positions, axis=0), axis=1)
    np.testing.assert_allclose(steps, 0.5, rtol=0.02)


def test_each_node_is_held_once() -> None:
    visual_map = drifted_map(5)
    hold_attitude(visual_map, NADIR_BODY_FROM_CAM)
    hold_attitude(visual_map, NADIR_BODY_FROM_CAM)
    assert sorted(visual_map.graph.attitude_priors[0]) == list(range(COUNT))
