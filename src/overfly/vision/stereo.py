"""Depth of features from a second camera.

Both pictures are rectified (turned so that the baseline is their x axis); each feature of the left picture is
then found in the right one to a fraction of a pixel by iterative Lucas-Kanade alignment, started at the
disparity of the ground, and back again as a check. The depth's standard deviation follows from that of the
disparity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from overfly.errors import CalibrationError
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray
from overfly.types import Float32Array, Rig, UInt8Array
from overfly.vision.rig_bend import RigBend, bent_rig

DISPARITY_SIGMA_PX = 0.15  # of the alignment, on textured ground
WINDOW_PX = 15
MATCH_LEVELS = 2  # halvings of the pictures from which what is not at the ground's disparity is sought
LARGEST_RETURN_ERROR_PX = 0.7
LEAST_CORRELATION = 0.75  # of windows that match; of other ground at most one in ten comes so far
COARSE_WIDTH_PX = 80


@dataclass(frozen=True, slots=True, eq=False)
class DepthPoints:
    """points_in_cam (n, 3) metres in the left (cam0) optical frame, NaN where not found; depth_sigma_m (n,).

    is_measured: by a second camera, not assumed.
    """

    points_in_cam: FloatArray
    depth_sigma_m: FloatArray
    is_measured: bool


class StereoMatcher:
    """Points of features in two pictures of one rig. Learns from them how far the rig is bent."""

    def __init__(self, rig: Rig) -> None:
        self._given = rig
        self.bend = RigBend()
        self._rectify(rig)

    def _rectify(self, rig: Rig) -> None:
        """Maps that turn both pictures so that the baseline is their x axis."""
        left, right = rig.cameras[0].camera, rig.cameras[1].camera
        if (left.width, left.height) != (right.width, right.height):
            raise CalibrationError("stereo needs two cameras of the same image size")
        right_from_left = rig.cam1_from_cam0
        baseline = -right_from_left.rotation.T @ right_from_left.translation  # of cam1's centre, in cam0
        self.baseline_m = float(np.linalg.norm(baseline))
        if self.baseline_m < 1e-6:
            raise CalibrationError("stereo needs two cameras at different places; the calibration gives none")
        x_axis = baseline / self.baseline_m
        view = np.array([0.0, 0.0, 1.0]) + right_from_left.rotation.T @ np.array([0.0, 0.0, 1.0])
        y_axis = np.cross(view, x_axis)
        y_axis /= np.linalg.norm(y_axis)
        rectified_from_left = np.stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
        self._rectified_from_left = rectified_from_left
        self._left = left
        self._focal = left.focal_px
        self._left_map, self._offset = _rectifying_map(left, rectified_from_left, self._focal)
        self._rectified_from_right = rectified_from_left @ right_from_left.rotation.T
        self._right_map, _ = _rectifying_map(right, self._rectified_from_right, self._focal, self._offset)

    @property
    def inverse_depth_sigma(self) -> float:
        """Standard deviation of 1/z in 1/m, the same for all depths."""
        return DISPARITY_SIGMA_PX / (self._focal * self.baseline_m)

    def depth(self, left: UInt8Array, right: UInt8Array, px: Float32Array) -> DepthPoints:
        """px: (n, 2) features in the left picture."""
        there, found = self._matched(left, right, px)
        good = np.isfinite(found[:, 0])
        xy, rows = (found[good] - self._offset) / self._focal, (found - there)[good, 1].astype(np.float64)
        if self.bend.learn(xy, rows, self._focal, self._rectified_from_right):
            self._rectify(bent_rig(self._given, self.bend.turn_rad))
            there, found = self._matched(left, right, px)
        disparity = (there[:, 0] - found[:, 0]).astype(np.float64)
        z = self._focal * self.baseline_m / disparity
        turned = np.column_stack([(there - self._offset) / self._focal, np.ones(len(there))])
        points = (turned * z[:, None]) @ self._rectified_from_left
        return DepthPoints(points, z * z / (self._focal * self.baseline_m) * DISPARITY_SIGMA_PX, True)

    def _matched(
        self, left: UInt8Array, right: UInt8Array, px: Float32Array
    ) -> tuple[Float32Array, Float32Array]:
        """Features (n, 2) in the left rectified picture and in the right one, NaN where not found."""
        left = np.asarray(cv2.remap(left, *self._left_map, cv2.INTER_LINEAR), np.uint8)
        right = np.asarray(cv2.remap(right, *self._right_map, cv2.INTER_LINEAR), np.uint8)
        rays = self._left.rays_from_pixels(px.astype(np.float64))
        turned = np.column_stack([rays, np.ones(len(rays))]) @ self._rectified_from_left.T
        there = (turned[:, :2] / turned[:, 2:] * self._focal + self._offset).astype(np.float32)
        found = np.full_like(there, np.nan)
        usable = np.flatnonzero(np.isfinite(there).all(axis=1))
        if len(usable) == 0:
            return there, found
        ground = coarse_disparity(left, right)
        left, right = _evened(left), _evened(right)
        # At the disparity of the ground first, in full resolution: reduced pictures hold nothing of a fine,
        # faint grain, and following them leads away from it. Then what stands out of the ground.
        for levels in (0, MATCH_LEVELS):
            left_over = usable[np.isnan(found[usable, 0])]
            matched = _there_and_back(left, right, there[left_over], ground, levels)
            matched[~self.bend.fits(matched[:, 1] - there[left_over, 1])] = np.nan
            found[left_over] = matched
        return there, found


def _there_and_back(
    left: UInt8Array, right: UInt8Array, there: Float32Array, guess_px: float, levels: int
) -> Float32Array:
    """Where the windows about there (n, 2) are in the right picture, sought from a guess of the disparity
    through so many halvings of the pictures; NaN where the way back does not end where it began.
    """
    guess = there - np.array([guess_px, 0.0], np.float32)
    found, found_status = _align(left, right, there, guess, levels)
    back, back_status = _align(right, left, found, there.copy(), 0)  # a check needs no search
    good = (
        found_status
        & back_status
        & (np.abs(back - there).max(axis=1) < LARGEST_RETURN_ERROR_PX)
        & (there[:, 0] - found[:, 0] > 0.5)
        & (_window_correlations(left, right, there, found) > LEAST_CORRELATION)
    )
    found[~good] = np.nan
    return found


def _evened(gray: UInt8Array) -> UInt8Array:
    """The picture without what changes slowly over it.

    Lucas-Kanade takes a difference in brightness between the cameras (exposure, fall-off towards the corners)
    for a shift wherever the window's gradients do not cancel: the same for the same ground from everywhere,
    so no number of views takes it away.
    """
    around = cv2.blur(gray, (WINDOW_PX, WINDOW_PX))
    return np.asarray(cv2.addWeighted(gray, 1.0, around, -1.0, 128.0), np.uint8)


def coarse_disparity(left: UInt8Array, right: UInt8Array) -> float:
    """Disparity in pixels at which most of two rectified pictures agree: that of the ground.

    Normalised correlation of the reduced pictures over all shifts up to half their width.
    """
    scale = COARSE_WIDTH_PX / left.shape[1]
    size = (COARSE_WIDTH_PX, max(8, round(left.shape[0] * scale)))
    a = cv2.resize(left, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    b = cv2.resize(right, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    a -= cv2.GaussianBlur(a, (0, 0), 4.0)
    b -= cv2.GaussianBlur(b, (0, 0), 4.0)
    return int(np.argmax(_correlations(a, b))) / float(scale)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _correlations(a, b):  # type: ignore[no-untyped-def]
    """Normalised correlation of a (h, w) with b shifted to the right by 0 to w/2 columns."""
    height, width = a.shape
    scores = np.empty(width // 2)
    for shift in range(width // 2):
        product, first, second = 0.0, 0.0, 0.0
        for i in range(height):
            for j in range(width - shift):
                x, y = a[i, j + shift], b[i, j]
                product += x * y
                first += x * x
                second += y * y
        scores[shift] = product / (math.sqrt(first * second) + 1e-6)
    return scores


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _window_correlations(left, right, there, found):  # type: ignore[no-untyped-def]
    """(n,) normalised correlations of the windows about there (n, 2) in left with those about found (n, 2) in
    right; 0 where one leaves its picture.
    """
    half = WINDOW_PX // 2
    result = np.zeros(len(there))
    values = np.empty((2, WINDOW_PX, WINDOW_PX))
    for n in range(len(there)):
        inside = True
        for side in range(2):
            image = left if side == 0 else right
            x, y = (there[n, 0], there[n, 1]) if side == 0 else (found[n, 0], found[n, 1])
            if not (
                x >= half and y >= half and x < image.shape[1] - half - 1 and y < image.shape[0] - half - 1
            ):
                inside = False
                break
            column, row = int(x) - half, int(y) - half
            fx, fy = x - int(x), y - int(y)
            for i in range(WINDOW_PX):
                for j in range(WINDOW_PX):
                    upper = (1.0 - fx) * image[row + i, column + j] + fx * image[row + i, column + j + 1]
                    lower = (1.0 - fx) * image[row + i + 1, column + j]
                    lower += fx * image[row + i + 1, column + j + 1]
                    values[side, i, j] = (1.0 - fy) * upper + fy * lower
        if inside:
            a, b = values[0] - values[0].mean(), values[1] - values[1].mean()
            result[n] = np.sum(a * b) / math.sqrt(np.sum(a * a) * np.sum(b * b) + 1e-6)
    return result


def _align(
    source: UInt8Array, target: UInt8Array, px: Float32Array, guess: Float32Array, levels: int
) -> tuple[Float32Array, np.ndarray]:
    """Where the windows about px (n, 2) of source are in target, and whether they were found (n,)."""
    if len(px) == 0:
        return px, np.zeros(0, np.bool_)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        np.ascontiguousarray(px, np.float32),
        np.ascontiguousarray(guess, np.float32),
        winSize=(WINDOW_PX, WINDOW_PX),
        maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 20, 0.01),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=1e-4,
    )
    inside = ((found >= 0) & (found < np.array([target.shape[1], target.shape[0]]))).all(axis=1)
    return np.asarray(found, np.float32), (status.ravel() == 1) & inside


def _rectifying_map(
    camera: Camera, rectified_from_cam: FloatArray, focal_px: float, offset: FloatArray | None = None
) -> tuple[tuple[np.ndarray, np.ndarray], FloatArray]:
    """Maps for cv2.remap and the rectified picture's centre (2,); the centre is chosen so that the middle
    stays the middle.
    """
    if offset is None:
        middle = camera.rays_from_pixels(np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]]))[0]
        turned = rectified_from_cam @ np.array([middle[0], middle[1], 1.0])
        offset = (
            np.array([(camera.width - 1) / 2, (camera.height - 1) / 2]) - focal_px * turned[:2] / turned[2]
        )
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    directions = np.stack(
        [(columns - offset[0]) / focal_px, (rows - offset[1]) / focal_px, np.ones_like(columns, float)],
        axis=-1,
    )
    px = camera.project(directions.reshape(-1, 3) @ rectified_from_cam)
    u, v = np.where(np.isfinite(px), px, -1.0).astype(np.float32).T.reshape(2, camera.height, camera.width)
    first, second = cv2.convertMaps(np.ascontiguousarray(u), np.ascontiguousarray(v), cv2.CV_16SC2)
    return (first, second), offset
