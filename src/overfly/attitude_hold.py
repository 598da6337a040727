"""The attitude sensor holds the finished map: roll and pitch of every node as absolute constraints.

From node to node the picture knows the tilt an order better than the sensor, so the sensor hardly shows
while flying. Over a long flight the small errors of the picture add up, and those of the sensor do not: half
a degree of white noise is a twentieth of a degree over a hundred nodes. Then the sensor says what is level.
"""

from __future__ import annotations

import math

from overfly.geometry.levelling import split_yaw, world_from_cam_rotation
from overfly.geometry.poses import FloatArray
from overfly.graph.batch import Start, optimise_batch
from overfly.visual_map import VisualMap

# A sensor's bias, and how a body hangs that has no sensor, change slowly: errors within so many seconds
# count as one.
CORRELATION_S = 10.0
NS_PER_S = 1e9


def hold_attitude(visual_map: VisualMap, body_from_cam: FloatArray) -> None:
    """Give every node that has none yet its measured roll and pitch, and optimise the graph with them.

    body_from_cam: (3, 3) mounting of the first camera.
    """
    graph = visual_map.graph
    held = set(graph.attitude_priors[0].tolist())
    for node in visual_map.nodes:
        if node.index in held:
            continue
        spacing_s = math.inf
        if node.parent >= 0:
            spacing_s = abs(node.t_ns - visual_map.nodes[node.index - 1].t_ns) / NS_PER_S
        alike = math.sqrt(max(1.0, CORRELATION_S / max(spacing_s, 1e-3)))
        yaw, _ = split_yaw(graph.pose(node.index).rotation, body_from_cam)
        measured = world_from_cam_rotation(yaw, node.tilt.level_from_cam)
        graph.add_prior_attitude(node.index, measured, alike * node.tilt.sigma_rad)
    if len(graph) > 1 and graph.n_constraints:
        optimise_batch(graph, start=Start.GIVEN)
