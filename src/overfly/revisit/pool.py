"""What several nodes that see one piece of ground hold, in one table, and matching it with a view:
everywhere, near where it is expected, or away from where a pose puts it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from overfly.geometry.poses import FloatArray, Pose
from overfly.revisit.descriptors import comparable
from overfly.types import Correspondences, Features, IntArray
from overfly.vision.features.interface import Metric
from overfly.vision.matching import bits_kernel
from overfly.vision.odometry import PooledMatches, Reference

NONE = np.uint64(0xFFFFFFFFFFFFFFFF)
INDEX_BITS = np.uint64(
    16
)  # of a key that holds a distance in bits and, below it, whose it is: the least is the first
EVERYWHERE = np.inf


@dataclass(frozen=True, slots=True, eq=False)
class Pool:
    """Points with a known place of some nodes, n of them, node by node.

    nodes: k of them; node (n,), row (n,): which feature of which node; points (n, 3), spread (n, 3): metres,
    world, as in Reference; words (n, w): descriptors as comparable() makes them; starts (k + 1,): where each
    node begins.
    """

    nodes: list[int]
    node: IntArray
    row: IntArray
    points: FloatArray
    spread: FloatArray
    words: NDArray[Any]
    starts: IntArray

    def of(self, values: FloatArray, number: int) -> FloatArray:
        """Those of values (n, ...) that belong to the node of this number in the pool."""
        return values[self.starts[number] : self.starts[number + 1]]


@dataclass(frozen=True, slots=True, eq=False)
class Expectation:
    """Where the points of a pool should be in the picture: world_from_cam as predicted, and radii_px (n,),
    how far from there they may be, NaN for points that cannot be seen."""

    world_from_cam: Pose
    radii_px: FloatArray


def pool_of(references: Sequence[Reference], metric: Metric) -> Pool:
    """The points of one or more nodes."""
    usable = [np.flatnonzero(np.isfinite(one.points[:, 2])) for one in references]
    counts = np.array([len(rows) for rows in usable])
    pairs = list(zip(references, usable, strict=True))
    descriptors = np.concatenate([one.features.descriptors[rows] for one, rows in pairs])
    return Pool(
        [one.node for one in references],
        np.repeat([one.node for one in references], counts),
        np.concatenate(usable),
        np.concatenate([one.points[rows] for one, rows in pairs]),
        np.concatenate([one.spread[rows] for one, rows in pairs]),
        comparable(descriptors, metric),
        np.concatenate([[0], np.cumsum(counts)]),
    )


def widest(pool: Pool, expected: Expectation) -> float:
    """Pixels that most points of a node, of the most uncertain one, may be from where they are expected."""
    reach = 0.0
    for number in range(len(pool.nodes)):
        radii = pool.of(expected.radii_px, number)
        seen = radii[np.isfinite(radii)]
        reach = max(reach, float(np.median(seen)) if len(seen) else 0.0)
    return reach


def match_pool(
    pool: Pool,
    features: Features,
    rays: FloatArray,
    metric: Metric,
    max_distance: float,
    middle_px: FloatArray | None = None,
    radii_px: FloatArray | None = None,
    not_px: FloatArray | None = None,
    exclusion_px: float = 0.0,
) -> PooledMatches:
    """Mutual nearest neighbours between each node of the pool and a view, sorted by descriptor distance in
    the metric's unit.

    features, rays (m, 2): of the view. Compared are pairs within radii_px (n,) of middle_px (n, 2), None:
    everywhere, and not within exclusion_px of not_px (n, 2), None: no such places.
    """
    n = len(pool.words)
    if middle_px is None or radii_px is None:
        middle_px, radii_px = np.zeros((n, 2)), np.full(n, EVERYWHERE)
    if not_px is None:
        not_px = np.full((n, 2), np.nan)
    px = features.px.astype(np.float64)
    order = np.argsort(px[:, 0], kind="stable")  # so that what is near a place lies together
    columns = np.ascontiguousarray(comparable(features.descriptors, metric)[order].T)
    binary = metric is Metric.HAMMING
    find = _nearest_bits if binary else _nearest_floats
    b, distance = find(
        pool.words,
        pool.starts,
        columns,
        np.ascontiguousarray(px[order].T),
        order.astype(np.uint64),
        np.ascontiguousarray(middle_px),
        np.ascontiguousarray(radii_px),
        np.ascontiguousarray(not_px),
        exclusion_px,
    )
    a = np.flatnonzero(b >= 0)
    apart = distance[a].astype(np.float64)
    apart = apart if binary else np.sqrt(apart)
    kept = (apart <= max_distance) & np.isfinite(rays[b[a], 0])
    by_distance = np.argsort(apart[kept], kind="stable")
    a, apart = a[kept][by_distance], apart[kept][by_distance]
    b = b[a]
    correspondences = Correspondences(pool.points[a], rays[b], apart, pool.row[a], b, pool.spread[a])
    return PooledMatches(correspondences, pool.node[a])


@njit(cache=True, nogil=True, inline="always")
def _window(x, radius, xs):  # type: ignore[no-untyped-def]
    """First and one past the last of the sorted xs within the radius of x."""
    if np.isinf(radius):
        return 0, len(xs)
    return np.searchsorted(xs, x - radius), np.searchsorted(xs, x + radius, side="right")


@njit(cache=True, nogil=True)
def _nearest_bits(words, starts, columns, px, order, middle, radii, away_from, exclusion):  # type: ignore[no-untyped-def]
    """For each row of words (n, w) its mutual nearest neighbour among the columns (w, m), by the original
    index that order (m,) tells, -1 where there is none, and its distance; node by node. px (2, m), sorted by
    x."""
    n, m = len(words), columns.shape[1]
    found, distance = np.full(n, -1, np.int64), np.zeros(n, np.float32)
    # All 64 bits wide, so that what is done with them runs along whole vectors.
    keys, best, best_of = np.empty(m, np.uint64), np.empty(n, np.uint64), np.empty(m, np.uint64)
    for node in range(len(starts) - 1):
        best_of[:] = NONE
        for i in range(starts[node], starts[node + 1]):
            best[i] = NONE
            x, y = middle[i, 0], middle[i, 1]
            if not (radii[i] >= 0.0 and np.isfinite(x) and np.isfinite(y)):
                continue
            first, last = _window(x, radii[i], px[0])
            near = keys[first:last]  # cut out, so that loops begin at zero: only then they are vectors
            near[:] = 0
            for k in range(len(columns)):
                word, column = words[i, k], columns[k, first:last]
                for j in range(len(near)):
                    near[j] += bits_kernel(word ^ column[j])
            _leave_out(
                near, px[0, first:last], px[1, first:last], middle[i], radii[i], away_from[i], exclusion
            )
            least, local = NONE, np.uint64(i - starts[node])
            of_columns, names = best_of[first:last], order[first:last]
            for j in range(len(near)):
                of_columns[j] = min(of_columns[j], near[j] | local)
                least = min(least, near[j] | names[j])
            best[i] = least
        _mutual(starts[node], best, best_of, order, found, distance)
    return found, distance


@njit(cache=True, nogil=True)
def _leave_out(keys, xs, ys, middle, radius, away_from, exclusion):  # type: ignore[no-untyped-def]
    """Distances become keys, those of pairs that do not count the largest."""
    x, y, far_x, far_y = middle[0], middle[1], away_from[0], away_from[1]
    radius2, exclusion2 = radius * radius, exclusion * exclusion
    for j in range(len(keys)):
        off = (xs[j] - x) * (xs[j] - x) + (ys[j] - y) * (ys[j] - y)
        near = (xs[j] - far_x) * (xs[j] - far_x) + (ys[j] - far_y) * (ys[j] - far_y)
        # Points behind the camera are near nothing.
        left_out = (off > radius2) | (near <= exclusion2)
        keys[j] = NONE if left_out else keys[j] << INDEX_BITS


@njit(cache=True, nogil=True)
def _mutual(begin, best, best_of, order, found, distance):  # type: ignore[no-untyped-def]
    """Enter those of one node that chose each other."""
    index = (np.uint64(1) << INDEX_BITS) - np.uint64(1)
    for j in range(len(best_of)):
        if best_of[j] == NONE:
            continue
        i = begin + np.int64(best_of[j] & index)
        if best[i] != NONE and (best[i] & index) == order[j]:
            found[i], distance[i] = order[j], np.float32(best[i] >> INDEX_BITS)


@njit(cache=True, nogil=True)
def _nearest_floats(words, starts, columns, px, order, middle, radii, away_from, exclusion):  # type: ignore[no-untyped-def]
    """The same for Euclidean distances, which are squared."""
    n, m = len(words), columns.shape[1]
    found, distance = np.full(n, -1, np.int64), np.full(n, np.inf, np.float32)
    apart = np.empty(m, columns.dtype)
    of_column, distance_of = np.empty(m, np.int64), np.empty(m, np.float32)
    for node in range(len(starts) - 1):
        of_column[:], distance_of[:] = -1, np.inf
        for i in range(starts[node], starts[node + 1]):
            x, y, limit = middle[i, 0], middle[i, 1], radii[i] * radii[i]
            if not (radii[i] >= 0.0 and np.isfinite(x) and np.isfinite(y)):
                continue
            first, last = _window(x, radii[i], px[0])
            near = apart[first:last]
            near[:] = 0
            for k in range(len(columns)):
                value, column = words[i, k], columns[k, first:last]
                for j in range(len(near)):
                    difference = value - column[j]
                    near[j] += difference * difference
            best = -1
            for j in range(first, last):
                off = (px[0, j] - x) ** 2 + (px[1, j] - y) ** 2
                beside = (px[0, j] - away_from[i, 0]) ** 2 + (px[1, j] - away_from[i, 1]) ** 2
                if off > limit or beside <= exclusion * exclusion:
                    continue
                d = apart[j]
                if best < 0 or d < distance[i] or (d == distance[i] and order[j] < order[best]):
                    best, distance[i] = j, d
                if d < distance_of[j]:
                    of_column[j], distance_of[j] = i, d
            found[i] = best
        for i in range(starts[node], starts[node + 1]):
            j = found[i]
            if j >= 0:
                found[i] = order[j] if of_column[j] == i else -1
    return found, distance
