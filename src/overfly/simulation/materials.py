"""Natural grounds: grass, meadow, soil, gravel, bark. Each is a material: (patch, seed) -> linear
reflectance.
"""

from __future__ import annotations

import numpy as np

from overfly.simulation.patches import Patch, mix
from overfly.types import Float32Array


def grass(patch: Patch, seed: int) -> Float32Array:
    """Lawn: dark between the blades, lighter where they lean, worn and dry in patches."""
    tufts = patch.noise(seed, 0.10, finest_m=0.004, gain=0.95)
    lean = patch.noise(seed + 1, 0.35, finest_m=0.02, gain=0.8, stretch=2.0, angle_rad=0.4)
    patches = patch.noise(seed + 2, 2.5, finest_m=0.10, gain=0.65)
    green = mix((0.030, 0.055, 0.016), (0.125, 0.185, 0.055), 0.42 + 0.27 * tufts + 0.14 * lean)
    dry = mix((0.10, 0.09, 0.04), (0.30, 0.26, 0.14), 0.45 + 0.25 * tufts + 0.15 * lean)
    return mix(green, dry, 0.16 + 0.26 * patches)


def meadow(patch: Patch, seed: int) -> Float32Array:
    """Rough grass seen from high up: clumps, tracks of wet and dry, bushes as dark grains."""
    clumps = patch.noise(seed, 1.4, finest_m=0.03, gain=0.95)
    wet = patch.noise(seed + 1, 60.0, finest_m=2.0, gain=0.6)
    grains = patch.noise(seed + 2, 5.0, finest_m=0.2, gain=0.7, ridged=True)
    base = mix((0.045, 0.075, 0.022), (0.16, 0.18, 0.075), 0.45 + 0.22 * clumps + 0.10 * grains)
    return mix(base, mix((0.14, 0.12, 0.06), (0.29, 0.25, 0.13), 0.5 + 0.25 * clumps), 0.3 + 0.4 * wet)


def soil(patch: Patch, seed: int) -> Float32Array:
    """Bare earth: crumbs at all sizes, damp and dry areas."""
    crumbs = patch.noise(seed, 0.10, finest_m=0.002, gain=0.85)
    clods = patch.noise(seed + 1, 0.5, finest_m=0.03, gain=0.6, ridged=True)
    damp = patch.noise(seed + 2, 2.5, finest_m=0.2)
    dry = mix((0.06, 0.042, 0.028), (0.26, 0.195, 0.135), 0.48 + 0.2 * crumbs + 0.12 * clods)
    wet = mix((0.03, 0.021, 0.014), (0.13, 0.095, 0.065), 0.48 + 0.2 * crumbs + 0.12 * clods)
    return mix(dry, wet, 0.35 + 0.4 * damp)


def sand(patch: Patch, seed: int) -> Float32Array:
    """Sand or fine gravel: bright, with grain and faint ripples."""
    grain = patch.noise(seed, 0.02, finest_m=0.001, gain=0.9)
    ripples = patch.noise(seed + 1, 0.35, finest_m=0.05, stretch=4.0, angle_rad=1.1)
    return mix((0.22, 0.18, 0.12), (0.50, 0.43, 0.31), 0.5 + 0.14 * grain + 0.14 * ripples)


def gravel_bed(patch: Patch, seed: int) -> Float32Array:
    """What lies between pebbles; the pebbles themselves are scattered on it."""
    grain = patch.noise(seed, 0.06, finest_m=0.002, gain=0.9)
    drift = patch.noise(seed + 1, 1.5, finest_m=0.1)
    return mix((0.07, 0.065, 0.058), (0.30, 0.285, 0.26), 0.42 + 0.22 * grain + 0.10 * drift)


def forest_floor(patch: Patch, seed: int) -> Float32Array:
    """Brown litter under trees, with moss."""
    litter = patch.noise(seed, 0.15, finest_m=0.004, gain=0.85)
    moss = patch.noise(seed + 1, 0.9, finest_m=0.03, gain=0.65)
    brown = mix((0.035, 0.024, 0.015), (0.20, 0.14, 0.085), 0.45 + 0.22 * litter)
    return mix(brown, mix((0.03, 0.05, 0.012), (0.12, 0.16, 0.04), 0.5 + 0.2 * litter), 0.9 * moss - 0.3)


def plain(red: float, green: float, blue: float, contrast: float = 0.08):  # type: ignore[no-untyped-def]
    """A painted or plastic surface of one colour with faint dirt."""

    def material(patch: Patch, seed: int) -> Float32Array:
        dirt = patch.noise(seed, 0.4, finest_m=0.003, gain=0.8)
        return np.clip(
            np.asarray((red, green, blue), dtype=np.float32) * (1.0 + contrast * dirt)[..., None], 0.0, 1.0
        ).astype(np.float32)

    return material


def crown(patch: Patch, seed: int) -> Float32Array:
    """Leaves of a tree from above: clumps, bright tips and dark gaps."""
    clumps = patch.noise(seed, 1.6, finest_m=0.05, gain=0.85)
    gaps = patch.noise(seed + 1, 0.7, finest_m=0.05, gain=0.8, ridged=True)
    return mix((0.012, 0.022, 0.006), (0.085, 0.125, 0.035), 0.42 + 0.25 * clumps + 0.15 * gaps)
