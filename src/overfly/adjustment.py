"""The finish of a map: all its poses and all points that they share, adjusted together.

While flying, a node is adjusted with its neighbours in time, and a place seen again ties two nodes by one
constraint. Here every two nodes that look at the same ground are compared once more, and all that was seen
decides together. How exact each kind of measurement is, is learnt from what it leaves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from overfly.adjustment_report import AdjustmentReport
from overfly.attitude_hold import tilt_deviations
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose, rotation_from_quaternion
from overfly.graph.points import adjust_points
from overfly.graph.points_influence import correlated_covariance
from overfly.graph.points_jackknife import jackknife_covariance
from overfly.graph.points_problem import PointProblem, PointSolution
from overfly.graph.points_relative import anchors, left_by_odometry, parts, relative_poses, tied_nodes
from overfly.graph.pose_graph import PoseGraph
from overfly.graph.shape import ground_sigma, shape_covariance, some_of
from overfly.gyroscope import Gyroscope, noise_density, turns_between
from overfly.map_points import Comparison, Observations, Tie, observe, shared
from overfly.range_offset import RangeOffset, RangeReadings, find_range_offset
from overfly.self_calibration import EXPECTED_SIGMA, camera_unknowns, with_changes
from overfly.types import IntArray
from overfly.vision.refine import HeightPrior
from overfly.visual_map import VisualMap

NO_HEIGHT = HeightPrior(0.0, math.inf)
OUTLIER_SIGMAS = 4.0
ROUNDS = 4  # of solving, learning the deviations and leaving outliers out
NODES_PER_PATCH = 10  # hills are wider than a view: flat ground is believed once for so many nodes
FIRST_RELIEF, LEAST_RELIEF = 0.1, 0.003  # of the height: until the ground is seen, and at least
MEDIAN_LENGTH = 1.1774  # median length of a two-dimensional residual of deviation 1
MEDIAN_SIZE = 0.6745  # and of a one-dimensional one
LARGEST_FACTOR = 5.0  # a deviation is at most so many times larger or smaller than it was thought
NOISELESS_DRIFT = 0.25  # of odometry's deviations: from calibration, relief, a level that is askew
ANY_SIZE = 10.0  # deviation of a logarithm: relative poses of a map without measured depth say no size
LEVEL_SIGMA_M = 30.0  # of GPS above the map's zero: altitudes of consumers' receivers, and the ground's
BIAS_SHARE = 0.5  # of an attitude sensor's deviation: what it may be off by all the time


@dataclass(frozen=True, slots=True, eq=False)
class Positions:
    """Where other sensors say that cameras are: node (k,), position (k, 3) and sigma (k, 3), metres, world.

    give_metre: the map has no better source of scale than these.
    """

    node: IntArray
    position: FloatArray
    sigma: FloatArray
    give_metre: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Instruments:
    """What measured the map. inverse_depth_sigma: of measured inverse depths, 1/m; measures_depth: whether
    there are such; else the ground is taken to be rather flat. refine_camera: find its calibration, too.
    """

    comparison: Comparison
    inverse_depth_sigma: float
    measures_depth: bool
    refine_camera: bool = False
    ranges: RangeReadings | None = None
    gyroscope: Gyroscope | None = None


@dataclass(slots=True, eq=False)
class _Estimate:
    """Poses of all nodes, places of all points by identity, and how exact the measurements were found to be:
    factors (3,) on the deviations by tie, and on those of inverse depths; relief as a share of the height;
    changes (5,) of the camera; range_offset: of the range sensor, where it shows; gyro_density: of the
    gyroscope's noise, rad/s/sqrt(Hz), infinite until it is known; grown: as a multiple of the map.
    """

    rotations: FloatArray
    translations: FloatArray
    points: FloatArray
    relief: float
    factors: FloatArray = field(default_factory=lambda: np.ones(len(Tie)))
    depth_factor: float = 1.0
    changes: FloatArray = field(default_factory=lambda: np.zeros(len(EXPECTED_SIGMA)))
    range_offset: RangeOffset | None = None
    gyro_density: float = math.inf
    grown: float = 1.0


def adjust_map(
    visual_map: VisualMap, instruments: Instruments, positions: Positions | None = None
) -> AdjustmentReport | None:
    """Adjust the map in place; None when there is nothing to adjust."""
    if len(visual_map) < 2:
        return None
    seen, joined = observe(visual_map, instruments.comparison)
    if len(seen) == 0:
        return None
    estimate = _present(visual_map, seen, instruments, positions)
    tied = np.zeros(0, np.int64) if instruments.refine_camera else tied_nodes(visual_map.graph)
    iterations = 0
    while True:
        nodes = np.unique(np.concatenate([seen.node, tied]))
        problem = _problem(visual_map, seen, nodes, estimate, instruments, positions)
        solution = adjust_points(problem)
        if solution is None:
            return None
        iterations += 1
        estimate.rotations[nodes], estimate.translations[nodes] = solution.rotations, solution.translations
        estimate.points[np.unique(seen.point)] = solution.points
        if instruments.refine_camera:
            estimate.changes = solution.shared
        if iterations == ROUNDS:
            break
        _learn(estimate, seen, problem, solution, instruments)
        _learn_range(instruments.ranges, nodes, ground_heights(seen, nodes, estimate.points), estimate)
        seen = _without_outliers(seen, problem, solution)
        if len(seen) == 0:
            return None
    some = some_of(len(nodes))
    covariance = jackknife_covariance(problem, solution, some)
    if positions is None and not instruments.measures_depth:
        ground_m = ground_heights(seen, nodes, estimate.points)
        if instruments.ranges is None:
            metre = _metre(problem.height, problem.height_sigma, solution.translations[:, 2] - ground_m)
        else:
            metre = _metre(*_ranges_and_heights(instruments.ranges, nodes, ground_m, estimate))
        solution = _multiplied(solution, metre)
        lengths = np.tile([metre, metre, metre, 1.0, 1.0, 1.0], len(some))
        covariance = covariance * np.outer(lengths, lengths)
        estimate.rotations[nodes], estimate.translations[nodes] = solution.rotations, solution.translations
    growth = 1.0 if instruments.measures_depth else _growth(visual_map, seen, problem, solution)
    if growth != 1.0:
        visual_map.rescale(growth, heights_are_measured=True)
    if instruments.refine_camera:
        _see_anew(visual_map, with_changes(instruments.comparison.camera, estimate.changes))
    _write_back(visual_map, seen, nodes, estimate, solution)
    focal_px = instruments.comparison.camera.focal_px
    rms = math.sqrt(float(np.mean((solution.error * problem.sigma)[solution.error < OUTLIER_SIGMAS] ** 2)))
    sigmas = tuple(
        float(np.median(problem.sigma[seen.tie == tie])) * focal_px if (seen.tie == tie).any() else math.nan
        for tie in Tie
    )
    ground_m = ground_heights(seen, nodes, estimate.points)
    shape = nodes[some], solution.rotations[some], solution.translations[some], covariance, ground_m[some]
    return AdjustmentReport(
        len(nodes), len(solution.points), len(seen), joined, rms * focal_px, solution.iterations, sigmas,
        (float(solution.tilt_bias[0]), float(solution.tilt_bias[1])), estimate.relief,
        solution.shared, correlated_covariance(problem, solution), growth,
        ground_sigma(len(visual_map), *shape), shape_covariance(*shape),
        _odometry_variance(visual_map.graph, estimate), estimate.range_offset, estimate.gyro_density,
    )  # fmt: skip


def _odometry_variance(graph: PoseGraph, estimate: _Estimate) -> float:
    """Of odometry's constraints, as a part of what their covariances say: they err as much more or less than
    expected as their points do, and no less than they differ from the adjusted map, which knows better."""
    as_points = float(estimate.factors[Tie.FOLLOWED]) ** 2 + NOISELESS_DRIFT**2
    return max(as_points, left_by_odometry(graph))


def _present(
    visual_map: VisualMap, seen: Observations, instruments: Instruments, positions: Positions | None
) -> _Estimate:
    """Poses as the graph has them, in the metre of the heights that hold it: by more than some per cent the
    solver does not find it. Of a point the newest place that a node gives it.
    """
    poses = [visual_map.graph.pose(node.index) for node in visual_map.nodes]
    points = np.full((int(seen.point.max()) + 1, 3), np.nan)
    for index in np.unique(seen.node).tolist():
        mine = seen.node == index
        in_cam = visual_map.nodes[index].points_in_cam[seen.row[mine]]
        points[seen.point[mine]] = poses[index].transform(in_cam)
    translations = np.array([pose.translation for pose in poses])
    metre = 1.0
    if positions is None and not instruments.measures_depth:
        heights = [node.height or NO_HEIGHT for node in visual_map.nodes]
        height, sigma = np.array([(one.z_m, one.sigma_m) for one in heights]).T
        metre = _metre(height, sigma, translations[:, 2])
    return _Estimate(
        np.array([pose.rotation for pose in poses]),
        metre * translations,
        metre * points,
        math.inf if instruments.measures_depth else FIRST_RELIEF,
        grown=metre,
    )


def _problem(
    visual_map: VisualMap, seen: Observations, nodes: IntArray, estimate: _Estimate,
    instruments: Instruments, positions: Positions | None,
) -> PointProblem:  # fmt: skip
    points, begins = np.unique(seen.point, return_index=True)
    members = [visual_map.nodes[int(index)] for index in nodes]
    heights = [node.height or NO_HEIGHT for node in members]
    height, height_sigma = np.array([(one.z_m, one.sigma_m) for one in heights]).T
    if estimate.range_offset is not None:
        height -= estimate.range_offset.offset_m
    position, position_sigma = np.zeros((len(nodes), 3)), np.full((len(nodes), 3), math.inf)
    if positions is not None:
        _, place, which = np.intersect1d(nodes, positions.node, return_indices=True)
        position[place], position_sigma[place] = positions.position[which], positions.sigma[which]
        if positions.give_metre:
            height_sigma[[node.parent < 0 for node in members]] = math.inf
    n_patches = max(1.0, len(nodes) / NODES_PER_PATCH)
    # With another camera than they were found with, relative poses would be others.
    relative = None if instruments.refine_camera else relative_poses(visual_map.graph, nodes)
    node = np.searchsorted(nodes, seen.node)
    tilt_sigma = tilt_deviations(visual_map)[nodes]
    part = parts(len(nodes), node, np.searchsorted(points, seen.point), relative)
    turns = None
    if instruments.gyroscope is not None:
        t_ns = np.array([member.t_ns for member in members])
        turns = turns_between(instruments.gyroscope, t_ns, part, estimate.gyro_density)
    return PointProblem(
        estimate.rotations[nodes],
        estimate.translations[nodes],
        anchors(part, np.isfinite(position_sigma[:, 0])),
        estimate.points[points],
        np.append(begins, len(seen)),
        node,
        seen.rays,
        seen.sigma * estimate.factors[seen.tie],
        seen.inverse_depth,
        instruments.inverse_depth_sigma * estimate.depth_factor,
        np.array([member.tilt.level_from_cam for member in members]),
        tilt_sigma,
        height,
        height_sigma,
        position,
        position_sigma,
        estimate.relief * math.sqrt(max(1.0, len(points) / n_patches)),
        BIAS_SHARE * float(np.median([member.tilt.sigma_rad for member in members])),
        0.0 if instruments.measures_depth or relative is None else ANY_SIZE,
        0.0 if positions is None else LEVEL_SIGMA_M,
        camera_unknowns(visual_map, seen, instruments.comparison.camera, estimate.changes)
        if instruments.refine_camera
        else None,
        relative,
        turns,
    )


def ground_heights(seen: Observations, nodes: IntArray, points: FloatArray) -> FloatArray:
    """(n,) height of the ground under nodes (n,), median of the points (m, 3) that each sees; between nodes
    that see some for one that sees none.
    """
    order = np.argsort(seen.node, kind="stable")
    z = points[seen.point[order], 2]
    seeing, begins = np.unique(seen.node[order], return_index=True)
    ground = [float(np.median(of_node)) for of_node in np.split(z, begins[1:])]
    return np.interp(nodes, seeing, ground)


def _metre(height: FloatArray, sigma: FloatArray, above: FloatArray) -> float:
    """What makes a map one in the metre of its heights (n,) with deviations (n,), infinite for none; above
    (n,): its own. What a range sensor measures, and what the first height was given above, is over the ground
    under the node; while solving it is over the level of zero.

    The size of the map is free otherwise, so that nothing else changes. Weighted median, for echoes.
    """
    known = np.isfinite(sigma) & (above > 0) & (height > 0)
    if not known.any():
        return 1.0
    ratio = height[known] / above[known]
    order = np.argsort(ratio)
    weight = np.cumsum((height[known] / sigma[known])[order] ** 2)
    return float(ratio[order][np.searchsorted(weight, 0.5 * weight[-1])])


def _multiplied(solution: PointSolution, factor: float) -> PointSolution:
    return replace(
        solution, translations=solution.translations * factor, points=solution.points * factor,
        point_covariance=solution.point_covariance * factor**2,
    )  # fmt: skip


def _growth(
    visual_map: VisualMap, seen: Observations, problem: PointProblem, solution: PointSolution
) -> float:
    """How much larger the solution is than the map: median ratio of the depths of points. What takes no part
    in the adjustment (points of one node, constraints, frames) has to grow with the rest.
    """
    before = np.empty(len(seen))
    for index in np.unique(seen.node).tolist():
        mine = seen.node == index
        before[mine] = visual_map.nodes[index].points_in_cam[seen.row[mine], 2]
    ratio = _depths(problem, solution) / before
    known = np.isfinite(ratio) & (ratio > 0)
    return float(np.median(ratio[known])) if known.any() else 1.0


def _see_anew(visual_map: VisualMap, camera: Camera) -> None:
    """All features seen by another camera: their rays turn, their points keep their depths."""
    for node in visual_map.nodes:
        node.rays = camera.rays_from_pixels(node.features.px)
        depth = node.points_in_cam[:, 2:]
        node.points_in_cam = np.hstack([node.rays * depth, depth])


def _learn(
    estimate: _Estimate, seen: Observations, problem: PointProblem, solution: PointSolution,
    instruments: Instruments,
) -> None:  # fmt: skip
    """How exact the measurements are, from what they leave: of a point with v views, 3 of 2 v numbers are
    used up by its place.
    """
    views = np.repeat(np.diff(problem.starts), np.diff(problem.starts))
    for tie in Tie:
        mine = seen.tie == tie
        if mine.any():
            redundancy = float(np.mean(1.0 - 1.5 / views[mine]))
            found = float(np.median(solution.error[mine])) / MEDIAN_LENGTH / math.sqrt(redundancy)
            estimate.factors[tie] = _limited(estimate.factors[tie] * found)
    left = _depth_residuals(problem, solution)
    if np.isfinite(left).any():
        estimate.depth_factor = _limited(
            estimate.depth_factor * float(np.nanmedian(np.abs(left))) / MEDIAN_SIZE
        )
    if problem.turns is not None and math.isinf(estimate.gyro_density):
        estimate.gyro_density = noise_density(problem.turns, solution.rotations)
    if not instruments.measures_depth:
        z = solution.points[:, 2]
        scatter = float(np.median(np.abs(z - np.median(z)))) / MEDIAN_SIZE
        height = float(np.median(solution.translations[:, 2]))
        estimate.relief = min(max(scatter / height, LEAST_RELIEF), FIRST_RELIEF)


def _learn_range(
    ranges: RangeReadings | None, nodes: IntArray, ground_m: FloatArray, estimate: _Estimate
) -> None:
    """What the range sensor reads too much, against heights above the ground (n,) under the nodes (n,)."""
    if ranges is None:
        return
    estimate.range_offset = None
    found = find_range_offset(*_ranges_and_heights(ranges, nodes, ground_m, estimate))
    estimate.range_offset = found if found is not None and found.is_significant else None


def _ranges_and_heights(
    ranges: RangeReadings, nodes: IntArray, ground_m: FloatArray, estimate: _Estimate
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Heights that the range sensor read, less its offset, their deviations, and those of the poses above
    the ground (n,) under the nodes (n,); each (k,), of all frames: nodes are too few to average its noise.
    """
    ground = np.full(len(estimate.translations), math.nan)
    ground[nodes] = ground_m
    offset_m = 0.0 if estimate.range_offset is None else estimate.range_offset.offset_m
    above = ranges.above(ground, estimate.rotations, estimate.translations, estimate.grown)
    return ranges.height_m - offset_m, ranges.sigma_m, above


def _limited(factor: float) -> float:
    return min(max(factor, 1.0 / LARGEST_FACTOR), LARGEST_FACTOR)


def _depth_residuals(problem: PointProblem, solution: PointSolution) -> FloatArray:
    """(k,) residuals of measured inverse depths in standard deviations, NaN where there are none."""
    z = _depths(problem, solution)
    return np.asarray((1.0 / z - problem.inverse_depth) / problem.inverse_depth_sigma)


def _depths(problem: PointProblem, solution: PointSolution) -> FloatArray:
    """(k,) of the observed points along the optical axes of the cameras that observe them, metres."""
    which = np.repeat(np.arange(len(solution.points)), np.diff(problem.starts))
    away = solution.points[which] - solution.translations[problem.node]
    return np.asarray(np.einsum("ki,ki->k", away, solution.rotations[problem.node][:, :, 2]))


def _without_outliers(seen: Observations, problem: PointProblem, solution: PointSolution) -> Observations:
    """Observations that fit; inverse depths that do not fit are left out."""
    far = np.abs(_depth_residuals(problem, solution)) > OUTLIER_SIGMAS
    kept = replace(seen, inverse_depth=np.where(far, np.nan, seen.inverse_depth))
    return shared(kept.at(np.flatnonzero(solution.error < OUTLIER_SIGMAS)))


def _write_back(
    visual_map: VisualMap, seen: Observations, nodes: IntArray, estimate: _Estimate, solution: PointSolution
) -> None:
    """Poses to the graph, nodes that took no part following their parents; followed points, with their
    depth's standard deviation, to the nodes that see them.
    """
    graph = visual_map.graph
    before = [graph.pose(index) for index in range(len(visual_map))]
    took_part = np.zeros(len(visual_map), np.bool_)
    took_part[nodes] = True
    for node in visual_map.nodes:
        index = node.index
        if took_part[index]:
            pose = Pose(estimate.rotations[index], estimate.translations[index])
            graph.set_pose(index, Pose(rotation_from_quaternion(pose.quaternion()), pose.translation))
        elif node.parent >= 0:
            moved = graph.pose(node.parent) @ before[node.parent].inverse()
            graph.set_pose(index, moved @ before[index])
    which = np.searchsorted(np.unique(seen.point), seen.point)
    own = seen.tie != Tie.JOINED
    for index in nodes.tolist():
        mine = np.flatnonzero((seen.node == index) & own)
        row, of_point = seen.row[mine], which[mine]
        pose, node = graph.pose(index), visual_map.nodes[index]
        # New arrays: that is how a map file that is kept knows what to write again.
        node.points_in_cam, node.depth_sigma_m = node.points_in_cam.copy(), node.depth_sigma_m.copy()
        node.points_in_cam[row] = pose.inverse().transform(solution.points[of_point])
        along = pose.rotation[:, 2]
        variance = solution.point_covariance[of_point] @ along @ along
        node.depth_sigma_m[row] = np.sqrt(np.maximum(variance, 0.0))
