"""Pairs of features whose descriptors are each other's nearest: everywhere, or near where they are expected.

Matches come sorted by descriptor distance, the order that the pair search of the paper's Eq. 2 wants.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from overfly.geometry.poses import FloatArray
from overfly.types import Float32Array, IntArray, UInt8Array
from overfly.vision.features.interface import Metric

Descriptors = UInt8Array | Float32Array
Matches = tuple[IntArray, IntArray, FloatArray]
# For each feature of a the nearest of b, its distance and that of the second; for each of b the nearest of a.
Nearest = tuple[IntArray, Float32Array, Float32Array, IntArray]

NO_RATIO = np.inf
WORDS = np.dtype(np.uint64)  # of binary descriptors as the kernels compare them


def match_mutual(
    a: Descriptors, b: Descriptors, metric: Metric, max_distance: float, max_ratio: float = NO_RATIO
) -> Matches:
    """Mutual nearest neighbours of descriptors (n_a, d) and (n_b, d): (index_a, index_b, distance).

    All three are (m,), sorted by distance in the metric's unit (bits, or Euclidean), equal ones by index_a;
    of equally near neighbours the first counts. Kept are distances up to ``max_distance`` and up to
    ``max_ratio`` times the distance of the second nearest in b (Lowe 2004). Raises ValueError when the
    descriptors do not fit each other or the metric.
    """
    _check(a, b, metric)
    if len(a) == 0 or len(b) == 0:
        return _no_matches()
    found = _nearest(_comparable(a, metric), np.ascontiguousarray(_comparable(b, metric).T))
    return _mutual(found, metric, max_distance, max_ratio)


def match_guided(
    a: Descriptors,
    b: Descriptors,
    metric: Metric,
    max_distance: float,
    predicted_px: Float32Array | FloatArray,
    px_b: Float32Array | FloatArray,
    radius_px: float | FloatArray,
    max_ratio: float = NO_RATIO,
) -> Matches:
    """As :func:`match_mutual`, but comparing only features of b that lie near the prediction of one of a.

    predicted_px (n_a, 2): where the features of a should appear in the image of b, in pixels, NaN where they
    cannot be seen; px_b (n_b, 2): where the features of b are; radius_px: search radius, one for all or
    (n_a,). Nearest, second nearest and mutual all mean among the pairs within the radius. Raises ValueError
    as match_mutual, and for a px_b that is not finite.
    """
    _check(a, b, metric)
    if len(a) == 0 or len(b) == 0:
        return _no_matches()
    predicted = np.ascontiguousarray(predicted_px, dtype=np.float64).reshape(len(a), 2)
    px = np.ascontiguousarray(px_b, dtype=np.float64).reshape(len(b), 2)
    if not np.isfinite(px).all():
        raise ValueError("px_b holds positions that are not finite")
    # Limits far beyond any picture keep the cell arithmetic finite; a radius below zero finds nothing.
    radius = np.nan_to_num(np.broadcast_to(np.asarray(radius_px, dtype=np.float64), len(a)), nan=-1.0)
    radius = np.clip(radius, -1.0, 1e6)
    found = _nearest_guided(_comparable(a, metric), _comparable(b, metric), predicted, px, radius)
    return _mutual(found, metric, max_distance, max_ratio)


def _check(a: Descriptors, b: Descriptors, metric: Metric) -> None:
    wanted = np.uint8 if metric is Metric.HAMMING else np.float32
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[1]:
        raise ValueError(f"descriptors of shapes {a.shape} and {b.shape} cannot be compared")
    if a.dtype != wanted or b.dtype != wanted:
        raise ValueError(
            f"{metric} distance needs {wanted.__name__} descriptors, not {a.dtype} and {b.dtype}"
        )


def _words(descriptors: Descriptors) -> NDArray[np.uint64]:
    """Binary descriptors (n, bytes) as (n, words), filled up with zeros, which add no distance."""
    count, width = descriptors.shape
    padded = -(-width // 8) * 8
    if padded != width:
        wide = np.zeros((count, padded), np.uint8)
        wide[:, :width] = descriptors
        descriptors = wide
    return np.ascontiguousarray(descriptors).view(np.uint64)


def _comparable(descriptors: Descriptors, metric: Metric) -> NDArray[Any]:
    """Descriptors as the kernels compare them: words of bits, or elements."""
    return _words(descriptors) if metric is Metric.HAMMING else np.ascontiguousarray(descriptors)


def _no_matches() -> Matches:
    return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.float64)


def _mutual(found: Nearest, metric: Metric, max_distance: float, max_ratio: float) -> Matches:
    """The pairs that chose each other; Euclidean distances come in squared."""
    nearest_b, distance, second, nearest_a = found
    index_a = np.flatnonzero(nearest_b >= 0)
    index_a = index_a[nearest_a[nearest_b[index_a]] == index_a]
    best, runner_up = distance[index_a].astype(np.float64), second[index_a].astype(np.float64)
    if metric is Metric.EUCLIDEAN:
        best, runner_up = np.sqrt(best), np.sqrt(runner_up)
    keep = best <= max_distance
    if np.isfinite(max_ratio):
        keep &= best <= max_ratio * runner_up
    index_a, best = index_a[keep], best[keep]
    order = np.argsort(best, kind="stable")
    index_a = index_a[order]
    return index_a, nearest_b[index_a], best[order]


@njit(cache=True, nogil=True)
def bits_kernel(word):  # type: ignore[no-untyped-def]
    """Number of set bits of a uint64: sums over 2, 4 and 8 bits, then of the bytes; compiles to popcnt."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (word * np.uint64(0x0101010101010101)) >> np.uint64(56)


@njit(cache=True, nogil=True)
def distances_kernel(a, i, columns, row):  # type: ignore[no-untyped-def]
    """Fills row (m,) with the bits that differ between row i of a (n, d) and each of the columns (d, m), or
    with their squared Euclidean distances. For other kernels, too.

    The inner loops run along whole vectors.
    """
    row[:] = 0
    for k in range(a.shape[1]):
        value, column = a[i, k], columns[k]
        if columns.dtype == WORDS:
            for j in range(len(row)):
                row[j] += bits_kernel(np.uint64(value) ^ np.uint64(column[j]))
        else:
            for j in range(len(row)):
                difference = value - column[j]
                row[j] += difference * difference


@njit(cache=True, nogil=True)
def _nearest(a, b_columns):  # type: ignore[no-untyped-def]
    """a (n, d), b_columns (d, m): see Nearest for what is returned; Euclidean distances are squared."""
    n, m = len(a), b_columns.shape[1]
    nearest_b, distance, second = np.empty(n, np.int64), np.empty(n, np.float32), np.empty(n, np.float32)
    nearest_a, distance_b = np.full(m, -1, np.int64), np.full(m, np.inf, np.float32)
    row = np.empty(m, b_columns.dtype)
    for i in range(n):
        distances_kernel(a, i, b_columns, row)
        _take_row(i, row, nearest_b, distance, second, nearest_a, distance_b)
    return nearest_b, distance, second, nearest_a


@njit(cache=True, nogil=True)
def _take_row(i, row, nearest_b, distance, second, nearest_a, distance_b):  # type: ignore[no-untyped-def]
    """Enters the distances of feature i of a to all of b."""
    best, runner_up, best_j = np.float32(np.inf), np.float32(np.inf), -1
    for j in range(len(row)):
        d = np.float32(row[j])
        if d < runner_up:
            if d < best:
                best, runner_up, best_j = d, best, j
            else:
                runner_up = d
        if d < distance_b[j]:
            distance_b[j] = d
            nearest_a[j] = i
    nearest_b[i], distance[i], second[i] = best_j, best, runner_up


@njit(cache=True, nogil=True)
def _cell_side(px, radius):  # type: ignore[no-untyped-def]
    """About one radius, so that a search looks at nine cells, but no grid much larger than the features."""
    extent = max(np.ptp(px[:, 0]), np.ptp(px[:, 1]))
    return max(1.0, np.median(radius), extent / (1.0 + 2.0 * np.sqrt(len(px))))


@njit(cache=True, nogil=True)
def _cells_within(place, radius, cell, cells):  # type: ignore[no-untyped-def]
    """First and last of the cells along one axis that reach within the radius, (0, -1) if none does."""
    first = max(0.0, np.floor((place - radius) / cell))
    last = min(cells - 1.0, np.floor((place + radius) / cell))
    if first > last:
        return 0, -1
    return int(first), int(last)


@njit(cache=True, nogil=True)
def _buckets(px, cell):  # type: ignore[no-untyped-def]
    """Features sorted into cells: (x0, y0, columns, rows, start of each cell, features cell by cell)."""
    x0, y0 = px[:, 0].min(), px[:, 1].min()
    columns = int((px[:, 0].max() - x0) / cell) + 1
    rows = int((px[:, 1].max() - y0) / cell) + 1
    start = np.zeros(columns * rows + 1, np.int64)
    cell_of = np.empty(len(px), np.int64)
    for j in range(len(px)):
        cell_of[j] = int((px[j, 1] - y0) / cell) * columns + int((px[j, 0] - x0) / cell)
        start[cell_of[j] + 1] += 1
    start = np.cumsum(start)
    free = start[:-1].copy()
    members = np.empty(len(px), np.int64)
    for j in range(len(px)):
        members[free[cell_of[j]]] = j
        free[cell_of[j]] += 1
    return x0, y0, columns, rows, start, members


@njit(cache=True, nogil=True)
def compare_kernel(a, i, b, j):  # type: ignore[no-untyped-def]
    """Bits that differ between row i of a and row j of b, or their squared distance. For other kernels, too.

    Which of both it is, is known when this is compiled; and rows are not cut out of their arrays, which costs
    more than comparing them.
    """
    if a.dtype == WORDS:
        bits = np.uint64(0)
        for k in range(a.shape[1]):
            bits += bits_kernel(np.uint64(a[i, k]) ^ np.uint64(b[j, k]))
        return np.float32(bits)
    total = np.float32(0.0)
    for k in range(a.shape[1]):
        difference = np.float32(a[i, k]) - np.float32(b[j, k])
        total += difference * difference
    return total


@njit(cache=True, nogil=True)
def _nearest_guided(a, b, predicted, px, radius):  # type: ignore[no-untyped-def]
    """As _nearest, among pairs within the radius; -1 where there is none."""
    n, m = len(a), len(b)
    nearest_b, nearest_a = np.full(n, -1, np.int64), np.full(m, -1, np.int64)
    distance, second = np.full(n, np.inf, np.float32), np.full(n, np.inf, np.float32)
    distance_b = np.full(m, np.inf, np.float32)
    cell = _cell_side(px, radius)
    x0, y0, columns, rows, start, members = _buckets(px, cell)
    for i in range(n):
        x, y, r = predicted[i, 0], predicted[i, 1], radius[i]
        if not (np.isfinite(x) and np.isfinite(y) and r >= 0.0):
            continue
        first_column, last_column = _cells_within(x - x0, r, cell, columns)
        first_row, last_row = _cells_within(y - y0, r, cell, rows)
        for row in range(first_row, last_row + 1):
            if first_column > last_column:
                break
            for k in range(start[row * columns + first_column], start[row * columns + last_column + 1]):
                j = members[k]
                if (px[j, 0] - x) ** 2 + (px[j, 1] - y) ** 2 > r * r:
                    continue
                d = compare_kernel(a, i, b, j)
                # Cells are not visited in the order of j: of equal distances the smaller index is taken by
                # name.
                if d < distance[i] or (d == distance[i] and j < nearest_b[i]):
                    second[i], distance[i], nearest_b[i] = distance[i], d, j
                elif d < second[i]:
                    second[i] = d
                if d < distance_b[j]:
                    distance_b[j], nearest_a[j] = d, i
    return nearest_b, distance, second, nearest_a
