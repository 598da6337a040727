"""Where the map lies on Earth: a similarity from the world to the positions that GPS gave, found after the flight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import Transformer

from overfly.geometry.geodesy import GeoOrigin, enu_from_geodetic, utm_crs, utm_epsg
from overfly.geometry.poses import FloatArray
from overfly.pipeline.recording import Recording
from overfly.products.georeference import GeoReference

WITHOUT_OWN_METRE = ("none", "given", "altitude")  # sources of scale that GPS is better than

SMALLEST_EXTENT_SIGMAS = 5.0  # a flight shorter than this many GPS sigmas says nothing on scale or heading


@dataclass(frozen=True, slots=True, eq=False)
class GeoAlignment:
    """projected = scale * Rz(rotation_rad) world + translation_m, projected in metres of a map projection.

    residuals_m (n, 3) of the positions used; horizontal_rms_m over the inliers of the robust fit.
    """

    scale: float
    rotation_rad: float
    translation_m: FloatArray
    residuals_m: FloatArray
    horizontal_rms_m: float


def align_to_positions(
    world: FloatArray, projected: FloatArray, sigma_m: FloatArray, iterations: int = 10
) -> GeoAlignment | None:
    """The similarity about the vertical that takes world (n, 3) to projected (n, 3), robustly.

    sigma_m (n,): horizontal standard deviations. Positions that disagree count less (Cauchy weights, re-estimated).
    None for fewer than three positions or an extent too small for the positions' accuracy.
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
        [fitted.real - projected[:, 0], fitted.imag - projected[:, 1], scale * world[:, 2] + lift - projected[:, 2]]
    )
    return GeoAlignment(
        scale,
        float(np.angle(turn)),
        np.array([shift.real, shift.imag, lift]),
        residuals,
        float(np.sqrt(np.mean(distance**2))),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Georeferenced:
    """The map on Earth: similarity to its UTM zone, how well it fits, and the origin in degrees for other formats."""

    reference: GeoReference
    horizontal_rms_m: float
    residuals_m: FloatArray  # (n, 3) east, north, up of the camera positions against GPS


def georeference(recording: Recording) -> Georeferenced | None:
    """Fit the map to its GPS positions, if it has any; give it their metre when it has no better one of its own."""
    fitted = _positions(recording)
    if fitted is None:
        return None
    body, geodetic, sigma = fitted
    origin = GeoOrigin(*(float(value) for value in geodetic[0]))
    local = align_to_positions(body, enu_from_geodetic(geodetic, origin), sigma)
    if local is None:
        return None
    start = recording.slam.start
    if start is not None and start.source in WITHOUT_OWN_METRE:
        recording.slam.rescale(local.scale, "gps")
        body = body * local.scale
    crs = utm_crs(origin.latitude_deg, origin.longitude_deg)
    transformer = Transformer.from_crs(4326, crs, always_xy=True)
    east, north = transformer.transform(geodetic[:, 1], geodetic[:, 0])
    projected = align_to_positions(body, np.column_stack([east, north, geodetic[:, 2]]), sigma)
    if projected is None:
        return None
    epsg = utm_epsg(origin.latitude_deg, origin.longitude_deg)
    x, y, z = (float(value) for value in projected.translation_m)
    return Georeferenced(
        GeoReference(f"EPSG:{epsg}", projected.scale, projected.rotation_rad, (x, y, z)),
        projected.horizontal_rms_m,
        projected.residuals_m,
    )


def _positions(recording: Recording) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """World positions of the body (n, 3), geodetic positions (n, 3) and horizontal sigmas (n,) of frames that have both."""
    body_from_cam = recording.slam.rig.cam0.body_from_cam
    rows = []
    for record in recording.slam.records:
        position = recording.positions.get(record.t_ns)
        if position is not None:
            body = recording.slam.pose_of(record) @ body_from_cam.inverse()
            geodetic = (position.latitude_deg, position.longitude_deg, position.altitude_m)
            rows.append((*body.translation, *geodetic, max(position.sigma_horizontal_m, 0.01)))
    if not rows:
        return None
    table = np.array(rows)
    return table[:, :3], table[:, 3:6], table[:, 6]
