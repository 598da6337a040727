"""Between nodes: the map's points are followed in the picture, without describing anything.

First the motion since the last picture, by pyramidal Lucas-Kanade on a few points; then every visible point
of the last nodes is aligned with the patch of the node that saw it first, which does not drift and is exact
to a tenth of a pixel. When too few points can be followed, the caller falls back to descriptors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from overfly.config import TrackingSettings
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.types import Correspondences, Float32Array, IntArray, NotFound, Reason, UInt8Array
from overfly.vision.alignment import LEVELS, align_patches, build_pyramid
from overfly.vision.observation import Observation
from overfly.vision.odometry import Located, PooledMatches
from overfly.vision.refine import HeightPrior, refine_pose
from overfly.vision.registration import Registrar

COARSE_WINDOW_PX = 15
COARSE_LEVELS = 3
WARP_STEP_PX = 4.0  # over which the warp between two views is differenced
SUPPORT_BORDER_PX = 6


@dataclass(frozen=True, slots=True, eq=False)
class TrackedPoints:
    """Points to follow, n of them: world (n, 3) metres and how far they may lie off (n, 3); where they were
    first seen: node (n,) and px (n, 2) there;
    main_node and row (n,): the newest node that has each as a feature, and which."""

    world: FloatArray
    spread: FloatArray
    anchor: IntArray
    anchor_px: FloatArray
    main_node: IntArray
    row: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """A node whose picture is still at hand: its pyramid and pose."""

    pyramid: Sequence[UInt8Array]
    world_from_cam: Pose


class Tracker:
    """Follows points from picture to picture; keeps the last picture and where its points were."""

    def __init__(self, camera: Camera, registrar: Registrar, settings: TrackingSettings) -> None:
        self._camera = camera
        self._registrar = registrar
        self._settings = settings
        self._last: UInt8Array | None = None
        self._px = np.empty((0, 2), np.float32)
        self._world = np.empty((0, 3))
        self._spread = np.empty((0, 3))

    def track(
        self,
        view: Observation,
        points: TrackedPoints,
        anchors: dict[int, Anchor],
        last_pose: Pose,
        predicted: Pose | None,
        height: HeightPrior | None,
    ) -> Located | NotFound:
        """The current pose from the points, or why they could not be followed."""
        start = self._motion(view, predicted or last_pose, height)
        if isinstance(start, NotFound):
            return start
        return self.settle(view, points, anchors, start, height)

    def settle(
        self,
        view: Observation,
        points: TrackedPoints,
        anchors: dict[int, Anchor],
        start: Pose,
        height: HeightPrior | None,
    ) -> Located | NotFound:
        """The exact pose from one that is good to a few pixels."""
        chosen = self._visible(points, start)
        px, found = self._align(view, points, anchors, start, chosen)
        rows = chosen[found]
        correspondences = Correspondences(
            points.world[rows],
            self._camera.rays_from_pixels(px[found]),
            np.zeros(len(rows)),
            points.row[rows],
            np.arange(len(rows)),
            points.spread[rows],
        )
        if len(rows) < self._settings.min_tracked:
            return NotFound(Reason.FEW_MATCHES, f"{len(rows)} points followed")
        estimate = self._registrar.refine(
            start, correspondences, view.tilt, height, 0.0, self._settings.localisation_px
        )
        if isinstance(estimate, NotFound):
            return estimate
        if len(estimate.inliers) < self._settings.min_share * len(rows):
            return NotFound(
                Reason.FEW_INLIERS, f"{len(estimate.inliers)} of {len(rows)} followed points agree"
            )
        return Located(
            estimate, PooledMatches(correspondences, points.main_node[rows]), px[found].astype(np.float32)
        )

    def remember(self, view: Observation, located: Located) -> None:
        """Keep this picture and its inliers as what the next one is compared with."""
        correspondences = located.matches.correspondences
        inliers = located.estimate.inliers
        px = located.px if located.px is not None else view.features.px[correspondences.frame_index]
        self._last = view.gray
        self._px, self._world = px[inliers], correspondences.points[inliers]
        assert correspondences.spread is not None
        self._spread = correspondences.spread[inliers]

    def move(self, world_from_old: Pose) -> None:
        """The map was optimised, and what surrounds the camera moved with it."""
        self._world = world_from_old.transform(self._world)

    def forget(self) -> None:
        """The last picture is of no use: lost, or a jump."""
        self._last = None

    def rescale(self, factor: float) -> None:
        """All lengths of the map were multiplied."""
        self._world, self._spread = self._world * factor, self._spread * factor

    # -- the steps of track

    def _motion(self, view: Observation, predicted: Pose, height: HeightPrior | None) -> Pose | NotFound:
        """A pose good to about a pixel, from the motion of a few points since the last picture."""
        if self._last is None or len(self._px) < self._settings.min_tracked:
            return NotFound(Reason.FEW_MATCHES, "no points to follow")
        some = spread_choice(
            self._px, (self._camera.width, self._camera.height), self._settings.coarse_points
        )
        guess = self._camera.project(predicted.inverse().transform(self._world[some])).astype(np.float32)
        px, found = _flow(self._last, view.gray, self._px[some], guess)
        rays = self._camera.rays_from_pixels(px[found])
        tilt = view.tilt
        refined = refine_pose(
            predicted,
            self._world[some][found],
            rays,
            self._registrar.pixels(1.0),
            (self._registrar.pixels(self._settings.coarse_limit_px), self._registrar.pixels(2.0)),
            tilt,
            height,
            self._spread[some][found],
        )
        if refined is None or refined.inliers.sum() < max(8, self._settings.min_share * len(some)):
            return NotFound(Reason.FEW_INLIERS, "points moved in different ways")
        return refined.world_from_cam

    def _visible(self, points: TrackedPoints, pose: Pose) -> IntArray:
        """Rows of points that the camera should see, spread over the picture, at most so many as the settings
        say.
        """
        px = self._camera.project(pose.inverse().transform(points.world))
        border = SUPPORT_BORDER_PX
        high = np.array([self._camera.width, self._camera.height]) - 1 - border
        with np.errstate(invalid="ignore"):
            inside = np.flatnonzero(((px >= border) & (px <= high)).all(axis=1))
        size = (self._camera.width, self._camera.height)
        return inside[spread_choice(px[inside].astype(np.float32), size, self._settings.points)]

    def _align(
        self,
        view: Observation,
        points: TrackedPoints,
        anchors: dict[int, Anchor],
        pose: Pose,
        rows: IntArray,
    ) -> tuple[FloatArray, np.ndarray]:
        """Positions (n, 2) of the chosen points in the current picture, and whether they were found."""
        pyramid = build_pyramid(view.gray, LEVELS)
        px = self._camera.project(pose.inverse().transform(points.world[rows]))
        found = np.zeros(len(rows), np.bool_)
        for node in np.unique(points.anchor[rows]):
            anchor = anchors[int(node)]
            mine = np.flatnonzero(points.anchor[rows] == node)
            world = points.world[rows[mine]]
            reference_px = points.anchor_px[rows[mine]]
            warp = np.asarray(np.linalg.inv(self._warp(anchor.world_from_cam, pose, world, reference_px)))
            px[mine], found[mine] = align_patches(anchor.pyramid, pyramid, reference_px, warp, px[mine])
        return px, found

    def _warp(self, anchor: Pose, current: Pose, world: FloatArray, anchor_px: FloatArray) -> FloatArray:
        """Jacobian (n, 2, 2) of pixels in the current picture by pixels in the anchor's, for level ground
        about the points.
        """
        seen = []
        for step in (np.zeros(2), np.array([WARP_STEP_PX, 0.0]), np.array([0.0, WARP_STEP_PX])):
            rays = self._camera.rays_from_pixels(anchor_px + step)
            directions = np.column_stack([rays, np.ones(len(rays))]) @ anchor.rotation.T
            depth = (world[:, 2] - anchor.translation[2]) / directions[:, 2]
            there = anchor.translation + directions * depth[:, None]
            seen.append(self._camera.project(current.inverse().transform(there)))
        jacobian = np.stack([seen[1] - seen[0], seen[2] - seen[0]], axis=-1) / WARP_STEP_PX
        with np.errstate(invalid="ignore"):  # NaN where the ground about a point is out of sight
            singular = ~(np.abs(np.linalg.det(jacobian)) > 1e-3)
        jacobian[singular] = np.eye(2) * 1e-3  # far too small a scale: align_patches passes it over
        return jacobian


def _flow(
    last: UInt8Array, current: UInt8Array, px: Float32Array, guess: Float32Array
) -> tuple[Float32Array, np.ndarray]:
    """Pyramidal Lucas-Kanade from a guess."""
    usable = np.isfinite(guess).all(axis=1, keepdims=True)
    guess = np.where(usable, guess, px).astype(np.float32)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        last,
        current,
        np.ascontiguousarray(px),
        guess,
        winSize=(COARSE_WINDOW_PX, COARSE_WINDOW_PX),
        maxLevel=COARSE_LEVELS,
        criteria=(cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 10, 0.03),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=1e-4,
    )
    inside = ((found >= 0) & (found < np.array([current.shape[1], current.shape[0]]))).all(axis=1)
    return np.asarray(found, np.float32), (status.ravel() == 1) & inside


def spread_choice(px: Float32Array, size: tuple[int, int], count: int) -> IntArray:
    """Indices of at most about count of the positions (n, 2), evenly spread: earlier ones first in every cell
    of a grid.
    """
    if len(px) <= count:
        return np.arange(len(px))
    cell = float(np.sqrt(size[0] * size[1] / count))
    columns = int(size[0] / cell) + 1
    bucket = (px[:, 1] / cell).astype(np.int64) * columns + (px[:, 0] / cell).astype(np.int64)
    order = np.argsort(bucket, kind="stable")
    sorted_bucket = bucket[order]
    first = np.concatenate([[True], sorted_bucket[1:] != sorted_bucket[:-1]])
    rank = np.arange(len(px)) - np.maximum.accumulate(np.where(first, np.arange(len(px)), 0))
    by_rank = order[np.lexsort((order, rank))]
    return np.sort(by_rank[:count])
