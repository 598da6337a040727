"""The public flights: they read whole, and what is read agrees with their truth and their pictures."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from overfly.geometry.geodesy import GeoOrigin, enu_from_geodetic
from overfly.geometry.poses import euler_from_rotation, rotation_from_euler, rotation_from_quaternion
from overfly.sensors import Flight, ScaleSource, choose_scale_source, open_flight
from overfly.types import Frame

pytestmark = pytest.mark.data


@pytest.mark.parametrize(
    ("name", "frames", "scale"),
    [
        ("flights/corridor", 557, ScaleSource.STEREO),
        ("flights/outdoor", 1426, ScaleSource.STEREO),
        ("flights/blimp", 566, ScaleSource.RANGE),
        ("flights/helicopter", 953, ScaleSource.LANDMARK),
        ("flights/survey", 193, ScaleSource.GPS),
        ("real/cuav", 18, ScaleSource.RANGE),
        ("real/opticflow", 550, ScaleSource.RANGE),
        ("real/eth_downfacing_vio", 1000, ScaleSource.RANGE),
        ("real/brighton_beach", 18, ScaleSource.GPS),
        ("real/caliterra", 75, ScaleSource.GPS),
    ],
)
def test_every_flight_opens(data_dir: Path, name: str, frames: int, scale: ScaleSource) -> None:
    flight = open_flight(data_dir / name)
    assert len(flight) == frames
    assert choose_scale_source(flight) is scale
    for index in (0, frames // 2, frames - 1):
        frame = flight.read_frame(index)
        assert frame is not None
        assert len(frame.images) == len(flight.rig.cameras)


def true_attitudes(flight: Flight, folder: Path) -> dict[int, tuple[float, float, float]]:
    """Roll, pitch and yaw of the body by frame index, from the true poses of the camera."""
    truth = np.loadtxt(folder / "truth" / "groundtruth_cam0.tum")
    body_from_cam = flight.rig.cam0.body_from_cam.rotation
    found = {}
    for index, t_ns in enumerate(flight.t_ns):
        row = truth[np.argmin(np.abs(truth[:, 0] - t_ns * 1e-9))]
        if abs(row[0] - t_ns * 1e-9) < 1e-3:
            found[index] = euler_from_rotation(rotation_from_quaternion(row[4:]) @ body_from_cam.T)
    return found


@pytest.mark.parametrize("name", ["flights/corridor", "flights/outdoor", "flights/survey", "real/opticflow"])
def test_attitude_is_that_of_the_truth_within_its_sigma(data_dir: Path, name: str) -> None:
    folder = data_dir / name
    flight = open_flight(folder)
    true = true_attitudes(flight, folder)
    assert len(true) > 0.9 * len(flight)
    errors = []
    for index, (roll, pitch, _) in list(true.items())[::5]:
        frame = flight.read_frame(index)
        assert frame is not None and frame.attitude is not None
        errors.append((frame.attitude.roll_rad - roll, frame.attitude.pitch_rad - pitch))
        sigma_rad = frame.attitude.sigma_rad
    rms = float(np.sqrt(np.mean(np.square(errors))))
    assert 0.3 * sigma_rad < rms < 1.3 * sigma_rad


def test_positions_agree_with_the_local_coordinates_beside_them(data_dir: Path) -> None:
    rows = np.loadtxt(data_dir / "flights" / "survey" / "mav0" / "gps0" / "data.csv", delimiter=",")
    origin = GeoOrigin(60.400857, 22.46044, 20.0)  # as stated in the sensor.yaml beside it
    np.testing.assert_allclose(enu_from_geodetic(rows[:, 1:4], origin), rows[:, 4:7], atol=1e-4)


def ground_shift_px(first: Frame, second: Frame, shrink: int) -> np.ndarray:
    """Median shift of the ground from the first picture to the second, (2,) pixels of the full size."""
    found = []
    for frame in (first, second):
        gray = cv2.cvtColor(frame.images[0], cv2.COLOR_RGB2GRAY)
        small = cv2.resize(gray, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA)
        found.append(cv2.SIFT_create(2000).detectAndCompute(small, None))
    (points, descriptors), (others, other_descriptors) = found
    pairs = cv2.BFMatcher().knnMatch(descriptors, other_descriptors, k=2)
    shifts = [
        np.subtract(others[best.trainIdx].pt, points[best.queryIdx].pt)
        for best, next_best in pairs
        if best.distance < 0.8 * next_best.distance
    ]
    assert len(shifts) >= 20
    return shrink * np.median(shifts, axis=0)


def test_gimbal_angles_gps_and_focal_length_explain_how_the_pictures_move(data_dir: Path) -> None:
    flight = open_flight(data_dir / "real" / "brighton_beach")
    with_heading = [
        index
        for index in range(len(flight))
        if (frame := flight.read_frame(index)) and frame.attitude and frame.attitude.yaw_rad is not None
    ]
    assert len(with_heading) == 12  # six were turned by a viewer
    for index in with_heading[:3]:
        first, second = flight.read_frame(index), flight.read_frame(index + 1)
        assert first is not None and second is not None
        assert first.position and second.position and second.attitude and second.altitude
        origin = GeoOrigin(first.position.latitude_deg, first.position.longitude_deg)
        there = np.array([[second.position.latitude_deg, second.position.longitude_deg, 0.0]])
        moved = enu_from_geodetic(there, origin)[0] * [1, 1, 0]
        attitude = second.attitude
        body = rotation_from_euler(attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad or math.nan)
        cam_from_world = (body @ flight.rig.cam0.body_from_cam.rotation).T
        focal_px = flight.rig.cam0.camera.focal_px
        expected = -(cam_from_world @ moved)[:2] * focal_px / second.altitude.value_m
        seen = ground_shift_px(first, second, shrink=8)
        assert np.linalg.norm(seen - expected) < 0.15 * np.linalg.norm(expected)
