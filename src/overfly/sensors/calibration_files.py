"""Camera calibrations as other tools write them: EuRoC sensor.yaml, Kalibr, OpenCV, ROS camera_info, COLMAP.

Centres: COLMAP puts (0.5, 0.5) on the centre of the top-left pixel and is moved by half a pixel here; the
others agree with Overfly, (0, 0).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from overfly.errors import CalibrationError, SourceError
from overfly.geometry.cameras import Camera, Distortion
from overfly.geometry.poses import FloatArray, Pose
from overfly.sensors.text_files import read_text, read_yaml

KINDS = "EuRoC sensor.yaml, Kalibr camchain, OpenCV or ROS camera_info yaml, COLMAP cameras.txt"

_DISTORTIONS = {
    "radialtangential": Distortion.RADIAL_TANGENTIAL,
    "radtan": Distortion.RADIAL_TANGENTIAL,
    "plumbbob": Distortion.RADIAL_TANGENTIAL,
    "brown": Distortion.RADIAL_TANGENTIAL,
    "rationalpolynomial": Distortion.RADIAL_TANGENTIAL,
    "none": Distortion.RADIAL_TANGENTIAL,
    "equidistant": Distortion.EQUIDISTANT,
    "equi": Distortion.EQUIDISTANT,
    "fisheye": Distortion.EQUIDISTANT,
    "kannalabrandt": Distortion.EQUIDISTANT,
}
_ORTHONORMAL_WITHIN = 1e-2  # rounding of a hand-written matrix, not a mistake in it


@dataclass(frozen=True, slots=True)
class CalibratedCamera:
    """One camera of a calibration file; where it sits, as far as the file says.

    body_from_cam: mount on the body (Kalibr: its IMU is the body). cam_from_previous: pose of the camera
    listed before it in this camera's frame (Kalibr's T_cn_cnm1).
    """

    camera: Camera
    body_from_cam: Pose | None = None
    cam_from_previous: Pose | None = None


def read_camera_file(path: Path, image_size: tuple[int, int] | None = None) -> tuple[CalibratedCamera, ...]:
    """Cameras of a calibration file, in its order; image_size (width, height) serves where the file has none.

    Raises CalibrationError, one line with the file's name, when the file is not understood or cannot be true.
    """
    try:
        if path.suffix.lower() == ".txt":
            return _read_colmap(path)
        content = read_yaml(path)
        chain = [content[key] for key in sorted(content) if key.startswith("cam") and key[3:].isdigit()]
        if chain and all(isinstance(entry, Mapping) for entry in chain):
            return tuple(_read_sensor(path, entry, image_size) for entry in chain)
        if "intrinsics" in content:
            return (_read_sensor(path, content, image_size),)
        return (_read_opencv(path, content, image_size),)
    except CalibrationError:
        raise
    except SourceError as error:
        raise CalibrationError(str(error)) from error
    except (TypeError, ValueError, KeyError, IndexError) as error:
        raise CalibrationError(
            f"{path}: not understood as a camera calibration ({error}); known are {KINDS}"
        ) from error


def fit_to_images(path: Path, camera: Camera, image_size: tuple[int, int]) -> Camera:
    """The camera for images of this size (width, height): scaled when they are the same picture resized.

    Raises CalibrationError when the shapes differ.
    """
    width, height = image_size
    if (camera.width, camera.height) == image_size:
        return camera
    if abs(camera.width * height - camera.height * width) > max(camera.width, camera.height):
        raise CalibrationError(
            f"{path}: calibrated for {camera.width}x{camera.height} pixels, but the images are "
            f"{width}x{height}, another shape; give the calibration of these images with --camera"
        )
    return camera.scaled(width, height)


def mount_from_yaml(path: Path, content: Mapping[str, Any], key: str = "T_BS") -> Pose | None:
    """Pose under ``key`` of a sensor.yaml: 16 numbers, rows of them, or a mapping with data; None when
    absent.

    Raises CalibrationError when it is not a rigid transform.
    """
    entry = content.get(key)
    if entry is None:
        return None
    numbers = _numbers(path, key, entry)
    if len(numbers) not in (12, 16):
        raise CalibrationError(f"{path}: {key} has {len(numbers)} numbers; 16 are needed (4 x 4, row by row)")
    matrix = np.array(numbers, dtype=np.float64).reshape(-1, 4)
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    nearest = u @ vt
    if np.linalg.det(nearest) < 0 or float(np.abs(nearest - matrix[:3, :3]).max()) > _ORTHONORMAL_WITHIN:
        raise CalibrationError(f"{path}: {key} is not a rotation and a translation; check its signs and rows")
    # exact matrices stay as they are: a decomposition would add rounding
    exact = float(np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max()) < 1e-12
    return Pose(matrix[:3, :3].copy() if exact else np.asarray(nearest), matrix[:3, 3].copy())


def _read_sensor(
    path: Path, content: Mapping[str, Any], image_size: tuple[int, int] | None
) -> CalibratedCamera:
    """One camera of an EuRoC sensor.yaml or of a Kalibr camchain."""
    if "intrinsics" not in content:
        raise CalibrationError(f"{path}: no intrinsics (fu, fv, cu, cv); add them or give --camera")
    model = str(content.get("camera_model", "pinhole")).lower()
    if model != "pinhole":
        raise CalibrationError(f"{path}: camera model '{model}' is not known; calibrate as pinhole")
    intrinsics = _numbers(path, "intrinsics", content["intrinsics"])
    coefficients = _numbers(
        path, "distortion", content.get("distortion_coefficients", content.get("distortion_coeffs", []))
    )
    camera = make_camera(
        path,
        _size(path, content.get("resolution"), image_size),
        intrinsics,
        str(content.get("distortion_model", "radial-tangential")),
        coefficients,
    )
    cam_from_body = mount_from_yaml(path, content, "T_cam_imu")
    return CalibratedCamera(
        camera,
        mount_from_yaml(path, content) if cam_from_body is None else cam_from_body.inverse(),
        mount_from_yaml(path, content, "T_cn_cnm1"),
    )


def _read_opencv(
    path: Path, content: Mapping[str, Any], image_size: tuple[int, int] | None
) -> CalibratedCamera:
    """Matrix and coefficients as OpenCV's samples and ROS name them."""
    keys = {key.lower().replace("_", ""): value for key, value in content.items() if isinstance(key, str)}
    matrix = next((keys[key] for key in ("cameramatrix", "k", "m1", "intrinsicmatrix") if key in keys), None)
    if matrix is None:
        raise CalibrationError(f"{path}: holds no camera matrix; known are {KINDS}")
    names = ("distortioncoefficients", "distcoeffs", "distortion", "d", "d1")
    entry: object = next((keys[key] for key in names if key in keys), None) or []
    numbers = _numbers(path, "camera matrix", matrix)
    if len(numbers) != 9:
        raise CalibrationError(f"{path}: the camera matrix has {len(numbers)} numbers, not 9")
    size = [keys.get("imagewidth", keys.get("width")), keys.get("imageheight", keys.get("height"))]
    camera = make_camera(
        path,
        _size(path, None if None in size else size, image_size),
        [numbers[0], numbers[4], numbers[2], numbers[5]],
        str(keys.get("distortionmodel", "radial-tangential")),
        _numbers(path, "distortion", entry),
    )
    return CalibratedCamera(camera)


def _read_colmap(path: Path) -> tuple[CalibratedCamera, ...]:
    """cameras.txt: CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]."""
    cameras = []
    for line in read_text(path).splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        model, width, height = words[1], int(words[2]), int(words[3])
        p = [float(word) for word in words[4:]]
        f, rest = (
            (p[:2], p[2:])
            if model in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV")
            else (
                [p[0], p[0]],
                p[1:],
            )
        )
        centre, k = [rest[0] - 0.5, rest[1] - 0.5], rest[2:]
        if model not in _COLMAP_COEFFICIENTS or len(k) != _COLMAP_COEFFICIENTS[model]:
            known = ", ".join(_COLMAP_COEFFICIENTS)
            raise CalibrationError(
                f"{path}: camera model {model} with {len(p)} parameters; known are {known}"
            )
        distortion = "equidistant" if model == "OPENCV_FISHEYE" else "radial-tangential"
        cameras.append(CalibratedCamera(make_camera(path, (width, height), [*f, *centre], distortion, k)))
    if not cameras:
        raise CalibrationError(f"{path}: names no camera; known are {KINDS}")
    return tuple(cameras)


_COLMAP_COEFFICIENTS = {
    "SIMPLE_PINHOLE": 0,
    "PINHOLE": 0,
    "SIMPLE_RADIAL": 1,
    "RADIAL": 2,
    "OPENCV": 4,
    "OPENCV_FISHEYE": 4,
    "FULL_OPENCV": 8,
}


def make_camera(
    path: Path, size: tuple[int, int], intrinsics: Sequence[float], model: str, coefficients: Sequence[float]
) -> Camera:
    """A camera of these numbers, fx fy cx cy and coefficients of the model by any of its names.

    Raises CalibrationError, naming path, when they are none.
    """
    distortion = _DISTORTIONS.get(model.lower().replace("-", "").replace("_", "").replace(" ", ""))
    if distortion is None:
        known = "radial-tangential (radtan, plumb_bob), equidistant (fisheye), none"
        raise CalibrationError(f"{path}: distortion model '{model}' is not known; known are {known}")
    if len(intrinsics) != 4:
        raise CalibrationError(f"{path}: {len(intrinsics)} intrinsics; 4 are needed: fu, fv, cu, cv")
    k = list(coefficients)
    if len(k) > 5 and not any(k[5:]):
        k = k[:5]
    if len(k) > 5:
        raise CalibrationError(
            f"{path}: {len(k)} distortion coefficients; calibrate with at most five, k1 k2 p1 p2 k3"
        )
    if distortion is Distortion.EQUIDISTANT and len(k) not in (0, 4):
        raise CalibrationError(
            f"{path}: {len(k)} coefficients for equidistant distortion; 4 are needed: k1 k2 k3 k4"
        )
    k += [0.0] * (4 - len(k))
    try:
        fx, fy, cx, cy = intrinsics
        return Camera(*size, fx, fy, cx, cy, distortion, tuple(k))
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error


def _size(path: Path, entry: object, image_size: tuple[int, int] | None) -> tuple[int, int]:
    if entry is None:
        if image_size is None:
            raise CalibrationError(f"{path}: no image size (resolution: [width, height]); add it")
        return image_size
    width, height = (int(number) for number in _numbers(path, "resolution", entry))
    return width, height


def _numbers(path: Path, what: str, entry: object) -> list[float]:
    """Finite numbers of a list, of a list of rows, or of a mapping with data."""
    if isinstance(entry, Mapping):
        entry = entry.get("data", [])
    items: list[object] = []
    for item in entry if isinstance(entry, list | tuple) else [entry]:
        items += item if isinstance(item, list | tuple) else [item]
    numbers: list[float] = []
    for item in items:
        try:
            number = float(item)  # type: ignore[arg-type]  # 1e-5 without a point is text to YAML
        except (TypeError, ValueError) as error:
            raise CalibrationError(f"{path}: {what} holds '{str(item)[:40]}', not a number") from error
        if not math.isfinite(number):
            raise CalibrationError(f"{path}: {what} holds {item}; calibrate again")
        numbers.append(number)
    return numbers


def nadir_mount() -> Pose:
    """Camera looking straight down, image top towards the front of the body, image right to starboard."""
    rotation: FloatArray = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return Pose(rotation, np.zeros(3))
