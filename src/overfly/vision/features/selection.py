"""Which of many candidate features to keep: the strongest, but spread over the image and over the octaves."""

from __future__ import annotations

import numpy as np
from numba import njit

from overfly.types import Float32Array, IntArray

# Candidates with less than this part of the contrast of the count-th strongest are noise beside it.
CONTRAST_FLOOR = 0.1
FEATURES_PER_CELL = 8  # a lower number spreads better, a higher one keeps stronger features


def select_spread(
    px: Float32Array,
    octave: IntArray,
    response: Float32Array,
    shape: tuple[int, int],
    count: int,
    contrast_power: int,
) -> IntArray:
    """Indices of at most ``count`` of n candidates, in the order they were chosen (strong and well spread
    first).

    px (n, 2) pixels; octave (n,) >= 0; response (n,), larger is better, growing with this power of image
    contrast; shape (H, W) of the image.
    Each octave has a grid of its own whose cells double their area from octave to octave, as the features of
    natural images do. In every round each cell of each octave gives its best candidate not chosen yet, so no
    part of the image and no scale is crowded out, and what an empty cell cannot give goes to the others.
    """
    if len(px) == 0:
        return np.empty(0, np.int64)
    order = np.argsort(-response, kind="stable")
    strength = response[order]
    floor = strength[min(count, len(strength)) - 1] * CONTRAST_FLOOR**contrast_power
    order = order[: np.searchsorted(-strength, -floor, side="right")]
    # The cells of all octaves together: twice those of the first.
    side = float(np.sqrt(shape[0] * shape[1] * 2.0 * FEATURES_PER_CELL / count))
    rounds = _rounds(px[order], octave[order].astype(np.int64), shape[0], shape[1], side)
    return np.asarray(order[np.argsort(rounds, kind="stable")[:count]], dtype=np.int64)


@njit(cache=True, nogil=True)
def _rounds(px, octave, height, width, side):  # type: ignore[no-untyped-def]
    """For candidates sorted by falling response: how many better ones share its cell and octave."""
    octaves = octave.max() + 1
    start = np.zeros(octaves + 1, np.int64)
    columns = np.zeros(octaves, np.int64)
    rows = np.zeros(octaves, np.int64)
    for o in range(octaves):
        cell = side * 2.0 ** (0.5 * o)
        columns[o] = max(1, round(width / cell))
        rows[o] = max(1, round(height / cell))
        start[o + 1] = start[o] + columns[o] * rows[o]
    taken = np.zeros(start[octaves], np.int64)
    rounds = np.empty(len(px), np.int64)
    for n in range(len(px)):
        o = octave[n]
        column = min(columns[o] - 1, max(0, int(px[n, 0] * columns[o] / width)))
        row = min(rows[o] - 1, max(0, int(px[n, 1] * rows[o] / height)))
        cell_index = start[o] + row * columns[o] + column
        rounds[n] = taken[cell_index]
        taken[cell_index] += 1
    return rounds
