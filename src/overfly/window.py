"""Windowed refinement: the last nodes and the points they share are adjusted together each time a node is
added.

The constraints between them are then those of the adjusted poses, with the adjustment's covariance. Older
nodes that share points with the window take part, held fixed, so that the window fits on to what was mapped
before.
"""

from __future__ import annotations

import math

import numpy as np

from overfly.config import WindowSettings
from overfly.geometry.poses import FloatArray, Pose
from overfly.revisit.drift import drift_covariance, map_bend
from overfly.types import BoolArray, IntArray
from overfly.vision.bundle import BundleProblem, BundleSolution, adjust
from overfly.vision.odometry import information_of_constraint
from overfly.visual_map import Node, VisualMap

OUTLIER_SIGMAS = 5.0
FEWEST_SHARED = 8  # tracks that an older node must share to take part
LEAST_RELIEF = 0.003  # of the flying height: no ground is flatter than that
LARGEST_RELIEF = 0.10
# Relief is alike over a good part of a view: so many patches of it are independent, and all points
# together say no more about the plane than these would.
PATCHES_PER_NODE = 2


def adjust_window(
    visual_map: VisualMap, settings: WindowSettings, inverse_depth_sigma: float, relief: float | None
) -> float | None:
    """Adjust the newest nodes in place. inverse_depth_sigma: of measured inverse depths, 1/m.

    relief: standard deviation of the ground about the plane z = 0 as a share of the height, or None where
    depth is measured. Returns the relief seen after the adjustment (robust standard deviation of the points'
    z), None if nothing was adjusted.
    """
    free = _together(visual_map, visual_map.newest(settings.nodes))
    nodes = _older_neighbours(visual_map, free, settings.fixed_nodes) + free
    if len(nodes) < 2:
        return None
    is_free = np.arange(len(nodes)) >= len(nodes) - len(free)
    point, which_node, which_row = _shared_points(nodes)
    if len(point) < FEWEST_SHARED:
        return None
    problem = _problem(
        visual_map,
        nodes,
        is_free,
        which_node,
        which_row,
        point,
        int(point.max()) + 1,
        inverse_depth_sigma,
        relief,
    )
    solution = adjust(problem)
    if solution is None:
        return None
    _write_back(visual_map, nodes, problem, solution, which_row)
    _detach_outliers(visual_map, nodes, problem, solution, which_row)
    _renew_constraints(visual_map, nodes, is_free, solution)
    return _relief_seen(solution)


def _relief_seen(solution: BundleSolution) -> float:
    """Standard deviation of the ground about its own level.

    Of the points found, and of what they still leave open: one step of expectation maximisation. Without the
    second part a flatness that was assumed would confirm itself.
    """
    z = solution.points[:, 2]
    scatter = 1.4826 * float(np.median(np.abs(z - np.median(z))))
    return math.hypot(scatter, math.sqrt(float(np.median(solution.point_covariance[:, 2, 2]))))


def _together(visual_map: VisualMap, newest: list[Node]) -> list[Node]:
    """Those of the newest nodes, oldest first, that odometry ties to the last one by way of the others.

    The camera may have gone elsewhere over known ground in between, or a gap be bridged: what has no point in
    common with the fixed nodes would float.
    """
    parent_of = {node.index: -1 if visual_map.is_bridged(node) else node.parent for node in newest}
    tied = {newest[-1].index}
    while (parent := parent_of[min(tied)]) in parent_of:
        tied.add(parent)
    for node in newest:
        if parent_of[node.index] in tied:
            tied.add(node.index)
    return [node for node in newest if node.index in tied]


def _older_neighbours(visual_map: VisualMap, free: list[Node], count: int) -> list[Node]:
    """The newest nodes before the window that share tracks with it, oldest first."""
    seen = np.unique(np.concatenate([node.tracks for node in free]))
    found: list[Node] = []
    candidates = dict.fromkeys(
        [node.parent for node in free if 0 <= node.parent < free[0].index]
        + list(range(free[0].index - 1, max(-1, free[0].index - 1 - 2 * count), -1))
    )
    for index in candidates:
        if len(found) == count:
            break
        node = visual_map.nodes[index]
        if np.isin(node.tracks, seen, assume_unique=True).sum() >= FEWEST_SHARED:
            found.append(node)
    return sorted(found, key=lambda node: node.index)


def _shared_points(nodes: list[Node]) -> tuple[IntArray, IntArray, IntArray]:
    """Observations of points seen from at least two of the nodes: number of the point in the order of its
    track, place of the node in the list, feature row.
    """
    tracks = np.concatenate([node.tracks for node in nodes])
    which_node = np.concatenate([np.full(len(node.tracks), place) for place, node in enumerate(nodes)])
    which_row = np.concatenate([np.arange(len(node.tracks)) for node in nodes])
    known = np.concatenate([node.has_point & np.isfinite(node.rays[:, 0]) for node in nodes])
    tracks, which_node, which_row = tracks[known], which_node[known], which_row[known]
    _, inverse, counts = np.unique(tracks, return_inverse=True, return_counts=True)
    shared = counts >= 2
    rows = np.flatnonzero(shared[inverse])
    return (np.cumsum(shared) - 1)[inverse[rows]], which_node[rows], which_row[rows]


def _problem(
    visual_map: VisualMap,
    nodes: list[Node],
    is_free: BoolArray,
    which_node: IntArray,
    which_row: IntArray,
    point: IntArray,
    n_points: int,
    inverse_depth_sigma: float,
    relief: float | None,
) -> BundleProblem:
    poses = [visual_map.graph.pose(node.index) for node in nodes]
    world = [pose.transform(node.points_in_cam) for pose, node in zip(poses, nodes, strict=True)]
    first = np.cumsum([0, *(len(node.rays) for node in nodes[:-1])])
    seen = first[which_node] + which_row  # rows in all nodes' features one after the other
    rays = np.concatenate([node.rays for node in nodes])[seen]
    ray_sigma = np.concatenate([node.ray_sigma for node in nodes])[seen]
    inverse_depth = np.concatenate([node.inverse_depth for node in nodes])[seen]
    points = np.empty((n_points, 3))
    points[point] = np.concatenate(world)[seen]  # in the order of time: the newest estimate of a point stays
    return BundleProblem(
        np.array([pose.rotation for pose in poses]),
        np.array([pose.translation for pose in poses]),
        is_free,
        points,
        which_node,
        point,
        rays,
        ray_sigma,
        inverse_depth,
        inverse_depth_sigma,
        np.array([node.tilt.level_from_cam for node in nodes]),
        np.array([node.tilt.sigma_rad for node in nodes]),
        np.array([node.height.z_m if node.height else 0.0 for node in nodes]),
        np.array([node.height.sigma_m if node.height else math.inf for node in nodes]),
        math.inf
        if relief is None
        else relief * math.sqrt(max(1.0, n_points / (PATCHES_PER_NODE * len(nodes)))),
        0 if is_free.all() else -1,
    )


def _write_back(
    visual_map: VisualMap,
    nodes: list[Node],
    problem: BundleProblem,
    solution: BundleSolution,
    which_row: IntArray,
) -> None:
    """Poses to the graph; points, with their depth's standard deviation, to the nodes that see them."""
    for place, (node, pose) in enumerate(zip(nodes, solution.poses, strict=True)):
        if not problem.free[place]:
            continue
        visual_map.graph.set_pose(node.index, pose)
        mine = problem.node == place
        rows, of_point = which_row[mine], problem.point[mine]
        node.points_in_cam[rows] = pose.inverse().transform(solution.points[of_point])
        along = pose.rotation[:, 2]
        variance = solution.point_covariance[of_point] @ along @ along
        node.depth_sigma_m[rows] = np.sqrt(np.maximum(variance, 0.0))


def _detach_outliers(
    visual_map: VisualMap,
    nodes: list[Node],
    problem: BundleProblem,
    solution: BundleSolution,
    which_row: IntArray,
) -> None:
    """Observations that do not fit their point become points of their own."""
    wrong = np.flatnonzero(solution.residual > OUTLIER_SIGMAS)
    tracks = visual_map.new_tracks(len(wrong))
    for place in np.unique(problem.node[wrong]):
        mine = problem.node[wrong] == place
        nodes[place].tracks[which_row[wrong[mine]]] = tracks[mine]


def _renew_constraints(
    visual_map: VisualMap, nodes: list[Node], is_free: BoolArray, solution: BundleSolution
) -> None:
    """The odometry constraints inside the window become the adjusted relative poses with their covariance."""
    place_of = {node.index: place for place, node in enumerate(nodes)}
    slot = np.cumsum(is_free) - 1
    bend = map_bend(visual_map)
    for place, node in enumerate(nodes):
        parent = place_of.get(node.parent)
        if node.constraint < 0 or parent is None or not is_free[place]:
            continue
        parent_from_node = solution.poses[parent].inverse() @ solution.poses[place]
        joint = [(int(slot[p]) if is_free[p] else None) for p in (parent, place)]
        covariance = _relative_covariance(solution.pose_covariance, joint, parent_from_node)
        graph = visual_map.graph
        graph.measured_positions[node.constraint] = parent_from_node.translation
        graph.measured_quaternions[node.constraint] = parent_from_node.quaternion()
        drift = drift_covariance(parent_from_node, float(solution.poses[parent].translation[2]), bend)
        graph.information[node.constraint] = information_of_constraint(covariance + drift)


def _relative_covariance(joint: FloatArray, slots: list[int | None], i_from_j: Pose) -> FloatArray:
    """Covariance (6, 6) of i_from_j under right perturbations, from the joint covariance of both poses.

    i_from_j exp(x) = exp(-x_i) i_from_j exp(x_j), hence x = x_j - Ad(j_from_i) x_i; a fixed node does not
    move.
    """
    i, j = slots
    assert j is not None
    J = np.zeros((6, 6))
    covariance = joint[6 * j : 6 * j + 6, 6 * j : 6 * j + 6].copy()
    if i is not None:
        J = -i_from_j.inverse().adjoint()
        cross = joint[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
        covariance += J @ joint[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] @ J.T + J @ cross + cross.T @ J.T
    covariance = 0.5 * (covariance + covariance.T)
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.maximum(values, 1e-14)) @ vectors.T)
