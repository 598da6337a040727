"""Even brightness over many pictures: a gain for each and one fall-off towards the corners, from what they
see in common.

A ground point seen in pictures i and j satisfies log v_i - log v_j = (g_i + f(r_i)) - (g_j + f(r_j)), with
f linear between even steps of the radius, and smooth, for the lens: some have a dark or a bright middle.
Solved by least squares, reweighted so that what moved or shone does not count. Where a lens falls off
otherwise in one colour than in another, its pictures have a tint in the middle: each colour's own tells it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray
from overfly.products.views import View, look_up
from overfly.types import IntArray, UInt8Array

DARKEST, BRIGHTEST = 6.0, 248.0  # beyond, the sensor or the coding has cut the brightness off
NOISE = 0.05  # of a log brightness, from thumbnails of different pictures
GAIN_SIGMA = 0.5  # prior of a log gain: pictures that meet no other keep theirs
FALL_OFF_SIGMA = 0.5
KNOTS = np.linspace(0.0, 1.0, 11)  # radii at which the lens's fall-off is told
BEND_SIGMA = 0.1  # of its second differences
THUMBNAIL_PX = 64
SAMPLES = 8  # of the picture in a pixel of the thumbnail, across: more tell nothing new
ROUNDS = 6
WHITE, WHITE_PERCENT = 235.0, 99.5  # gray above which a channel may be cut off, and of all pixels below it


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """log_gain (n,) of each picture; fall_off (11,) of log brightness at evenly spaced radii from the middle
    to a corner; tint (3, 11): how much brighter than that red, green and blue are there.
    """

    log_gain: FloatArray
    fall_off: FloatArray
    tint: FloatArray = field(default_factory=lambda: np.zeros((3, len(KNOTS))))

    @staticmethod
    def even(log_gain: FloatArray) -> Exposure:
        """Of a lens as bright in the corners as in the middle."""
        return Exposure(log_gain, np.zeros(len(KNOTS)))

    def log_brightness(self, index: int, camera: Camera, px: FloatArray) -> FloatArray:
        """(n,) by how much, in logarithm, the picture is too bright at px (n, 2)."""
        return np.asarray(self.log_gain[index] + np.interp(radius(camera, px), KNOTS, self.fall_off))


def radius(camera: Camera, px: FloatArray) -> FloatArray:
    """(n,) distance from the image's middle, 1 in a corner and not more beyond."""
    x, y = px[:, 0] + 0.5 - 0.5 * camera.width, px[:, 1] + 0.5 - 0.5 * camera.height
    return np.asarray(np.minimum(2.0 * np.hypot(x, y) / np.hypot(camera.width, camera.height), 1.0))


def thumbnail_of(picture: UInt8Array) -> UInt8Array:
    """Small copy, for brightness, from every few of the pixels."""
    width = min(THUMBNAIL_PX, picture.shape[1])
    height = max(1, round(picture.shape[0] * width / picture.shape[1]))
    step = max(1, picture.shape[1] // (SAMPLES * width))
    sampled = np.ascontiguousarray(picture[step // 2 :: step, step // 2 :: step])
    return np.asarray(cv2.resize(sampled, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def gray_of(thumbnail: UInt8Array) -> UInt8Array:
    gray = thumbnail if thumbnail.ndim == 2 else cv2.cvtColor(thumbnail, cv2.COLOR_RGB2GRAY)
    return np.asarray(gray, dtype=np.uint8)


def even_exposure(views: list[View], thumbnails: list[UInt8Array], ground_points: FloatArray) -> Exposure:
    """Exposure of n pictures from their thumbnails and ground points (m, 3), world, all over the map; the
    lens's tint where all thumbnails have colours.
    """
    grays = [gray_of(thumbnail) for thumbnail in thumbnails]
    in_colour = all(thumbnail.ndim == 3 for thumbnail in thumbnails)
    bands = [np.dstack(both) for both in zip(grays, thumbnails, strict=True)] if in_colour else grays
    seen = _observations(views, bands, ground_points)
    gains, fall_off = _evened(len(views), seen, 0)
    # The lens alone must not brighten or colour the whole: pictures keep their average.
    radii = _radii_of(views[0], grays[0])
    gains -= np.median(gains) + np.mean(np.interp(radii, KNOTS, fall_off))
    exposure = within_white(Exposure(gains, fall_off), views, grays)
    if not in_colour:
        return exposure
    tint = np.array([_evened(len(views), seen, band)[1] for band in (1, 2, 3)]) - fall_off
    return replace(exposure, tint=tint - [[np.mean(np.interp(radii, KNOTS, own))] for own in tint])


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Of each ground point in each picture that sees it: point, view, radius (k,) and value (k, bands)."""

    point: IntArray
    view: IntArray
    radius: FloatArray
    value: FloatArray


def _evened(n: int, seen: _Seen, band: int) -> tuple[FloatArray, FloatArray]:
    """Log gains (n,) of the pictures, and the fall-off (11,), in one band; their mean is anything."""
    k = len(KNOTS)
    first, second, difference, radii = _differences(seen, band)
    if len(difference) == 0:
        return np.zeros(n), np.zeros(k)
    rows, ones = np.arange(len(difference)), np.ones(len(difference))
    by_gain = sparse.csr_matrix(
        (np.concatenate([ones, -ones]), (np.tile(rows, 2), np.concatenate([first, second]))), (len(rows), n)
    )
    design = sparse.hstack([by_gain, _hats(radii[:, 0]) - _hats(radii[:, 1])]).tocsr()
    bend = np.diff(np.eye(k), 2, axis=0) / BEND_SIGMA
    prior = sparse.block_diag(
        [sparse.eye(n) * GAIN_SIGMA**-2.0, np.eye(k) * FALL_OFF_SIGMA**-2.0 + bend.T @ bend]
    )
    weight = np.full(len(difference), NOISE**-2.0)
    solution = np.zeros(n + k)
    for _ in range(ROUNDS):
        normal = (design.T @ design.multiply(weight[:, None]) + prior).tocsc()
        solution = spsolve(normal, design.T @ (weight * difference))
        residual = difference - design @ solution
        weight = 1.0 / (NOISE**2 * (1.0 + (residual / (2.0 * NOISE)) ** 2) ** 2)  # Geman and McClure
    return solution[:n], solution[n:]


def _hats(radii: FloatArray) -> sparse.csr_matrix:
    """(m, 11) by how much the fall-off at each knot counts at the radii (m,)."""
    step = radii * (len(KNOTS) - 1)
    lower = np.minimum(step.astype(np.int64), len(KNOTS) - 2)
    rows, share = np.arange(len(radii)), step - lower
    return sparse.csr_matrix(
        (
            np.concatenate([1.0 - share, share]),
            (np.tile(rows, 2), np.concatenate([lower, lower + 1])),
        ),
        (len(radii), len(KNOTS)),
    )


def _pixels(thumbnail: UInt8Array) -> FloatArray:
    """(n, 2) all of them, row by row."""
    rows, columns = thumbnail.shape
    return np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2).astype(float)


def _radii_of(view: View, thumbnail: UInt8Array) -> FloatArray:
    """(n,) of the thumbnail's pixels."""
    return radius(view.image.camera.scaled(*thumbnail.shape[::-1]), _pixels(thumbnail))


def within_white(exposure: Exposure, views: list[View], thumbnails: list[UInt8Array]) -> Exposure:
    """The same, as much darker as is needed for what was not white in the pictures not to become it."""
    before, after = [], []
    for index, (view, thumbnail) in enumerate(zip(views, thumbnails, strict=True)):
        px = _pixels(thumbnail)
        camera = view.image.camera.scaled(*thumbnail.shape[::-1])
        before.append(np.log(np.maximum(thumbnail.ravel(), 1.0)))
        after.append(before[-1] - exposure.log_brightness(index, camera, px))
    highest, lifted = (float(np.percentile(np.concatenate(part), WHITE_PERCENT)) for part in (before, after))
    excess = lifted - max(highest, math.log(WHITE))
    return replace(exposure, log_gain=exposure.log_gain + max(excess, 0.0))


def _observations(views: list[View], bands: list[UInt8Array], points: FloatArray) -> _Seen:
    """Values of the ground points in small copies (h, w) or (h, w, bands) of the pictures."""
    parts = []
    for index, (view, small) in enumerate(zip(views, bands, strict=True)):
        near = np.flatnonzero(view.may_see(points))
        camera = view.image.camera.scaled(small.shape[1], small.shape[0])
        px, cost = look_up(view, camera, points[near])
        near, px = near[np.isfinite(cost)], px[np.isfinite(cost)]
        if len(near) == 0:
            continue
        u, v = px.astype(np.float32).T
        sampled = cv2.remap(small.astype(np.float32), u, v, cv2.INTER_LINEAR).reshape(len(near), -1)
        parts.append((near, np.full(len(near), index), radius(camera, px), sampled.astype(np.float64)))
    if not parts:
        return _Seen(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 4)))
    return _Seen(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _differences(seen: _Seen, band: int) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Pairs of views of one point: (first, second, difference of logs, (k, 2) radii)."""
    usable = np.flatnonzero((seen.value[:, band] > DARKEST) & (seen.value[:, band] < BRIGHTEST))
    order = usable[np.lexsort((seen.view[usable], seen.point[usable]))]
    point, view, radii = seen.point[order], seen.view[order], seen.radius[order]
    log_value = np.log(np.maximum(seen.value[order, band], 1.0))
    parts = []
    for step in (1, 2, 3, 5, 8):  # neighbours in time and further ones, without the square of all pairs
        same = np.flatnonzero(point[step:] == point[:-step])
        other = same + step
        parts.append((view[same], view[other], log_value[same] - log_value[other], radii[same], radii[other]))
    first, second, difference, one, two = (np.concatenate(column) for column in zip(*parts, strict=True))
    return first, second, difference, np.column_stack([one, two])
