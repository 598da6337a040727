"""Similarities about the vertical: scale, heading and shift between two sets of places, found robustly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from overfly.geometry.poses import FloatArray

SMALLEST_EXTENT_SIGMAS = 5.0  # a flight shorter than this many GPS sigmas says nothing on scale or heading


@dataclass(frozen=True, slots=True, eq=False)
class VerticalSimilarity:
    """projected = scale * Rz(rotation_rad) world + translation_m, projected in metres of a map projection.

    residuals_m (n, 3) of the positions used; horizontal_rms_m over the inliers of the robust fit.
    """

    scale: float
    rotation_rad: float
    translation_m: FloatArray
    residuals_m: FloatArray
    horizontal_rms_m: float


def align_about_vertical(
    world: FloatArray, projected: FloatArray, sigma_m: FloatArray, iterations: int = 10
) -> VerticalSimilarity | None:
    """The similarity about the vertical that takes world (n, 3) to projected (n, 3), robustly.

    sigma_m (n,): horizontal standard deviations. Positions that disagree count less (Cauchy weights,
    re-estimated). None for fewer than three positions or an extent too small for the positions' accuracy.
    """
    if len(world) < 3:
        return None
    extent = float(np.linalg.norm(np.std(projected[:, :2], axis=0)))
    if extent < SMALLEST_EXTENT_SIGMAS * float(np.median(sigma_m)) / np.sqrt(len(world)):
        return None
    source = world[:, 0] + 1j * world[:, 1]
    target = projected[:, 0] + 1j * projected[:, 1]
    weight = 1.0 / sigma_m**2
    for _ in range(iterations):
        share = weight / weight.sum()
        source_mean, target_mean = (share * source).sum(), (share * target).sum()
        spread = float((share * np.abs(source - source_mean) ** 2).sum())
        if spread <= 0:
            return None
        turn = (share * np.conj(source - source_mean) * (target - target_mean)).sum() / spread
        shift = target_mean - turn * source_mean
        distance = np.abs(turn * source + shift - target)
        typical = max(1.4826 * float(np.median(distance)), 1e-9)
        weight = 1.0 / (sigma_m**2 * (1.0 + (distance / (2.0 * typical)) ** 2))
    scale = float(np.abs(turn))
    if scale <= 0:
        return None
    lift = float(np.median(projected[:, 2] - scale * world[:, 2]))
    fitted = turn * source + shift
    residuals = np.column_stack(
        [
            fitted.real - projected[:, 0],
            fitted.imag - projected[:, 1],
            scale * world[:, 2] + lift - projected[:, 2],
        ]
    )
    return VerticalSimilarity(
        scale,
        float(np.angle(turn)),
        np.array([shift.real, shift.imag, lift]),
        residuals,
        float(np.sqrt(np.mean(distance**2))),
    )
