"""An analogue video link: snow, lines torn sideways, smeared colour, ghosts, bursts of lost lines."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from overfly.types import UInt8Array


@dataclass(frozen=True, slots=True)
class RadioLink:
    """snow: RMS of the noise in codes; tear_px: RMS of the sideways jitter of lines; ghost: share of the
    echo; burst: chance that a frame has a torn, noisy band.
    """

    snow: float = 6.0
    tear_px: float = 0.35
    ghost: float = 0.10
    ghost_px: int = 7
    burst: float = 0.12


def receive(image: UInt8Array, link: RadioLink, generator: np.random.Generator) -> UInt8Array:
    """image (h, w, channels) as it comes out of the receiver."""
    height, width = image.shape[:2]
    picture = image.astype(np.float32).reshape(height, width, -1)
    shifts = np.asarray(generator.normal(0.0, link.tear_px, height))
    snow = np.full(height, link.snow, dtype=np.float32)
    if generator.random() < link.burst:
        first = int(generator.integers(0, height))
        rows = slice(first, first + int(generator.integers(6, max(7, height // 6))))
        shifts[rows] += generator.normal(0.0, 0.02 * width) * np.linspace(1.0, 0.0, len(shifts[rows]))
        snow[rows] *= 5.0
    columns = (np.arange(width)[None, :] - shifts[:, None]).astype(np.float32)
    rows_at = np.repeat(np.arange(height, dtype=np.float32)[:, None], width, axis=1)
    torn = cv2.remap(picture, columns, rows_at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    torn = torn.reshape(height, width, -1)
    # The video band is narrower than the camera's: a short smear along the line, and an echo of it.
    smeared = cv2.GaussianBlur(torn, (5, 1), 0.8).reshape(torn.shape)
    echo = np.roll(smeared, link.ghost_px, axis=1)
    out = (1.0 - link.ghost) * smeared + link.ghost * echo
    noise = generator.standard_normal((height, width, 1), dtype=np.float32) * snow[:, None, None]
    return np.clip(out + cv2.GaussianBlur(noise, (3, 1), 0.6).reshape(height, width, 1), 0, 255).astype(
        np.uint8
    )
