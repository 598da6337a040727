"""Which of many points to take: some from everywhere."""

from __future__ import annotations

import numpy as np
from numba import njit

from overfly.types import Float32Array, IntArray


def spread_choice(px: Float32Array, size: tuple[int, int], count: int) -> IntArray:
    """Indices of at most about count of the positions (n, 2), evenly spread: earlier ones first in every cell
    of a grid.
    """
    if len(px) <= count:
        return np.arange(len(px))
    cell = float(np.sqrt(size[0] * size[1] / count))
    return np.asarray(_spread_choice(px, np.float32(cell), int(size[0] / cell) + 1, count))


@njit(cache=True, nogil=True)
def _spread_choice(px, cell, columns, count):  # type: ignore[no-untyped-def]
    """One from each cell, then a second one, until there are enough; of the last round the first ones."""
    n = px.shape[0]
    bucket = np.empty(n, np.int64)
    for k in range(n):
        bucket[k] = int(px[k, 1] / cell) * columns + int(px[k, 0] / cell)
    taken = np.zeros(bucket.max() + 1, np.int64)
    rank = np.empty(n, np.int64)
    of_rank = np.zeros(n + 1, np.int64)
    for k in range(n):
        rank[k] = taken[bucket[k]]
        taken[bucket[k]] += 1
        of_rank[rank[k]] += 1
    last, left = 0, count
    while of_rank[last] <= left:
        left -= of_rank[last]
        last += 1
    chosen = np.empty(count, np.int64)
    filled = 0
    for k in range(n):
        if rank[k] < last or (rank[k] == last and left > 0):
            if rank[k] == last:
                left -= 1
            chosen[filled] = k
            filled += 1
    return chosen
