"""Blob detector: maxima of the determinant of the Hessian in a Gaussian scale space (Lindeberg 1998).

Levels are true Gaussian blurs, not boxes, and derivatives central differences of them: nothing here is
patented. Orientation is the direction of the intensity centroid (Rosin 1999), taken in the blurred octave so
that large features are not aliased.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from overfly.types import Float32Array, IntArray, UInt8Array
from overfly.vision.features.peaks import find_peaks
from overfly.vision.features.selection import select_spread

# Blur of the four levels of an octave, in its own pixels, half an octave apart; maxima are sought in the two
# inner ones, whose scales thereby cover the octaves without gaps.
LEVEL_SIGMAS = tuple(1.2 * math.sqrt(2.0) ** level for level in range(4))
CAMERA_SIGMA = 0.5  # blur that a sharp picture has from its own pixels
SMALLEST_SIDE = 24  # pixels of the shorter side of the last octave
# Square of two standard deviations of what rounding to whole grey levels (variance 1/12) makes of a
# normalised second derivative at the finest scale, 3 / (16 pi sigma^2) / 12: nothing weaker can be told from
# rounding.
RESPONSE_FLOOR = 4.0 * 3.0 / (16.0 * math.pi * LEVEL_SIGMAS[1] ** 2) / 12.0
CONTRAST_POWER = 2  # of determinants of two derivatives
CENTROID_RADIUS = 4  # samples, one sigma apart


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """n features before their description.

    px (n, 2) pixels; sigma_px (n,) scale: the blur under which the blob is strongest; angle_rad (n,) image x
    towards y; response (n,) scale-normalised determinant of the Hessian, grey levels squared.
    """

    px: Float32Array
    sigma_px: Float32Array
    angle_rad: Float32Array
    response: Float32Array


def detect_hessian(gray: UInt8Array, count: int, upright: bool = False) -> Keypoints:
    """gray: (H, W) uint8 -> at most ``count`` blobs spread over the image and its scales, best first.

    upright: leaves all angles zero.
    """
    bases, found = [], []
    sigmas = np.array(LEVEL_SIGMAS)
    # Nearer to the border than this, much of a blob is mirrored, not seen.
    margins = np.ceil(2.0 * sigmas).astype(np.int64)
    for octave, levels in enumerate(_octaves(gray)):
        responses = np.zeros((len(levels), *levels[0].shape), np.float32)
        for level, sigma in enumerate(LEVEL_SIGMAS):
            _determinant(levels[level], np.float32(sigma**4), responses[level])
        candidates = find_peaks(responses, sigmas, margins, RESPONSE_FLOOR)
        bases.append(levels[0])
        found.append(np.column_stack([candidates, np.full(len(candidates), octave, np.float32)]))
    table = np.concatenate(found) if found else np.empty((0, 5), np.float32)
    octave_of = table[:, 4].astype(np.int64)
    step = np.exp2(table[:, 4])
    chosen = select_spread(
        table[:, :2] * step[:, None], octave_of, table[:, 3], gray.shape, count, CONTRAST_POWER
    )
    table, octave_of, step = table[chosen], octave_of[chosen], step[chosen]
    return Keypoints(
        px=table[:, :2] * step[:, None],
        sigma_px=table[:, 2] * step,
        angle_rad=np.zeros(len(table), np.float32) if upright else _centroid_angles(bases, table, octave_of),
        response=np.ascontiguousarray(table[:, 3]),
    )


def _octaves(gray: UInt8Array) -> Iterator[list[Float32Array]]:
    """Yields the four blurred levels of each octave; pixel (i, j) of octave o stands at (i, j) * 2^o."""
    image = gray.astype(np.float32)
    sigma = CAMERA_SIGMA
    while min(image.shape) >= SMALLEST_SIDE:
        levels = []
        for target in LEVEL_SIGMAS:
            image = _blur(image, math.sqrt(max(0.0, target**2 - sigma**2)))
            levels.append(image)
            sigma = target
        yield levels
        image = np.ascontiguousarray(levels[2][::2, ::2])
        sigma = LEVEL_SIGMAS[2] / 2.0


def _blur(image: Float32Array, sigma: float) -> Float32Array:
    if sigma < 0.01:
        return image
    side = 2 * math.ceil(2.6 * sigma) + 1
    return np.asarray(cv2.GaussianBlur(image, (side, side), sigma, borderType=cv2.BORDER_REFLECT_101))


def _centroid_angles(bases: list[Float32Array], table: Float32Array, octave_of: IntArray) -> Float32Array:
    """Angles (n,) of the rows (x, y, sigma, ...) of table, in pixels of their octave."""
    angles = np.zeros(len(table), np.float32)
    for octave, base in enumerate(bases):
        rows = np.flatnonzero(octave_of == octave)
        if len(rows):
            angles[rows] = _centroid_angle(base, table[rows], _DISC)
    return angles


def _disc(radius: int) -> NDArray[np.float32]:
    steps = np.arange(-radius, radius + 1)
    offsets = np.array([(x, y) for y in steps for x in steps if 0 < x * x + y * y <= radius * radius])
    return offsets.astype(np.float32)


_DISC = _disc(CENTROID_RADIUS)


@njit(cache=True, nogil=True)
def _determinant(level, normalisation, out):  # type: ignore[no-untyped-def]
    """Scale-normalised determinant of the Hessian of one level; the outermost pixels stay zero."""
    height, width = level.shape
    quarter = np.float32(0.25)
    two = np.float32(2.0)
    inner = width - 2
    for i in range(1, height - 1):
        above, row, below, o = level[i - 1], level[i], level[i + 1], out[i, 1 : width - 1]
        a0, a1, a2 = above[0:inner], above[1 : width - 1], above[2:width]
        r0, r1, r2 = row[0:inner], row[1 : width - 1], row[2:width]
        b0, b1, b2 = below[0:inner], below[1 : width - 1], below[2:width]
        for j in range(inner):
            twice = two * r1[j]
            xx = r0[j] + r2[j] - twice
            yy = a1[j] + b1[j] - twice
            xy = quarter * (b2[j] - b0[j] - a2[j] + a0[j])
            o[j] = normalisation * (xx * yy - xy * xy)


@njit(cache=True, nogil=True)
def _centroid_angle(image, keypoints, offsets):  # type: ignore[no-untyped-def]
    """Direction from each keypoint (x, y, sigma, ...) to the centroid of a disc of samples one sigma apart.

    Samples are interpolated: taken from whole pixels they cost one match in twenty.
    """
    height, width = image.shape
    angles = np.empty(len(keypoints), np.float32)
    for n in range(len(keypoints)):
        x, y, sigma = keypoints[n, 0], keypoints[n, 1], keypoints[n, 2]
        moment_x = np.float32(0.0)
        moment_y = np.float32(0.0)
        for k in range(len(offsets)):
            dx, dy = offsets[k, 0], offsets[k, 1]
            u, v = x + dx * sigma, y + dy * sigma
            column, row = math.floor(u), math.floor(v)
            if column < 0 or row < 0 or column >= width - 1 or row >= height - 1:
                continue
            u -= column
            v -= row
            upper = image[row, column] + u * (image[row, column + 1] - image[row, column])
            lower = image[row + 1, column] + u * (image[row + 1, column + 1] - image[row + 1, column])
            value = upper + v * (lower - upper)
            moment_x += dx * value
            moment_y += dy * value
        angles[n] = math.atan2(moment_y, moment_x)
    return angles
