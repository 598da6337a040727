"""What the simulator shows is where geometry says it is: the figures that everything else rests on."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from overfly.geometry.cameras import Camera, Distortion
from overfly.geometry.poses import FloatArray, rotation_from_euler
from overfly.simulation.degradation import CLEAN
from overfly.simulation.optics import CameraSetup, looking_down
from overfly.simulation.patches import Patch
from overfly.simulation.relief import build_relief, flat_relief
from overfly.simulation.rendering import add_exposure, pixel_rays
from overfly.simulation.tiles import TileCache

from .scenes import CAMERA, Dots, dots_flight, measure, measure_disparity, steady, still

MEAN_PX, WORST_PX = 0.05, 0.2


def grid(height_m: float, count: int = 5, x: float = 0.0, y: float = 0.0) -> FloatArray:
    """Dots over the view from height_m, at uneven places so that they meet texels everywhere."""
    reach = 0.36 * height_m
    a = np.linspace(-reach, reach, count)
    points = np.stack(np.meshgrid(x + a, y + a), axis=-1).reshape(-1, 2)
    points = points + 0.013 * height_m * np.sin(7.0 * np.arange(2 * len(points))).reshape(-1, 2)
    return np.column_stack([points, np.zeros(len(points))])


@pytest.mark.parametrize("height_m", [0.3, 1.7, 12.0, 80.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 9.0])
def test_markers_are_where_they_project_to(height_m: float, tilt_deg: float) -> None:
    at = np.array([3.1, -2.2, height_m])
    path = still(at, np.array([math.radians(tilt_deg), math.radians(-0.7 * tilt_deg), 0.4]))
    shift = height_m * math.tan(math.radians(tilt_deg))
    points = grid(height_m, x=at[0] - 0.5 * shift, y=at[1])
    flight = dots_flight(points, path, sigma_m=2.5 * height_m / CAMERA.fx)
    errors = measure(flight, points, 11)
    assert errors.mean < MEAN_PX
    assert errors.worst < WORST_PX


def test_a_wrong_pose_would_be_noticed() -> None:
    """The measure itself can fail: half a pixel of shift shows."""
    points = grid(1.7)
    flight = dots_flight(points, still(np.array([0.0, 0.0, 1.7]), np.zeros(3)), sigma_m=0.015)
    moved = points + np.array([0.5 * 1.7 / CAMERA.fx, 0.0, 0.0])
    assert measure(flight, moved, 11).mean > 0.4


def test_fisheye_lens() -> None:
    fisheye = Camera(320, 240, 150.0, 150.0, 158.0, 121.0, Distortion.EQUIDISTANT, (0.02, -0.01, 0.003, 0.0))
    setup = CameraSetup("cam0", fisheye, looking_down(), quality=CLEAN)
    points = grid(2.0)
    path = still(np.array([0.0, 0.0, 2.0]), np.array([0.05, 0.0, 1.0]))
    errors = measure(dots_flight(points, path, sigma_m=0.03, cameras=(setup,)), points, 11)
    assert errors.mean < MEAN_PX
    assert errors.worst < WORST_PX


def wavy(cell_m: float = 0.1):  # type: ignore[no-untyped-def]
    x = np.arange(-3.0, 3.0, cell_m)
    return build_relief(0.25 * np.sin(1.3 * x)[None, :] * np.cos(1.1 * x)[:, None], -3.0, -3.0, cell_m)


def test_markers_on_relief_and_stereo_disparity() -> None:
    relief = dataclasses.replace(wavy(), light=np.ones_like(wavy().light))
    points = grid(2.2)
    points[:, 2] = relief.height(points[:, 0], points[:, 1])
    assert np.ptp(points[:, 2]) > 0.2
    pair = tuple(
        CameraSetup(name, CAMERA, looking_down(0.05, y, -0.03, 0.01 * k, -0.008), quality=CLEAN)
        for k, (name, y) in enumerate((("cam0", 0.06), ("cam1", -0.06)))
    )
    flight = dots_flight(
        points,
        still(np.array([0.0, 0.0, 2.2]), np.array([0.03, 0.02, 0.3])),
        sigma_m=0.016,
        relief=relief,
        cameras=pair,
    )
    left, right = measure(flight, points, 10), measure(flight, points, 10, camera=1)
    for errors in (left, right, measure_disparity(flight, points, 10)):
        assert errors.mean < MEAN_PX
        assert errors.worst < WORST_PX


def test_disparity_agrees_with_the_height_field() -> None:
    """Per pixel, not per marker: rays of both cameras to the same ground point differ as the height there
    says.
    """
    relief = wavy()
    flight = dots_flight(
        grid(2.0), still(np.array([0.1, 0.2, 2.0]), np.zeros(3)), sigma_m=0.02, relief=relief
    )
    eye = flight._eyes[0]
    rotations, centres = eye.row_poses(flight.scenario.path, 1.0)
    rays = np.column_stack([eye._rays.reshape(-1, 2), np.ones(320 * 240)])[::97]
    directions = rays @ rotations[0].T
    origins = np.repeat(centres[:1], len(rays), axis=0)
    points = origins + relief.ranges(origins, directions)[:, None] * directions
    # the point is on the surface, and no nearer point of the ray is under it
    assert np.abs(points[:, 2] - relief.height(points[:, 0], points[:, 1])).max() < 1e-6
    for share in np.linspace(0.5, 0.995, 40):
        before = origins + share * (points - origins)
        assert (before[:, 2] > relief.height(before[:, 0], before[:, 1]) - 1e-9).all()
    offset = np.array([0.0, -0.12, 0.0])
    disparity = CAMERA.fx * 0.12 / (centres[0, 2] - points[:, 2])
    away = (points - origins - offset) @ rotations[0]
    shift = CAMERA.fx * (rays[:, :2] - away[:, :2] / away[:, 2:])
    assert (
        np.abs(np.linalg.norm(shift, axis=1) - disparity * (1.0 / np.cos(0.01))).max()
        < 0.05 * disparity.max()
    )


def test_motion_blur_follows_the_path() -> None:
    """The blurred dot's middle is at mid-exposure and its length is the motion over the exposure."""
    exposure = 0.04
    velocity = np.array([1.2, -0.5, 0.0])
    path = steady(np.array([0.0, 0.0, 2.0]), velocity, np.zeros(3), np.array([0.0, 0.0, 0.3]))
    setup = CameraSetup("cam0", CAMERA, looking_down(), exposure_s=exposure, quality=CLEAN)
    points = grid(2.0, 4)
    sigma_px = 2.0
    flight = dots_flight(points, path, sigma_m=sigma_px * 2.0 / CAMERA.fx, cameras=(setup,))
    errors = measure(flight, points, 16)
    assert errors.mean < MEAN_PX
    assert errors.worst < WORST_PX
    sharp = dataclasses.replace(setup, exposure_s=0.0)
    spreads = []
    for camera in (sharp, setup):
        one = dots_flight(np.zeros((1, 3)), path, sigma_m=sigma_px * 2.0 / CAMERA.fx, cameras=(camera,))
        image = one._eyes[0].expose(path, 1.0)[..., 0].astype(float) - 0.153
        weight = np.clip(image, 0.0, None)
        rows, cols = np.mgrid[0:240, 0:320]
        u, v = (weight * cols).sum() / weight.sum(), (weight * rows).sum() / weight.sum()
        spreads.append((weight * ((cols - u) ** 2 + (rows - v) ** 2)).sum() / weight.sum())
    flow = np.linalg.norm(velocity) * CAMERA.fx / 2.03 * exposure
    # the variance of a uniform smear of length L is L^2 / 12
    assert math.isclose(math.sqrt(12.0 * (spreads[1] - spreads[0])), flow, rel_tol=0.05)


def test_rolling_shutter_shears_as_the_path_says() -> None:
    path = steady(
        np.array([0.0, 0.0, 2.0]), np.array([0.0, 1.5, 0.0]), np.zeros(3), np.array([0.1, 0.0, 0.2])
    )
    rolling = CameraSetup("cam0", CAMERA, looking_down(), readout_s=0.03, quality=CLEAN)
    points = grid(2.0)
    flight = dots_flight(points, path, sigma_m=0.017, cameras=(rolling,))
    errors = measure(flight, points, 11)
    assert errors.mean < MEAN_PX
    assert errors.worst < WORST_PX
    whole = dots_flight(points, path, sigma_m=0.017, cameras=(dataclasses.replace(rolling, readout_s=0.0),))
    shift = np.linalg.norm(flight.project(1, points) - whole.project(1, points), axis=1)
    assert np.nanmax(shift) > 2.0, "the shear is large against what is allowed"


def test_texture_stays_put_over_all_levels() -> None:
    """Painted coarse or fine, a dot is at the same place: levels do not shift against each other."""
    dots = Dots(np.array([[0.37, -0.21]]), 0.3)
    for texel in (0.01, 0.02, 0.04, 0.08):
        n = int(4.0 / texel)
        patch = Patch(-2.0, -2.0, texel, n)
        weight = dots.paint(patch)[..., 0].astype(float) - 0.15
        assert abs((weight * patch.x).sum() / weight.sum() - 0.37) < 0.002
        assert abs((weight * patch.y).sum() / weight.sum() + 0.21) < 0.002


def test_flat_relief_is_flat_everywhere() -> None:
    relief = flat_relief(0.5)
    ranges = relief.ranges(np.array([[100.0, -3.0, 2.5]]), np.array([[0.3, 0.1, -1.0]]))
    assert math.isclose(ranges[0], 2.0)


class Slope:
    """Ground whose reflectance is linear in place: linear interpolation must return it exactly."""

    def paint(self, patch: Patch) -> np.ndarray:
        value = 0.4 + 0.05 * patch.x + 0.03 * patch.y
        return np.repeat(value[..., None], 3, axis=2).astype(np.float32)


@pytest.mark.parametrize("height_m", [0.7, 1.1, 1.9])
def test_sampling_returns_a_linear_ground_exactly(height_m: float) -> None:
    relief = flat_relief()
    rays = pixel_rays(CAMERA)
    rotation = rotation_from_euler(0.1, -0.05, 0.8) @ looking_down().rotation
    centre = np.array([0.3, -0.2, height_m])
    rotations, centres = np.repeat(rotation[None], 240, axis=0), np.repeat(centre[None], 240, axis=0)
    seen = np.zeros((240, 320, 1), dtype=np.float32)
    add_exposure(seen, rays, rotations, centres, CAMERA.focal_px, relief, TileCache(Slope().paint), 1.0)
    directions = np.dstack([rays, np.ones((240, 320))]) @ rotation.T
    ground = centre + directions * (-height_m / directions[..., 2:])
    assert np.abs(seen[..., 0] - (0.4 + 0.05 * ground[..., 0] + 0.03 * ground[..., 1])).max() < 1e-4
