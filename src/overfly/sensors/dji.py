"""The drone's own entries in a photograph's XMP packet: angles, heights and factory calibration, as DJI
writes them.

Angles come as aerospace NED/FRD (north, east, down; forward, right, down) and leave as Overfly's ENU/FLU. A
camera on a gimbal has a body of its own: it looks straight down at roll 0, pitch 0, and the top of the image
is its front.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np

from overfly.geometry.cameras import Camera, Distortion
from overfly.geometry.poses import FloatArray, euler_from_rotation, rotation_from_euler
from overfly.sensors.calibration_files import nadir_mount
from overfly.sensors.default_sigmas import AIRFRAME_SIGMA_RAD, ATTITUDE_SIGMA_RAD, YAW_SIGMA_RAD
from overfly.types import Attitude

_ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# a camera at gimbal angles zero looks forward: image right is starboard, image down is down
_FRD_FROM_CAM = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_ENTRY = re.compile(r"(?<!/)drone-dji:(\w+)\s*(?:=\s*[\"']([^\"']*)[\"']|>([^<]*)<)")


@dataclass(frozen=True, slots=True)
class DjiTags:
    """Entries by DJI's own names."""

    entries: dict[str, str]

    def number(self, *names: str) -> float | None:
        """First of these entries that holds a finite number."""
        for name in names:
            try:
                value = float(self.entries[name])
            except (KeyError, ValueError):
                continue
            if math.isfinite(value):
                return value
        return None

    def angles_rad(self, which: str) -> tuple[float, float, float] | None:
        """(yaw, pitch, roll) of "Gimbal" or "Flight", NED/FRD, radians."""
        numbers = [self.number(f"{which}{axis}Degree") for axis in ("Yaw", "Pitch", "Roll")]
        if None in numbers:
            return None
        yaw, pitch, roll = (math.radians(number or 0.0) for number in numbers)
        return yaw, pitch, roll


def parse_dji(xmp: str) -> DjiTags:
    """Entries of the drone-dji name space, written as attributes or elements; empty when there are none."""
    return DjiTags({name: attribute or element.strip() for name, attribute, element in _ENTRY.findall(xmp)})


def camera_rotation_from_gimbal(yaw_rad: float, pitch_rad: float, roll_rad: float) -> FloatArray:
    """R_world_cam (3, 3), world ENU, optical camera frame, of gimbal angles: Rz(yaw) Ry(pitch) Rx(roll) in
    NED/FRD.

    Pitch 0 looks at the horizon, -pi/2 straight down; yaw 0 is north, clockwise.
    """
    ned_from_frd = rotation_from_euler(roll_rad, pitch_rad, yaw_rad)
    return np.asarray(_ENU_FROM_NED @ ned_from_frd @ _FRD_FROM_CAM)


def tilt_from_nadir_rad(world_from_cam: FloatArray) -> float:
    """Angle between the optical axis and straight down; world_from_cam (3, 3) rotation."""
    return math.acos(max(-1.0, min(1.0, -float(world_from_cam[2, 2]))))


def read_attitude(tags: DjiTags) -> Attitude | None:
    """Attitude of the camera's own level body from the gimbal, or of the airframe when no gimbal is named."""
    gimbal = tags.angles_rad("Gimbal")
    if gimbal is not None:
        world_from_cam = camera_rotation_from_gimbal(*gimbal)
        sigma_rad = ATTITUDE_SIGMA_RAD
    else:
        airframe = tags.angles_rad("Flight")
        if airframe is None:
            return None
        # camera bolted on, looking down with the image top forward
        yaw, pitch, roll = airframe
        world_from_cam = rotation_from_euler(roll, -pitch, 0.5 * math.pi - yaw) @ nadir_mount().rotation
        sigma_rad = AIRFRAME_SIGMA_RAD
    roll, pitch, yaw = euler_from_rotation(world_from_cam @ nadir_mount().rotation.T)
    return Attitude(roll, pitch, sigma_rad, yaw, YAW_SIGMA_RAD)


def factory_camera(tags: DjiTags, width: int, height: int, stated_width: int | None) -> Camera | None:
    """Camera calibrated by the maker, for an image of width x height pixels; None when the packet has none.

    stated_width: the width Exif states, that of the picture as it was taken.
    """
    full_width = stated_width or width
    centre_x = tags.number("CalibratedOpticalCenterX")
    centre_y = tags.number("CalibratedOpticalCenterY")
    if centre_x and abs(2.0 * centre_x / full_width - 1.0) > 0.1:
        full_width = round(2.0 * centre_x)  # resized, and the tags with it, but not this packet
    full_height = round(full_width * height / width)
    middle = 0.5 * full_width, 0.5 * full_height
    warp = re.findall(r"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?", tags.entries.get("DewarpData", "").partition(";")[2])
    if len(warp) == 9 and tags.number("DewarpFlag") != 1:
        fx, fy, dx, dy, *k = (float(word) for word in warp)
        camera = Camera(
            full_width,
            full_height,
            fx,
            fy,
            middle[0] + dx - 0.5,
            middle[1] + dy - 0.5,
            Distortion.RADIAL_TANGENTIAL,
            tuple(k),
        )
        return camera.scaled(width, height)
    focal_px = tags.number("CalibratedFocalLength")
    if focal_px is None or not 0.2 * full_width < focal_px < 20.0 * full_width:
        return None
    # the centre is given from the corner of the picture, not from the centre of its first pixel
    cx, cy = (centre_x, centre_y) if centre_x and centre_y else middle
    return Camera(full_width, full_height, focal_px, focal_px, cx - 0.5, cy - 0.5).scaled(width, height)
