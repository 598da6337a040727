"""Parts that several scenarios share: cameras as cheap as the paper's, and stereo rigs."""

from __future__ import annotations

import math

from overfly.geometry.cameras import Camera
from overfly.simulation.degradation import ImageQuality
from overfly.simulation.optics import CameraSetup, looking_down

# About a Logitech Communicate STX: 320x240 over a diagonal of some 65 degrees, mild barrel distortion.
WEBCAM = Camera(320, 240, 288.0, 288.0, 161.4, 116.6, coefficients=(-0.12, 0.05, 0.0006, -0.0004))


def mono(
    camera: Camera = WEBCAM,
    exposure_s: float = 0.010,
    quality: ImageQuality = ImageQuality(),  # noqa: B008  (frozen)
    *,
    color: bool = False,
    readout_s: float = 0.0,
) -> tuple[CameraSetup, ...]:
    """One camera that looks down, mounted a little crooked, as they are."""
    mount = looking_down(0.05, 0.0, -0.03, math.radians(0.6), math.radians(-0.8), math.radians(0.4))
    return (CameraSetup("cam0", camera, mount, exposure_s, readout_s, color, quality),)


def stereo(
    camera: Camera = WEBCAM,
    baseline_m: float = 0.12,
    exposure_s: float = 0.010,
    quality: ImageQuality = ImageQuality(),  # noqa: B008  (frozen)
    *,
    color: bool = False,
) -> tuple[CameraSetup, ...]:
    """Two cameras side by side, left one first, each mounted a little crooked."""
    left = looking_down(
        0.05, 0.5 * baseline_m, -0.03, math.radians(0.7), math.radians(0.5), math.radians(-0.9)
    )
    right = looking_down(
        0.05, -0.5 * baseline_m, -0.03, math.radians(-0.4), math.radians(-0.3), math.radians(0.6)
    )
    return (
        CameraSetup("cam0", camera, left, exposure_s, 0.0, color, quality),
        CameraSetup("cam1", camera, right, exposure_s, 0.0, color, quality),
    )
