"""Dense depths of pictures over ground that is known exactly, and the surface that many of them make."""

from __future__ import annotations

import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage
from tests.vision.scenes import camera_pose

from overfly.geometry.cameras import Camera, Distortion
from overfly.geometry.levelling import NADIR_BODY_FROM_CAM
from overfly.geometry.poses import Pose
from overfly.pipeline.surface import JURY, SurfaceView, _borne_out, _mean_by_cell, dense_elevation
from overfly.types import MountedCamera, Rig
from overfly.vision.dense import DepthRange, dense_points, pair_geometry

Array = NDArray[np.float64]

LENS = Camera(320, 240, 270.0, 271.0, 162.0, 117.0, coefficients=(-0.12, 0.04, 0.0006, -0.0004))
FISHEYE = Camera(320, 240, 250.0, 250.0, 161.0, 118.0, Distortion.EQUIDISTANT, (0.02, -0.005, 0.0, 0.0))
TEXEL_M = 0.01
AT_2M = DepthRange(2.0, 1.5, 2.5)


def texture() -> Array:
    generator = np.random.default_rng(0)
    waves = sum(
        scale * ndimage.gaussian_filter(generator.normal(size=(1024, 1024)), scale, mode="wrap")
        for scale in (1.5, 4, 12)
    )
    return np.asarray(np.clip(125 + 35 * waves / np.std(waves), 0, 255))


TEXTURE = texture()


def hills(x: Array, y: Array) -> Array:
    return np.asarray(0.12 * np.sin(1.3 * x) * np.cos(1.7 * y))


def seen(camera: Camera, world_from_cam: Pose) -> NDArray[np.uint8]:
    """What the camera sees of the textured hills, by walking down every ray."""
    column, row = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    rays = camera.rays_from_pixels(np.stack([column.ravel(), row.ravel()], axis=1))
    direction = np.column_stack([rays, np.ones(len(rays))]) @ world_from_cam.rotation.T
    centre = world_from_cam.translation
    z = np.zeros(len(rays))
    for _ in range(25):  # a fixed point of gentle relief
        x, y = (centre[:2] + direction[:, :2] / direction[:, 2:] * (z - centre[2])[:, None]).T
        z = hills(x, y)
    value = ndimage.map_coordinates(TEXTURE, [-y / TEXEL_M, x / TEXEL_M], order=1, mode="grid-wrap")
    return np.asarray(np.clip(value + 0.5, 0, 255), np.uint8).reshape(camera.height, camera.width)


@settings(max_examples=12)
@given(
    heading=st.floats(-3.1, 3.1), away=st.floats(-3.1, 3.1), share=st.floats(0.1, 0.4),
    turn=st.floats(-3.1, 3.1), tilt=st.tuples(*[st.floats(-0.08, 0.08)] * 4), fisheye=st.booleans(),
)  # fmt: skip
def test_two_pictures_from_anywhere_tell_the_hills(
    heading: float, away: float, share: float, turn: float, tilt: tuple[float, ...], fisheye: bool
) -> None:
    camera = FISHEYE if fisheye else LENS
    left = camera_pose(0.3, -0.2, 2.0, tilt[0], tilt[1], heading)
    x, y = 0.3 + 2.0 * share * np.cos(away), -0.2 + 2.0 * share * np.sin(away)
    right = camera_pose(x, y, 2.05, tilt[2], tilt[3], turn)
    pair = pair_geometry(camera, camera, right.inverse() @ left, AT_2M)
    assert pair is not None
    found = dense_points(pair, seen(camera, left), seen(camera, right))
    overlap = np.prod(1.0 - np.abs([x - 0.3, y + 0.2]) / 1.8)
    assert len(found.in_cam) > 0.35 * overlap * camera.width * camera.height
    world = left.transform(found.in_cam)
    error = (world[:, 2] - hills(world[:, 0], world[:, 1])) / found.sigma_m
    assert 0.05 < np.median(np.abs(error)) < 1.0
    assert np.mean(np.abs(error) > 4.0) < 0.03
    px = camera.project(found.in_cam)
    assert (px > 0).all() and (px < [camera.width, camera.height]).all()


def test_cameras_that_stand_too_near_or_in_a_row_tell_nothing() -> None:
    down = camera_pose(0.0, 0.0, 2.0)
    assert pair_geometry(LENS, LENS, camera_pose(0.02, 0.0, 2.0).inverse() @ down, AT_2M) is None
    assert pair_geometry(LENS, LENS, camera_pose(0.05, 0.0, 2.5).inverse() @ down, AT_2M) is None
    assert pair_geometry(LENS, LENS, camera_pose(0.3, 0.0, 2.0).inverse() @ down, AT_2M) is not None


def flight(stereo: bool, count: int = 7) -> tuple[list[SurfaceView], Rig]:
    """Along x, half a metre a step; one picture is nothing but noise."""
    generator = np.random.default_rng(3)
    left = MountedCamera("cam0", LENS, Pose(NADIR_BODY_FROM_CAM, np.array([0.0, 0.06, 0.0])))
    right = MountedCamera("cam1", LENS, Pose(NADIR_BODY_FROM_CAM, np.array([0.0, -0.06, 0.0])))
    rig = Rig((left, right) if stereo else (left,))
    views = []
    for number in range(count):
        body = Pose(np.eye(3), np.array([0.5 * number, 0.0, 2.0]))
        pictures = [seen(mounted.camera, body @ mounted.body_from_cam) for mounted in rig.cameras]
        if number == 3:
            pictures = [generator.integers(0, 255, (240, 320)).astype(np.uint8) for _ in pictures]
        views.append(SurfaceView(body @ left.body_from_cam, AT_2M, lambda p=tuple(pictures): p))
    return views, rig


@pytest.mark.parametrize("stereo", [True, False], ids=["stereo", "one camera"])
def test_many_views_make_a_surface(stereo: bool) -> None:
    """17 px of disparity in stereo and 68 between nodes: 0.2 px are 24 and 6 mm of depth at 2 m. Poses and
    pictures are exact here, so that errors are smaller than those of flights."""
    views, rig = flight(stereo)
    grid = dense_elevation(views, rig)
    assert grid is not None
    rows, columns = np.nonzero(np.isfinite(grid.heights))
    x, y = grid.x0_m + (columns + 0.5) * grid.cell_m, grid.y0_m - (rows + 0.5) * grid.cell_m
    error = grid.heights[rows, columns] - hills(x, y)
    rmse = float(np.sqrt(np.mean(error**2)))
    assert 5e-4 < rmse < (0.03 if stereo else 0.015)
    assert (
        len(error) * grid.cell_m**2 > 3.0
    )  # square metres, of the 3.0 m x 1.8 m that two nodes see and more
    assert 0.12 < np.median(np.abs(error) / grid.sigma[rows, columns]) < 1.2
    assert 0.01 < grid.cell_m < 0.05


def test_what_poses_are_off_by_is_added_to_the_sigmas() -> None:
    views, rig = flight(stereo=True, count=3)
    plain = dense_elevation(views, rig)
    told = dense_elevation([replace(view, pose_sigma_m=0.1 * (1 + k)) for k, view in enumerate(views)], rig)
    assert plain is not None and told is not None
    np.testing.assert_array_equal(told.heights, plain.heights)
    known = np.isfinite(plain.heights)
    added = np.sqrt(told.sigma[known] ** 2 - plain.sigma[known] ** 2)
    assert 0.0999 < added.min() < 0.101  # only the first view sees that ground
    assert 0.299 < added.max() < 0.3001
    assert ((added > 0.14) & (added < 0.26)).any()  # what two see is neither's


def test_depths_at_the_border_are_as_good_as_inside(monkeypatch: pytest.MonkeyPatch) -> None:
    """Boards along the rows tell little: a black frame around the pictures would be their strongest edge."""
    boards = ndimage.gaussian_filter(np.random.default_rng(1).normal(size=(1024, 1024)), (2, 25), mode="wrap")
    monkeypatch.setattr(sys.modules[__name__], "TEXTURE", np.clip(125 + 20 * boards / boards.std(), 0, 255))
    rig = flight(stereo=True, count=0)[1]
    pose = camera_pose(0.3, -0.2, 2.0)
    pair = pair_geometry(LENS, LENS, rig.cam1_from_cam0, AT_2M)
    assert pair is not None
    found = dense_points(pair, seen(LENS, pose), seen(LENS, pose @ rig.cam1_from_cam0.inverse()))
    world, px = pose.transform(found.in_cam), LENS.project(found.in_cam)
    error = (world[:, 2] - hills(world[:, 0], world[:, 1])) / found.sigma_m
    inside = np.minimum(px, [LENS.width - 1, LENS.height - 1] - px).min(axis=1)
    at_border = (inside < 10) & (px[:, 0] > 60)  # further left the second camera sees nothing
    assert np.count_nonzero(at_border) > 1000
    assert np.mean(error[at_border] ** 2) < 1.4 * np.mean(error[inside > 20] ** 2)


@given(st.floats(0.5, 100.0), st.floats(0.0, 0.5), st.integers(0, 1000))
def test_depths_are_searched_where_points_are_and_a_little_beyond(
    ground: float, relief: float, seed: int
) -> None:
    depths = ground * (1.0 + relief * np.random.default_rng(seed).uniform(-1, 1, 200))
    found = DepthRange.of(depths)
    assert found.nearest_m < found.ground_m < found.furthest_m
    low, high = np.percentile(depths, [2, 98])
    assert found.nearest_m <= max(0.85 * low, 0.41 * found.ground_m)
    assert found.furthest_m >= min(1.15 * high, 1.59 * found.ground_m)
    assert found.nearest_m >= 0.39 * found.ground_m
    assert found.furthest_m <= 1.61 * found.ground_m


def test_nothing_to_match_is_no_surface() -> None:
    views, rig = flight(stereo=False, count=1)
    assert dense_elevation(views, rig) is None
    assert dense_elevation([], rig) is None


def test_colour_and_large_pictures_are_reduced_first() -> None:
    """Four times as many pixels and three channels say the same, at the same cell size."""
    views, rig = flight(stereo=True, count=2)
    mounted = [MountedCamera(m.name, m.camera.scaled(640, 480), m.body_from_cam) for m in rig.cameras]

    def enlarged(view: SurfaceView) -> SurfaceView:
        pictures = [cv2.cvtColor(cv2.resize(p, (640, 480)), cv2.COLOR_GRAY2RGB) for p in view.load()]
        return SurfaceView(view.world_from_cam, view.depths_m, lambda: tuple(pictures))

    small = dense_elevation(views, rig)
    large = dense_elevation([enlarged(view) for view in views], Rig(tuple(mounted)))
    assert small is not None and large is not None
    assert large.cell_m == small.cell_m
    x, y = np.meshgrid(np.linspace(0.0, 0.5, 20), np.linspace(-0.3, 0.3, 20))
    np.testing.assert_allclose(large.height_at(x, y), small.height_at(x, y), atol=0.03)


def test_cells_hold_the_means_of_their_points() -> None:
    """Twin of the sums over cells: the mean of the points in each cell that holds three or more."""
    generator = np.random.default_rng(3)
    points, sigmas = generator.uniform(-1.0, 1.0, (400, 3)), generator.uniform(0.01, 0.02, 400)
    pose = camera_pose(0.3, -0.2, 2.0, 0.05, -0.03, 0.7)
    table = _mean_by_cell(points, sigmas, pose.rotation, pose.translation, 0.2, 3)
    world = pose.transform(points)
    places = np.floor(world[:, :2] / 0.2).astype(int)
    cells, inverse, counts = np.unique(places, axis=0, return_inverse=True, return_counts=True)
    filled = np.flatnonzero(counts >= 3)
    expected = [
        [
            *(0.2 * (cells[k] + 0.5)),
            world[inverse.ravel() == k, 2].mean(),
            sigmas[inverse.ravel() == k].mean(),
        ]
        for k in filled
    ]
    assert 20 < len(filled) < len(cells)
    np.testing.assert_allclose(
        table[np.lexsort(table[:, :2].T)], np.array(expected)[np.lexsort(np.array(expected)[:, :2].T)]
    )


def with_points(count: int, wrong: int = 0) -> SurfaceView:
    """From two metres above level ground, of which the map has points, some of them 0.5 m too high."""
    generator = np.random.default_rng(5)
    ground = np.column_stack([generator.uniform(-1.0, 1.0, (count, 2)), generator.normal(0.0, 0.005, count)])
    ground[:wrong, 2] += 0.5
    pose = camera_pose(0.0, 0.0, 2.0)
    points = pose.inverse().transform(ground)
    return SurfaceView(pose, AT_2M, lambda: (), 0.0, points, np.full(count, 0.01))


def test_a_piece_that_the_points_of_the_map_contradict_is_left_out() -> None:
    """As tiles matched a period off: 0.5 m square, 0.3 m too high."""
    x, y = (side.ravel() for side in np.meshgrid(np.arange(-0.975, 1.0, 0.05), np.arange(-0.975, 1.0, 0.05)))
    is_wrong = (x > 0.3) & (x < 0.8) & (np.abs(y) < 0.25)
    cells = np.column_stack([x, y, 0.3 * is_wrong, np.full(len(x), 0.01)])
    kept = _borne_out(cells, with_points(400), 0.05)
    assert np.count_nonzero(kept[:, 2] > 0.1) < 0.2 * np.count_nonzero(is_wrong)
    assert np.count_nonzero(kept[:, 2] == 0.0) > 0.97 * np.count_nonzero(~is_wrong)
    few = _borne_out(cells, with_points(JURY - 1), 0.05)
    np.testing.assert_array_equal(few, cells)
    right = cells[~is_wrong]
    np.testing.assert_array_equal(_borne_out(right, with_points(400), 0.05), right)
    assert len(_borne_out(right, with_points(400, wrong=12), 0.05)) > 0.99 * len(right)
