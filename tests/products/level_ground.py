"""Level textured ground, and what a camera that flies over it sees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import Pose, rotation_z
from overfly.products.cog import TILE_PX
from overfly.products.growing_mosaic import POINTS, NodePicture, Placement

LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])
CAMERA = Camera(240, 180, 200.0, 200.0, 119.5, 89.5)
HEIGHT_M = 4.0
PX_M = HEIGHT_M / CAMERA.fx
TEXEL_M = 2 * PX_M
TILE_M = TILE_PX * PX_M
_noise = np.random.default_rng(0).normal(size=(700, 700))
TEXTURE = sum(
    scale * ndimage.gaussian_filter(_noise, scale, mode="wrap") for scale in (2.0, 5.0, 20.0)
)  # of a square that repeats itself
TEXTURE = 125 + 28 * TEXTURE / np.std(TEXTURE)

Floats = NDArray[np.float64]


def brightness(x: Floats, y: Floats) -> Floats:
    where = [-y / TEXEL_M, x / TEXEL_M]
    return np.clip(ndimage.map_coordinates(TEXTURE, where, order=1, mode="grid-wrap"), 30, 220)


def above(x: float, y: float, yaw_rad: float = 0.0, height_m: float = HEIGHT_M) -> Pose:
    return Pose(rotation_z(yaw_rad) @ LOOKING_DOWN, np.array([x, y, height_m]))


def seen_from(pose: Pose, gain: float = 1.0) -> NDArray[np.uint8]:
    """What the camera sees of level textured ground."""
    column, row = np.meshgrid(np.arange(CAMERA.width, dtype=float), np.arange(CAMERA.height, dtype=float))
    rays = CAMERA.rays_from_pixels(np.stack([column.ravel(), row.ravel()], axis=1))
    direction = np.column_stack([rays, np.ones(len(rays))]) @ pose.rotation.T
    xy = pose.translation[:2] - direction[:, :2] / direction[:, 2:] * pose.translation[2]
    value = gain * brightness(xy[:, 0], xy[:, 1])
    return np.clip(value + 0.5, 0, 255).astype(np.uint8).reshape(CAMERA.height, CAMERA.width)


def placement(poses: list[Pose], is_placed: list[bool] | None = None) -> Placement:
    """Nodes whose points lie on the ground."""
    rays = np.random.default_rng(1).uniform(-0.4, 0.4, (POINTS, 2))
    rays = np.column_stack([rays, np.ones(POINTS), np.full(POINTS, 0.01)])
    points = np.stack([pose.translation[2] * rays for pose in poses])
    return Placement(
        np.array([pose.translation for pose in poses]),
        np.array([pose.rotation for pose in poses]),
        np.ones(len(poses), np.bool_) if is_placed is None else np.array(is_placed),
        0,
        points,
    )


def pictures(poses: list[Pose], first: int = 0, gains: tuple[float, ...] = (1.0,)) -> list[NodePicture]:
    return [
        NodePicture(number, seen_from(poses[number], gains[number % len(gains)]))
        for number in range(first, len(poses))
    ]


def grid_flight(columns: int = 4, rows: int = 3) -> list[Pose]:
    turns = np.random.default_rng(2).uniform(-3, 3, columns * rows)
    places = [(1.9 * column, 1.4 * row) for row in range(rows) for column in range(columns)]
    return [above(x, y, yaw) for (x, y), yaw in zip(places, turns.tolist(), strict=True)]
