"""The simulated camera: where it sits, how long it looks, and the exposure as a sum of sharp images along the
path.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.simulation.degradation import ImageQuality
from overfly.simulation.paths import Path
from overfly.simulation.relief import HeightField
from overfly.simulation.rendering import NO_MOVERS, Movers, add_exposure, pixel_rays
from overfly.simulation.tiles import TileCache
from overfly.types import Float32Array

MOST_SUBEXPOSURES = 32

# Optical axes (x right, y down, z forward) of a camera that looks straight down, top of the image forward, in
# body FLU.
DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def looking_down(
    x_m: float = 0.05,
    y_m: float = 0.0,
    z_m: float = -0.03,
    tilt_x_rad: float = 0.0,
    tilt_y_rad: float = 0.0,
    turn_rad: float = 0.0,
) -> Pose:
    """body_from_cam of a downward camera at (x, y, z) in the body, with small turns about its own axes."""
    turn = Pose.exp(np.array([0.0, 0.0, 0.0, tilt_x_rad, tilt_y_rad, turn_rad]))
    return Pose(DOWN @ turn.rotation, np.array([x_m, y_m, z_m]))


@dataclass(frozen=True, slots=True)
class CameraSetup:
    """A camera on the body: what its calibration says, what is really there, and how it takes pictures.

    true_camera, true_body_from_cam: when the calibration is wrong; None: as it says. readout_s: time from the
    first row to the last of a rolling shutter. Stamps are in the middle of the exposure (of the middle row).
    """

    name: str
    camera: Camera
    body_from_cam: Pose
    exposure_s: float = 0.0
    readout_s: float = 0.0
    color: bool = False
    quality: ImageQuality = field(default_factory=ImageQuality)
    true_camera: Camera | None = None
    true_body_from_cam: Pose | None = None

    @property
    def real_camera(self) -> Camera:
        return self.true_camera or self.camera

    @property
    def real_mount(self) -> Pose:
        return self.true_body_from_cam or self.body_from_cam


class Eye:
    """Takes linear pictures of a world with one camera that moves along a path."""

    def __init__(self, setup: CameraSetup, relief: HeightField, tiles: TileCache) -> None:
        self.setup = setup
        self.camera = setup.real_camera
        self._relief = relief
        self._tiles = tiles
        self._rays = pixel_rays(self.camera)

    def expose(self, path: Path, time_s: float, movers: Movers = NO_MOVERS) -> Float32Array:
        """(h, w, channels) linear radiance of the exposure around time_s."""
        shape = (self.camera.height, self.camera.width, self._tiles.channels)
        radiance = np.zeros(shape, dtype=np.float32)
        self._tiles.tick()
        count = self.subexposures(path, time_s)
        offsets = ((np.arange(count) + 0.5) / count - 0.5) * self.setup.exposure_s
        for offset in offsets:
            rotations, centres = self.row_poses(path, time_s + offset)
            add_exposure(
                radiance, self._rays, rotations, centres, self.camera.focal_px,
                self._relief, self._tiles, 1.0 / count, movers,
            )  # fmt: skip
        return radiance

    def row_poses(self, path: Path, time_s: float) -> tuple[FloatArray, FloatArray]:
        """world_from_cam of every image row, exposed around time_s: rotations (h, 3, 3), centres (h, 3)."""
        height = self.camera.height
        times = time_s + self.row_delays() if self.setup.readout_s else np.array([time_s])
        body, positions = path.poses(times)
        mount = self.setup.real_mount
        rotations = body @ mount.rotation
        centres = positions + body @ mount.translation
        if len(times) == 1:
            rotations, centres = np.repeat(rotations, height, axis=0), np.repeat(centres, height, axis=0)
        return np.ascontiguousarray(rotations), np.ascontiguousarray(centres)

    def row_delays(self) -> FloatArray:
        """(h,) seconds from the stamp to the middle of each row's exposure."""
        height = self.camera.height
        return (np.arange(height) - 0.5 * (height - 1)) / max(1, height - 1) * self.setup.readout_s

    def subexposures(self, path: Path, time_s: float) -> int:
        """How many sharp images make the blurred one: about one for each pixel of motion."""
        if self.setup.exposure_s <= 0.0:
            return 1
        half = 0.5 * self.setup.exposure_s
        rotations, positions = path.poses(np.array([time_s - half, time_s, time_s + half]))
        mount = self.setup.real_mount
        centres = positions + rotations @ mount.translation
        axes = rotations @ mount.rotation
        range_m = float(self._relief.ranges(centres[1:2], axes[1:2, :, 2])[0])
        shift = float(np.linalg.norm(centres[2] - centres[0])) / max(range_m, 0.1)
        turn = math.acos(max(-1.0, min(1.0, 0.5 * (float(np.trace(axes[0].T @ axes[2])) - 1.0))))
        return int(min(MOST_SUBEXPOSURES, max(1, math.ceil(self.camera.focal_px * (shift + turn)))))
