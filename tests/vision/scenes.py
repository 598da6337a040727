"""A camera over random ground with exact truth, shared by the tests of the vision part."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from overfly.geometry.cameras import Camera
from overfly.geometry.levelling import NADIR_BODY_FROM_CAM, level_from_cam
from overfly.geometry.poses import FloatArray, Pose, rotation_from_euler
from overfly.types import Attitude, Correspondences, MountedCamera, Rig, UInt8Array

CAMERA = Camera(320, 240, 288.0, 288.0, 159.5, 119.5)


def camera_pose(
    x: float = 0.0, y: float = 0.0, z: float = 2.0, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0
) -> Pose:
    """world_from_cam of a camera mounted straight down on a body with this attitude."""
    return Pose(rotation_from_euler(roll, pitch, yaw) @ NADIR_BODY_FROM_CAM, np.array([x, y, z]))


def level(roll: float = 0.0, pitch: float = 0.0) -> FloatArray:
    """level_from_cam as an attitude sensor gives it."""
    return level_from_cam(Attitude(roll, pitch, 0.01), NADIR_BODY_FROM_CAM)


def mono_rig(camera: Camera = CAMERA) -> Rig:
    return Rig((MountedCamera("cam0", camera, Pose(NADIR_BODY_FROM_CAM, np.zeros(3))),))


def rays_of(pose: Pose, points: FloatArray) -> FloatArray:
    """Where the camera sees world points (n, 3): (n, 2) undistorted image coordinates."""
    seen = pose.inverse().transform(points)
    return np.asarray(seen[:, :2] / seen[:, 2:])


def ground_in_view(
    rng: np.random.Generator, pose: Pose, count: int, relief_m: float = 0.1, camera: Camera = CAMERA
) -> FloatArray:
    """(n, 3) points spread over the picture, on ground with relief about z = 0."""
    px = rng.uniform([0, 0], [camera.width - 1, camera.height - 1], (count, 2))
    rays = camera.rays_from_pixels(px)
    directions = np.column_stack([rays, np.ones(count)]) @ pose.rotation.T
    z = rng.uniform(-relief_m, relief_m, count)
    depth = (z - pose.translation[2]) / directions[:, 2]
    return np.asarray(pose.translation + directions * depth[:, None])


@dataclass(frozen=True)
class Sight:
    """A camera, its true pose, and correspondences with the map, outliers at the given rows."""

    pose: Pose
    tilt: FloatArray
    correspondences: Correspondences
    is_outlier: np.ndarray


def sight(
    seed: int,
    count: int = 60,
    outliers: float = 0.0,
    noise_px: float = 0.0,
    tilt_error_rad: float = 0.0,
    relief_m: float = 0.1,
) -> Sight:
    """One look at random ground; tilt_error_rad: standard deviation of the attitude sensor."""
    rng = np.random.default_rng(seed)
    roll, pitch = rng.uniform(-0.15, 0.15, 2)
    pose = camera_pose(*rng.uniform(-3, 3, 2), rng.uniform(1.0, 4.0), roll, pitch, rng.uniform(-3.1, 3.1))
    points = ground_in_view(rng, pose, count, relief_m)
    rays = rays_of(pose, points) + rng.normal(0.0, 1.0, (count, 2)) * noise_px / CAMERA.focal_px
    distance = np.sort(rng.uniform(0.02, 0.2, count))
    wrong = rng.random(count) < outliers
    rays[wrong] = CAMERA.rays_from_pixels(rng.uniform([0, 0], [319, 239], (int(wrong.sum()), 2)))
    roll_error, pitch_error = rng.normal(0.0, 1.0, 2) * tilt_error_rad
    rows = np.arange(count)
    return Sight(
        pose,
        level(roll + roll_error, pitch + pitch_error),
        Correspondences(points, rays, distance, rows, rows),
        wrong,
    )


def pose_error(estimate: Pose, truth: Pose) -> FloatArray:
    """(6,) the tangent x with estimate @ exp(x) = truth."""
    return (estimate.inverse() @ truth).log()


def smooth_texture(seed: int, height: int = 240, width: int = 320, sigma_px: float = 2.0) -> UInt8Array:
    """Random ground (H, W), blurred so much that bilinear sampling of it is nearly exact."""
    rng = np.random.default_rng(seed)
    field = sum(
        cv2.GaussianBlur(rng.normal(0.0, 1.0, (height, width)), (0, 0), sigma_px * scale) * scale
        for scale in (1.0, 2.0, 4.0)
    )
    field = np.asarray(field)
    scaled = 127.5 + 45.0 * (field - field.mean()) / field.std()
    return np.asarray(np.clip(np.rint(scaled), 0, 255), np.uint8)


def normalised_squared_errors(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """(n,) squared Mahalanobis lengths of errors (n, d) under covariances (n, d, d)."""
    return np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)


def chi_square_bounds(degrees: int, probability: float = 1e-4) -> tuple[float, float]:
    """Two-sided bounds of the mean of a chi-square sum divided by its degrees of freedom."""
    from scipy.stats import chi2

    low, high = chi2.ppf([probability / 2, 1 - probability / 2], degrees)
    return float(low) / degrees, float(high) / degrees


def angle_between(a: FloatArray, b: FloatArray) -> float:
    """Angle in radians of the rotation that is left between two rotations (3, 3)."""
    return math.acos(max(-1.0, min(1.0, (float(np.trace(a.T @ b)) - 1.0) / 2.0)))


GROUND_M_PER_PX = 0.004


@lru_cache(maxsize=4)
def ground_texture(seed: int, size_px: int = 1500) -> UInt8Array:
    """Picture (H, W) of level ground, GROUND_M_PER_PX a pixel, its middle at the world's origin."""
    return smooth_texture(seed, size_px, size_px, 2.5)


def picture_of_ground(
    texture: UInt8Array, world_from_cam: Pose, camera: Camera = CAMERA, ground_z: float = 0.0
) -> UInt8Array:
    """What the camera sees of the textured plane z = ground_z; texture rows run along -y, columns along x."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.rays_from_pixels(np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))
    directions = np.column_stack([rays, np.ones(len(rays))]) @ world_from_cam.rotation.T
    depth = (ground_z - world_from_cam.translation[2]) / directions[:, 2]
    points = world_from_cam.translation + directions * depth[:, None]
    middle = (np.array(texture.shape[::-1]) - 1) / 2
    u = points[:, 0] / GROUND_M_PER_PX + middle[0]
    v = -points[:, 1] / GROUND_M_PER_PX + middle[1]
    return sampled(texture, u, v).reshape(camera.height, camera.width)


def sampled(image: UInt8Array, u: FloatArray, v: FloatArray) -> UInt8Array:
    """Grey values by cubic splines; OpenCV rounds places to 1/32 of a pixel."""
    values = map_coordinates(image.astype(np.float32), [v, u], order=3, mode="mirror")
    return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)
