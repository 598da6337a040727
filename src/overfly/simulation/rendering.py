"""Pixels from rays: where each pixel's ray meets the ground, the texture there at the pixel's own scale, and
the light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray
from overfly.simulation.kernels import FINEST_EXPONENT, sample, trace
from overfly.simulation.relief import HeightField
from overfly.simulation.tiles import TileCache
from overfly.types import Float32Array

_MOST_WANTED = 4096


@dataclass(frozen=True, slots=True, eq=False)
class Movers:
    """Things that move and light that moves, as they are at one time.

    discs (m, 8): x, y, cos, sin of heading, half length, half width (metres), reflectance, corner roundness
    0..1; a reflectance below zero darkens what is there to that share instead (a shadow). clouds: periodic
    grid of light shares, cloud_m metres per cell, moved by cloud_offset_m.
    """

    discs: FloatArray
    clouds: Float32Array
    cloud_m: float
    cloud_offset_m: tuple[float, float]


NO_MOVERS = Movers(np.zeros((0, 8)), np.ones((1, 1), dtype=np.float32), 1.0, (0.0, 0.0))


def pixel_rays(camera: Camera) -> FloatArray:
    """(h, w, 2) undistorted image coordinates of every pixel's centre."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    rays = camera.rays_from_pixels(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
    return rays.reshape(camera.height, camera.width, 2)


def add_exposure(
    radiance: Float32Array,
    rays: FloatArray,
    rotations: FloatArray,
    centres: FloatArray,
    focal_px: float,
    relief: HeightField,
    tiles: TileCache,
    weight: float,
    movers: Movers = NO_MOVERS,
    sharpness: float = 0.3,
) -> None:
    """Add ``weight`` times the image of the ground to radiance (h, w, channels), linear, in place.

    rays: see :func:`pixel_rays`; NaN rays stay black. rotations (h, 3, 3) and centres (h, 3): world_from_cam
    of every row, which is what a rolling shutter is. sharpness: levels finer than one texel per pixel.
    """
    hits = np.empty((*rays.shape[:2], 4))
    level_shift = FINEST_EXPONENT - sharpness - math.log2(focal_px)
    cloud = np.array([movers.cloud_m, *movers.cloud_offset_m])
    trace(hits, rays, rotations, centres, level_shift, *relief.kernel_arguments(), movers.clouds, cloud)
    wanted = np.empty(_MOST_WANTED, dtype=np.int64)
    for _ in range(8):
        layer = np.zeros_like(radiance)
        count = sample(
            layer,
            hits,
            movers.discs,
            tiles.pool,
            tiles.keys,
            tiles.table,
            tiles.last_used,
            tiles.clock,
            wanted,
        )
        if not count:
            radiance += np.float32(weight) * layer
            return
        tiles.add(wanted[:count])  # and look again
    raise RuntimeError("one frame sees more ground tiles than the cache holds: give TileCache more capacity")
