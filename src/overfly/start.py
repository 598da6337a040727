"""How a map begins: the height of the first camera, and with it the scale, where no stereo gives it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from overfly.config import Config
from overfly.geometry.levelling import height_share, split_yaw, world_from_cam_rotation
from overfly.geometry.poses import FloatArray, Pose
from overfly.types import AltitudeKind, Frame, Rig, ScaleLandmark
from overfly.vision.refine import HeightPrior, TiltPrior, refine_pose

UNKNOWN_HEIGHT_M = 1.0  # the map's unit is then one flying height
CORNER_SIGMA_PX = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """First pose over the ground z = 0: height in metres, level_from_cam (3, 3), and where the height came
    from.
    """

    height_m: float
    level_from_cam: FloatArray
    source: str


def begin_height(
    frame: Frame, rig: Rig, tilt: TiltPrior, config: Config, landmark: ScaleLandmark | None
) -> Start:
    """Height of the first camera by the best source without stereo: range, landmark of known size, given,
    above start.
    """
    level = tilt.level_from_cam
    height = range_height(frame, rig, level, None)
    if height is not None:
        return Start(height.z_m, level, "range")
    if landmark is not None and landmark.t_ns == frame.t_ns:
        found = height_from_landmark(landmark, rig, tilt)
        if found is not None:
            return found
    if config.height.given_m is not None:
        return Start(config.height.given_m, level, "given")
    altitude = frame.altitude
    if altitude is not None and altitude.kind is AltitudeKind.ABOVE_START and altitude.value_m > 0.5:
        return Start(altitude.value_m, level, "altitude")
    return Start(UNKNOWN_HEIGHT_M, level, "none")


def range_height(
    frame: Frame, rig: Rig, level_from_cam: FloatArray, ground_z_m: float | None
) -> HeightPrior | None:
    """Height of cam0 by the range sensor, which measures along the body's down axis from the body's origin.

    level_from_cam: (3, 3) tilt of the camera; ground_z_m: height of the ground in the world, 0 if None.
    """
    if frame.altitude is None or frame.altitude.kind is not AltitudeKind.RANGE:
        return None
    body_from_cam = rig.cam0.body_from_cam
    level_from_body = level_from_cam @ body_from_cam.rotation.T
    share = height_share(float(level_from_body[2, 2]), frame.altitude.half_angle_rad)
    above = frame.altitude.value_m * share + float(level_from_body[2] @ body_from_cam.translation)
    return HeightPrior((ground_z_m or 0.0) + above, frame.altitude.sigma_m) if above > 0 else None


def height_from_landmark(landmark: ScaleLandmark, rig: Rig, tilt: TiltPrior) -> Start | None:
    """Height and tilt of the camera over a flat object whose corners it sees; None if they cannot be seen so.

    The object lies on the ground; its own yaw and place are free.
    """
    mounted = next((camera for camera in rig.cameras if camera.name == landmark.camera), None)
    if mounted is None or mounted is not rig.cam0 or len(landmark.corners_m) < 3:
        return None
    rays = mounted.camera.rays_from_pixels(landmark.corners_px)
    points = np.column_stack([landmark.corners_m, np.zeros(len(rays))])
    size = np.linalg.norm(points - points.mean(axis=0), axis=1).mean()
    seen = np.linalg.norm(rays - rays.mean(axis=0), axis=1).mean()
    height = float(size / seen)
    level_rays_xy = (np.column_stack([rays, np.ones(len(rays))]) @ tilt.level_from_cam.T)[:, :2]
    turn = np.sum((points[:, 0] + 1j * points[:, 1]) * np.conj(_centred(level_rays_xy)))
    rotation = world_from_cam_rotation(float(np.angle(turn)), tilt.level_from_cam)
    middle = points.mean(axis=0) - rotation @ (height * np.append(rays.mean(axis=0), 1.0))
    refined = refine_pose(
        Pose(rotation, middle),
        points,
        rays,
        CORNER_SIGMA_PX / mounted.camera.focal_px,
        (math.inf, math.inf),
        tilt,
    )
    if refined is None or refined.world_from_cam.translation[2] <= 0:
        return None
    _, level = split_yaw(refined.world_from_cam.rotation, mounted.body_from_cam.rotation)
    return Start(float(refined.world_from_cam.translation[2]), level, "landmark")


def _centred(xy: FloatArray) -> np.ndarray:
    """(n, 2) as complex numbers about their mean."""
    values = xy[:, 0] + 1j * xy[:, 1]
    return np.asarray(values - values.mean())


def first_pose(start: Start, yaw_rad: float | None) -> Pose:
    """world_from_cam over the origin; without a heading the picture's right-hand side is the
    world's x axis.
    """
    level = start.level_from_cam
    yaw = -math.atan2(level[1, 0], level[0, 0]) if yaw_rad is None else yaw_rad
    return Pose(world_from_cam_rotation(yaw, level), np.array([0.0, 0.0, start.height_m]))
