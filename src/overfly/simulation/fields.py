"""Open country from high up: parcels with crops in rows, meadows, ditches between them."""

from __future__ import annotations

import math

import numpy as np

from overfly.simulation.materials import meadow
from overfly.simulation.noise import hashed_uniform
from overfly.simulation.patches import Patch, line_coverage, mix
from overfly.types import Float32Array

PARCEL_M = (140.0, 85.0)
TURN_RAD = 0.35


def farmland(patch: Patch, seed: int) -> Float32Array:
    """Parcels of about 140 m by 85 m, each with its own crop, separated by grassy ditches."""
    c, s = math.cos(TURN_RAD), math.sin(TURN_RAD)
    bend = 2.5 * patch.noise(seed + 9, 120.0, finest_m=30.0)  # field edges are not straight
    u, v = c * patch.x + s * patch.y + bend, c * patch.y - s * patch.x + bend
    j = np.floor(v / PARCEL_M[1]).astype(np.int64)
    along = u / PARCEL_M[0] + hashed_uniform(j, np.zeros_like(j), 1, seed)
    i = np.floor(along).astype(np.int64)
    crop = (5 * hashed_uniform(i, j, 2, seed)).astype(np.int64)
    across = (hashed_uniform(i, j, 3, seed) > 0.5).astype(np.float32)
    albedo = meadow(patch, seed + 50)
    for kind in np.unique(crop):
        if kind:
            here = (crop == kind).astype(np.float32)
            albedo += here[..., None] * (_crop(patch, seed + 10 * int(kind), int(kind), across) - albedo)
    edge_v = np.abs(v - PARCEL_M[1] * np.round(v / PARCEL_M[1]))
    edge_u = np.abs(along - np.round(along)) * PARCEL_M[0]
    edge = np.minimum(edge_u, edge_v)
    verge = mix(meadow(patch, seed + 60), (0.05, 0.065, 0.03), line_coverage(edge, 0.8, patch.texel_m))
    return mix(albedo, verge, line_coverage(edge, 4.0, patch.texel_m))


def _crop(patch: Patch, seed: int, kind: int, across: Float32Array) -> Float32Array:
    """One crop over the whole patch: 1 young corn, 2 stubble, 3 ploughed earth, 4 ripe grain."""
    spacing = (0.75, 0.75, 1.5, 3.0, 0.4)[kind]
    turn = TURN_RAD
    rows = [
        patch.noise(
            seed + k, spacing * 1.3, finest_m=spacing / 4, stretch=25.0, angle_rad=turn + k * math.pi / 2
        )
        for k in (0, 1)
    ]
    lines = rows[0] + across * (rows[1] - rows[0])
    tracks = _tramlines(patch, seed, across)
    clods = patch.noise(seed + 2, 0.8, finest_m=0.03, gain=0.95)
    vigour = patch.noise(seed + 3, 45.0, finest_m=1.5, gain=0.6)
    level = 0.5 + 0.16 * lines + 0.14 * clods + 0.12 * vigour
    dark, bright = (
        ((0.05, 0.08, 0.02), (0.16, 0.18, 0.07)),
        ((0.07, 0.085, 0.035), (0.21, 0.22, 0.10)),
        ((0.15, 0.12, 0.065), (0.40, 0.34, 0.20)),
        ((0.075, 0.052, 0.035), (0.23, 0.165, 0.115)),
        ((0.17, 0.145, 0.06), (0.40, 0.35, 0.17)),
    )[kind]
    return mix(mix(dark, bright, level), (0.11, 0.085, 0.055), 0.65 * tracks)


def _tramlines(patch: Patch, seed: int, across: Float32Array) -> Float32Array:
    """Pairs of wheel tracks every 18 m, along or across the parcel."""
    c, s = math.cos(TURN_RAD), math.sin(TURN_RAD)
    wander = 0.25 * patch.noise(seed + 4, 20.0, finest_m=5.0)
    shares = []
    for v in (c * patch.y - s * patch.x, c * patch.x + s * patch.y):
        offset = np.abs((v + wander + 9.0) % 18.0 - 9.0)
        shares.append(line_coverage(np.abs(offset - 0.9), 0.4, patch.texel_m))
    return np.asarray(shares[0] + across * (shares[1] - shares[0]))
