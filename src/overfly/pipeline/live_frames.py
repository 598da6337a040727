"""Frames of a camera that runs now, with the attitude and range of an autopilot at the
time of each picture.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from overfly.errors import CalibrationError
from overfly.geometry.levelling import NADIR_BODY_FROM_CAM
from overfly.geometry.poses import Pose
from overfly.navigation.mavlink import AutopilotLink
from overfly.sensors.calibration_files import fit_to_images, read_camera_file
from overfly.sensors.live_camera import LiveCamera, Picture
from overfly.types import Frame, MountedCamera, Rig

ATTITUDE_WAIT_S = 0.05  # for a sample after the picture, so that there is something to interpolate
PICTURE_WAIT_S = 2.0


@dataclass(slots=True, eq=False)
class LiveFrames:
    """Iterate it for frames until the camera ends or falls silent. link: None without an autopilot."""

    camera: LiveCamera
    rig: Rig
    link: AutopilotLink | None = None
    count: int = 0
    _last: Picture | None = None

    def __iter__(self) -> Iterator[Frame]:
        while (frame := self.sense()) is not None:
            yield frame

    def sense(self) -> Frame | None:
        """The newest frame that was not given out yet; None when none comes any more."""
        picture = self.camera.next(self._last, PICTURE_WAIT_S)
        if picture is None:
            return None
        self._last = picture
        frame = Frame(self.count, picture.t_ns, f"picture {picture.number}", (picture.image,))
        self.count += 1
        if self.link is None:
            return frame
        attitude = self.link.attitude_at(picture.t_ns, ATTITUDE_WAIT_S)
        return replace(frame, attitude=attitude, altitude=self.link.range_at(picture.t_ns))


def live_rig(name: str, size: tuple[int, int], calibration: Path | None, known: Rig | None = None) -> Rig:
    """The first camera: by the calibration file, else that of a known map, for pictures of this size.

    Raises CalibrationError when neither fits: a vehicle is not flown by a guess.
    """
    mount = Pose(NADIR_BODY_FROM_CAM, NADIR_BODY_FROM_CAM[0] * 0.0)
    if calibration is not None:
        calibrated = read_camera_file(calibration, size)[0]
        camera = fit_to_images(calibration, calibrated.camera, size)
        return Rig((MountedCamera("cam0", camera, calibrated.body_from_cam or mount),), "given")
    if known is None:
        raise CalibrationError(
            f"{name}: a live camera needs its calibration; give the file (Kalibr, OpenCV, ROS, EuRoC)"
        )
    camera = fit_to_images(Path(name), known.cam0.camera, size)
    return Rig((replace(known.cam0, camera=camera),), known.calibration_source)
