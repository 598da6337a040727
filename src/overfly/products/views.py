"""Located images as seen from the ground: where a ground point falls in each, and how well it is seen."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.products.elevation import ElevationGrid
from overfly.types import BoolArray, UInt8Array

STEEPEST_TAN = 3.0  # ground seen further from straight down than this (72 degrees) is a smear, not a map
FADE = 0.12  # of the image: the zone along its border that seams keep away from
BORDER_PX = 1.5  # outermost pixels: debayering and compression leave seams there


@dataclass(frozen=True, slots=True, eq=False)
class MappedImage:
    """A picture and where it was taken. load: gives uint8 (H, W) or (H, W, 3) RGB, distorted as recorded."""

    name: str
    load: Callable[[], UInt8Array]
    camera: Camera
    world_from_cam: Pose


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A mapped image prepared for lookups from the ground.

    ray_limit: radius of the rays that the image's border sees; beyond it distortion models may fold back
    into the image. outline (m, 2): where the border meets the ground, metres, world. gsd_m: ground length
    of a pixel below the camera.
    """

    image: MappedImage
    ray_limit: float
    outline: FloatArray
    gsd_m: float

    @property
    def low(self) -> FloatArray:
        return np.asarray(self.outline.min(axis=0))

    @property
    def high(self) -> FloatArray:
        return np.asarray(self.outline.max(axis=0))

    def may_see(self, points: FloatArray) -> BoolArray:
        """(n,) which points (n, 2 or more), metres, world, lie in the rectangle around the outline."""
        low, high, x, y = self.low, self.high, points[:, 0], points[:, 1]
        return np.asarray((x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1]))

    @property
    def centre(self) -> FloatArray:
        return np.asarray(self.outline.mean(axis=0))


def view_of(image: MappedImage, ground: ElevationGrid, height_range_m: tuple[float, float]) -> View | None:
    """The view of an image; None when it does not look down on the ground. height_range_m: of the ground."""
    rays = border_rays(image.camera)
    centre = image.world_from_cam.translation
    height_m = float(centre[2] - ground.height_at(centre[0], centre[1]))
    directions = np.column_stack([rays, np.ones(len(rays))]) @ image.world_from_cam.rotation.T
    if height_m <= 0 or len(rays) < 8 or image.world_from_cam.rotation[2, 2] >= -0.1:
        return None
    flat = np.linalg.norm(directions[:, :2], axis=1)
    down = np.maximum(-directions[:, 2], flat / STEEPEST_TAN)
    levels = {*height_range_m, float(centre[2]) - height_m}
    outline = [
        centre[:2] + directions[:, :2] / down[:, None] * (centre[2] - level)
        for level in levels
        if level < centre[2]
    ]
    return View(
        image,
        float(np.linalg.norm(rays, axis=1).max()),
        np.concatenate(outline),
        height_m / image.camera.focal_px,
    )


def look_up(view: View, camera: Camera, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where ground points fall in the image, (n, 2) pixels, and what it costs to take them from there, (n,).

    points: (n, 3) metres, world; camera: that of the view, scaled to the picture in use. The cost is the
    squared distance, so that the nearest camera, which sees finest and steepest, wins; it rises towards
    the image's border, so that seams keep away from it. Infinite where the point is not seen; the pixels
    are outside the image there, but continuous.
    """
    pose = view.image.world_from_cam
    points = np.ascontiguousarray(points, np.float64)
    rays, stretch = _rays(points, pose.rotation, pose.translation, view.ray_limit)
    px = camera.pixels_from_rays(rays)
    cost = _costs(
        px, points, stretch, pose.rotation, pose.translation,
        (camera.cx, camera.cy, float(camera.width), float(camera.height)),
    )  # fmt: skip
    return px, np.asarray(cost)


@njit(cache=True, nogil=True)
def _rays(points, rotation, centre, limit):  # type: ignore[no-untyped-def]
    """(n, 2) rays of points, drawn in to the limit, and by how much (n,)."""
    rays, stretch = np.empty((len(points), 2)), np.empty(len(points))
    for n in range(len(points)):
        dx, dy, dz = points[n, 0] - centre[0], points[n, 1] - centre[1], points[n, 2] - centre[2]
        x = dx * rotation[0, 0] + dy * rotation[1, 0] + dz * rotation[2, 0]
        y = dx * rotation[0, 1] + dy * rotation[1, 1] + dz * rotation[2, 1]
        z = dx * rotation[0, 2] + dy * rotation[1, 2] + dz * rotation[2, 2]
        depth = max(z, 0.02 * math.sqrt(x * x + y * y + z * z))
        stretch[n] = max(1.0, math.sqrt(x * x + y * y) / (depth * limit))
        rays[n, 0], rays[n, 1] = x / (depth * stretch[n]), y / (depth * stretch[n])
    return rays, stretch


@njit(cache=True, nogil=True)
def _costs(px, points, stretch, rotation, centre, frame):  # type: ignore[no-untyped-def]
    """(n,) costs; px (n, 2) are moved out by the stretch, in place. frame: cx, cy, width, height."""
    cx, cy, width, height = frame
    costs = np.empty(len(points))
    for n in range(len(points)):
        dx, dy, dz = points[n, 0] - centre[0], points[n, 1] - centre[1], points[n, 2] - centre[2]
        z = dx * rotation[0, 2] + dy * rotation[1, 2] + dz * rotation[2, 2]
        squared = dx * dx + dy * dy + dz * dz
        column = cx + (px[n, 0] - cx) * stretch[n]
        row = cy + (px[n, 1] - cy) * stretch[n]
        px[n, 0], px[n, 1] = column, row
        inside = min(column + 0.5, width - 0.5 - column, row + 0.5, height - 0.5 - row)
        fade = min(max(1.0 - inside / (FADE * min(width, height)), 0.0), 1.0)
        hidden = inside < BORDER_PX or z <= 0.0 or squared > (1.0 + STEEPEST_TAN**2) * dz * dz
        costs[n] = np.inf if hidden else squared * (1.0 + 2.0 * fade * fade)
    return costs


def spread_out(views: list[View], overlap: float) -> list[View]:
    """Views whose neighbours overlap by about ``overlap`` of their length at most, in their order."""
    chosen: list[View] = []
    centres = np.zeros((0, 2))
    for view in views:
        size = view.high - view.low
        least = (1.0 - overlap) * math.sqrt(float(size[0] * size[1]))
        if len(centres) == 0 or np.min(np.linalg.norm(centres - view.centre, axis=1)) >= least:
            chosen.append(view)
            centres = np.vstack([centres, view.centre])
    return chosen


def border_rays(camera: Camera) -> FloatArray:
    """(m, 2) rays through the border of the image; those the model cannot invert are left out."""
    x = np.linspace(-0.5, camera.width - 0.5, 17)
    y = np.linspace(-0.5, camera.height - 0.5, 17)
    left, top = np.full(17, -0.5), np.full(17, -0.5)
    right, bottom = np.full(17, camera.width - 0.5), np.full(17, camera.height - 0.5)
    border = np.concatenate(
        [np.stack(side, axis=1) for side in ((x, top), (x, bottom), (left, y), (right, y))]
    )
    rays = camera.rays_from_pixels(border)
    return rays[np.isfinite(rays).all(axis=1)]
