"""Calibration files of five programs, of one and the same camera."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from overfly.errors import CalibrationError
from overfly.geometry.cameras import Camera, Distortion
from overfly.sensors.calibration_files import fit_to_images, read_camera_file

CAMERA = Camera(640, 480, 500.0, 510.0, 320.5, 241.25, coefficients=(-0.2, 0.05, 0.001, -0.002))

EUROC = """\
%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, 0.1, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
resolution: [640, 480]
camera_model: pinhole
intrinsics: [500.0, 510.0, 320.5, 241.25]
distortion_model: radial-tangential
distortion_coefficients: [-0.2, 0.05, 1e-3, -0.002]
"""
KALIBR = """\
cam0:
  cam_overlaps: [1]
  T_cam_imu:
  - [0.0, -1.0, 0.0, 0.0]
  - [-1.0, 0.0, 0.0, 0.1]
  - [0.0, 0.0, -1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.2, 0.05, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [500.0, 510.0, 320.5, 241.25]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.12]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.1, 0.2, 0.3, 0.4]
  distortion_model: equidistant
  intrinsics: [400.0, 400.0, 320.0, 240.0]
  resolution: [640, 480]
"""
ROS = """\
image_width: 640
image_height: 480
camera_name: down
camera_matrix:
  rows: 3
  cols: 3
  data: [500.0, 0.0, 320.5, 0.0, 510.0, 241.25, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.2, 0.05, 0.001, -0.002, 0.0]
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""
COLMAP = """\
# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
1 OPENCV 640 480 500 510 321 241.75 -0.2 0.05 0.001 -0.002
"""


def same(found: Camera, wanted: Camera = CAMERA) -> None:
    assert (found.width, found.height, found.distortion) == (wanted.width, wanted.height, wanted.distortion)
    np.testing.assert_allclose(found.matrix(), wanted.matrix())
    np.testing.assert_allclose(found.coefficients[:4], wanted.coefficients)
    assert not any(found.coefficients[4:])


@pytest.mark.parametrize(
    ("name", "content"),
    [("sensor.yaml", EUROC), ("camchain.yaml", KALIBR), ("camera_info.yaml", ROS), ("cameras.txt", COLMAP)],
)
def test_every_dialect_gives_the_same_camera(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / name).write_text(content)
    same(read_camera_file(tmp_path / name)[0].camera)


def test_opencv_files_as_opencv_writes_them(tmp_path: Path) -> None:
    path = tmp_path / "opencv.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", CAMERA.matrix())
    storage.write("distortion_coefficients", np.array([[*CAMERA.coefficients, 0.0]]))
    storage.release()
    same(read_camera_file(path)[0].camera)


def test_mounts(tmp_path: Path) -> None:
    (tmp_path / "sensor.yaml").write_text(EUROC)
    (tmp_path / "camchain.yaml").write_text(KALIBR)
    euroc = read_camera_file(tmp_path / "sensor.yaml")[0].body_from_cam
    first, second = read_camera_file(tmp_path / "camchain.yaml")
    assert euroc is not None and first.body_from_cam is not None and second.cam_from_previous is not None
    np.testing.assert_allclose(euroc.matrix(), first.body_from_cam.matrix(), atol=1e-12)
    np.testing.assert_allclose(second.cam_from_previous.translation, [-0.12, 0.0, 0.0])
    assert second.camera.distortion is Distortion.EQUIDISTANT
    assert second.camera.coefficients == (0.1, 0.2, 0.3, 0.4)


@pytest.mark.parametrize(
    ("line", "focal", "coefficients"),
    [
        ("1 SIMPLE_PINHOLE 640 480 500 320 240", (500, 500), (0, 0, 0, 0)),
        ("1 PINHOLE 640 480 500 510 320 240", (500, 510), (0, 0, 0, 0)),
        ("1 SIMPLE_RADIAL 640 480 500 320 240 0.1", (500, 500), (0.1, 0, 0, 0)),
        ("1 RADIAL 640 480 500 320 240 0.1 0.2", (500, 500), (0.1, 0.2, 0, 0)),
        ("1 OPENCV_FISHEYE 640 480 500 510 320 240 0.1 0.2 0.3 0.4", (500, 510), (0.1, 0.2, 0.3, 0.4)),
        (
            "1 FULL_OPENCV 640 480 500 510 320 240 0.1 0.2 0.3 0.4 0.5 0 0 0",
            (500, 510),
            (0.1, 0.2, 0.3, 0.4, 0.5),
        ),
    ],
)
def test_colmap_models(
    tmp_path: Path, line: str, focal: tuple[float, float], coefficients: tuple[float, ...]
) -> None:
    (tmp_path / "cameras.txt").write_text(line)
    camera = read_camera_file(tmp_path / "cameras.txt")[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (*focal, 319.5, 239.5)
    assert camera.coefficients == coefficients


def test_size_may_come_from_the_images(tmp_path: Path) -> None:
    path = tmp_path / "k.yaml"
    path.write_text("K: [[500, 0, 320], [0, 500, 240], [0, 0, 1]]\nD: [0.1, 0, 0, 0]\n")
    assert read_camera_file(path, (640, 480))[0].camera.width == 640
    with pytest.raises(CalibrationError, match="size"):
        read_camera_file(path)


def test_resized_images_scale_the_camera_and_cropped_ones_do_not(tmp_path: Path) -> None:
    assert fit_to_images(tmp_path, CAMERA, (640, 480)) is CAMERA
    half = fit_to_images(tmp_path, CAMERA, (320, 240))
    assert half.fx == pytest.approx(250.0)
    assert half.cx == pytest.approx(160.0)
    with pytest.raises(CalibrationError, match="shape"):
        fit_to_images(tmp_path, CAMERA, (640, 360))


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("a.yaml", "", "key"),
        ("a.yaml", "x: 1\n", "camera matrix"),
        ("a.yaml", "cam0: {camera_model: omni, intrinsics: [1, 2, 3, 4, 5]}", "omni"),
        ("a.yaml", ROS.replace("plumb_bob", "thin_prism"), "thin_prism"),
        ("a.yaml", ROS.replace("500.0, 0.0, 320.5", "500.0, 320.5"), "8 numbers"),
        ("a.yaml", ROS.replace("-0.002, 0.0]", "-0.002, 0.0, 0.1, 0.2, 0.3]"), "8 distortion"),
        ("a.yaml", ROS.replace("[-0.2,", "[wide,"), "wide"),
        ("a.yaml", KALIBR.replace("[640, 480]", "[640]"), "understood"),
        ("a.yaml", "a: 2001-99-99\n", "YAML"),
        ("a.yaml", "a: " + "[" * 3000, "YAML"),
        ("a.yaml", "a: !!opencv-matrix [1]", "YAML"),
        ("a.yaml", "intrinsics: &a [1, [*a]]\n", "not a number"),
        ("a.txt", "", "no camera"),
        ("a.txt", "1 THIN_PRISM_FISHEYE 640 480 1 2 3 4 5 6 7 8 9 10 11 12\n", "THIN_PRISM_FISHEYE"),
        ("a.txt", "hello\n", "understood"),
        ("a.txt", "1 PINHOLE 640 x 1 2 3 4\n", "understood"),
    ],
)
def test_what_is_not_a_calibration_says_so_in_one_line(
    tmp_path: Path, name: str, content: str, word: str
) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(CalibrationError) as error:
        read_camera_file(path)
    assert str(path) in str(error.value)
    assert word in str(error.value)
    assert "\n" not in str(error.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="nowhere"):
        read_camera_file(tmp_path / "nowhere.yaml")
