"""Which older nodes may show what the camera sees: by where they are, and by what they look like."""

from __future__ import annotations

import numpy as np

from overfly.config import RevisitSettings
from overfly.geometry.cameras import Camera
from overfly.revisit.descriptors import DescriptorBlocks, comparable
from overfly.revisit.region import FootprintIndex, footprint_radius, ground_places, ground_sigma, on_ground
from overfly.revisit.tree import DescriptorTrees
from overfly.revisit.uncertainty import Uncertainty
from overfly.types import Features, IntArray
from overfly.vision.features import Extractor
from overfly.visual_map import VisualMap

RELATIVE_REACH = 0.5  # of both views' radii: footprints nearer than that share about a third of their area
BESIDE = 0.7  # of the flying height: nodes nearer than that see much the same ground
LEAST_SHARE = 0.4  # of the votes of the best group, for another one to be looked at
TENDED_ROWS = 48  # descriptors that enter the trees with one frame, at least
TENDED_SHARE = 0.125  # and of those that wait: nodes in close succession do not pile up


class PlaceIndex:
    """Footprints and descriptors of the nodes that were taken in, in their order."""

    def __init__(
        self,
        visual_map: VisualMap,
        uncertainty: Uncertainty,
        camera: Camera,
        extractor: Extractor,
        settings: RevisitSettings,
    ) -> None:
        self._map = visual_map
        self._uncertainty = uncertainty
        self._camera = camera
        self._max_distance = extractor.max_distance
        self._settings = settings
        self._blocks = DescriptorBlocks(extractor.metric)
        self._trees = DescriptorTrees(extractor.metric, settings.trees)
        self._n_in_trees = 0  # rows of the blocks; the others enter little by little, or when first needed
        self._footprints = FootprintIndex()
        self._heights = np.empty(64)

    def __len__(self) -> int:
        """Nodes taken in."""
        return len(self._blocks)

    def take_in(self, count: int) -> None:
        """Take in nodes, in their order, until ``count`` are known."""
        for index in range(len(self), count):
            height = self.height(index)
            self._blocks.add(self._map.nodes[index].features)
            if index == len(self._heights):
                self._heights = np.concatenate([self._heights, np.empty(index)])
            self._heights[index] = height
            self._add_footprint(index)

    def tend(self) -> None:
        """A frame's share of the work that the newest nodes left behind: few searches need the trees."""
        waiting = self._blocks.n_features - self._n_in_trees
        self.grow_trees(max(TENDED_ROWS, int(TENDED_SHARE * waiting)))

    def grow_trees(self, most: int | None = None) -> None:
        """Enter the descriptors that are not in the trees yet, all or so many."""
        last = self._blocks.n_features
        if most is not None:
            last = min(last, self._n_in_trees + most)
        if last > self._n_in_trees:
            self._trees.insert(self._blocks.table, self._n_in_trees, last)
            self._n_in_trees = last

    def rescale(self, factor: float) -> None:
        """All lengths of the map were multiplied."""
        self._heights[: len(self)] *= factor
        self._footprints = FootprintIndex()
        for index in range(len(self)):
            self._add_footprint(index)

    def _add_footprint(self, index: int) -> None:
        pose, height = self._map.graph.pose(index), float(self._heights[index])
        sigma = ground_sigma(self._uncertainty.place(index), pose.rotation, height)
        radius = RELATIVE_REACH * footprint_radius(self._camera, height)
        self._footprints.add(on_ground(pose, height), radius, sigma)

    def height(self, index: int) -> float:
        """Metres of a node above its ground: median depth of its points."""
        if index < len(self):
            return float(self._heights[index])
        node = self._map.nodes[index]
        depth = node.points_in_cam[node.has_point, 2]
        return float(np.median(depth)) if len(depth) else float(self._map.graph.positions[index, 2])

    def follow(self, moved: IntArray) -> None:
        """Nodes moved: their footprints go with them."""
        inside = moved[moved < len(self)]
        if len(inside):
            self._footprints.move(inside, ground_places(self._map.graph, inside, self._heights[inside]))

    def near(self, index: int, wider: float = 1.0) -> IntArray:
        """Nodes taken in, nearest first, that may show the same ground as node ``index``, three sigma
        included, or so many times that."""
        pose, height = self._map.graph.pose(index), self.height(index)
        sigma = ground_sigma(self._uncertainty.place(index), pose.rotation, height)
        radius = RELATIVE_REACH * footprint_radius(self._camera, height)
        return self._footprints.within(on_ground(pose, height), radius, sigma, wider * self._settings.sigmas)

    def groups(self, features: Features, rows: IntArray, candidates: IntArray | None) -> list[IntArray]:
        """Neighbouring nodes that look like the features in some rows, best group first.

        candidates: nodes to choose from, nearest first; None: all. Few are searched exactly, many through
        the trees.
        """
        words = comparable(features.descriptors[rows], self._blocks.metric)
        if candidates is not None and len(candidates) <= self._settings.most_candidates:
            nodes = candidates
            votes = self._blocks.votes(words, candidates, self._max_distance)
        else:
            nodes, votes = self._votes_of_trees(words, candidates)
        return self._grouped(nodes[votes > 0], votes[votes > 0])

    def _votes_of_trees(self, words: np.ndarray, candidates: IntArray | None) -> tuple[IntArray, IntArray]:
        """Nodes (k,) that hold the nearest descriptors of the map, and how many (k,)."""
        if len(self) == 0 or len(words) == 0:
            return np.empty(0, np.int64), np.empty(0, np.int64)
        self.grow_trees()
        may_be = None if candidates is None else self._blocks.rows_of(candidates)
        row, distance = self._trees.nearest(self._blocks.table, words, self._settings.comparisons, may_be)
        voted = self._blocks.nodes_of(row[distance <= self._max_distance])
        nodes, votes = np.unique(voted, return_counts=True)
        return nodes, votes

    def _grouped(self, nodes: IntArray, votes: IntArray) -> list[IntArray]:
        """Greedily: the place with most votes, the nodes beside it that have most of them, then what is
        left elsewhere."""
        settings = self._settings
        places = ground_places(self._map.graph, nodes, self._heights[nodes])
        groups: list[IntArray] = []
        best_sum = 0.0
        while len(nodes) and len(groups) < settings.most_groups:
            apart = np.linalg.norm(places[:, None] - places[None], axis=2) / self._heights[nodes][:, None]
            together = (apart < BESIDE) @ votes
            middle = int(np.lexsort((-votes, -together))[0])
            if together[middle] < max(settings.least_votes, LEAST_SHARE * best_sum):
                break
            best_sum = max(best_sum, float(together[middle]))
            beside = np.flatnonzero(apart[middle] < BESIDE)
            chosen = beside[np.argsort(-votes[beside], kind="stable")][: settings.group]
            groups.append(nodes[chosen])
            rest = apart[middle] >= BESIDE
            nodes, votes, places = nodes[rest], votes[rest], places[rest]
        return groups
