"""Which points of the whole map are seen from where: followed from node to node, and found again in others.

A followed point is one point with many views, exact to a tenth of a pixel against each other. Two
descriptions that match across the map say less: that two rays meet, to the half pixel that a description is
worth. So each set of matching descriptions is a point of its own beside the followed ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray
from overfly.types import BoolArray, IntArray
from overfly.vision.common_points import common_points
from overfly.vision.features.interface import Metric
from overfly.visual_map import VisualMap

PARTNERS = 10  # other nodes that a node is compared with at most
NEAR_IN_TIME = 1  # nodes on either side of one that was chosen, which would add little to it
OVERLAP = 2.0  # in typical distances of a view's points from their middle: middles that lie nearer overlap
ENOUGH_SHARED = 60  # nodes with so many points in common already need no comparing
MOST_VIEWS = 40  # of one point that take part
FEWEST_SEEN = 15  # shared points that a node must see to take part


class Tie(IntEnum):
    """How views of a point were found to be of one point."""

    FOLLOWED = 0  # aligned patches, from node to node
    DESCRIBED = 1  # descriptions, from node to node
    JOINED = 2  # descriptions, across the map


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Who sees which point, k of them, sorted by point, then node; each point at most once from a node.

    node, row (k,): node and its feature; point (k,): identity; tie (k,): of the point; rays (k, 2) and sigma
    (k,): undistorted image coordinates and their standard deviation; inverse_depth (k,) 1/m, NaN where not
    measured.
    """

    node: IntArray
    row: IntArray
    point: IntArray
    tie: IntArray
    rays: FloatArray
    sigma: FloatArray
    inverse_depth: FloatArray

    def __len__(self) -> int:
        return len(self.node)

    def at(self, chosen: IntArray) -> Observations:
        """The observations at these places, in this order."""
        return Observations(
            self.node[chosen],
            self.row[chosen],
            self.point[chosen],
            self.tie[chosen],
            self.rays[chosen],
            self.sigma[chosen],
            self.inverse_depth[chosen],
        )


@dataclass(frozen=True, slots=True)
class Comparison:
    """What descriptions are compared with: camera of the working pictures, metric and its largest distance
    of the same point. cameras: one per node, where nodes come from several.
    """

    camera: Camera
    metric: Metric
    max_distance: float
    cameras: tuple[Camera, ...] = ()

    def camera_of(self, node: int) -> Camera:
        return self.cameras[node] if self.cameras else self.camera


def observe(visual_map: VisualMap, comparison: Comparison) -> tuple[Observations, int]:
    """All observations of points seen from several nodes, and how many pairs of nodes were joined."""
    nodes = visual_map.nodes
    counts = np.array([len(node.rays) for node in nodes])
    first = np.concatenate([[0], np.cumsum(counts)])
    rays = np.concatenate([node.rays for node in nodes])
    sigma = np.concatenate([node.ray_sigma for node in nodes])
    usable = np.concatenate([node.has_point for node in nodes]) & np.isfinite(rays).all(axis=1)
    tracks = np.concatenate([node.tracks for node in nodes])
    described = _described_sigma(visual_map)
    usable &= sigma <= described  # else put where the whole picture agrees, and seen by nobody
    is_first = np.concatenate([node.anchor == node.index for node in nodes])
    best = np.full(visual_map.n_tracks, np.inf)
    np.minimum.at(best, tracks, sigma)  # the view that the others follow is the measure, so as exact as they
    own = np.flatnonzero(usable)
    joins, joined = _joins(visual_map, first, usable, comparison)
    again, label = np.flatnonzero(joins >= 0), joins[joins >= 0]
    rows = np.concatenate([own, again])
    own_tie = np.where(best[tracks[own]] < described, Tie.FOLLOWED, Tie.DESCRIBED)
    found = Observations(
        np.repeat(np.arange(len(nodes)), counts)[rows],
        rows - np.repeat(first[:-1], counts)[rows],
        np.concatenate([tracks[own], visual_map.n_tracks + label]),
        np.concatenate([own_tie, np.full(len(again), Tie.JOINED)]),
        rays[rows],
        np.concatenate(
            [np.where(is_first[own], best[tracks[own]], sigma[own]), np.full(len(again), described)]
        ),
        np.concatenate([np.concatenate([n.inverse_depth for n in nodes])[own], np.full(len(again), np.nan)]),
    )
    return shared(found), joined


def _described_sigma(visual_map: VisualMap) -> float:
    """Deviation of a feature's ray: that of a point where it was seen first. A view of it in another node may
    be more exact, or less.
    """
    return max(float(node.ray_sigma[node.anchor == node.index].max(initial=0.0)) for node in visual_map.nodes)


def _joins(
    visual_map: VisualMap, first: IntArray, usable: BoolArray, comparison: Comparison
) -> tuple[IntArray, int]:
    """For all features of all nodes the set of matching descriptions that they belong to, -1 for none; and
    the number of pairs of nodes that have some in common.
    """
    ones, others = [], []
    for i, j in overlapping(visual_map):
        camera = comparison.camera_of(j)
        node, other = visual_map.nodes[i], visual_map.nodes[j]
        mine, theirs = usable[first[i] : first[i + 1]], usable[first[j] : first[j + 1]]
        in_other = visual_map.graph.pose(j).inverse().transform(visual_map.points_in_world(node)[mine])
        found = common_points(
            camera.project(in_other), node.features.at(mine), other.features.at(theirs), camera.width,
            comparison.metric, comparison.max_distance,
        )  # fmt: skip
        if found is not None:
            ones.append(first[i] + np.flatnonzero(mine)[found[0]])
            others.append(first[j] + np.flatnonzero(theirs)[found[1]])
    labels = np.full(first[-1], -1, np.int64)
    if ones:
        one, other_one = np.concatenate(ones), np.concatenate(others)
        links = coo_array((np.ones(len(one), np.int8), (one, other_one)), shape=(first[-1], first[-1]))
        _, component = connected_components(links, directed=False)
        rows = np.unique(np.concatenate([one, other_one]))
        rows = rows[usable[rows]]
        labels[rows] = component[rows]
    return labels, len(ones)


def overlapping(visual_map: VisualMap) -> list[tuple[int, int]]:
    """Pairs of nodes that look at the same ground and do not share many points yet, older one first.

    Only within a piece of the map: where others are against it is not known.
    """
    nodes = visual_map.nodes
    middle, reach = np.full((len(nodes), 2), np.inf), np.zeros(len(nodes))
    for node in nodes:
        seen = visual_map.points_in_world(node)[node.has_point, :2]
        if len(seen):
            middle[node.index] = np.median(seen, axis=0)
            reach[node.index] = np.median(np.linalg.norm(seen - middle[node.index], axis=1))
    piece = visual_map.pieces()
    known = np.flatnonzero(np.isfinite(middle[:, 0]))
    tree = cKDTree(middle[known])
    pairs = set()
    for i in known.tolist():
        near = known[tree.query_ball_point(middle[i], OVERLAP * reach[i])]
        near = near[np.argsort(np.linalg.norm(middle[near] - middle[i], axis=1), kind="stable")]
        partners: list[int] = []
        for j in near.tolist():
            if len(partners) == PARTNERS:
                break
            if j != i and piece[j] == piece[i] and all(abs(j - other) > NEAR_IN_TIME for other in partners):
                partners.append(j)
                pairs.add((min(i, j), max(i, j)))
    return sorted((i, j) for i, j in pairs if _in_common(visual_map, i, j) < ENOUGH_SHARED)


def _in_common(visual_map: VisualMap, i: int, j: int) -> int:
    return int(np.isin(visual_map.nodes[i].tracks, visual_map.nodes[j].tracks).sum())


def shared(found: Observations) -> Observations:
    """Those that take part: of points seen from several nodes, once from each, by nodes that see enough."""
    order = np.lexsort((found.row, found.node, found.point))
    point, node = found.point[order], found.node[order]
    twice = np.concatenate([[False], (np.diff(point) == 0) & (np.diff(node) == 0)])
    order = _thinned(order[~twice], found.point)
    while len(order):
        _, which, views = np.unique(found.point[order], return_inverse=True, return_counts=True)
        order = order[views[which] >= 2]
        _, which, seen = np.unique(found.node[order], return_inverse=True, return_counts=True)
        if (seen >= FEWEST_SEEN).all():
            break
        order = order[seen[which] >= FEWEST_SEEN]
    return found.at(order)


def _thinned(order: IntArray, point: IntArray) -> IntArray:
    """At most MOST_VIEWS of each point, spread evenly; order: places sorted by point."""
    if len(order) == 0:
        return order
    begins = np.flatnonzero(np.concatenate([[True], np.diff(point[order]) != 0]))
    counts = np.diff(np.append(begins, len(order)))
    place = np.arange(len(order)) - np.repeat(begins, counts)
    total = np.repeat(counts, counts)
    new_slot = place * MOST_VIEWS // total != (place - 1) * MOST_VIEWS // total
    return np.asarray(order[(total <= MOST_VIEWS) | (place == 0) | new_slot])
