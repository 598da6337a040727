"""The files of an EuRoC folder: calibration texts, and writing that never leaves half a file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from overfly.geometry.poses import Pose
from overfly.simulation.optics import CameraSetup

_IDENTITY = Pose.identity()


def write_bytes(path: Path, data: bytes) -> None:
    """Write under a temporary name, then rename."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    part.write_bytes(data)
    part.replace(path)


def write_text(path: Path, text: str) -> None:
    write_bytes(path, text.encode())


def write_lines(path: Path, lines: Iterable[str]) -> None:
    write_text(path, "\n".join(lines) + "\n")


def sensor_yaml(kind: str, facts: dict[str, object], body_from_sensor: Pose = _IDENTITY) -> str:
    """sensor.yaml of a sensor: type, place on the body, then the facts one per line."""
    numbers = [f"{value:.17g}" for value in body_from_sensor.matrix().ravel()]
    rows = [", ".join(numbers[4 * k : 4 * k + 4]) for k in range(4)]
    lines = [
        f"sensor_type: {kind}",
        "comment: simulated by Overfly; body axes x forward, y left, z up",
        "",
        "# Sensor extrinsics wrt. the body frame: p_B = T_BS p_S",
        "T_BS:",
        "  cols: 4",
        "  rows: 4",
        "  data: [" + ",\n         ".join(rows) + "]",
        "",
        *(f"{key}: {_plain(value)}" for key, value in facts.items()),
    ]
    return "\n".join(lines) + "\n"


def camera_yaml(setup: CameraSetup, rate_hz: float) -> str:
    """sensor.yaml of a camera, as its calibration says it is."""
    camera = setup.camera
    facts: dict[str, object] = {
        "rate_hz": rate_hz,
        "resolution": [camera.width, camera.height],
        "camera_model": "pinhole",
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "distortion_model": str(camera.distortion),
        "distortion_coefficients": list(camera.coefficients),
        "exposure_s": setup.exposure_s,
        "readout_s": setup.readout_s,
    }
    return sensor_yaml("camera", facts, setup.body_from_cam)


def _plain(value: object) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(_plain(item) for item in value) + "]"
    return f"{value:.17g}" if isinstance(value, float) else str(value)
