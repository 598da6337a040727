"""Focal length, centre and distortion of the camera, found together with the map (map --refine-camera).

The unknowns are changes against the given calibration that mean the same at every picture size: the focal
length and the centre in shares of the focal length, and the first two radial coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray
from overfly.types import Rig

# How far a given calibration may be off, one standard deviation: focal lengths from EXIF are good to some per
# cent, centres lie within a few per cent of the middle.
EXPECTED_SIGMA = np.array([0.05, 0.02, 0.02, 0.1, 0.1])


@dataclass(frozen=True, slots=True)
class RefinedCamera:
    """The camera at its own size, and standard deviations in pixels and of the radial coefficients k1, k2."""

    camera: Camera
    focal_sigma_px: float
    centre_sigma_px: tuple[float, float]
    radial_sigma: tuple[float, float]


def with_changes(camera: Camera, changes: FloatArray) -> Camera:
    """The camera with changes (5,): of focal length and centre in shares of the focal length, of k1, k2."""
    share, x, y, k1, k2 = (float(value) for value in changes)
    first, second, *others = camera.coefficients
    return replace(
        camera,
        fx=camera.fx * (1.0 + share),
        fy=camera.fy * (1.0 + share),
        cx=camera.cx + x * camera.fx,
        cy=camera.cy + y * camera.fy,
        coefficients=(first + k1, second + k2, *others),
    )


def refined_rig(rig: Rig, changes: FloatArray) -> Rig:
    """The rig of one camera with these changes."""
    mounted = replace(rig.cam0, camera=with_changes(rig.cam0.camera, changes))
    return replace(rig, cameras=(mounted, *rig.cameras[1:]), calibration_source="refined")


def refined_camera(camera: Camera, covariance: FloatArray) -> RefinedCamera:
    """The refined camera with what the covariance (5, 5) of the changes means in its pixels."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return RefinedCamera(
        camera,
        float(sigma[0]) * camera.focal_px,
        (float(sigma[1]) * camera.fx, float(sigma[2]) * camera.fy),
        (float(sigma[3]), float(sigma[4])),
    )
