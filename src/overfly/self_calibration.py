"""Focal length, centre and distortion of the camera, found together with the map (map --refine-camera,
and where only EXIF tells it).

The unknowns are changes against the given calibration that mean the same at every picture size: the focal
length and the centre in shares of the focal length, and the first two radial coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from overfly.config import AdjustmentSettings
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray
from overfly.graph.points_problem import Shared
from overfly.map_points import Observations
from overfly.types import Rig
from overfly.visual_map import VisualMap

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


def refines_camera(rig: Rig, settings: AdjustmentSettings) -> bool:
    """Whether the camera is found with the map: where that is wished, else where only EXIF tells it."""
    if rig.is_stereo:
        return False
    if settings.refine_camera is None:
        return rig.calibration_source == "exif"
    return settings.refine_camera


def as_refined(rig: Rig, known: Rig) -> Rig:
    """A rig that only EXIF tells, with the camera that a map found, where that can be the same."""
    mine, refined = rig.cam0.camera, known.cam0.camera
    same_size = (mine.width, mine.height) == (refined.width, refined.height)
    if rig.calibration_source != "exif" or known.calibration_source != "refined" or not same_size:
        return rig
    return replace(rig, cameras=(replace(rig.cam0, camera=refined),), calibration_source="refined")


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


def camera_unknowns(visual_map: VisualMap, seen: Observations, camera: Camera, now: FloatArray) -> Shared:
    """Changes of the camera's calibration as unknowns of the adjustment. Rays are linear in them about where
    they are now (5,), for inverting the distortion is dear; the next round begins where this one ends.
    """
    px = np.empty((len(seen), 2))
    for index in np.unique(seen.node).tolist():
        mine = seen.node == index
        px[mine] = visual_map.nodes[index].features.px[seen.row[mine]]

    def rays_and_size(changes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rays, and the logarithm of a pixel's size in them."""
        changed = with_changes(camera, changes)
        rays, right, below = (changed.rays_from_pixels(px + step) for step in ([0, 0], [1, 0], [0, 1]))
        (across_x, across_y), (down_x, down_y) = (right - rays).T, (below - rays).T
        return rays, 0.5 * np.log(np.abs(across_x * down_y - across_y * down_x))

    rays, size = rays_and_size(now)
    by_rays, by_size = np.empty((*rays.shape, len(now))), np.empty((len(size), len(now)))
    for p, nudge in enumerate(np.diag(1e-2 * EXPECTED_SIGMA)):
        (ahead, larger), (behind, smaller) = rays_and_size(now + nudge), rays_and_size(now - nudge)
        by_rays[:, :, p] = (ahead - behind) / (2.0 * nudge[p])
        by_size[:, p] = (larger - smaller) / (2.0 * nudge[p])
    size = size - rays_and_size(np.zeros(len(now)))[1]
    unknown = ~np.isfinite(np.column_stack([rays, size, by_size])).all(axis=1)
    rays[unknown], size[unknown], by_rays[unknown], by_size[unknown] = seen.rays[unknown], 0.0, 0.0, 0.0

    def rays_of(changes: FloatArray) -> tuple[FloatArray, FloatArray]:
        return rays + by_rays @ (changes - now), np.exp(size + by_size @ (changes - now))

    return Shared(np.zeros(len(now)), EXPECTED_SIGMA, rays_of, now)
