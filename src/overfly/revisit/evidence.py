"""Evidence of many views for where a piece of the map lies against the others.

Over ground that repeats itself a view fits at many places: one tile further it still finds half of its
inliers. All of these are kept as hypotheses, followed from view to view by the odometry between them, and
compared with each other on the same features of the same views: those whose ground both say that the map
holds. Under the true one features fit, and look more alike, than under any other, wherever the ground is not
quite the same; two false ones win and lose about equally often, however often one of them is seen.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit

from overfly.geometry.poses import Pose
from overfly.revisit.descriptors import comparable
from overfly.revisit.index import PlaceIndex
from overfly.revisit.pool import Expectation, Pool
from overfly.revisit.region import ground_places, on_ground
from overfly.revisit.verification import (
    SAME_PLACE_PX,
    Query,
    Verifier,
    pool_of_nodes,
    surroundings_at,
)
from overfly.types import BoolArray, Float32Array, IntArray, NotFound
from overfly.vision.features.interface import Metric
from overfly.vision.matching import compare_kernel
from overfly.vision.odometry import Located
from overfly.visual_map import VisualMap

MOST_VIEWS = 8  # newest ones that count
MOST_HYPOTHESES = 12
NEW_PER_VIEW = 4
REACH_PX = 12.0  # in a picture 320 wide: how far odometry may be off from one view to the next
ALIKE_PX = 4.0  # the same: where the feature of an older node has to be to be compared
BESIDE = 1.0  # of the flying height: nodes nearer than that see some of the same ground

# What it takes to believe a hypothesis; measured: see docs/revisit.md.
LEAST_SHARED = 0.3  # of a view's features, whose ground the map holds under both hypotheses
FEWEST_VIEWS = 4
FEWEST_DECIDED = 100  # features that fit under one of two hypotheses alone
FEWEST_RIVALS = 5
LARGEST_SHARE = 0.57  # of the features that speak for it, so many at most may speak for a rival
LEAST_FIT = 1.0 / 3.0  # of the features whose ground the map holds


@dataclass(frozen=True, slots=True, eq=False)
class Support:
    """What one view, n features, says of a hypothesis.

    held (n,): features whose ground nodes of the other piece show; fits (n,): inliers; distance (n,): to the
    most similar descriptor that is seen there, inf for none. located: None where it does not fit.
    """

    held: BoolArray
    fits: BoolArray
    distance: Float32Array
    located: Located | None


@dataclass(slots=True, eq=False)
class Hypothesis:
    """A place of the other piece against this one: what views, by their node, say of it, oldest first."""

    piece: int
    support: dict[int, Support] = field(default_factory=dict)

    @property
    def inliers(self) -> int:
        return sum(int(support.fits.sum()) for support in self.support.values())


@dataclass(frozen=True, slots=True)
class Believed:
    """A hypothesis that no other can match: the view that shows it best, of this node."""

    node: int
    query: Query
    located: Located


class Evidence:
    """Collects hypotheses and what the newest views of one piece say of them."""

    def __init__(self, visual_map: VisualMap, index: PlaceIndex, verifier: Verifier) -> None:
        self._map = visual_map
        self._index = index
        self._verifier = verifier
        self._px_scale = verifier.px_scale
        self._views: dict[int, Query] = {}
        self._hypotheses: list[Hypothesis] = []

    def clear(self) -> None:
        """Forget all: the pieces changed."""
        self._views.clear()
        self._hypotheses.clear()

    def add(self, node: int, query: Query, places: list[Located]) -> None:
        """One more view, of a new node, and the places of other pieces that it fits."""
        pieces = self._map.pieces()
        if any(pieces[view] != pieces[node] for view in self._views):
            self.clear()
        if not self._hypotheses and not places:
            return
        self._views[node] = query
        for hypothesis in self._hypotheses:
            self._follow(hypothesis, node)
        self._drop_doubles(node)
        for place in places[:NEW_PER_VIEW]:
            if not any(self._agree(hypothesis, node, place.pose) for hypothesis in self._hypotheses):
                self._hypotheses.append(self._begin(int(pieces[place.main_node]), node, place.pose))
        self._forget()

    def believed(self, least_apart: float) -> Believed | None:
        """The hypothesis that wins against all others, where enough of them were seen as often.

        least_apart: flying heights between the views that have to show it.
        """
        if not self._hypotheses:
            return None
        best = max(self._hypotheses, key=lambda hypothesis: hypothesis.inliers)
        seen = [node for node, support in best.support.items() if support.located is not None]
        if len(seen) < FEWEST_VIEWS or not self._are_apart(seen, least_apart):
            return None
        if best.inliers < LEAST_FIT * sum(int(best.support[node].held.sum()) for node in seen):
            return None
        shares = [
            share
            for other in self._hypotheses
            if other is not best and (share := share_of_rival(best.support, other.support)) is not None
        ]
        if len(shares) < FEWEST_RIVALS or max(shares) > LARGEST_SHARE:
            return None
        node = max(seen, key=lambda view: int(best.support[view].fits.sum()))
        located = best.support[node].located
        assert located is not None
        return Believed(node, self._views[node], located)

    # -- hypotheses

    def _begin(self, piece: int, node: int, pose: Pose) -> Hypothesis:
        """A new hypothesis, judged by all views, from the newest back."""
        hypothesis = Hypothesis(piece)
        self._judge(hypothesis, node, pose)
        for view in sorted(self._views, reverse=True)[1:]:
            self._follow(hypothesis, view)
        hypothesis.support = dict(sorted(hypothesis.support.items()))
        return hypothesis

    def _follow(self, hypothesis: Hypothesis, node: int) -> None:
        """Judge the hypothesis by the view of a node, from the nearest view that it fits."""
        located = {
            view: support.located.pose
            for view, support in hypothesis.support.items()
            if support.located is not None
        }
        if not located:
            return
        graph = self._map.graph
        view = min(located, key=lambda other: abs(other - node))
        self._judge(hypothesis, node, located[view] @ graph.pose(view).inverse() @ graph.pose(node))

    def _judge(self, hypothesis: Hypothesis, node: int, pose: Pose) -> None:
        """Register the view of a node where the hypothesis puts it: world_from_cam."""
        query = self._views[node]
        nodes = self._nodes_beside(hypothesis.piece, node, pose)
        held = self._held(node, pose, nodes)
        if held.mean() < LEAST_SHARED:
            return
        pool = pool_of_nodes(self._map, nodes, self._verifier.extractor.metric)
        expected = Expectation(pose, np.full(len(pool.points), REACH_PX * self._px_scale))
        change = self._verifier.registrar.config.registration.height_change
        around = surroundings_at(self._map, nodes, change)
        located, _ = self._verifier.register(query, pool, expected, around)
        fits, distance = np.zeros(len(held), np.bool_), np.full(len(held), np.inf, np.float32)
        if isinstance(located, Located):
            fits[located.matches.correspondences.frame_index[located.estimate.inliers]] = True
            distance = self._distances(query, pool, located.pose)
        found = None if isinstance(located, NotFound) else located
        hypothesis.support[node] = Support(held, fits, distance, found)

    def _nodes_beside(self, piece: int, node: int, pose: Pose) -> IntArray:
        """Nodes of the piece nearest to where the pose looks."""
        known = np.flatnonzero(self._map.pieces()[: len(self._index)] == piece)
        heights = np.array([self._index.height(int(one)) for one in known])
        height = self._index.height(node)
        apart = np.linalg.norm(
            ground_places(self._map.graph, known, heights) - on_ground(pose, height), axis=1
        )
        nearest = np.argsort(apart, kind="stable")[: self._verifier.settings.group]
        return np.asarray(known[nearest[apart[nearest] < BESIDE * height]])

    def _held(self, node: int, pose: Pose, nodes: IntArray) -> BoolArray:
        """(n,) features of a node whose ground the others show, were it seen from the pose."""
        points = pose.transform(self._map.nodes[node].points_in_cam)
        camera = self._verifier.camera
        held = np.zeros(len(points), np.bool_)
        for other in nodes:
            px = camera.project(self._map.graph.pose(int(other)).inverse().transform(points))
            held |= ((px >= 0) & (px < (camera.width, camera.height))).all(axis=1)
        return held

    def _distances(self, query: Query, pool: Pool, pose: Pose) -> Float32Array:
        metric = self._verifier.extractor.metric
        words = comparable(query.features.descriptors, metric)
        px = query.features.px.astype(np.float64)
        distance = np.full(len(px), np.inf, np.float32)
        seen = self._verifier.camera.project(pose.inverse().transform(pool.points))
        _lower(distance, words, px, pool.words, seen, ALIKE_PX * self._px_scale)
        limit = self._verifier.extractor.max_distance
        limit = limit if metric is Metric.HAMMING else limit**2
        distance[distance > limit] = np.inf
        return distance

    # -- which are kept

    def _drop_doubles(self, node: int) -> None:
        """Of hypotheses that have become one, keep that with most inliers."""
        kept: list[Hypothesis] = []
        for hypothesis in sorted(self._hypotheses, key=lambda one: -one.inliers):
            support = hypothesis.support.get(node)
            if (
                support is None
                or support.located is None
                or not any(self._agree(other, node, support.located.pose) for other in kept)
            ):
                kept.append(hypothesis)
        self._hypotheses = kept

    def _agree(self, hypothesis: Hypothesis, node: int, pose: Pose) -> bool:
        """Whether the hypothesis puts the view of a node at this pose."""
        support = hypothesis.support.get(node)
        if support is None or support.located is None:
            return False
        height = self._index.height(node)
        limit = SAME_PLACE_PX * self._px_scale / self._verifier.camera.focal_px * height
        apart = on_ground(support.located.pose, height) - on_ground(pose, height)
        return float(np.linalg.norm(apart)) <= limit

    def _forget(self) -> None:
        """Keep the newest views and the hypotheses that they fit best."""
        for view in sorted(self._views)[:-MOST_VIEWS]:
            del self._views[view]
            for hypothesis in self._hypotheses:
                hypothesis.support.pop(view, None)
        alive = [hypothesis for hypothesis in self._hypotheses if hypothesis.inliers > 0]
        self._hypotheses = sorted(alive, key=lambda one: -one.inliers)[:MOST_HYPOTHESES]

    def _are_apart(self, nodes: list[int], least_apart: float) -> bool:
        heights = np.array([self._index.height(node) for node in nodes])
        places = ground_places(self._map.graph, np.array(nodes), heights)
        return bool(np.linalg.norm(places - places[0], axis=1).max() >= least_apart * heights[0])


def share_of_rival(best: dict[int, Support], other: dict[int, Support]) -> float | None:
    """Features that speak for another hypothesis as a share of those that speak for the best one, over the
    views and the ground that both have; None where that is too little to tell.

    A feature speaks for the hypothesis under which alone it fits, and for that under which it finds the more
    similar descriptor.
    """
    for_best, for_other, decided, views = 0, 0, 0, 0
    for node in best.keys() & other.keys():
        one, two = best[node], other[node]
        both = one.held & two.held
        if both.mean() < LEAST_SHARED or not (one.fits.any() or two.fits.any()):
            continue
        alone, other_alone = (
            int((both & one.fits & ~two.fits).sum()),
            int((both & two.fits & ~one.fits).sum()),
        )
        views, decided = views + 1, decided + alone + other_alone
        for_best += alone + int((both & (one.distance < two.distance)).sum())
        for_other += other_alone + int((both & (two.distance < one.distance)).sum())
    if views < FEWEST_VIEWS - 1 or decided < FEWEST_DECIDED:
        return None
    return for_other / max(for_best, 1)


@njit(cache=True, nogil=True)
def _lower(distance, a, px_a, b, px_b, radius):  # type: ignore[no-untyped-def]
    """Lower each distance to that of the most similar of b within the radius of a's place, in the unit that
    kernels compare in."""
    for i in range(len(a)):
        for j in range(len(b)):
            off = (px_a[i, 0] - px_b[j, 0]) ** 2 + (px_a[i, 1] - px_b[j, 1]) ** 2
            if off <= radius**2:
                distance[i] = min(distance[i], compare_kernel(a, i, b, j))
