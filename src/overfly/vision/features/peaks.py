"""Peaks of blob responses in position and scale, refined below the sampling."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray
from overfly.types import Float32Array, IntArray


def find_peaks(responses: Float32Array, sigmas: FloatArray, margins: IntArray, floor: float) -> Float32Array:
    """responses (levels, h, w) of one octave -> its peaks (n, 4) float32: x, y, sigma, response.

    Only the inner levels can have peaks. sigmas (levels,): scale of each level, rising, in pixels of the
    responses, which is the unit of x, y and sigma; margins (levels,): rows and columns at the borders of each
    level that are left out, at least 1; floor: what weaker responses are not looked at. Positions are those
    of the quadratic through the nine values in the level, scales that of the parabola through the three
    levels; where either peak is more than one sample away there is none. One quadratic in all three (Brown
    and Lowe 2002) was measured to be worse: mixed differences across levels half an octave apart are poor.
    """
    return np.asarray(_peaks(responses, sigmas, margins, np.float32(floor)))


@njit(cache=True, nogil=True)
def _peaks(responses, sigmas, margins, floor):  # type: ignore[no-untyped-def]
    levels, height, width = responses.shape
    found = np.empty((1024, 4), np.float32)
    marks = np.zeros(width, np.uint8)
    n = 0
    for m in range(1, levels - 1):
        finer, level, coarser = responses[m - 1], responses[m], responses[m + 1]
        for i in range(margins[m], height - margins[m]):
            _mark_peaks(level[i - 1 : i + 2], finer[i], coarser[i], floor, marks)
            for j in range(margins[m], width - margins[m]):
                if marks[j] == 0:
                    continue
                dx, dy, ds = _quadratic_peak(finer, level, coarser, i, j)
                if max(abs(dx), abs(dy), abs(ds)) > 1.0:
                    continue
                if n == len(found):
                    larger = np.empty((2 * n, 4), np.float32)
                    larger[:n] = found
                    found = larger
                found[n, 0] = j + dx
                found[n, 1] = i + dy
                side = 1 if ds > 0.0 else -1
                found[n, 2] = sigmas[m] + abs(ds) * (sigmas[m + side] - sigmas[m])
                found[n, 3] = level[i, j]
                n += 1
    return found[:n]


@njit(cache=True, nogil=True)
def _mark_peaks(rows, finer, coarser, floor, marks):  # type: ignore[no-untyped-def]
    """marks[j] = 1 where the middle one of three rows (3, w) has a peak; finer, coarser (w,): the next
    levels' rows.

    A peak is larger than its eight neighbours in the level and than its own place in the next finer and
    coarser level; asking the other sixteen neighbours too would drop features that repeat. Of equal
    neighbours the first counts.
    """
    inner = rows.shape[1] - 2
    v, left, right = rows[1, 1 : inner + 1], rows[1, 0:inner], rows[1, 2 : inner + 2]
    a0, a1, a2 = rows[0, 0:inner], rows[0, 1 : inner + 1], rows[0, 2 : inner + 2]
    b0, b1, b2 = rows[2, 0:inner], rows[2, 1 : inner + 1], rows[2, 2 : inner + 2]
    fine, coarse, out = finer[1 : inner + 1], coarser[1 : inner + 1], marks[1 : inner + 1]
    for j in range(inner):  # no branches, so that it runs on whole vectors
        above = (v[j] > a0[j]) & (v[j] > a1[j]) & (v[j] > a2[j])
        below = (v[j] >= b0[j]) & (v[j] >= b1[j]) & (v[j] >= b2[j])
        beside = (v[j] > left[j]) & (v[j] >= right[j]) & (v[j] > fine[j]) & (v[j] >= coarse[j])
        out[j] = above & below & beside & (v[j] >= floor)


@njit(cache=True, nogil=True)
def _quadratic_peak(finer, level, coarser, i, j):  # type: ignore[no-untyped-def]
    """Offset (x, y, scale) of the peak about (i, j), infinite where the values do not fall off on all
    sides."""
    v = level[i, j]
    gx = 0.5 * (level[i, j + 1] - level[i, j - 1])
    gy = 0.5 * (level[i + 1, j] - level[i - 1, j])
    gs = 0.5 * (coarser[i, j] - finer[i, j])
    xx = level[i, j + 1] + level[i, j - 1] - 2.0 * v
    yy = level[i + 1, j] + level[i - 1, j] - 2.0 * v
    ss = coarser[i, j] + finer[i, j] - 2.0 * v
    xy = 0.25 * (level[i + 1, j + 1] - level[i + 1, j - 1] - level[i - 1, j + 1] + level[i - 1, j - 1])
    determinant = xx * yy - xy * xy
    if determinant <= 0.0 or ss >= 0.0:
        return math.inf, math.inf, math.inf
    return (xy * gy - yy * gx) / determinant, (xy * gx - xx * gy) / determinant, -gs / ss
