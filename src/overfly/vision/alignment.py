"""Where the ground about a map point is in the current picture, to a tenth of a pixel.

The patch about the point, as an earlier node saw it, is warped into the geometry of the current view and then
shifted until it fits, by inverse compositional Gauss-Newton with brightness and contrast taken out (Baker and
Matthews 2004, "Lucas-Kanade 20 years on"; Forster et al. 2014, "SVO", section IV-B).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray
from overfly.types import BoolArray, UInt8Array

HALF_PX = 4  # patches are 9 x 9
MAX_ITERATIONS = 10
CONVERGED_PX = 0.01
LARGEST_SHIFT_PX = 4.0  # per pyramid level
LEAST_CORRELATION = 0.75
LEVELS = 3


def build_pyramid(gray: UInt8Array, levels: int = LEVELS) -> list[UInt8Array]:
    """The picture and its halvings; pixel (x, y) of a level lies at (2x, 2y) of the one before."""
    pyramid = [gray]
    for _ in range(levels - 1):
        pyramid.append(np.asarray(cv2.pyrDown(pyramid[-1]), np.uint8))
    return pyramid


def align_patches(
    reference: Sequence[UInt8Array],
    current: Sequence[UInt8Array],
    reference_px: FloatArray,
    reference_from_current: FloatArray,
    start_px: FloatArray,
    coarsest: int = 1,
) -> tuple[FloatArray, BoolArray]:
    """Positions (n, 2) in the current picture of patches about reference_px (n, 2), and whether they were
    found (n,).

    reference, current: pyramids. reference_from_current (n, 2, 2): Jacobian of the warp, pixels over pixels.
    start_px (n, 2): where the patches should be, within a few pixels at the coarsest level.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.sqrt(np.abs(np.linalg.det(reference_from_current)))
        shift = np.clip(np.nan_to_num(np.round(np.log2(scale))), 0, LEVELS - 1).astype(np.int64)
    px = np.ascontiguousarray(start_px, dtype=np.float64).copy()
    found = np.isfinite(px).all(axis=1) & np.isfinite(reference_from_current).all(axis=(1, 2)) & (scale > 0.2)
    for level in range(coarsest, -1, -1):
        for extra in np.unique(shift[found]):
            # A patch that the reference saw larger is read from a coarser level of it, lest it alias.
            of_reference = min(level + int(extra), len(reference) - 1)
            rows = np.flatnonzero(found & (shift == extra))
            found[rows] = _align(
                reference[of_reference],
                current[level],
                reference_px[rows] / 2.0**of_reference,
                reference_from_current[rows] * 2.0 ** (level - of_reference),
                px,
                rows,
                2.0**level,
                level == 0,
            )
    return px, found


@njit(cache=True, nogil=True, inline="always")
def _sample(image, x, y):  # type: ignore[no-untyped-def]
    """Bilinear grey value; the caller keeps (x, y) inside."""
    i, j = int(y), int(x)
    fy, fx = y - i, x - j
    top = image[i, j] * (1.0 - fx) + image[i, j + 1] * fx
    bottom = image[i + 1, j] * (1.0 - fx) + image[i + 1, j + 1] * fx
    return top * (1.0 - fy) + bottom * fy


@njit(cache=True, nogil=True)
def _template(image, x, y, A, patch):  # type: ignore[no-untyped-def]
    """Warped patch with a border of one pixel for its gradient; False if it leaves the picture."""
    height, width = image.shape
    side = patch.shape[0]
    half = side // 2
    reach_x = half * (abs(A[0, 0]) + abs(A[0, 1]))
    reach_y = half * (abs(A[1, 0]) + abs(A[1, 1]))
    if x - reach_x < 0 or y - reach_y < 0 or x + reach_x >= width - 1 or y + reach_y >= height - 1:
        return False
    for i in range(side):
        for j in range(side):
            dx, dy = j - half, i - half
            patch[i, j] = _sample(image, x + A[0, 0] * dx + A[0, 1] * dy, y + A[1, 0] * dx + A[1, 1] * dy)
    return True


@njit(cache=True, nogil=True)
def _align(reference, current, reference_px, warp, px, rows, scale, is_last):  # type: ignore[no-untyped-def]  # noqa: PLR0912, PLR0915
    """One pyramid level for the patches in rows; px (all, 2) full-resolution positions, improved in place."""
    height, width = current.shape
    side = 2 * HALF_PX + 1
    count = side * side
    bordered = np.empty((side + 2, side + 2))
    T, Tx, Ty, values = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    found = np.zeros(rows.shape[0], np.bool_)
    for n in range(rows.shape[0]):
        if not _template(reference, reference_px[n, 0], reference_px[n, 1], warp[n], bordered):
            continue
        mean = 0.0
        for k in range(count):
            i, j = k // side + 1, k % side + 1
            T[k] = bordered[i, j]
            Tx[k] = 0.5 * (bordered[i, j + 1] - bordered[i, j - 1])
            Ty[k] = 0.5 * (bordered[i + 1, j] - bordered[i - 1, j])
            mean += T[k]
        mean /= count
        mean_x, mean_y = Tx.mean(), Ty.mean()
        deviation, xx, xy, yy = 0.0, 0.0, 0.0, 0.0
        for k in range(count):
            T[k] -= mean
            deviation += T[k] * T[k]
            # Brightness is a free parameter: eliminating it takes the mean out of the gradients.
            Tx[k] -= mean_x
            Ty[k] -= mean_y
            xx += Tx[k] * Tx[k]
            xy += Tx[k] * Ty[k]
            yy += Ty[k] * Ty[k]
        determinant = xx * yy - xy * xy
        trace = xx + yy
        if deviation < 4.0 * count or determinant < 0.01 * trace * trace or determinant <= 0.0:
            continue  # flat, or an edge along which it could slide
        x0, y0 = px[rows[n], 0] / scale, px[rows[n], 1] / scale
        x, y = x0, y0
        correlation = 0.0
        for _ in range(MAX_ITERATIONS):
            if not (HALF_PX <= x < width - 1 - HALF_PX and HALF_PX <= y < height - 1 - HALF_PX):
                correlation = -1.0
                break
            mean_value = 0.0
            for k in range(count):
                values[k] = _sample(current, x + (k % side - HALF_PX), y + (k // side - HALF_PX))
                mean_value += values[k]
            mean_value /= count
            product, square = 0.0, 0.0
            for k in range(count):
                values[k] -= mean_value
                product += values[k] * T[k]
                square += values[k] * values[k]
            correlation = product / math.sqrt(deviation * square + 1e-9)
            gain = math.sqrt(square / deviation) + 1e-9
            bx, by = 0.0, 0.0
            for k in range(count):
                difference = values[k] / gain - T[k]
                bx += Tx[k] * difference
                by += Ty[k] * difference
            step_x = (yy * bx - xy * by) / determinant
            step_y = (xx * by - xy * bx) / determinant
            x -= step_x
            y -= step_y
            if abs(x - x0) > LARGEST_SHIFT_PX or abs(y - y0) > LARGEST_SHIFT_PX:
                correlation = -1.0
                break
            if abs(step_x) + abs(step_y) < CONVERGED_PX:
                break
        if correlation < 0.0 or (is_last and correlation < LEAST_CORRELATION):
            continue
        px[rows[n], 0], px[rows[n], 1] = x * scale, y * scale
        found[n] = True
    return found
