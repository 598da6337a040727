"""overfly map camera:0: mapping while flying. What the camera shows is recorded as an EuRoC folder meanwhile,
so that the map's products, and any later run, have the same pictures and the same attitude.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from overfly.errors import OutputError
from overfly.navigation.mavlink import AutopilotLink
from overfly.pipeline.growing import MOSAIC_NAME, growing_mosaic
from overfly.pipeline.keeping import keeping_map
from overfly.pipeline.live_frames import LiveFrames, live_rig
from overfly.pipeline.mapping import MapOutcome, MapRequest, check_located, save
from overfly.pipeline.recording import Progress, record_flight
from overfly.pipeline.results import prepare_folder
from overfly.pipeline.watching import watching
from overfly.sensors import Flight, ReadOptions, SourceKind, open_flight
from overfly.sensors.flight import Problems
from overfly.sensors.live_camera import LiveCamera
from overfly.slam import Slam
from overfly.types import Frame, MountedCamera
from overfly.viewer.interface import Viewers

FLIGHT_NAME = "flight"
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]  # quick: the camera does not wait


@dataclass(frozen=True, slots=True)
class LiveSource:
    """camera: camera:0 or a URL. mavlink: of the autopilot whose attitude and range the frames get."""

    camera: str
    mavlink: str | None = None
    camera_delay_s: float = 0.0


def run(
    source: LiveSource, request: MapRequest, progress: Progress, camera: LiveCamera | None = None
) -> MapOutcome:
    """Map until the time is over (reading.stop_s), the camera ends, or somebody interrupts.

    camera: one that is open already. Raises OverflyError in one line each.
    """
    prepare_folder(request.out)
    folder = request.out / FLIGHT_NAME
    with ExitStack() as stack:
        link = stack.enter_context(AutopilotLink.open(source.mavlink)) if source.mavlink else None
        if link is not None:
            link.wait_for_autopilot()
        eye = stack.enter_context(camera or LiveCamera.open(source.camera, source.camera_delay_s))
        height, width = eye.first().image.shape[:2]
        rig = live_rig(source.camera, (width, height), request.reading.camera_file)
        recorder = FlightRecorder(folder, rig.cam0)
        slam = Slam(rig, request.config)
        flight = Flight(folder, SourceKind.LIVE, rig, np.zeros(0, np.int64), lambda _n: None, Problems())
        with keeping_map(request.out, flight, slam, resume=False) as keeper:
            growing = growing_mosaic(
                None if request.growing_mosaic is False else request.out / MOSAIC_NAME, slam
            )
            with watching(request.watch, rig, slam) as viewer, growing as drawer:
                frames = recorded(LiveFrames(eye, rig, link), recorder, request.reading)
                recording = record_flight(frames, slam, progress, keeper, Viewers((viewer, drawer)))
            check_located(flight, recording)
            return save(open_flight(folder), recording, request)


def recorded(frames: LiveFrames, recorder: FlightRecorder, reading: ReadOptions) -> Iterator[Frame]:
    """The frames as the options ask for them, each on the disk before it is used."""
    begin = time.monotonic()
    stop_s = np.inf if reading.stop_s is None else reading.stop_s
    for frame in frames:
        since_s = time.monotonic() - begin
        if since_s > stop_s:
            return
        if since_s < (reading.start_s or 0.0) or (frame.index % reading.every):
            continue
        yield recorder.add(frame)


class FlightRecorder:
    """Writes frames as they come; the folder can be opened as a flight at any moment."""

    def __init__(self, folder: Path, mounted: MountedCamera) -> None:
        """folder: new or empty. Raises OutputError when it is not, or cannot be written."""
        if folder.exists() and any(folder.iterdir()):
            raise OutputError(f"{folder} holds a flight already: choose another output folder, or remove it")
        self._mav0 = folder / "mav0"
        self._count = 0
        camera, mount = mounted.camera, mounted.body_from_cam.matrix().reshape(-1).tolist()
        self._write("cam0/sensor.yaml", (
            f"sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: {mount}\n"
            f"resolution: [{camera.width}, {camera.height}]\ncamera_model: pinhole\n"
            f"intrinsics: [{camera.fx!r}, {camera.fy!r}, {camera.cx!r}, {camera.cy!r}]\n"
            f"distortion_model: {camera.distortion}\ndistortion_coefficients: {list(camera.coefficients)}\n"
        ))  # fmt: skip
        self._write("cam0/data.csv", "#timestamp [ns],filename\n")

    def add(self, frame: Frame) -> Frame:
        """The frame as it lies on the disk now: its number among those. Raises OutputError."""
        name = f"{frame.t_ns}.png"
        image = frame.images[0]
        colours = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        is_encoded, data = cv2.imencode(".png", colours, _PNG)
        if not is_encoded:
            raise OutputError(f"{self._mav0}: a picture cannot be written as PNG")
        self._write(f"cam0/data/{name}", data.tobytes())
        self._append("cam0/data.csv", "", f"{frame.t_ns},{name}")
        attitude, altitude = frame.attitude, frame.altitude
        if attitude is not None:
            yaw_rad = attitude.yaw_rad
            angles = [attitude.roll_rad, attitude.pitch_rad, *([] if yaw_rad is None else [yaw_rad])]
            header = "#timestamp [ns],roll [rad],pitch [rad]" + ("" if yaw_rad is None else ",yaw [rad]")
            self._append("attitude0/data.csv", header, ",".join([str(frame.t_ns), *map(repr, angles)]))
        if altitude is not None:
            if altitude.half_angle_rad and not (self._mav0 / "altitude0/sensor.yaml").exists():
                self._write("altitude0/sensor.yaml", f"cone_half_angle_rad: {altitude.half_angle_rad!r}\n")
            row = f"{frame.t_ns},{altitude.value_m!r},{altitude.sigma_m!r}"
            self._append("altitude0/data.csv", "#timestamp [ns],range [m],sigma [m]", row)
        self._count += 1
        return Frame(self._count - 1, frame.t_ns, name, frame.images, attitude, altitude, frame.position)

    def _write(self, name: str, content: str | bytes) -> None:
        path = self._mav0 / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content.encode() if isinstance(content, str) else content)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror})") from error

    def _append(self, name: str, header: str, row: str) -> None:
        path = self._mav0 / name
        if not path.exists():
            self._write(name, header + "\n")
        try:
            with path.open("a", encoding="utf-8") as file:
                file.write(row + "\n")
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror})") from error
