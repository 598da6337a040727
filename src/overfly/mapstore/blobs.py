"""Arrays and small values as columns, and back with every length and number checked."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly.errors import CalibrationError, MapFileError
from overfly.geometry.cameras import Camera, Distortion
from overfly.geometry.poses import FloatArray, Pose
from overfly.types import GeoPosition, MountedCamera, Rig

LONGEST_TEXT = 1_000_000
UNIT_TOLERANCE = 1e-6


def pack(array: NDArray[Any], dtype: str) -> bytes:
    """dtype: one of this module's little-endian types."""
    return np.ascontiguousarray(array, dtype=dtype).tobytes()


def unpack(blob: bytes, dtype: str, shape: tuple[int, ...], *, unknown: bool = False) -> NDArray[Any]:
    """The array of a blob, writable and of the machine's byte order. unknown: NaN may stand for what is not
    known.

    Raises ValueError when the length does not fit the shape, or for numbers that are not finite.
    """
    kind = np.dtype(dtype)
    if len(blob) != kind.itemsize * int(np.prod(shape)):
        raise ValueError(f"{len(blob)} bytes where {kind.itemsize * int(np.prod(shape))} belong")
    array = np.frombuffer(blob, kind).reshape(shape).astype(kind.newbyteorder("="))
    if kind.kind == "f" and not (np.isinf(array).sum() == 0 if unknown else np.isfinite(array).all()):
        raise ValueError("a number that is not finite")
    return array


def pack_pose(pose: Pose) -> bytes:
    """Translation and the nine elements of the rotation, so that a pose comes back to the last bit."""
    return pack(np.concatenate([pose.translation, pose.rotation.ravel()]), "<f8")


def unpack_pose(blob: bytes) -> Pose:
    """Raises ValueError for what is no rigid transform."""
    numbers = unpack(blob, "<f8", (12,))
    rotation = numbers[3:].reshape(3, 3)
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > UNIT_TOLERANCE:
        raise ValueError("a rotation that is none")
    return Pose(rotation.copy(), numbers[:3].copy())


def unpack_quaternion_pose(blob: bytes) -> FloatArray:
    """(7,) translation and unit quaternion xyzw."""
    numbers = unpack(blob, "<f8", (7,))
    if abs(float(np.linalg.norm(numbers[3:])) - 1.0) > UNIT_TOLERANCE:
        raise ValueError("a quaternion that is not of unit length")
    return np.asarray(numbers)


def pack_position(position: GeoPosition | None) -> bytes | None:
    if position is None:
        return None
    return pack(
        np.array(
            [
                position.latitude_deg,
                position.longitude_deg,
                position.altitude_m,
                position.sigma_horizontal_m,
                position.sigma_vertical_m,
            ]
        ),
        "<f8",
    )


def unpack_position(blob: bytes | None) -> GeoPosition | None:
    """Sigmas may be infinite or NaN where the receiver gives none."""
    if blob is None:
        return None
    if len(blob) != 40:
        raise ValueError(f"{len(blob)} bytes where 40 belong")
    numbers = np.frombuffer(blob, "<f8")
    if not np.isfinite(numbers[:3]).all():
        raise ValueError("a position that is not finite")
    return GeoPosition(*(float(number) for number in numbers))


def to_json(value: Any) -> str:
    """Numbers of NumPy are written as any others."""
    return json.dumps(value, allow_nan=False, separators=(",", ":"), default=lambda number: number.item())


def from_json(text: str) -> Any:
    """Raises ValueError for what is too long or no JSON."""
    if len(text) > LONGEST_TEXT:
        raise ValueError("a text that is too long")
    return json.loads(text)


def rig_to_json(rig: Rig) -> str:
    cameras = [
        {
            "name": mounted.name,
            "width": mounted.camera.width,
            "height": mounted.camera.height,
            "focal_px": [mounted.camera.fx, mounted.camera.fy],
            "centre_px": [mounted.camera.cx, mounted.camera.cy],
            "distortion": str(mounted.camera.distortion),
            "coefficients": list(mounted.camera.coefficients),
            "body_from_cam": mounted.body_from_cam.matrix()[:3].tolist(),
        }
        for mounted in rig.cameras
    ]
    return to_json(
        {
            "cameras": cameras,
            "calibration_source": rig.calibration_source,
            "level_sigma_rad": rig.level_sigma_rad,
        }
    )


def rig_from_json(text: str) -> Rig:
    """Raises MapFileError without naming a file, ValueError, KeyError or TypeError."""
    tree = from_json(text)
    cameras = []
    for entry in tree["cameras"]:
        fx, fy = entry["focal_px"]
        cx, cy = entry["centre_px"]
        matrix = np.array(entry["body_from_cam"], np.float64)
        if matrix.shape != (3, 4):
            raise ValueError("a mounting that is no pose")
        try:
            camera = Camera(
                int(entry["width"]),
                int(entry["height"]),
                float(fx),
                float(fy),
                float(cx),
                float(cy),
                Distortion(entry["distortion"]),
                tuple(float(number) for number in entry["coefficients"]),
            )
        except CalibrationError as error:
            raise MapFileError(str(error)) from error
        cameras.append(
            MountedCamera(str(entry["name"]), camera, unpack_pose(pack_pose(Pose.from_matrix(matrix))))
        )
    if not 1 <= len(cameras) <= 2:
        raise ValueError("a rig has one camera or two")
    sigma = tree["level_sigma_rad"]
    return Rig(tuple(cameras), str(tree["calibration_source"]), None if sigma is None else float(sigma))
