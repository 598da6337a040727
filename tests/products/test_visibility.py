"""Ground behind higher ground: what is hidden, and that the mosaic takes it from where it is not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import Pose
from overfly.products.elevation import ElevationGrid
from overfly.products.georeference import transform_points
from overfly.products.mosaic import MappedImage, write_mosaic
from overfly.products.visibility import is_hidden

Array = NDArray[np.float64]

CELL_M = 0.05
WALL_M = 1.0  # high, from x = 2.0 to 2.4, along all of y
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])
CAMERA = Camera(320, 240, 160.0, 160.0, 160.0, 120.0)


def wall() -> ElevationGrid:
    x = (np.arange(120) + 0.5) * CELL_M
    row = np.where((x > 2.0) & (x < 2.4), WALL_M, 0.0)
    heights = np.tile(row, (80, 1)).astype(np.float32)
    return ElevationGrid(0.0, 4.0, CELL_M, heights, np.zeros_like(heights))


@settings(max_examples=50)
@given(st.floats(0.3, 1.7), st.floats(1.5, 6.0), st.floats(0.5, 3.5))
def test_a_wall_hides_what_its_shadow_would_cover(camera_x: float, height: float, camera_y: float) -> None:
    x = np.arange(2.45, 5.9, 0.01)
    points = np.column_stack([x, np.full_like(x, camera_y), np.zeros_like(x)])
    hidden = is_hidden(wall(), points, np.array([camera_x, camera_y, height]), WALL_M)
    edge = 2.4 + (2.4 - camera_x) * WALL_M / (height - WALL_M)  # end of the shadow of the wall's far edge
    slack = (3.0 * CELL_M) * (1.0 + (edge - camera_x) / height * 2.0)
    assert hidden[x < edge - slack].all()
    assert not hidden[x > edge + slack].any()
    near = np.column_stack([np.arange(0.1, 1.9, 0.05), np.full(36, camera_y), np.zeros(36)])
    assert not is_hidden(wall(), near, np.array([camera_x, camera_y, height]), WALL_M).any()


def test_level_ground_hides_nothing() -> None:
    points = np.random.default_rng(0).uniform(0, 3, (50, 3)) * [1, 1, 0]
    centre = np.array([0.0, 0.0, 2.0])
    assert not is_hidden(ElevationGrid.flat(0.0), points, centre, 0.0).any()


def seen_beside_the_wall(pose: Pose) -> NDArray[np.uint8]:
    """Dark ground, white wall, by small steps along every ray."""
    column, row = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = CAMERA.rays_from_pixels(np.stack([column.ravel(), row.ravel()], axis=1).astype(float))
    direction = np.column_stack([rays, np.ones(len(rays))]) @ pose.rotation.T
    centre = pose.translation
    value = np.full(len(rays), 60, np.uint8)
    for z in np.arange(WALL_M, 0.0, -0.01):
        x = centre[0] + direction[:, 0] / direction[:, 2] * (z - centre[2])
        value[(x > 2.0) & (x < 2.4)] = 220
    return value.reshape(CAMERA.height, CAMERA.width)


@pytest.mark.parametrize("knows_the_wall", [True, False])
def test_the_mosaic_does_not_paint_a_wall_onto_the_ground_behind_it(
    tmp_path: Path, knows_the_wall: bool
) -> None:
    """The left camera is nearer to the ground right of the wall, and does not see it."""
    images = []
    for name, x in (("left", 1.6), ("right", 4.6)):
        pose = Pose(LOOKING_DOWN, np.array([x, 2.0, 3.0]))
        picture = seen_beside_the_wall(pose)
        images.append(MappedImage(name, lambda picture=picture: picture, CAMERA, pose))
    ground = wall() if knows_the_wall else ElevationGrid.flat(0.0)
    mosaic = write_mosaic(tmp_path / "mosaic.tif", images, ground, gsd_m=0.02)
    with rasterio.open(mosaic.path) as raster:
        rgba = raster.read()
    column, row = np.meshgrid(np.arange(mosaic.width) + 0.5, np.arange(mosaic.height) + 0.5)
    xy = transform_points(mosaic.crs_from_pixel, np.stack([column, row], axis=-1))
    x, y = xy[..., 0], xy[..., 1]
    seen = (rgba[3] == 255) & (np.abs(y - 2.0) < 0.8)
    behind = seen & (x > 2.55) & (x < 2.75)
    white = np.mean(rgba[0][behind] > 140)
    assert white < 0.05 if knows_the_wall else white > 0.2
    if knows_the_wall:
        on_top = seen & (x > 2.1) & (x < 2.3)
        assert np.mean(rgba[0][on_top] > 140) > 0.95
