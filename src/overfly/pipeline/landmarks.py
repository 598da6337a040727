"""Named points that somebody clicked in a few frames: where they are, from the poses of those frames."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from overfly.files import atomic_path
from overfly.geometry.poses import FloatArray
from overfly.pipeline.recording import Recording
from overfly.types import LandmarkClick

CLICK_SIGMA_PX = 1.0
NEIGHBOURS = 12  # map points that tell the height of the ground about a landmark


@dataclass(frozen=True, slots=True, eq=False)
class Landmark:
    """position_m (3,) in the world; sigma_m (3,) standard deviations in the map's own shape, which as a whole
    may be moved and turned; n_views: clicks that were used."""

    name: str
    position_m: FloatArray
    sigma_m: FloatArray
    n_views: int


def locate_landmarks(clicks: Sequence[LandmarkClick], recording: Recording) -> list[Landmark]:
    """Each landmark is where the rays of its clicks come nearest to each other and to the ground the map
    knows there.
    """
    slam = recording.slam
    records = {record.t_ns: record for record in slam.placed()}
    cameras = {mounted.name: index for index, mounted in enumerate(slam.rig.cameras)}
    points, sigmas = slam.map.all_points(slam.main_piece())
    landmarks = []
    for name in dict.fromkeys(click.name for click in clicks):
        rays = []
        for click in clicks:
            if click.name == name and click.t_ns in records and click.camera in cameras:
                mounted = slam.rig.cameras[cameras[click.camera]]
                cam0_from_cam = slam.rig.cam0.body_from_cam.inverse() @ mounted.body_from_cam
                pose = slam.pose_of(records[click.t_ns]) @ cam0_from_cam
                # clicks are in recorded pixels
                recorded = slam.source_rig.cameras[cameras[click.camera]].camera
                ray = recorded.rays_from_pixels(np.array([click.px]))[0]
                direction = pose.rotation @ np.append(ray, 1.0)
                if np.isfinite(direction).all() and direction[2] < 0:
                    rays.append((pose.translation, direction, CLICK_SIGMA_PX / mounted.camera.focal_px))
        if rays:
            position, covariance = _meet(rays, points, sigmas)
            if slam.adjustment is not None:  # the cameras err together, by as much as the map is bent there
                covariance += slam.adjustment.shape.of_ground(slam.map.graph.pose, position[:2])
            landmarks.append(Landmark(name, position, np.sqrt(np.diag(covariance)), len(rays)))
    return landmarks


def _meet(
    rays: list[tuple[FloatArray, FloatArray, float]], points: FloatArray, sigmas: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Place (3,) and covariance (3, 3), if the cameras stand where they are said to: weighted least squares
    of a point on its rays, and on the ground as a level surface of uncertain height.
    """
    ground_z, ground_sigma = 0.0, 0.1 * float(rays[0][0][2])
    position = np.zeros(3)
    information = np.eye(3)
    for _ in range(3):  # the ground's height is looked up where the landmark turned out to be
        information = np.diag([0.0, 0.0, ground_sigma**-2])
        right = np.array([0.0, 0.0, ground_z * ground_sigma**-2])
        for origin, direction, angle_sigma in rays:
            depth = (ground_z - origin[2]) / direction[2]
            unit = direction / np.linalg.norm(direction)
            across = (np.eye(3) - np.outer(unit, unit)) / (angle_sigma * depth) ** 2
            information += across
            right += across @ origin
        position = np.linalg.solve(information, right)
        if len(points) >= NEIGHBOURS:
            distance = np.hypot(points[:, 0] - position[0], points[:, 1] - position[1])
            nearest = np.argpartition(distance, NEIGHBOURS - 1)[:NEIGHBOURS]
            ground_z = float(np.median(points[nearest, 2]))
            scatter = 1.4826 * float(np.median(np.abs(points[nearest, 2] - ground_z)))
            ground_sigma = max(scatter, float(np.median(sigmas[nearest])), 1e-3 * abs(float(rays[0][0][2])))
    return np.asarray(position), np.asarray(np.linalg.inv(information))


def write_landmarks(path: Path, landmarks: Sequence[Landmark]) -> None:
    """landmarks.json: by name, x y z in metres in the world, their standard deviations and the number of
    views.
    """
    tree = {
        landmark.name: {
            "x_m": float(landmark.position_m[0]),
            "y_m": float(landmark.position_m[1]),
            "z_m": float(landmark.position_m[2]),
            "sigma_m": [float(value) for value in landmark.sigma_m],
            "views": landmark.n_views,
        }
        for landmark in landmarks
    }
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(tree, indent=2) + "\n", encoding="utf-8")
