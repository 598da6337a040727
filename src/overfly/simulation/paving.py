"""Built grounds: slabs, bricks, asphalt, concrete, wooden and tiled floors. Each is a material: (patch, seed)
-> reflectance.
"""

from __future__ import annotations

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.simulation.noise import hashed_uniform
from overfly.simulation.patches import Material, Patch, line_coverage, mix
from overfly.types import Float32Array, IntArray


def _cells(
    patch: Patch, length_m: float, width_m: float, stagger: float, seed: int
) -> tuple[IntArray, IntArray, Float32Array, FloatArray]:
    """Courses of rectangles along x: indices (i, j), share of joint-line distance and the distance to the
    nearest joint.

    stagger: share of a length by which each course is shifted against the one below; above 1: a random shift
    per course.
    """
    j = np.broadcast_to(np.floor(patch.y / width_m).astype(np.int64), (patch.n, patch.n))
    shift = hashed_uniform(j, np.zeros_like(j), 1, seed) if stagger > 1.0 else (j * stagger) % 1.0
    along = patch.x / length_m + shift
    i = np.floor(along).astype(np.int64)
    across_joint = patch.y - width_m * np.round(patch.y / width_m)
    along_joint = (along - np.round(along)) * length_m
    distance = np.minimum(np.abs(across_joint), np.abs(along_joint))
    return i, j, distance.astype(np.float32), np.asarray(along - i)


def slabs(
    length_m: float = 0.5, width_m: float = 0.5, joint_m: float = 0.008, stagger: float = 0.0
) -> Material:
    """Concrete slabs: each its own shade, worn grain, stains, dark joints."""

    def material(patch: Patch, seed: int) -> Float32Array:
        i, j, joint, _ = _cells(patch, length_m, width_m, stagger, seed)
        shade = hashed_uniform(i, j, 2, seed).astype(np.float32) - 0.5
        warmth = hashed_uniform(i, j, 3, seed).astype(np.float32)
        grain = patch.noise(seed + 1, 0.05, finest_m=0.001, gain=0.9)
        stains = patch.noise(seed + 2, 0.8, finest_m=0.02, gain=0.6)
        level = 0.5 + 0.35 * shade + 0.10 * grain + 0.15 * stains
        cold = mix((0.17, 0.17, 0.165), (0.42, 0.42, 0.41), level)
        warm = mix((0.20, 0.17, 0.14), (0.46, 0.40, 0.34), level)
        dirt = patch.noise(seed + 3, 0.15, finest_m=0.004, gain=0.8)
        line = line_coverage(joint, joint_m, patch.texel_m) * np.clip(0.8 + 0.25 * dirt, 0.3, 1.0)
        return mix(mix(cold, warm, warmth), (0.045, 0.045, 0.035), line)

    return material


def bricks(length_m: float = 0.21, width_m: float = 0.105, joint_m: float = 0.006) -> Material:
    """Clinker paving in running bond."""

    def material(patch: Patch, seed: int) -> Float32Array:
        i, j, joint, _ = _cells(patch, length_m, width_m, 0.5, seed)
        shade = hashed_uniform(i, j, 2, seed).astype(np.float32)
        grain = patch.noise(seed + 1, 0.03, finest_m=0.001, gain=0.9)
        wear = patch.noise(seed + 2, 1.5, finest_m=0.1)
        red = mix((0.14, 0.062, 0.042), (0.36, 0.19, 0.13), 0.75 * shade + 0.10 * grain + 0.12 * wear + 0.1)
        grey = mix((0.10, 0.09, 0.085), (0.24, 0.21, 0.20), shade + 0.10 * grain)
        body = mix(red, grey, (hashed_uniform(i, j, 3, seed) > 0.86).astype(np.float32))
        return mix(body, (0.17, 0.155, 0.12), line_coverage(joint, joint_m, patch.texel_m))

    return material


def asphalt(patch: Patch, seed: int) -> Float32Array:
    """Grey with stones at the surface, repairs, cracks sealed with tar."""
    stones = patch.noise(seed, 0.025, finest_m=0.002, gain=0.95)
    worn = patch.noise(seed + 1, 1.8, finest_m=0.1, gain=0.6)
    base = mix((0.055, 0.055, 0.057), (0.20, 0.195, 0.19), 0.42 + 0.20 * stones + 0.14 * worn)
    cracks = patch.noise(seed + 2, 2.5, finest_m=0.08, gain=0.55)
    line = line_coverage(cracks.astype(np.float64) * 0.6, 0.02, max(patch.texel_m, 0.004))
    some = np.clip(2.0 * patch.noise(seed + 3, 4.0, finest_m=1.0) - 0.6, 0.0, 0.8)
    return mix(base, (0.02, 0.02, 0.02), line * some)


def concrete(patch: Patch, seed: int) -> Float32Array:
    """Smooth screed: almost no texture, faint clouds, few pores. Hard on purpose."""
    clouds = patch.noise(seed, 1.2, finest_m=0.05, gain=0.5)
    pores = patch.noise(seed + 1, 0.015, finest_m=0.001, gain=0.9)
    return mix((0.26, 0.26, 0.25), (0.42, 0.415, 0.405), 0.5 + 0.14 * clouds + 0.05 * pores)


def wood_floor(length_m: float = 1.4, width_m: float = 0.12) -> Material:
    """Planks along x with grain, knots, shades per plank and thin dark joints."""

    def material(patch: Patch, seed: int) -> Float32Array:
        i, j, joint, _ = _cells(patch, length_m, width_m, 2.0, seed)
        shade = hashed_uniform(i, j, 2, seed).astype(np.float32)
        grain = patch.noise(seed + 1, 0.030, finest_m=0.0015, gain=0.8, stretch=22.0)
        cloud = patch.noise(seed + 2, 0.22, finest_m=0.01, gain=0.6, stretch=5.0)
        knots = np.clip(patch.noise(seed + 3, 0.30, finest_m=0.1, stretch=1.8) - 2.1, 0.0, 0.6)
        level = 0.12 + 0.62 * shade + 0.13 * grain + 0.10 * cloud - knots
        body = mix((0.125, 0.066, 0.030), (0.44, 0.29, 0.155), level)
        return mix(body, (0.03, 0.018, 0.010), 0.85 * line_coverage(joint, 0.003, patch.texel_m))

    return material


def tiled_floor(tile_m: float = 0.30, joint_m: float = 0.004) -> Material:
    """Ceramic tiles that all look alike: the marbling repeats with every second tile, only dirt tells them
    apart.
    """

    def material(patch: Patch, seed: int) -> Float32Array:
        i, j, joint, _ = _cells(patch, tile_m, tile_m, 0.0, seed)
        dark = ((i + j) % 2).astype(np.float32)
        swirl = np.sin(
            2 * np.pi * (patch.x / tile_m + 0.35 * np.sin(2 * np.pi * patch.y / tile_m))
            + 1.7 * np.sin(4 * np.pi * patch.y / tile_m)
        ) * np.cos(2 * np.pi * (2 * patch.y / tile_m + 0.3 * np.cos(2 * np.pi * patch.x / tile_m)))
        swirl = np.asarray(swirl * np.clip(tile_m / patch.texel_m / 8.0 - 1.0, 0.0, 1.0), dtype=np.float32)
        dirt = patch.noise(seed, 0.5, finest_m=0.003, gain=0.7)
        light = mix((0.36, 0.34, 0.30), (0.56, 0.54, 0.50), 0.5 + 0.35 * swirl + 0.05 * dirt)
        deep = mix((0.16, 0.14, 0.13), (0.30, 0.28, 0.26), 0.5 + 0.35 * swirl + 0.05 * dirt)
        return mix(mix(light, deep, dark), (0.10, 0.10, 0.095), line_coverage(joint, joint_m, patch.texel_m))

    return material


def carpet_tiles(tile_m: float = 0.5) -> Material:
    """Office carpet: loop pile turned by a quarter from tile to tile."""

    def material(patch: Patch, seed: int) -> Float32Array:
        i, j, joint, _ = _cells(patch, tile_m, tile_m, 0.0, seed)
        along_x = patch.noise(seed, 0.02, finest_m=0.002, gain=0.9, stretch=5.0)
        along_y = patch.noise(seed + 1, 0.02, finest_m=0.002, gain=0.9, stretch=5.0, angle_rad=np.pi / 2)
        pile = np.where((i + j) % 2 == 0, along_x, along_y)
        wear = patch.noise(seed + 2, 1.5, finest_m=0.05)
        body = mix((0.05, 0.06, 0.075), (0.17, 0.185, 0.21), 0.45 + 0.22 * pile + 0.12 * wear)
        return mix(body, (0.03, 0.035, 0.045), 0.6 * line_coverage(joint, 0.003, patch.texel_m))

    return material
