"""Which reader a path is for."""

from __future__ import annotations

from pathlib import Path

from overfly.errors import SourceError, UsageError
from overfly.sensors.euroc import find_mav0, open_euroc
from overfly.sensors.flight import Flight, ReadOptions
from overfly.sensors.live_camera import is_live
from overfly.sensors.photographs import find_pictures, open_photographs
from overfly.sensors.ros_bag import is_bag, open_ros_bag
from overfly.sensors.video import is_video, open_video

READABLE = (
    "an EuRoC folder (the one that holds mav0), a folder of photographs, a video, a ROS bag or MCAP file"
)


def open_flight(path: str | Path, options: ReadOptions | None = None) -> Flight:
    """Open a recorded flight, whatever it was recorded as.

    path: a folder in the EuRoC layout (the one that holds mav0, or mav0 itself), a folder of photographs, or
    a video with its telemetry beside it. Raises SourceError (CalibrationError for the camera) with one line
    that names the file and what to do.
    """
    path = Path(path)
    options = options or ReadOptions()
    if is_live(str(path)):
        raise UsageError(f"{path}: a camera that runs now is for overfly map and overfly fly --mavlink")
    if not path.exists():
        raise SourceError(f"{path}: no such file or folder")
    if is_video(path):
        return open_video(path, options)
    if is_bag(path):
        return open_ros_bag(path, options)
    if not path.is_dir():
        raise SourceError(f"{path}: not something that can be read; readable are {READABLE}")
    if find_mav0(path) is not None:
        return open_euroc(path, options)
    if find_pictures(path) is not None:
        return open_photographs(path, options)
    raise SourceError(f"{path}: holds neither mav0/cam0 nor pictures; readable are {READABLE}")
