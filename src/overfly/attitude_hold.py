"""The attitude sensor holds the finished map: roll and pitch of every node as absolute constraints.

From node to node the picture knows the tilt an order better than the sensor, so the sensor hardly shows
while flying. Over a long flight the small errors of the picture add up, and those of the sensor do not: half
a degree of white noise is a twentieth of a degree over a hundred nodes. Then the sensor says what is level.
"""

from __future__ import annotations

import math

import numpy as np

from overfly.geometry.levelling import split_yaw, world_from_cam_rotation
from overfly.geometry.poses import FloatArray
from overfly.graph.batch import Start, optimise_batch
from overfly.visual_map import VisualMap

# A sensor's bias, and how a body hangs that has no sensor, change slowly: errors within so many seconds
# count as one, at most.
CORRELATION_S = 10.0
FEWEST_DIFFERENCES = 10  # that tell how slowly
LARGEST_SHARE = 9.0  # of a squared difference in what white noise has: more is an outlier
MEDIAN_SQUARE = 0.4549  # median of chi-squared of one degree of freedom
NS_PER_S = 1e9


def hold_attitude(visual_map: VisualMap, body_from_cam: FloatArray) -> None:
    """Give every node that has none yet its measured roll and pitch, and optimise the graph with them.

    body_from_cam: (3, 3) mounting of the first camera.
    """
    graph = visual_map.graph
    held = set(graph.attitude_priors[0].tolist())
    deviations = tilt_deviations(visual_map)
    for node in visual_map.nodes:
        if node.index in held:
            continue
        yaw, _ = split_yaw(graph.pose(node.index).rotation, body_from_cam)
        measured = world_from_cam_rotation(yaw, node.tilt.level_from_cam)
        graph.add_prior_attitude(node.index, measured, float(deviations[node.index]))
    if len(graph) > 1 and graph.n_constraints:
        optimise_batch(graph, start=Start.GIVEN)


def tilt_deviations(visual_map: VisualMap) -> FloatArray:
    """(n,) radians: standard deviations of the nodes' roll and pitch, so large that those of neighbours in
    time, which err alike, together say no more than one of them would.

    How alike they err shows in their differences, since from node to node the picture knows the tilt far
    better: white noise of deviation s differs by sqrt(2) s, a slow error hardly. As many independent
    measurements as a first-order process with that correlation has are believed.
    """
    sigma = np.array([node.tilt.sigma_rad for node in visual_map.nodes])
    up = np.array([visual_map.graph.pose(node.index).rotation[2] for node in visual_map.nodes])
    level = np.array([node.tilt.level_from_cam for node in visual_map.nodes])
    tilt = np.einsum("nij,nj->ni", level, up)[:, :2]
    follows = np.array([node.parent >= 0 for node in visual_map.nodes])[1:]
    t_ns = np.array([node.t_ns for node in visual_map.nodes], np.float64)
    spacing_s = np.append(math.inf, np.where(follows, np.abs(np.diff(t_ns)) / NS_PER_S, math.inf))
    slowest = np.maximum(1.0, CORRELATION_S / np.maximum(spacing_s, 1e-3))
    if follows.sum() < FEWEST_DIFFERENCES:
        return np.asarray(sigma * np.sqrt(slowest))
    share = (np.diff(tilt, axis=0) / sigma[1:, None])[follows] ** 2 / 2.0  # 1 of white noise
    independent = min(max(float(np.mean(np.minimum(share, LARGEST_SHARE))), 1e-6), 1.0)
    alike = np.minimum((2.0 - independent) / independent, slowest)
    noisier = max(1.0, float(np.median(share)) / MEDIAN_SQUARE)
    return np.asarray(sigma * np.sqrt(np.maximum(alike, 1.0) * noisier))
