"""Where the ground about a map point is in the current picture, to a tenth of a pixel.

The patch about the point, as an earlier node saw it, is warped into the geometry of the current view and then
shifted until it fits, by inverse compositional Gauss-Newton with brightness and contrast taken out (Baker and
Matthews 2004, "Lucas-Kanade 20 years on"; Forster et al. 2014, "SVO", section IV-B).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray
from overfly.types import BoolArray, IntArray, UInt8Array

HALF_PX = 4  # patches are 9 x 9
SIDE = 2 * HALF_PX + 1
PATCH_SPREAD_PX2 = (
    HALF_PX * (HALF_PX + 1) / 3.0
)  # mean square of a patch's columns about its middle, and rows
MAX_ITERATIONS = 10
CONVERGED_PX = 0.01
LARGEST_SHIFT_PX = 4.0  # per pyramid level
LEAST_CORRELATION = 0.75
LEVELS = 3
MOST_REFERENCES = 8  # pyramids that patches are aligned with at a time
SMALLEST_SCALE = 0.2  # of the warp; below it a patch would shrink to nothing
NOISELESS_SIGMA_PX = 0.1  # what lens, relief and warp leave where noise does not matter
# Patches are off by so many times what their fit says: interpolation smooths the noise that it sees, a
# video's noise is smooth itself, and the first patch has its own.
PATCH_NOISE = 2.0
REORDERED = {"reassoc", "contract"}  # sums may be regrouped; NaN keeps its meaning


Pyramid = tuple[UInt8Array, ...]


@dataclass(frozen=True, slots=True, eq=False)
class AlignedPatches:
    """Where n patches are: px (n, 2), where they should be for those not found; found (n,); sigma_px (n,)
    standard deviation of a coordinate of one that was found; spread_px2 (n,) mean square of a patch's columns
    about its middle, and of its rows.
    """

    px: FloatArray
    found: BoolArray
    sigma_px: FloatArray
    spread_px2: FloatArray


def build_pyramid(gray: UInt8Array, levels: int = LEVELS) -> Pyramid:
    """The picture and its halvings; pixel (x, y) of a level lies at (2x, 2y) of the one before."""
    pyramid = [np.require(gray, np.uint8, ("C", "W"))]  # one type for the kernels, whatever the reader gave
    for _ in range(levels - 1):
        pyramid.append(halved(pyramid[-1]))
    return tuple(pyramid)


def halved(gray: UInt8Array) -> UInt8Array:
    """The next level of a pyramid."""
    return np.asarray(cv2.pyrDown(gray), np.uint8)


def align_patches(
    references: Sequence[Pyramid],
    of_reference: IntArray,
    current: Pyramid,
    reference_px: FloatArray,
    reference_from_current: FloatArray,
    start_px: FloatArray,
    coarsest: int = 1,
) -> AlignedPatches:
    """Where patches about reference_px (n, 2) are in the current picture.

    references: at most MOST_REFERENCES pyramids by build_pyramid, and of_reference (n,) which of them each
    patch is in. reference_from_current (n, 2, 2): Jacobian of the warp, pixels over pixels. start_px (n, 2):
    where the patches should be, within a few pixels at the coarsest level.
    """
    px = np.array(start_px, dtype=np.float64, order="C")
    sigma_px, spread_px2 = np.full(len(px), np.nan), np.full(len(px), PATCH_SPREAD_PX2)
    found = _align(
        # Always as many, so that the kernel is compiled for one type.
        tuple(references) + (current,) * (MOST_REFERENCES - len(references)),
        np.ascontiguousarray(of_reference, dtype=np.int64),
        current,
        np.ascontiguousarray(reference_px, dtype=np.float64),
        np.ascontiguousarray(reference_from_current, dtype=np.float64),
        px,
        sigma_px,
        spread_px2,
        coarsest,
    )
    return AlignedPatches(px, found, sigma_px, spread_px2)


@njit(cache=True, nogil=True)
def _align(  # type: ignore[no-untyped-def]
    references, of_reference, current, reference_px, warp, px, sigma_px, spread_px2, coarsest
):
    """All patches, from the coarsest level to the finest, each where it is found most exactly: in a noisy
    picture that can be a coarser level, whose patch sees more ground. px (n, 2) is improved, sigma_px (n,)
    and spread_px2 (n,) are entered in place.
    """
    bordered = np.empty((SIDE + 2, SIDE + 2), np.float32)
    work = np.empty((4, SIDE * SIDE), np.float32)  # template, its gradient in x and y, current values
    found = np.zeros(px.shape[0], np.bool_)
    for n in range(px.shape[0]):
        A = warp[n]
        area = abs(A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0])
        finite = math.isfinite(px[n, 0]) and math.isfinite(px[n, 1])
        if not (finite and math.isfinite(area) and area > SMALLEST_SCALE * SMALLEST_SCALE):
            continue
        reference = references[of_reference[n]]
        # A patch that the reference saw larger is read from a coarser level of it, lest it alias.
        extra = min(max(int(np.round(0.5 * math.log2(area))), 0), LEVELS - 1)
        x, y = px[n]
        for level in range(coarsest, -1, -1):
            source = min(level + extra, len(reference) - 1)
            if not _template(reference[source], reference_px[n], 0.5**source, A, 2.0**level, bordered):
                break
            size = 2.0**level
            x, y, correlation, variance = _shift(bordered, current[level], x / size, y / size, work)
            x, y = x * size, y * size
            if correlation < 0.0:
                break
            sigma = size * math.hypot(NOISELESS_SIGMA_PX, PATCH_NOISE * math.sqrt(variance))
            if correlation >= LEAST_CORRELATION and not sigma >= sigma_px[n]:
                px[n, 0], px[n, 1], sigma_px[n] = x, y, sigma
                spread_px2[n] = PATCH_SPREAD_PX2 * size * size
                found[n] = True
    return found


@njit(cache=True, nogil=True, fastmath=REORDERED)
def _template(image, place, reduction, A, step, patch):  # type: ignore[no-untyped-def]
    """Warped patch with a border of one pixel for its gradient; False if it leaves the picture.

    place (2,): its middle at full resolution; reduction: of the image; step: between samples, in
    full-resolution pixels of the current picture.
    """
    height, width = image.shape
    half = patch.shape[0] // 2
    x, y = place[0] * reduction, place[1] * reduction
    scale = reduction * step
    xx, xy, yx, yy = A[0, 0] * scale, A[0, 1] * scale, A[1, 0] * scale, A[1, 1] * scale
    reach_x = half * (abs(xx) + abs(xy))
    reach_y = half * (abs(yx) + abs(yy))
    if x - reach_x < 0 or y - reach_y < 0 or x + reach_x >= width - 1 or y + reach_y >= height - 1:
        return False
    for i in range(patch.shape[0]):
        u = x + xy * (i - half) - xx * half
        v = y + yy * (i - half) - yx * half
        for j in range(patch.shape[1]):
            column, row = int(u), int(v)
            fx, fy = np.float32(u - column), np.float32(v - row)
            a, b = np.float32(image[row, column]), np.float32(image[row, column + 1])
            c, d = np.float32(image[row + 1, column]), np.float32(image[row + 1, column + 1])
            upper = a + fx * (b - a)
            patch[i, j] = upper + fy * (c + fx * (d - c) - upper)
            u += xx
            v += yx
    return True


@njit(cache=True, nogil=True, fastmath=REORDERED)
def _prepare(bordered, work):  # type: ignore[no-untyped-def]
    """Template and gradient without their means; returns (sum of squares, the gradient's xx, xy, yy)."""
    T, Tx, Ty = work[0], work[1], work[2]
    mean, mean_x, mean_y = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    half = np.float32(0.5)
    for i in range(SIDE):
        for j in range(SIDE):
            k = i * SIDE + j
            T[k] = bordered[i + 1, j + 1]
            Tx[k] = half * (bordered[i + 1, j + 2] - bordered[i + 1, j])
            Ty[k] = half * (bordered[i + 2, j + 1] - bordered[i, j + 1])
            mean += T[k]
            mean_x += Tx[k]
            mean_y += Ty[k]
    count = np.float32(SIDE * SIDE)
    mean, mean_x, mean_y = mean / count, mean_x / count, mean_y / count
    square, xx, xy, yy = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(SIDE * SIDE):
        # Brightness is a free parameter: eliminating it takes the mean out of the gradients.
        T[k] -= mean
        Tx[k] -= mean_x
        Ty[k] -= mean_y
        square += T[k] * T[k]
        xx += Tx[k] * Tx[k]
        xy += Tx[k] * Ty[k]
        yy += Ty[k] * Ty[k]
    return float(square), float(xx), float(xy), float(yy)


@njit(cache=True, nogil=True, fastmath=REORDERED)
def _compare(image, x, y, work):  # type: ignore[no-untyped-def]
    """Sums over the patch about (x, y), mean taken out: squares, products with template and gradient."""
    T, Tx, Ty, values = work[0], work[1], work[2], work[3]
    column, row = int(x) - HALF_PX, int(y) - HALF_PX
    fx, fy = np.float32(x - int(x)), np.float32(y - int(y))
    one = np.float32(1.0)
    w00, w01, w10, w11 = (one - fx) * (one - fy), fx * (one - fy), (one - fx) * fy, fx * fy
    mean = np.float32(0.0)
    for i in range(SIDE):
        upper, lower = image[row + i], image[row + i + 1]
        for j in range(SIDE):
            value = w00 * np.float32(upper[column + j]) + w01 * np.float32(upper[column + j + 1])
            value += w10 * np.float32(lower[column + j]) + w11 * np.float32(lower[column + j + 1])
            values[i * SIDE + j] = value
            mean += value
    mean /= np.float32(SIDE * SIDE)
    square, product, by_x, by_y = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(SIDE * SIDE):
        value = values[k] - mean
        square += value * value
        product += value * T[k]
        by_x += value * Tx[k]
        by_y += value * Ty[k]
    return float(square), float(product), float(by_x), float(by_y)


@njit(cache=True, nogil=True)
def _shift(bordered, image, x0, y0, work):  # type: ignore[no-untyped-def]
    """Where the template fits about (x0, y0), its correlation there, -1 where it does not fit, and the
    variance of a coordinate.
    """
    height, width = image.shape
    deviation, xx, xy, yy = _prepare(bordered, work)
    determinant = xx * yy - xy * xy
    trace = xx + yy
    if deviation < 4.0 * SIDE * SIDE or determinant < 0.01 * trace * trace or determinant <= 0.0:
        return x0, y0, -1.0, 0.0  # flat, or an edge along which it could slide
    template_x, template_y = 0.0, 0.0  # products of the template with its own gradient
    for k in range(SIDE * SIDE):
        template_x += work[1, k] * work[0, k]
        template_y += work[2, k] * work[0, k]
    x, y = x0, y0
    correlation = -1.0
    for _ in range(MAX_ITERATIONS):
        if not (HALF_PX <= x < width - 1 - HALF_PX and HALF_PX <= y < height - 1 - HALF_PX):
            return x, y, -1.0, 0.0
        square, product, by_x, by_y = _compare(image, x, y, work)
        correlation = product / math.sqrt(deviation * square + 1e-9)
        gain = math.sqrt(square / deviation) + 1e-9  # contrast, the other free parameter
        bx, by = by_x / gain - template_x, by_y / gain - template_y
        step_x = (yy * bx - xy * by) / determinant
        step_y = (xx * by - xy * bx) / determinant
        x -= step_x
        y -= step_y
        if abs(x - x0) > LARGEST_SHIFT_PX or abs(y - y0) > LARGEST_SHIFT_PX:
            return x, y, -1.0, 0.0
        if abs(step_x) + abs(step_y) < CONVERGED_PX:
            break
    left = max(1.0 - correlation * correlation, 0.0) * deviation / (SIDE * SIDE - 4.0)
    return x, y, correlation, 0.5 * left * trace / determinant


def kernel_cache_folder() -> str:
    """Folder in which the compiled kernels of this part are kept between starts."""
    return str(_align._cache.cache_path)  # type: ignore[attr-defined]
