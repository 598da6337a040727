"""Orientation and description of SURF features (Bay et al. 2008, sections 4.1, 4.2) on integral images."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from overfly.types import Float32Array

DESCRIPTOR_LENGTH = 64
ANGLE_BINS = 72  # of 5 degrees; the sliding window of 60 degrees covers 12


def orient(integral: np.ndarray, px: Float32Array, sigma_px: Float32Array) -> Float32Array:
    """Angles (n,) of the strongest sum of Haar responses in any window of 60 degrees, within six sigma of
    each feature.

    integral (H+1, W+1) int32; px (n, 2); sigma_px (n,).
    """
    return np.asarray(_orient(integral, px, sigma_px, _CIRCLE))


def describe(
    integral: np.ndarray, px: Float32Array, sigma_px: Float32Array, angle_rad: Float32Array
) -> Float32Array:
    """Descriptors (n, 64) of length 1: sums of gradients and of their absolute values over 4 x 4 parts of 5
    sigma.

    Where the box-filter Laplacian is negative, the sums of absolute values are negated.
    """
    return np.asarray(_describe(integral, px, sigma_px, angle_rad, _WEIGHTS))


def _circle() -> Float32Array:
    """Rows (dx, dy, weight) of the samples within six sigma, Gaussian of 2.5 sigma."""
    steps = np.arange(-6, 7)
    rows = [
        (x, y, math.exp(-(x * x + y * y) / (2.0 * 2.5**2)))
        for y in steps
        for x in steps
        if x * x + y * y < 36
    ]
    return np.array(rows, np.float32)


def _weights() -> Float32Array:
    """(20, 20) Gaussian of 3.3 sigma over the patch's samples."""
    along = np.exp(-((np.arange(20) - 9.5) ** 2) / (2.0 * 3.3**2))
    return np.outer(along, along).astype(np.float32)


_CIRCLE, _WEIGHTS = _circle(), _weights()


@njit(cache=True, nogil=True)
def _box(integral, left, top, right, bottom):  # type: ignore[no-untyped-def]
    """Sum over columns left..right-1 and rows top..bottom-1, as far as they are in the picture."""
    rows, columns = integral.shape[0] - 1, integral.shape[1] - 1
    left, right = min(max(left, 0), columns), min(max(right, 0), columns)
    top, bottom = min(max(top, 0), rows), min(max(bottom, 0), rows)
    lower = np.int32(integral[bottom, right] - integral[bottom, left])
    return np.int32(lower - np.int32(integral[top, right] - integral[top, left]))


@njit(cache=True, nogil=True)
def _angle_bin(x, y):  # type: ignore[no-untyped-def]
    """Bin of the direction (x, y); the arc tangent by a cubic good to 0.3 degrees, as bins are 5 wide."""
    across, along = abs(y), abs(x)
    ratio = min(across, along) / max(across, along)
    angle = ratio * (np.float32(0.9724) - np.float32(0.1919) * ratio * ratio)
    if across > along:
        angle = np.float32(0.5 * math.pi) - angle
    if x < 0:
        angle = np.float32(math.pi) - angle
    if y < 0:
        angle = np.float32(2.0 * math.pi) - angle
    return int(angle * np.float32(ANGLE_BINS / (2.0 * math.pi))) % ANGLE_BINS


@njit(cache=True, nogil=True)
def _orient(integral, px, sigma_px, circle):  # type: ignore[no-untyped-def]
    angles = np.empty(len(px), np.float32)
    along_x, along_y = np.empty(ANGLE_BINS, np.float32), np.empty(ANGLE_BINS, np.float32)
    for n in range(len(px)):
        # Boundaries between pixels are counted as the integral image does: pixel p reaches from p to p + 1.
        x, y, s = px[n, 0] + np.float32(0.5), px[n, 1] + np.float32(0.5), sigma_px[n]
        reach = max(1, math.floor(np.float32(2.0) * s + np.float32(0.5)))
        along_x[:], along_y[:] = 0.0, 0.0
        for k in range(len(circle)):
            u = math.floor(x + circle[k, 0] * s + np.float32(0.5))
            v = math.floor(y + circle[k, 1] * s + np.float32(0.5))
            left, top, right, bottom = u - reach, v - reach, u + reach, v + reach
            if left < 0 or top < 0 or right >= integral.shape[1] or bottom >= integral.shape[0]:
                continue
            whole = _box(integral, left, top, right, bottom)
            gx = circle[k, 2] * np.float32(whole - 2 * _box(integral, left, top, u, bottom))
            gy = circle[k, 2] * np.float32(whole - 2 * _box(integral, left, top, right, v))
            if gx != 0.0 or gy != 0.0:
                which = _angle_bin(gx, gy)
                along_x[which] += gx
                along_y[which] += gy
        angles[n] = _strongest_window(along_x, along_y)
    return angles


@njit(cache=True, nogil=True)
def _strongest_window(along_x, along_y):  # type: ignore[no-untyped-def]
    """Direction of the longest sum of vectors over any 12 neighbouring bins."""
    window = ANGLE_BINS // 6
    x, y = along_x[:window].sum(), along_y[:window].sum()
    best, best_x, best_y = np.float32(-1.0), x, y
    for k in range(ANGLE_BINS):
        length = x * x + y * y
        if length > best:
            best, best_x, best_y = length, x, y
        entering = (k + window) % ANGLE_BINS
        x += along_x[entering] - along_x[k]
        y += along_y[entering] - along_y[k]
    return math.atan2(best_y, best_x)


@njit(cache=True, nogil=True)
def _sample_patch(integral, x, y, sigma, angle, patch):  # type: ignore[no-untyped-def]
    """patch (21, 21): means of boxes one sigma wide on a turned lattice one sigma apart; borders continue."""
    height, width = integral.shape[0] - 1, integral.shape[1] - 1
    c, s = np.float32(math.cos(angle)) * sigma, np.float32(math.sin(angle)) * sigma
    side = min(max(2, math.floor(sigma + 0.5)), height, width)
    # From the box's middle to its first pixel, less one half for rounding. Boxes between pixels,
    # interpolated, were measured to give 6 % more correct matches for twice the time.
    back = np.float32(0.5 * (side - 1) - 0.5)
    mean = np.float32(1.0 / (side * side))
    for i in range(21):
        u, v = np.float32(-10.0), np.float32(i - 10)
        column, row = x + u * c - v * s - back, y + u * s + v * c - back
        for j in range(21):
            left = min(max(math.floor(column), 0), width - side)
            top = min(max(math.floor(row), 0), height - side)
            lower = np.int32(integral[top + side, left + side] - integral[top + side, left])
            upper = np.int32(integral[top, left + side] - integral[top, left])
            patch[i, j] = mean * np.float32(np.int32(lower - upper))
            column += c
            row += s


@njit(cache=True, nogil=True)
def _laplacian_sign(integral, x, y, sigma):  # type: ignore[no-untyped-def]
    """Sign of the sum of the two box-filter second derivatives at the feature's own scale."""
    lobe = 2 * max(1, math.floor(sigma * 1.25 + 0.5)) - 1  # a third of the filter's side 7.5 sigma, made odd
    half, middle = (3 * lobe) // 2, lobe // 2
    u, v = math.floor(x + 0.5), math.floor(y + 0.5)
    xx = _box(integral, u - half, v - lobe + 1, u + half + 1, v + lobe)
    xx -= 3 * _box(integral, u - middle, v - lobe + 1, u + middle + 1, v + lobe)
    yy = _box(integral, u - lobe + 1, v - half, u + lobe, v + half + 1)
    yy -= 3 * _box(integral, u - lobe + 1, v - middle, u + lobe, v + middle + 1)
    return np.float32(1.0) if xx + yy >= 0 else np.float32(-1.0)


@njit(cache=True, nogil=True)
def _describe(integral, px, sigma_px, angle_rad, weights):  # type: ignore[no-untyped-def]
    descriptors = np.empty((len(px), DESCRIPTOR_LENGTH), np.float32)
    patch = np.empty((21, 21), np.float32)
    for n in range(len(px)):
        _sample_patch(integral, px[n, 0], px[n, 1], sigma_px[n], angle_rad[n], patch)
        sign = _laplacian_sign(integral, px[n, 0], px[n, 1], sigma_px[n])
        out = descriptors[n]
        square = np.float32(0.0)
        for part in range(16):
            row, column = 5 * (part // 4), 5 * (part % 4)
            sx, sy, ax, ay = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for i in range(row, row + 5):
                for j in range(column, column + 5):
                    # Haar wavelets of side two sigma along the patch's own axes.
                    falling = patch[i + 1, j + 1] - patch[i, j]
                    rising = patch[i, j + 1] - patch[i + 1, j]
                    gx, gy = weights[i, j] * (falling + rising), weights[i, j] * (falling - rising)
                    sx += gx
                    sy += gy
                    ax += abs(gx)
                    ay += abs(gy)
            out[4 * part], out[4 * part + 1], out[4 * part + 2], out[4 * part + 3] = (
                sx,
                sy,
                sign * ax,
                sign * ay,
            )
            square += sx * sx + sy * sy + ax * ax + ay * ay
        if square > 0.0:
            scale = np.float32(1.0 / math.sqrt(square))
            for k in range(DESCRIPTOR_LENGTH):
                out[k] *= scale
    return descriptors
