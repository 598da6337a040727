"""The mosaic that is drawn while flying: which tiles are drawn again, and that it is the mosaic of the same
poses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from numpy.typing import NDArray
from scipy import ndimage
from tests.products.level_ground import (
    CAMERA,
    HEIGHT_M,
    PX_M,
    TILE_M,
    above,
    brightness,
    grid_flight,
    pictures,
    placement,
    seen_from,
)

from overfly.geometry.poses import Pose, rotation_z
from overfly.products import growing_mosaic
from overfly.products.elevation import ElevationGrid
from overfly.products.growing_mosaic import GrowingMosaic, NodePicture
from overfly.products.mosaic import MappedImage, write_mosaic
from overfly.products.picture_spool import PictureSpool
from overfly.products.tiles import NODE_PX, PAD_NODES


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


def far_apart(count: int) -> list[Pose]:
    """A picture for nearly every tile."""
    return [above(8.0 * (k % 12), 8.0 * (k // 12)) for k in range(count)]


def test_a_film_that_outruns_the_drawing_is_shown_whole_and_coarse(
    mosaic: GrowingMosaic, tmp_path: Path
) -> None:
    poses, waiting = far_apart(240), []
    for count in range(12, len(poses) + 1, 12):
        mosaic.lay(placement(poses[:count]), pictures(poses[:count], count - 12))
        waiting.append(len(mosaic.due))
        for _ in range(6):
            mosaic.draw_next()
    assert max(waiting) < 2 * growing_mosaic.MOST_DUE
    assert mosaic.px_m in [pytest.approx(factor * PX_M) for factor in (2, 4)]
    mosaic.save(tmp_path / "a.tif")
    rgba, transform = pixels_of(tmp_path / "a.tif")
    middles = np.array([~transform @ tuple(pose.translation[:2]) for pose in poses[:-24]]).astype(int)
    x, y = middles[(middles[:, 1] >= 0) & (middles[:, 1] < len(rgba))].T
    assert np.count_nonzero(rgba[y, x, 3]) > 0.9 * len(middles)


def test_what_is_drawn_as_it_comes_keeps_its_pixels(mosaic: GrowingMosaic) -> None:
    poses = far_apart(120)
    for count in range(12, len(poses) + 1, 12):
        mosaic.lay(placement(poses[:count]), pictures(poses[:count], count - 12))
        draw(mosaic)
    # all of it moves at once: it is shown where it was meanwhile, and there is no haste
    moved = [Pose(pose.rotation, pose.translation + np.array([PX_M, 0.0, 0.0])) for pose in poses]
    mosaic.lay(placement(moved), [])
    assert len(mosaic.due) > growing_mosaic.MOST_DUE
    assert mosaic.px_m == pytest.approx(PX_M)
