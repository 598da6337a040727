"""Between nodes: the map's points are followed in the picture, without describing anything.

First the motion since the last picture, by pyramidal Lucas-Kanade on a few points; then every visible point
of the last nodes is aligned with the patch of the node that saw it first, which does not drift and is exact
to a tenth of a pixel. When too few points can be followed, the caller falls back to descriptors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from overfly.config import TrackingSettings
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.types import Correspondences, IntArray, NotFound, Reason, UInt8Array
from overfly.vision.alignment import AlignedPatches, Pyramid, align_patches
from overfly.vision.flow import coarse_picture, flow
from overfly.vision.observation import Observation
from overfly.vision.odometry import Located, PooledMatches
from overfly.vision.patch_warp import curvature, inverse_warp, patch_rays, rays_to, with_steps
from overfly.vision.refine import HeightPrior, refine_pose
from overfly.vision.registration import Registrar
from overfly.vision.spread import spread_choice
from overfly.vision.whole_picture import PictureFit, Plane, WholePicture, ground_plane

SUPPORT_BORDER_PX = 6
FEW_FOUND = 0.3  # of the visible points; with fewer the whole picture is compared, too
LONGEST_SHIFT = 0.15  # since the last picture, in picture widths, for that; else descriptors are surer
SURE_CORRELATION = 0.85  # with the nearest node's picture: it is not compared with the last one, too
CLEAR_GAIN = 0.1  # of the correlation, for which drift from picture to picture is put up with
FILLED_POINTS = 40  # that are taken to be where the whole picture puts them


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

    pyramid: Pyramid
    world_from_cam: Pose


@dataclass(frozen=True, slots=True, eq=False)
class _Templates:
    """What aligning needs of the points, the same for every picture between two changes of the map.

    of_reference (n,): which pyramid shows each point's patch; rays (n, 5, 2) about it: its own, and
    steps to all sides; rotations (k, 3, 3) and translations (k, 3): world_from_cam of the pyramids.
    """

    points: TrackedPoints
    pyramids: tuple[Pyramid, ...]
    of_reference: IntArray
    rays: FloatArray
    rotations: FloatArray
    translations: FloatArray


class Tracker:
    """Follows points from picture to picture; keeps the last picture and where its points were."""

    def __init__(self, camera: Camera, registrar: Registrar, settings: TrackingSettings) -> None:
        self._camera = camera
        self._registrar = registrar
        self._settings = settings
        self._size = (camera.width, camera.height)
        self._pictures = WholePicture(camera)
        self._newest = -1  # of the nodes whose pictures were seen
        self._last: UInt8Array | None = None
        self._last_anchor: Anchor | None = None  # the last picture, whole
        self._px = np.empty((0, 2), np.float32)
        self._world = np.empty((0, 3))
        self._spread = np.empty((0, 3))
        self._templates: _Templates | None = None

    def track(
        self,
        view: Observation,
        points: TrackedPoints,
        anchors: dict[int, Anchor],
        last_pose: Pose,
        predicted: Pose | None,
        height: HeightPrior | None,
        calmly: Pose | None = None,
    ) -> Located | NotFound:
        """The current pose from the points, or why they could not be followed.

        predicted: by the last motion; calmly: by the mean motion of late.
        """
        if self._last is None:
            return NotFound(Reason.FEW_MATCHES, "no points to follow")
        if (newest := max(anchors)) > self._newest:
            self._newest = newest
            self._pictures.learn(anchors[newest].pyramid)
        moved = self._motion(view, predicted or last_pose, height)
        located: Located | NotFound
        start: Pose | None
        if isinstance(moved, NotFound):
            located, start = moved, calmly
        else:
            start = moved
            located = self.settle(view, points, anchors, start, height)
            n_visible = len(self._visible(points, start))
            if isinstance(located, Located) and len(located.estimate.inliers) >= FEW_FOUND * n_visible:
                return located
        found = self.by_whole_picture(view, points, anchors, last_pose, start, height, any_picture=False)
        return found or located

    def settle(
        self,
        view: Observation,
        points: TrackedPoints,
        anchors: dict[int, Anchor],
        start: Pose,
        height: HeightPrior | None,
        n_filled: int = 0,
    ) -> Located | NotFound:
        """The exact pose from one that is good to a few pixels. n_filled: so many points that are not found
        are taken to be where the start puts them."""
        chosen = self._visible(points, start)
        aligned = self._align(view, points, anchors, start, chosen)
        px, found = aligned.px, aligned.found.copy()
        filled = np.zeros(len(chosen), np.bool_)
        if n_filled:
            lost = np.flatnonzero(~found)
            lost = lost[spread_choice(px[lost].astype(np.float32), self._size, n_filled)]
            px[lost] = self._camera.pixels_from_rays(rays_to(start, points.world[chosen[lost]]))
            filled[lost], found[lost] = True, True
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
            estimate,
            PooledMatches(correspondences, points.main_node[rows]),
            px[found].astype(np.float32),
            filled[found],
            aligned.sigma_px[found],
        )

    def _shift(self, last: Pose, now: Pose) -> float:
        """How far the picture moved between two poses, in picture widths."""
        motion = (last.inverse() @ now).log()
        rays = np.linalg.norm(motion[:3]) / abs(last.translation[2]) + np.linalg.norm(motion[3:])
        return float(rays) * self._camera.focal_px / self._camera.width

    def by_whole_picture(
        self,
        view: Observation,
        points: TrackedPoints,
        anchors: dict[int, Anchor],
        last_pose: Pose,
        start: Pose | None,
        height: HeightPrior | None,
        *,
        any_picture: bool = True,
    ) -> Located | None:
        """The pose where most patches are lost in the noise: from all of the picture, and from what points
        there are; some of the others are taken to be where the whole picture puts them.

        start: where the camera should be; None where that is not known. any_picture: also when only the last
        picture shows the same, and no node's.
        """
        if self._last_anchor is None or start is None or self._shift(last_pose, start) > LONGEST_SHIFT:
            return None
        start = Pose(start.rotation, np.array([*start.translation[:2], last_pose.translation[2]]))
        chosen = self._visible(points, start)
        if len(chosen) < self._settings.min_tracked:
            return None
        fit = self._fit_picture(view, anchors, start, ground_plane(points.world[chosen]), any_picture)
        if fit is None:
            return None
        located = self.settle(view, points, anchors, fit.world_from_cam, height, FILLED_POINTS)
        if isinstance(located, NotFound):
            return None
        covariance = located.estimate.covariance + fit.covariance
        return replace(located, estimate=replace(located.estimate, covariance=covariance))

    def remember_first(self, view: Observation, pose: Pose) -> None:
        """Keep the first picture of a piece of map, world_from_cam; nothing is followed in it yet."""
        self.forget()
        self._last_anchor = Anchor(view.pyramid, pose)

    def _fit_picture(
        self, view: Observation, anchors: dict[int, Anchor], start: Pose, ground: Plane, any_picture: bool
    ) -> PictureFit | None:
        """The pose by the whole picture: against the nearest node's, which does not drift; where that has
        little in common with it, by the last one's, if that has more."""
        nearest = min(anchors.values(), key=lambda one: _apart(one.world_from_cam, start))
        by_node = self._pictures.fit(nearest.pyramid, nearest.world_from_cam, view.pyramid, start, ground)
        last = self._last_anchor
        is_sure = by_node is not None and by_node.correlation >= SURE_CORRELATION
        if is_sure or last is None or not (by_node or any_picture):
            return by_node
        by_last = self._pictures.fit(last.pyramid, last.world_from_cam, view.pyramid, start, ground)
        if by_node is None or by_last is None:
            return by_node or by_last
        return by_last if by_last.correlation > by_node.correlation + CLEAR_GAIN else by_node

    def remember(self, view: Observation, located: Located) -> None:
        """Keep this picture and its inliers as what the next one is compared with."""
        self._last_anchor = Anchor(view.pyramid, located.pose)
        correspondences = located.matches.correspondences
        inliers = located.estimate.inliers
        px = located.px if located.px is not None else view.features.px[correspondences.frame_index]
        self._last, _ = coarse_picture(view)
        self._px, self._world = px[inliers], correspondences.points[inliers]
        assert correspondences.spread is not None
        self._spread = correspondences.spread[inliers]

    def move(self, world_from_old: Pose) -> None:
        """The map was optimised, and what surrounds the camera moved with it."""
        self._world = world_from_old.transform(self._world)
        if self._last_anchor is not None:
            anchor = self._last_anchor
            self._last_anchor = Anchor(anchor.pyramid, world_from_old @ anchor.world_from_cam)

    def forget(self) -> None:
        """No points can be followed from the last picture: the one after it was not found. As a whole it is
        still of use, while the camera cannot be far from there."""
        self._last = None

    def rescale(self, factor: float) -> None:
        """All lengths of the map were multiplied."""
        self._world, self._spread = self._world * factor, self._spread * factor
        if self._last_anchor is not None:
            anchor = self._last_anchor
            self._last_anchor = Anchor(anchor.pyramid, anchor.world_from_cam.scaled(factor))

    # -- the steps of track

    def _motion(self, view: Observation, predicted: Pose, height: HeightPrior | None) -> Pose | NotFound:
        """A pose good to about a pixel, from the motion of a few points since the last picture."""
        assert self._last is not None
        if len(self._px) < self._settings.min_tracked:
            return NotFound(Reason.FEW_MATCHES, "no points to follow")
        some = spread_choice(self._px, self._size, self._settings.coarse_points)
        guess = self._camera.pixels_from_rays(rays_to(predicted, self._world[some])).astype(np.float32)
        now, scale = coarse_picture(view)
        px, found = flow(self._last, now, self._px[some] / scale, guess / scale)
        rays = self._camera.rays_from_pixels(px[found] * scale)
        world = self._world[some][found]
        limit = self._registrar.pixels(self._settings.coarse_limit_px)
        refined = refine_pose(
            _shifted(predicted, world, rays, limit),
            world,
            rays,
            self._registrar.pixels(1.0),
            (limit, self._registrar.pixels(2.0)),
            view.tilt,
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
        px = self._camera.pixels_from_rays(rays_to(pose, points.world))
        inside = _inside(px, float(SUPPORT_BORDER_PX), *self._size)
        some = spread_choice(px[inside].astype(np.float32), self._size, self._settings.points)
        return np.asarray(inside[some])

    def _align(
        self,
        view: Observation,
        points: TrackedPoints,
        anchors: dict[int, Anchor],
        pose: Pose,
        rows: IntArray,
    ) -> AlignedPatches:
        """Where the chosen points are in the current picture."""
        templates = self._templates_of(points, anchors)
        rays = patch_rays(
            templates.rotations,
            templates.translations,
            templates.of_reference,
            pose,
            templates.rays,
            points.world,
            rows,
        )
        steps = self._camera.pixels_from_rays(rays)
        aligned = align_patches(
            templates.pyramids,
            templates.of_reference[rows],
            view.pyramid,
            points.anchor_px[rows],
            inverse_warp(steps),
            self._camera.pixels_from_rays(rays_to(pose, points.world[rows])),
        )
        return replace(aligned, px=aligned.px - aligned.spread_px2[:, None] * curvature(steps))

    def _templates_of(self, points: TrackedPoints, anchors: dict[int, Anchor]) -> _Templates:
        """Prepared once for as long as the same points are followed."""
        if self._templates is None or self._templates.points is not points:
            nodes, of_reference = np.unique(points.anchor, return_inverse=True)
            used = [anchors[int(node)] for node in nodes]
            self._templates = _Templates(
                points,
                tuple(anchor.pyramid for anchor in used),
                of_reference,
                self._camera.rays_from_pixels(with_steps(points.anchor_px)).reshape(-1, 5, 2),
                np.array([anchor.world_from_cam.rotation for anchor in used]),
                np.array([anchor.world_from_cam.translation for anchor in used]),
            )
        return self._templates


def _apart(one: Pose, other: Pose) -> float:
    return float(np.linalg.norm(one.translation - other.translation))


def _shifted(world_from_cam: Pose, world: FloatArray, rays: FloatArray, limit: float) -> Pose:
    """The pose, moved sideways if it puts most points (n, 3) further than the limit from their rays (n, 2):
    after a shift that nobody foresaw the refinement would take them all for outliers.
    """
    in_cam = world_from_cam.inverse().transform(world)
    ahead = in_cam[:, 2] > 0.0
    if not ahead.any():
        return world_from_cam
    offsets = np.sort(in_cam[ahead, :2] / in_cam[ahead, 2:] - rays[ahead], axis=0)
    x, y = offsets[len(offsets) // 2]  # the median
    if math.hypot(x, y) < limit:
        return world_from_cam
    depth = float(np.median(in_cam[:, 2]))
    return world_from_cam @ Pose(np.eye(3), np.array([x * depth, y * depth, 0.0]))


@njit(cache=True, nogil=True)
def _inside(px, border, width, height):  # type: ignore[no-untyped-def]
    """Rows of the positions (n, 2) that are so far inside the picture."""
    rows = np.empty(px.shape[0], np.int64)
    count = 0
    for k in range(px.shape[0]):
        x, y = px[k]
        if border <= x <= width - 1.0 - border and border <= y <= height - 1.0 - border:
            rows[count] = k
            count += 1
    return rows[:count]
