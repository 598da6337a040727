"""SURF-64 (Bay, Ess, Tuytelaars, Van Gool 2008), the features of the paper, written from the description.

SURF is patented in places (US 8,165,401 and US 8,670,619 among others): using it is the user's choice, it is
never a default. The octave's step also divides the columns of the integral image into planes, so that every
inner loop runs over neighbouring numbers; beyond the description, features are spread over the image as all
of Overfly's are.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from overfly.types import Features, Float32Array, UInt8Array
from overfly.vision.features.interface import Metric, checked_image, no_features
from overfly.vision.features.peaks import find_peaks
from overfly.vision.features.selection import select_spread
from overfly.vision.features.surf_descriptor import DESCRIPTOR_LENGTH, describe, orient

FILTER_SIDES = np.array([[9, 15, 21, 27], [15, 27, 39, 51], [27, 51, 75, 99], [51, 99, 147, 195]])
SIGMA_PER_SIDE = 1.2 / 9.0  # the 9 x 9 filter stands for a Gaussian of 1.2 pixels
CONTRAST_POWER = 2  # of determinants of two derivatives
MIXED_WEIGHT = 0.9  # balances the mixed derivative's boxes against the others' (Bay et al., Eq. 4)
# As in hessian.py, what rounding to whole grey levels (variance 1/12) makes of it at the finest scale: the 9
# x 9 filter for a second derivative has 30 pixels of weight 1 and 15 of weight -2.
RESPONSE_FLOOR = 4.0 * (30.0 + 15.0 * 4.0) / 81.0**2 / 12.0


@dataclass(frozen=True, slots=True)
class Surf:
    """SURF-64; ``upright`` leaves out the orientation, for cameras that keep their heading."""

    count: int
    upright: bool = False
    metric: Metric = Metric.EUCLIDEAN
    max_distance: float = 0.3  # of descriptors of length 1

    @property
    def name(self) -> str:
        return "surf-upright" if self.upright else "surf"

    def extract(self, gray: UInt8Array) -> Features:
        """gray: (H, W) uint8 -> at most ``count`` features, best first. Raises ValueError for other arrays.

        Descriptors have length 1. Where the Laplacian is negative the sums of absolute values are negated:
        bright and dark blobs are then at least 1 apart, which is the description's comparison of the
        Laplacian's sign.
        """
        gray = checked_image(gray)
        integral = cv2.integral(gray)
        table, octave = _detect(integral)
        chosen = select_spread(table[:, :2], octave, table[:, 3], gray.shape, self.count, CONTRAST_POWER)
        if len(chosen) == 0:
            return no_features(np.empty((0, DESCRIPTOR_LENGTH), np.float32))
        px, sigma = np.ascontiguousarray(table[chosen, :2]), table[chosen, 2].copy()
        angle = np.zeros(len(px), np.float32) if self.upright else orient(integral, px, sigma)
        descriptors = describe(integral, px, sigma, angle)
        return Features(px, descriptors, 2.0 * sigma, angle, table[chosen, 3].copy())


def _detect(integral: np.ndarray) -> tuple[Float32Array, np.ndarray]:
    """integral (H+1, W+1) int32 -> candidates (n, 4): x, y, sigma in pixels, response; octaves (n,)."""
    height, width = integral.shape[0] - 1, integral.shape[1] - 1
    found = [np.empty((0, 4), np.float32)]
    for octave, sides in enumerate(FILTER_SIDES):
        if sides[2] >= min(height, width):  # no level between two others would fit into the picture
            break
        step = 2**octave
        planes = _planes(integral, step)
        responses = np.zeros((len(sides), -(-height // step), -(-width // step)), np.float32)
        for response, side in zip(responses, sides, strict=True):
            _determinant(planes, height, width, side, response)
        margins = (sides // 2) // step + 1
        candidates = find_peaks(responses, sides * (SIGMA_PER_SIDE / step), margins, RESPONSE_FLOOR)
        candidates[:, :3] *= step
        found.append(candidates)
    octaves = np.repeat(np.arange(len(found)) - 1, [len(part) for part in found])
    return np.concatenate(found), octaves


def _planes(integral: np.ndarray, step: int) -> np.ndarray:
    """(H+1, W+1) -> (step, H+1, columns): column c becomes column c // step of plane c % step."""
    if step == 1:
        return integral[None]
    rows, columns = integral.shape
    planes = np.zeros((step, rows, -(-columns // step)), np.int32)
    for k in range(step):
        part = integral[:, k::step]
        planes[k, :, : part.shape[1]] = part
    return planes


@njit(cache=True, nogil=True)
def _add_box(planes, top, bottom, left, weight, out):  # type: ignore[no-untyped-def]
    """Adds weight times the sums over rows top..bottom-1 and columns left[0]..left[1]-1, moved on by a step
    per entry.

    Differences of int32 wrap round like the integral image itself does in large pictures, and come out right.
    """
    step, n = len(planes), len(out)
    a, b = left[0] // step, left[1] // step
    upper_left = planes[left[0] % step, top, a : a + n]
    upper_right = planes[left[1] % step, top, b : b + n]
    lower_left = planes[left[0] % step, bottom, a : a + n]
    lower_right = planes[left[1] % step, bottom, b : b + n]
    for j in range(n):
        lower, upper = np.int32(lower_right[j] - lower_left[j]), np.int32(upper_right[j] - upper_left[j])
        out[j] += weight * np.int32(lower - upper)


@njit(cache=True, nogil=True)
def _determinant(planes, height, width, side, response):  # type: ignore[no-untyped-def]
    """Box-filter determinant of the Hessian at every step-th pixel where the filter of this side fits."""
    step = len(planes)
    lobe, half = side // 3, side // 2
    middle = lobe // 2
    first = (half + step - 1) // step
    last_row, last_column = (height - 1 - half) // step, (width - 1 - half) // step
    n = last_column - first + 1
    xx, yy, xy = np.empty(max(n, 0), np.int32), np.empty(max(n, 0), np.int32), np.empty(max(n, 0), np.int32)
    area = np.float32(1.0 / (side * side))
    mixed = np.float32(MIXED_WEIGHT)
    for i in range(first, last_row + 1):
        if n <= 0:
            break
        r, c = i * step, first * step
        xx[:], yy[:], xy[:] = 0, 0, 0
        _add_box(planes, r - lobe + 1, r + lobe, (c - half, c + half + 1), 1, xx)
        _add_box(planes, r - lobe + 1, r + lobe, (c - middle, c + middle + 1), -3, xx)
        _add_box(planes, r - half, r + half + 1, (c - lobe + 1, c + lobe), 1, yy)
        _add_box(planes, r - middle, r + middle + 1, (c - lobe + 1, c + lobe), -3, yy)
        _add_box(planes, r - lobe, r, (c - lobe, c), 1, xy)
        _add_box(planes, r - lobe, r, (c + 1, c + lobe + 1), -1, xy)
        _add_box(planes, r + 1, r + lobe + 1, (c - lobe, c), -1, xy)
        _add_box(planes, r + 1, r + lobe + 1, (c + 1, c + lobe + 1), 1, xy)
        out = response[i, first : last_column + 1]
        for j in range(n):
            dxx, dyy = area * np.float32(xx[j]), area * np.float32(yy[j])
            dxy = mixed * area * np.float32(xy[j])
            out[j] = dxx * dyy - dxy * dxy
