"""Pixels from rays: where each pixel's ray meets the ground, the texture there at the pixel's own scale, and
the light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray
from overfly.simulation.relief import HeightField, meet_ground
from overfly.simulation.tiles import FINEST_EXPONENT, LEVELS, TILE, TileCache, find_tile, tile_key
from overfly.types import Float32Array

_MOST_WANTED = 4096
_PER_METRE = 2.0 ** (FINEST_EXPONENT - np.arange(LEVELS + 1.0))  # texels per metre of each level
SKY = 0.8  # radiance of rays that never meet the ground


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
    _trace(hits, rays, rotations, centres, level_shift, *relief.kernel_arguments(), movers.clouds, cloud)
    wanted = np.empty(_MOST_WANTED, dtype=np.int64)
    for _ in range(8):
        layer = np.zeros_like(radiance)
        count = _sample(
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


@njit(cache=True, nogil=True, error_model="numpy")
def _note(wanted, count, key):  # type: ignore[no-untyped-def]
    """Append key to wanted unless the last few are the same; the rest of the duplicates are dropped later."""
    for k in range(max(0, count - 8), count):
        if wanted[k] == key:
            return count
    if count < len(wanted):
        wanted[count] = key
        return count + 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _cloud_light(clouds, cloud, x, y):  # type: ignore[no-untyped-def]
    """Periodic bilinear look-up of the light that clouds let through."""
    rows, cols = clouds.shape
    u, v = (x - cloud[1]) / cloud[0], (y - cloud[2]) / cloud[0]
    c, r = math.floor(u), math.floor(v)
    fu, fv = u - c, v - r
    c0, r0 = c % cols, r % rows
    c1, r1 = (c0 + 1) % cols, (r0 + 1) % rows
    low = clouds[r0, c0] * (1.0 - fu) + clouds[r0, c1] * fu
    high = clouds[r1, c0] * (1.0 - fu) + clouds[r1, c1] * fu
    return low * (1.0 - fv) + high * fv


@njit(cache=True, nogil=True, error_model="numpy")
def _grid_light(light, frame, x, y):  # type: ignore[no-untyped-def]
    rows, cols = light.shape
    u, v = (x - frame[0]) / frame[2], (y - frame[1]) / frame[2]
    if not (0.0 <= u < cols - 1 and 0.0 <= v < rows - 1):
        return 1.0
    c, r = int(u), int(v)
    fu, fv = u - c, v - r
    low = light[r, c] * (1.0 - fu) + light[r, c + 1] * fu
    high = light[r + 1, c] * (1.0 - fu) + light[r + 1, c + 1] * fu
    return low * (1.0 - fv) + high * fv


@njit(cache=True, nogil=True, error_model="numpy")
def _mover_share(disc, x, y, footprint):  # type: ignore[no-untyped-def]
    """Share of a pixel that a moving thing covers: a box with rounded corners, edges one pixel soft."""
    dx, dy = x - disc[0], y - disc[1]
    p, q = abs(disc[2] * dx + disc[3] * dy), abs(disc[2] * dy - disc[3] * dx)
    corner = disc[7] * min(disc[4], disc[5])
    p, q = p - disc[4] + corner, q - disc[5] + corner
    outside = math.sqrt(max(p, 0.0) ** 2 + max(q, 0.0) ** 2) + min(max(p, q), 0.0) - corner
    return min(max(0.5 - outside / footprint, 0.0), 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _trace_row(hits, rays, R, centre, level_shift, z, light, blocks, frame, clouds, cloud):  # type: ignore[no-untyped-def]
    """hits (width, 4) of one image row: x, y on the ground, texture level (-1: sky, -2: no ray), light."""
    cloudy = clouds.size > 1
    flat = frame[5] - frame[4] < 1e-9
    texels_at_1m = 2.0**level_shift
    level, half = 0, 1.0
    for col in range(rays.shape[0]):
        x, y = rays[col, 0], rays[col, 1]
        hits[col, 2] = -2.0
        if math.isnan(x):
            continue
        dx = R[0, 0] * x + R[0, 1] * y + R[0, 2]
        dy = R[1, 0] * x + R[1, 1] * y + R[1, 2]
        dz = R[2, 0] * x + R[2, 1] * y + R[2, 2]
        if flat:
            t = (frame[5] - centre[2]) / dz if dz < -1e-3 else math.inf
        else:
            t = meet_ground(centre[0], centre[1], centre[2], dx, dy, dz, z, blocks, frame)
        hits[col, 2] = -1.0
        if not t < 1e6:
            continue
        gx, gy = centre[0] + t * dx, centre[1] + t * dy
        shade = 1.0 if flat else _grid_light(light, frame, gx, gy)
        if cloudy:
            shade *= _cloud_light(clouds, cloud, gx, gy)
        hits[col, 0], hits[col, 1], hits[col, 3] = gx, gy, shade
        # The texture level, linear between powers of two; found from the last pixel's, which is nearly always
        # the same.
        texels = max(t, 1e-3) * texels_at_1m
        while texels * half >= 2.0 and level < LEVELS - 2:
            level += 1
            half *= 0.5
        while texels * half < 1.0 and level > 0:
            level -= 1
            half *= 2.0
        hits[col, 2] = level + min(max(texels * half - 1.0, 0.0), 0.999)


@njit(cache=True, nogil=True, error_model="numpy")
def _sample_row(out, hits, step, pool, keys, table, last_used, clock, wanted, count):  # type: ignore[no-untyped-def]
    """Fill out (width, channels) from level floor(level) + step; step 0 starts the pixel, step 1 completes
    it.
    """
    seen_level, seen_i, seen_j, slot = -1, 0, 0, -1
    for col in range(out.shape[0]):
        level = int(hits[col, 2]) + step
        if hits[col, 2] < 0.0:
            continue
        share = hits[col, 2] - int(hits[col, 2])
        weight = np.float32(hits[col, 3] * (share if step else 1.0 - share) / 65535.0)
        su, sv = hits[col, 0] * _PER_METRE[level] - 0.5, hits[col, 1] * _PER_METRE[level] - 0.5
        u, v = math.floor(su), math.floor(sv)
        if (u >> 7) != seen_i or (v >> 7) != seen_j or level != seen_level:
            seen_i, seen_j, seen_level = u >> 7, v >> 7, level
            key = tile_key(level, seen_i, seen_j)
            slot = find_tile(key, keys, table)
            if slot < 0:
                count = _note(wanted, count, key)
            else:
                last_used[slot] = clock
        if slot < 0:
            continue
        fu, fv = np.float32(su - u), np.float32(sv - v)
        c, r = u & (TILE - 1), v & (TILE - 1)
        w11 = weight * fu * fv
        w10, w01 = weight * fv - w11, weight * fu - w11
        w00 = weight - w10 - w01 - w11
        for k in range(out.shape[1]):
            out[col, k] += (
                w00 * pool[slot, r, c, k] + w01 * pool[slot, r, c + 1, k]
                + w10 * pool[slot, r + 1, c, k] + w11 * pool[slot, r + 1, c + 1, k]
            )  # fmt: skip
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _overlay_row(out, hits, discs):  # type: ignore[no-untyped-def]
    """Sky, and moving things, over one image row."""
    for col in range(out.shape[0]):
        if hits[col, 2] == -1.0:
            out[col, :] = SKY
        if hits[col, 2] < 0.0:
            continue
        for m in range(discs.shape[0]):
            footprint = 1.0 / _PER_METRE[int(hits[col, 2])]
            cover = np.float32(_mover_share(discs[m], hits[col, 0], hits[col, 1], footprint))
            if cover <= 0.0:
                continue
            for k in range(out.shape[1]):
                if discs[m, 6] >= 0.0:
                    out[col, k] += cover * (np.float32(discs[m, 6] * hits[col, 3]) - out[col, k])
                else:
                    out[col, k] *= np.float32(1.0) + cover * np.float32(discs[m, 6])


@njit(cache=True, nogil=True, error_model="numpy")
def _trace(  # type: ignore[no-untyped-def]
    hits, rays, rotations, centres, level_shift, z, light, blocks, frame, clouds, cloud
):
    """Fill hits (h, w, 4), see :func:`_trace_row`."""
    for row in range(rays.shape[0]):
        R, centre = rotations[row], centres[row]
        _trace_row(hits[row], rays[row], R, centre, level_shift, z, light, blocks, frame, clouds, cloud)


@njit(cache=True, nogil=True, error_model="numpy")
def _sample(out, hits, discs, pool, keys, table, last_used, clock, wanted):  # type: ignore[no-untyped-def]
    """Fill out (h, w, channels), zeros, with radiance; returns how many tiles are missing: keys in wanted."""
    count = 0
    for row in range(hits.shape[0]):
        count = _sample_row(out[row], hits[row], 0, pool, keys, table, last_used, clock, wanted, count)
        count = _sample_row(out[row], hits[row], 1, pool, keys, table, last_used, clock, wanted, count)
        _overlay_row(out[row], hits[row], discs)
    return count
