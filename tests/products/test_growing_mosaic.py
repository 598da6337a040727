"""The mosaic that is drawn while flying: which tiles are drawn again, that it is the mosaic of the same
poses, and that its file is whole at any moment."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from overfly.errors import OutputError
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import Pose, rotation_z
from overfly.products import growing_mosaic, picture_spool
from overfly.products.cog import TILE_PX
from overfly.products.elevation import ElevationGrid
from overfly.products.growing_mosaic import POINTS, GrowingMosaic, NodePicture, Placement
from overfly.products.growing_raster import GrowingRaster
from overfly.products.mosaic import MappedImage, write_mosaic
from overfly.products.picture_spool import PictureSpool
from overfly.products.tiles import NODE_PX, PAD_NODES

LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])
CAMERA = Camera(240, 180, 200.0, 200.0, 119.5, 89.5)
HEIGHT_M = 4.0
PX_M = HEIGHT_M / CAMERA.fx
TEXEL_M = 2 * PX_M
TILE_M = TILE_PX * PX_M
_noise = np.random.default_rng(0).normal(size=(700, 700))
TEXTURE = sum(
    scale * ndimage.gaussian_filter(_noise, scale, mode="wrap") for scale in (2.0, 5.0, 20.0)
)  # of a square that repeats itself
TEXTURE = 125 + 28 * TEXTURE / np.std(TEXTURE)

Floats = NDArray[np.float64]


def brightness(x: Floats, y: Floats) -> Floats:
    where = [-y / TEXEL_M, x / TEXEL_M]
    return np.clip(ndimage.map_coordinates(TEXTURE, where, order=1, mode="grid-wrap"), 30, 220)


def above(x: float, y: float, yaw_rad: float = 0.0, height_m: float = HEIGHT_M) -> Pose:
    return Pose(rotation_z(yaw_rad) @ LOOKING_DOWN, np.array([x, y, height_m]))


def seen_from(pose: Pose, gain: float = 1.0) -> NDArray[np.uint8]:
    """What the camera sees of level textured ground."""
    column, row = np.meshgrid(np.arange(CAMERA.width, dtype=float), np.arange(CAMERA.height, dtype=float))
    rays = CAMERA.rays_from_pixels(np.stack([column.ravel(), row.ravel()], axis=1))
    direction = np.column_stack([rays, np.ones(len(rays))]) @ pose.rotation.T
    xy = pose.translation[:2] - direction[:, :2] / direction[:, 2:] * pose.translation[2]
    value = gain * brightness(xy[:, 0], xy[:, 1])
    return np.clip(value + 0.5, 0, 255).astype(np.uint8).reshape(CAMERA.height, CAMERA.width)


def placement(poses: list[Pose], is_placed: list[bool] | None = None) -> Placement:
    """Nodes whose points lie on the ground."""
    rays = np.random.default_rng(1).uniform(-0.4, 0.4, (POINTS, 2))
    rays = np.column_stack([rays, np.ones(POINTS), np.full(POINTS, 0.01)])
    points = np.stack([pose.translation[2] * rays for pose in poses])
    return Placement(
        np.array([pose.translation for pose in poses]),
        np.array([pose.rotation for pose in poses]),
        np.ones(len(poses), np.bool_) if is_placed is None else np.array(is_placed),
        0,
        points,
    )


def pictures(poses: list[Pose], first: int = 0, gains: tuple[float, ...] = (1.0,)) -> list[NodePicture]:
    return [
        NodePicture(number, seen_from(poses[number], gains[number % len(gains)]))
        for number in range(first, len(poses))
    ]


def grid_flight(columns: int = 4, rows: int = 3) -> list[Pose]:
    turns = np.random.default_rng(2).uniform(-3, 3, columns * rows)
    places = [(1.9 * column, 1.4 * row) for row in range(rows) for column in range(columns)]
    return [above(x, y, yaw) for (x, y), yaw in zip(places, turns.tolist(), strict=True)]


@pytest.fixture
def mosaic(tmp_path: Path) -> Iterator[GrowingMosaic]:
    with closing(PictureSpool(tmp_path)) as spool:
        yield GrowingMosaic(CAMERA, spool)


def draw(mosaic: GrowingMosaic) -> int:
    count = 0
    while mosaic.draw_next():
        count += 1
    assert not mosaic.due
    return count


def laid(mosaic: GrowingMosaic, poses: list[Pose]) -> GrowingMosaic:
    mosaic.lay(placement(poses), pictures(poses))
    draw(mosaic)
    return mosaic


def pixels_of(path: Path) -> tuple[NDArray[np.uint8], Affine]:
    with rasterio.open(path) as raster:
        return raster.read().transpose(1, 2, 0), raster.transform


def window(path: Path, low: tuple[float, float], high: tuple[float, float]) -> NDArray[np.uint8]:
    """RGBA between two corners, metres, world."""
    rgba, transform = pixels_of(path)
    left, top = ~transform @ (low[0], high[1])
    right, bottom = ~transform @ (high[0], low[1])
    return rgba[round(top) : round(bottom), round(left) : round(right)]


def reached(pose: Pose) -> set[tuple[int, int]]:
    """Tiles that a level picture may change: those of the box around it, and what blending adds."""
    half = 0.5 * HEIGHT_M * np.array([CAMERA.width / CAMERA.fx, CAMERA.height / CAMERA.fy])
    corners = pose.translation + np.array([(x, y, 0.0) for x in (-1, 1) for y in (-1, 1)]) * [
        *half, 0.0] @ pose.rotation.T  # fmt: skip
    pad_m = NODE_PX * (PAD_NODES + 1) * PX_M
    low, high = corners[:, :2].min(axis=0) - pad_m, corners[:, :2].max(axis=0) + pad_m
    columns = range(math.floor(low[0] / TILE_M), math.floor(high[0] / TILE_M) + 1)
    rows = range(math.floor(-high[1] / TILE_M), math.floor(-low[1] / TILE_M) + 1)
    return {(row, column) for row in rows for column in columns}


# -- which tiles are drawn


@pytest.mark.parametrize("turn_rad", [0.0, 0.7])
def test_what_moved_by_less_than_half_a_pixel_is_not_drawn_again(
    mosaic: GrowingMosaic, turn_rad: float
) -> None:
    poses = grid_flight()
    laid(mosaic, poses)
    shift = PX_M * np.array([math.cos(turn_rad), math.sin(turn_rad), 0.0])
    for share in (0.3, 0.49):
        mosaic.lay(placement([Pose(p.rotation, p.translation + share * shift) for p in poses]), [])
        assert not mosaic.due
    # not against where it was a moment ago, but against where it was drawn
    moved = [Pose(p.rotation, p.translation + 0.51 * shift) for p in poses]
    mosaic.lay(placement(moved), [])
    assert mosaic.due == set().union(*(reached(pose) for pose in [*poses, *moved]))


@pytest.mark.parametrize("moved", [0, 5, 11])
def test_one_picture_that_moved_draws_the_tiles_that_it_touches(mosaic: GrowingMosaic, moved: int) -> None:
    poses = grid_flight()
    laid(mosaic, poses)
    before = poses[moved]
    poses[moved] = Pose(before.rotation, before.translation + np.array([0.0, 0.7 * PX_M, 0.0]))
    mosaic.lay(placement(poses), [])
    assert mosaic.due == reached(before) | reached(poses[moved])
    assert draw(mosaic) > 0
    mosaic.lay(placement(poses), [])
    assert not mosaic.due


def test_turning_and_climbing_move_the_ground_too(mosaic: GrowingMosaic) -> None:
    poses = grid_flight()
    laid(mosaic, poses)
    far_px = math.hypot(CAMERA.width, CAMERA.height) / 2
    for share, is_due in ((0.4, False), (0.7, True)):
        turned = [Pose(rotation_z(share / far_px) @ p.rotation, p.translation) for p in poses]
        mosaic.lay(placement(turned), [])
        assert bool(mosaic.due) == is_due


def test_pictures_that_show_nothing_new_are_left_out(mosaic: GrowingMosaic) -> None:
    poses = grid_flight()
    laid(mosaic, poses)
    inner = poses[5:7]
    again = [*poses, *poses, *(Pose(p.rotation, p.translation + 0.05) for p in inner)]
    mosaic.lay(placement(again), pictures(again, first=len(poses)))
    assert not mosaic.due
    beyond = [*again, above(9.0, 9.0)]
    mosaic.lay(placement(beyond), pictures(beyond, first=len(again)))
    assert mosaic.due == reached(beyond[-1])


def test_a_piece_appears_when_its_place_is_known_and_goes_when_it_is_not(mosaic: GrowingMosaic) -> None:
    poses = [*grid_flight(2, 2), above(20.0, 0.0)]
    mosaic.lay(placement(poses, [True] * 4 + [False]), pictures(poses))
    draw(mosaic)
    assert not reached(poses[-1]) & set(mosaic._raster.places())  # type: ignore[union-attr]
    mosaic.lay(placement(poses), [])
    assert mosaic.due == reached(poses[-1])
    draw(mosaic)
    mosaic.lay(placement(poses, [True] * 4 + [False]), [])
    assert mosaic.due == reached(poses[-1])


def test_new_ground_comes_before_what_moved_and_the_oldest_first(mosaic: GrowingMosaic) -> None:
    poses = grid_flight()
    laid(mosaic, poses)
    moved = [Pose(pose.rotation, pose.translation + np.array([PX_M, 0.0, 0.0])) for pose in poses]
    news = [above(60.0, 0.0), above(40.0, 0.0), above(80.0, 0.0)]
    for count in (1, 2, 3):
        now = [*moved, *news[:count]]
        mosaic.lay(placement(now), pictures(now, first=len(now) - 1))
    order = []
    while before := mosaic.due:
        mosaic.draw_next()
        order += before - mosaic.due
    for pose in news:
        count = len(reached(pose))
        assert set(order[:count]) == reached(pose)
        order = order[count:]
    assert set(order) == set().union(*(reached(pose) for pose in [*poses, *moved]))


# -- what is drawn


def test_it_is_the_mosaic_of_the_same_poses(mosaic: GrowingMosaic, tmp_path: Path) -> None:
    poses = grid_flight()
    for count in (1, 3, 4, 9, len(poses)):  # as a flight brings them
        mosaic.lay(placement(poses[:count]), pictures(poses[:count], first=max(0, mosaic_size(mosaic))))
        draw(mosaic)
    mosaic.save(tmp_path / "growing.tif")
    images = [MappedImage("", lambda pose=pose: seen_from(pose), CAMERA, pose) for pose in poses]
    whole = write_mosaic(tmp_path / "whole.tif", images, ElevationGrid.flat(0.0))
    assert whole.gsd_m == pytest.approx(PX_M)
    expected, transform = pixels_of(tmp_path / "whole.tif")
    low = transform @ (0, whole.height)
    high = transform @ (whole.width, 0)
    found = window(tmp_path / "growing.tif", low, high)
    assert found.shape == expected.shape
    np.testing.assert_array_equal(found[..., 3], expected[..., 3])
    seen = expected[..., 3] > 0
    away = np.abs(found.astype(float) - expected)[..., 0][seen]
    assert np.median(away) <= 2.0  # of exposure, and of the pictures' JPEG
    assert np.percentile(away, 99) < 6.0


def mosaic_size(mosaic: GrowingMosaic) -> int:
    return len(mosaic._laid.nodes)


def test_it_grows_in_every_direction_and_keeps_what_is_drawn(mosaic: GrowingMosaic, tmp_path: Path) -> None:
    poses = grid_flight()
    laid(mosaic, poses).save(tmp_path / "a.tif")
    inner = (0.5, 0.5), (4.5, 2.5)
    before, (_, first) = window(tmp_path / "a.tif", *inner), pixels_of(tmp_path / "a.tif")
    assert (before[..., 3] == 255).all()
    for x, y in ((-40.0, 0.0), (45.0, 0.0), (0.0, 42.0), (0.0, -41.0)):
        poses = [*poses, above(x, y)]
        mosaic.lay(placement(poses), pictures(poses, first=len(poses) - 1))
        assert mosaic.due == reached(poses[-1])
        draw(mosaic)
        mosaic.save(tmp_path / "a.tif")
        np.testing.assert_array_equal(window(tmp_path / "a.tif", *inner), before)
        assert (window(tmp_path / "a.tif", (x - 1, y - 1), (x + 1, y + 1))[..., 3] == 255).all()
    with rasterio.open(tmp_path / "a.tif") as raster:
        assert raster.transform.c < first.c - 35.0
        assert raster.transform.f > first.f + 35.0
        assert raster.overviews(1)


def test_a_map_that_was_given_another_metre_is_not_drawn_again(mosaic: GrowingMosaic, tmp_path: Path) -> None:
    laid(mosaic, grid_flight()).save(tmp_path / "a.tif", 1.25)
    with rasterio.open(tmp_path / "a.tif") as raster:
        assert raster.transform.a == pytest.approx(1.25 * PX_M)
    found = window(tmp_path / "a.tif", (2.0, 2.0), (2.5, 2.5))[..., 0].astype(float)
    x, y = np.meshgrid(2.0 + 1.25 * PX_M * (np.arange(20) + 0.5), 2.5 - 1.25 * PX_M * (np.arange(20) + 0.5))
    assert np.median(np.abs(found - brightness(x / 1.25, y / 1.25))) < 5.0


def test_brightness_is_evened_as_pictures_come(mosaic: GrowingMosaic, tmp_path: Path) -> None:
    poses, gains = [above(1.2 * k, 0.0) for k in range(16)], (1.0, 1.3)
    for count in range(2, len(poses) + 1, 2):
        mosaic.lay(placement(poses[:count]), pictures(poses[:count], count - 2, gains))
        draw(mosaic)
    mosaic.save(tmp_path / "a.tif")
    low, high = (0.0, -0.5), (18.0, 0.5)
    found = window(tmp_path / "a.tif", low, high)[..., 0].astype(float)
    rows, columns = found.shape
    x, y = np.meshgrid(low[0] + PX_M * (np.arange(columns) + 0.5), high[1] - PX_M * (np.arange(rows) + 0.5))
    gain = ndimage.uniform_filter(np.log(found / brightness(x, y)), 40)
    assert np.std(gain) < 0.2 * math.log(gains[1])  # one picture beside the other: 0.5 of it


def test_a_camera_that_changed_its_exposure_for_good_is_evened_for_good(
    mosaic: GrowingMosaic, tmp_path: Path
) -> None:
    poses = [above(1.2 * k, 0.0) for k in range(24)]
    gains = tuple(1.0 if k < 6 else 0.7 for k in range(len(poses)))
    for count in range(2, len(poses) + 1, 2):
        mosaic.lay(placement(poses[:count]), pictures(poses[:count], count - 2, gains))
        draw(mosaic)
    mosaic.save(tmp_path / "a.tif")
    means = [
        np.mean(window(tmp_path / "a.tif", (x, -0.5), (x + 3.0, 0.5))[..., 0])
        / np.mean(brightness(*np.meshgrid(np.linspace(x, x + 3.0, 99), np.linspace(-0.5, 0.5, 33))))
        for x in (0.0, 9.0, 18.0, 24.0)
    ]
    assert np.ptp(means) < 0.1  # 0.3 as they were taken


def test_bright_ground_beside_dark_is_not_cut_off(mosaic: GrowingMosaic, tmp_path: Path) -> None:
    """A camera that shortens its exposure over bright ground, 2.5 times as bright as what it saw first."""
    poses = [above(1.2 * k, 0.0) for k in range(16)]
    gains = tuple(1.0 if k < 8 else 0.5 for k in range(len(poses)))

    def seen(k: int) -> NodePicture:
        column = poses[k].translation[0] + PX_M * (np.arange(CAMERA.width) - CAMERA.cx)
        ground = np.where(column > 9.0, 2.5, 1.0)
        value = gains[k] * ground * seen_from(poses[k]).astype(float)
        return NodePicture(k, np.clip(value, 0, 255).astype(np.uint8))

    for count in range(2, len(poses) + 1, 2):
        mosaic.lay(placement(poses[:count]), [seen(k) for k in range(count - 2, count)])
        draw(mosaic)
    mosaic.save(tmp_path / "a.tif")
    rgba = window(tmp_path / "a.tif", (11.0, -1.0), (18.0, 1.0))
    white = np.mean(rgba[..., 0] == 255)
    raw = np.mean([np.mean(seen(k).pixels == 255) for k in range(12, 16)])
    assert white < raw + 0.02


def test_a_camera_that_climbs_makes_the_pixels_longer(mosaic: GrowingMosaic, tmp_path: Path) -> None:
    poses = [above(0.0, 0.0), *(above(20.0 * k, 0.0, 0.0, 10 * HEIGHT_M) for k in range(1, 4))]
    for count in (1, 4):
        mosaic.lay(placement(poses[:count]), pictures(poses[:count], 0 if count == 1 else 1))
        draw(mosaic)
    assert mosaic.px_m == pytest.approx(8 * PX_M)
    mosaic.save(tmp_path / "a.tif")
    assert (window(tmp_path / "a.tif", (-0.5, -0.5), (80.0, 0.5))[..., 3] == 255).all()


def test_memory_is_bounded_by_longer_pixels(
    mosaic: GrowingMosaic, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(growing_mosaic, "MOST_BYTES", 1_000_000)
    poses = [above(2.0 * (k % 12), 1.5 * (k // 12)) for k in range(96)]
    for count in range(12, 97, 12):
        mosaic.lay(placement(poses[:count]), pictures(poses[:count], count - 12))
        draw(mosaic)
    mosaic.lay(placement(poses), [])
    assert mosaic._raster is not None
    assert mosaic._raster.n_bytes <= 1_000_000
    assert mosaic.px_m in (pytest.approx(2 * PX_M), pytest.approx(4 * PX_M))
    draw(mosaic)
    mosaic.save(tmp_path / "a.tif")
    found = window(tmp_path / "a.tif", (0.0, 0.0), (20.0, 9.0))
    assert (found[..., 3] == 255).all()


# -- the raster and its file


places = st.tuples(st.integers(-9, 9), st.integers(-9, 9))


@settings(max_examples=12)
@given(st.lists(places, min_size=1, max_size=5, unique=True), st.lists(places, max_size=2), st.booleans())
def test_the_file_holds_the_tiles_where_they_belong(
    tmp_path_factory: pytest.TempPathFactory,
    drawn: list[tuple[int, int]],
    gone: list[tuple[int, int]],
    is_coarser: bool,
) -> None:
    raster, path = GrowingRaster(0.5), tmp_path_factory.mktemp("raster") / "a.tif"
    for place in [*gone, *drawn]:
        raster.put(place, plain_tile((0, 0)))
    for place in gone:
        raster.put(place, None)
    for number, place in enumerate(drawn, start=1):
        raster.put(place, plain_tile((number, 3 * number)))
    if is_coarser:
        raster.coarsen()
    raster.save(path)
    with rasterio.open(path) as file:
        rgba, transform, factors = file.read(), file.transform, file.overviews(1)
    assert transform.a == raster.px_m == (1.0 if is_coarser else 0.5)
    assert np.count_nonzero(rgba[3]) == len(set(drawn)) * TILE_PX**2 // (4 if is_coarser else 1)
    half_m = 0.25 * TILE_PX
    for number, (row, column) in enumerate(drawn, start=1):
        x, y = 2 * half_m * column + half_m, -2 * half_m * row - half_m
        for level in range(len(factors) + 1):
            with rasterio.open(path, **({"overview_level": level - 1} if level else {})) as file:
                across, down = ~file.transform @ (x, y)
                found = file.read()[:, int(down), int(across)]
            np.testing.assert_array_equal(found, [number, 3 * number, 7, 255])


def plain_tile(colour: tuple[int, int]) -> NDArray[np.uint8]:
    return np.broadcast_to(np.array([*colour, 7, 255], np.uint8), (TILE_PX, TILE_PX, 4))


KILLED = """
import sys
import numpy as np
from overfly.products.growing_raster import GrowingRaster
raster, tile = GrowingRaster(0.1), np.random.default_rng(0).integers(0, 255, (512, 512, 4), np.uint8)
number = 0
while True:
    raster.put((number % 7 - 3, number % 5), tile)
    raster.save(sys.argv[1])
    number += 1
"""


def test_a_process_that_is_killed_leaves_a_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "mosaic.tif"
    for wait_s in (0.0, 0.15, 0.31):
        process = subprocess.Popen([sys.executable, "-c", KILLED, str(path)])
        try:
            end = time.monotonic() + 60.0
            while not path.exists() and time.monotonic() < end:
                time.sleep(0.02)
            time.sleep(wait_s)
        finally:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
        with rasterio.open(path) as raster:
            assert raster.read().any()
        path.unlink()


# -- pictures set aside


def test_pictures_come_back_and_few_stay_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(picture_spool, "CACHE_BYTES", 3 * CAMERA.width * CAMERA.height)
    spool = PictureSpool(tmp_path)
    gray = [seen_from(above(k, 0.0)) for k in range(8)]
    for number, picture in enumerate(gray):
        spool.add(2 * number, picture)
        spool.add(2 * number + 1, np.stack([picture, picture // 2, picture // 3], axis=2))
    for number, picture in enumerate(gray):
        assert np.abs(spool.get(2 * number).astype(int) - picture).max() <= 8
        assert spool.get(2 * number) is spool.get(2 * number)
        colours = spool.get(2 * number + 1)
        away = np.abs(colours.astype(int) - np.stack([picture, picture // 2, picture // 3], axis=2))
        assert np.median(away, axis=(0, 1)).max() <= 3
        assert sum(kept.nbytes for kept in spool._cache.values()) <= 3 * CAMERA.width * CAMERA.height
    assert not list(tmp_path.iterdir())  # nobody has to clear it away
    spool.close()


def test_a_folder_without_room_is_named(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="nowhere"):
        PictureSpool(tmp_path / "nowhere")
