"""The mosaic against ground that is known exactly: where things are, how bright, what is transparent."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
import yaml
from numpy.typing import NDArray
from rio_cogeo.cogeo import cog_validate
from scipy import ndimage

from overfly.errors import OutputError
from overfly.geometry.cameras import Camera, Distortion
from overfly.geometry.poses import Pose, rotation_from_euler, rotation_z
from overfly.products.elevation import ElevationGrid
from overfly.products.georeference import GeoReference, transform_points
from overfly.products.mosaic import MappedImage, Mosaic, write_mosaic
from overfly.products.views import look_up, view_of
from overfly.trajectory import read_tum

LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])
CAMERA = Camera(200, 150, 160.0, 161.0, 101.0, 73.0, coefficients=(-0.08, 0.02, 0.001, -0.0005))
TEXEL_M = 0.02


def smooth_noise(seed: int, size: int = 900) -> NDArray[np.float64]:
    """A texture of several scales, brightness 50 to 200; texel (row, column) at x = column * TEXEL_M - 4, y =
    9 - row * TEXEL_M."""
    generator = np.random.default_rng(seed)
    texture = sum(
        scale * ndimage.gaussian_filter(generator.normal(size=(size, size)), scale, mode="wrap")
        for scale in (3, 8, 30)
    )
    return np.asarray(np.clip(125 + 30 * texture / np.std(texture), 50, 200))


TEXTURE = smooth_noise(0)


def brightness(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(ndimage.map_coordinates(TEXTURE, [(9.0 - y) / TEXEL_M, (x + 4.0) / TEXEL_M], order=1))


def rendered(
    camera: Camera, world_from_cam: Pose, height_of: Callable[..., NDArray[np.float64]], gain: float = 1.0
) -> NDArray[np.uint8]:
    """What the camera sees of the textured ground z = height_of(x, y), by walking down every ray."""
    column, row = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    rays = camera.rays_from_pixels(np.stack([column.ravel(), row.ravel()], axis=1))
    direction = np.column_stack([rays, np.ones(len(rays))]) @ world_from_cam.rotation.T
    centre = world_from_cam.translation
    z = np.zeros(len(rays))
    for _ in range(25):  # a fixed point of gentle relief
        xy = centre[:2] + direction[:, :2] / direction[:, 2:] * (z - centre[2])[:, None]
        z = height_of(xy[:, 0], xy[:, 1])
    return (
        np.clip(gain * brightness(xy[:, 0], xy[:, 1]) + 0.5, 0, 255)
        .astype(np.uint8)
        .reshape(camera.height, camera.width)
    )


def level(x: NDArray[np.float64], _y: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.zeros_like(x)


def hills(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(0.4 * np.sin(0.9 * x) * np.cos(1.1 * y))


def flight(
    seed: int = 1, height_of: Callable[..., NDArray[np.float64]] = level, camera: Camera = CAMERA
) -> list[MappedImage]:
    """Nine pictures of 3 x 3 places, tilted a little, headings at random."""
    generator = np.random.default_rng(seed)
    images = []
    for number, (x, y) in enumerate((x, y) for y in (1.0, 2.6, 4.2) for x in (1.0, 3.0, 5.0)):
        roll, pitch, yaw = generator.normal(0, 0.05), generator.normal(0, 0.05), generator.uniform(-3, 3)
        rotation = rotation_from_euler(roll, pitch, yaw) @ LOOKING_DOWN
        pose = Pose(rotation, np.array([x, y, 3.0 + generator.normal(0, 0.1)]))
        picture = rendered(camera, pose, height_of)
        images.append(MappedImage(str(number), lambda picture=picture: picture, camera, pose))
    return images


def read(
    mosaic: Mosaic,
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Gray values, where they are, and x, y of the pixels' middles in the CRS."""
    with rasterio.open(mosaic.path) as raster:
        rgba = raster.read()
    column, row = np.meshgrid(np.arange(mosaic.width) + 0.5, np.arange(mosaic.height) + 0.5)
    xy = transform_points(mosaic.crs_from_pixel, np.stack([column, row], axis=-1))
    return rgba[0].astype(float), rgba[3] == 255, xy[..., 0], xy[..., 1]


def shift_px(one: NDArray[np.float64], other: NDArray[np.float64], size: int = 64) -> NDArray[np.float64]:
    """(n, 2) shifts between two rasters, patch by patch."""
    shifts = []
    window = cv2.createHanningWindow((size, size), cv2.CV_32F)
    for row in range(0, one.shape[0] - size, size):
        for column in range(0, one.shape[1] - size, size):
            patch = (slice(row, row + size), slice(column, column + size))
            if np.isfinite(other[patch]).all():
                a, b = one[patch].astype(np.float32), other[patch].astype(np.float32)
                shifts.append(cv2.phaseCorrelate(a - a.mean(), b - b.mean(), window)[0])
    return np.array(shifts)


@pytest.fixture(scope="module")
def level_mosaic(tmp_path_factory: pytest.TempPathFactory) -> Mosaic:
    return write_mosaic(tmp_path_factory.mktemp("mosaic") / "mosaic.tif", flight(), ElevationGrid.flat(0.0))


def test_everything_is_where_it_is_and_as_bright(level_mosaic: Mosaic) -> None:
    gray, seen, x, y = read(level_mosaic)
    truth = np.where(seen, brightness(x, y), np.nan)
    assert level_mosaic.n_images == 9
    assert level_mosaic.gsd_m == pytest.approx(3.0 / CAMERA.focal_px, rel=0.05)
    assert np.median(np.abs(gray - truth)[seen]) < 2.0
    assert np.percentile(np.abs(gray - truth)[seen], 99) < 10.0
    shifts = np.linalg.norm(shift_px(gray, truth), axis=1)
    assert len(shifts) >= 8
    assert shifts.max() < 0.15


def test_transparent_exactly_where_no_picture_looks(level_mosaic: Mosaic) -> None:
    gray, seen, x, y = read(level_mosaic)
    ground = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    visible = np.zeros(x.size, dtype=bool)
    for image in flight():
        view = view_of(image, ElevationGrid.flat(0.0), (0.0, 0.0))
        assert view is not None
        visible |= np.isfinite(look_up(view, image.camera, ground)[1])
    visible = visible.reshape(x.shape)
    inner = ndimage.binary_erosion(visible, iterations=3)
    assert seen[inner].all()  # no black wedge, no hole
    assert not seen[~ndimage.binary_dilation(visible, iterations=2)].any()
    assert (gray[~seen] == 0).all()
    assert gray[seen].min() > 30
    assert level_mosaic.fraction_seen == pytest.approx(seen.mean())


def test_file_is_a_valid_cloud_optimised_geotiff(level_mosaic: Mosaic) -> None:
    valid, errors, _ = cog_validate(level_mosaic.path)
    assert valid, errors
    with rasterio.open(level_mosaic.path) as raster:
        assert raster.count == 4
        assert [interpretation.name for interpretation in raster.colorinterp] == [
            "red",
            "green",
            "blue",
            "alpha",
        ]
        assert 'UNIT["metre",1' in raster.crs.to_wkt()
    assert [entry.name for entry in level_mosaic.path.parent.iterdir()] == ["mosaic.tif"]


def test_relief_is_followed(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.arange(-3.95, 9, 0.1), np.arange(8.95, -4, -0.1))
    grid = ElevationGrid(-4.0, 9.0, 0.1, hills(x, y).astype(np.float32), np.zeros_like(x, dtype=np.float32))
    images = flight(height_of=hills)
    shifts = {}
    for name, ground in (("known", grid), ("ignored", ElevationGrid.flat(0.0))):
        gray, seen, px, py = read(write_mosaic(tmp_path / f"{name}.tif", images, ground))
        shifts[name] = np.linalg.norm(shift_px(gray, np.where(seen, brightness(px, py), np.nan)), axis=1)
    assert np.median(shifts["known"]) < 0.1
    assert np.median(shifts["ignored"]) > 0.5  # else the first line would prove nothing


def test_exposure_is_evened(tmp_path: Path) -> None:
    generator = np.random.default_rng(5)
    column, row = np.meshgrid(np.linspace(-1, 1, CAMERA.width), np.linspace(-1, 1, CAMERA.height))
    fall_off = 1.0 - 0.25 * (column**2 + row**2) / 2
    images = []
    for image in flight():
        gain = generator.uniform(0.75, 1.2)
        dimmed = np.clip(image.load() * gain * fall_off, 0, 255).astype(np.uint8)
        images.append(
            MappedImage(image.name, lambda dimmed=dimmed: dimmed, image.camera, image.world_from_cam)
        )
    gray, seen, x, y = read(write_mosaic(tmp_path / "mosaic.tif", images, ElevationGrid.flat(0.0)))
    ratio = np.log(gray[seen] / brightness(x, y)[seen])
    assert (
        np.std(ratio) < 0.05
    )  # the pictures themselves differ by 0.15 and darken by 0.25 towards the corners
    assert abs(np.median(ratio)) < 0.2


def test_a_dark_and_coloured_middle_of_the_lens_does_not_show(tmp_path: Path) -> None:
    """As of a Raspberry Pi's camera with the wrong lens table: a third darker there, and blue by half."""
    column, row = np.meshgrid(np.linspace(-1, 1, CAMERA.width), np.linspace(-1, 1, CAMERA.height))
    spot = np.exp(-5.0 * np.hypot(4 * column, 3 * row) / 5)
    lens = np.exp(-np.multiply.outer(spot, [0.4, 0.55, 0.7]))
    images = []
    for image in flight():
        seen_so = np.clip(image.load()[..., None] * lens, 0, 255).astype(np.uint8)
        images.append(replace(image, load=lambda seen_so=seen_so: seen_so))
    mosaic = write_mosaic(tmp_path / "mosaic.tif", images, ElevationGrid.flat(0.0))
    _, seen, x, y = read(mosaic)
    with rasterio.open(mosaic.path) as raster:
        colours = raster.read([1, 2, 3]).astype(float)[:, seen]
    left = [np.std(np.log(colour / brightness(x, y)[seen])) for colour in colours]
    assert np.std(np.log(lens[..., 2])) > 0.09
    assert max(left) < 0.02
    assert np.std(np.log(colours[2] / colours[0])) < 0.02


def test_bright_ground_is_not_cut_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A beach beside a wood: the camera exposes less where it is bright. Evened as the wood is, the beach
    would be whiter than white; all must become darker instead."""
    bright = TEXTURE.copy()
    bright[:, round(9.0 / TEXEL_M) :] *= 1.7  # from x = 5 on; up to 340
    monkeypatch.setattr(sys.modules[__name__], "TEXTURE", bright)
    images = []
    for image in flight():
        gain = 0.7 if image.world_from_cam.translation[0] > 4.5 else 1.0
        picture = rendered(image.camera, image.world_from_cam, level, gain)
        images.append(
            MappedImage(image.name, lambda picture=picture: picture, image.camera, image.world_from_cam)
        )
    gray, seen, x, y = read(write_mosaic(tmp_path / "mosaic.tif", images, ElevationGrid.flat(0.0)))
    beach = seen & (x > 5.0)
    assert np.mean(gray[beach] >= 254) < 0.005
    ratio = np.log(gray[seen] / brightness(x, y)[seen])
    assert np.std(ratio) < 0.06
    assert -0.5 < np.median(ratio) < -0.2  # log of 235 / 340 is -0.37


def test_large_pictures_are_averaged_not_picked_from(tmp_path: Path) -> None:
    fine = CAMERA.scaled(1600, 1200)
    generator = np.random.default_rng(2)
    pose = Pose(LOOKING_DOWN, np.array([2.0, 3.0, 3.0]))
    grain = generator.integers(0, 2, (fine.height, fine.width), dtype=np.uint8) * 200
    image = MappedImage("grain", lambda: grain, fine, pose)
    gray, seen, _, _ = read(
        write_mosaic(tmp_path / "m.tif", [image], ElevationGrid.flat(0.0), gsd_m=8 * 3.0 / fine.focal_px)
    )
    assert gray[seen].mean() == pytest.approx(100, abs=2)
    assert gray[seen].std() < 25  # 100 / 8 for a mean of 8 x 8 independent pixels, 100 for a picked one


def test_georeference_turns_scales_and_shifts(tmp_path: Path) -> None:
    reference = GeoReference("EPSG:32635", 1.5, 0.7, (470000.0, 6700000.0, 12.0))
    mosaic = write_mosaic(tmp_path / "m.tif", flight(), ElevationGrid.flat(0.0), reference=reference)
    gray, seen, east, north = read(mosaic)
    back = np.stack([east - 470000.0, north - 6700000.0], axis=-1) @ rotation_z(0.7)[:2, :2] / 1.5
    truth = np.where(seen, brightness(back[..., 0], back[..., 1]), np.nan)
    assert np.nanmedian(np.abs(gray - truth)) < 2.0
    with rasterio.open(mosaic.path) as raster:
        assert raster.crs.to_epsg() == 32635


def test_colour_and_gray_pictures_go_together(tmp_path: Path) -> None:
    images = flight()
    colour = np.dstack([images[0].load()] * 3)
    colour[..., 2] //= 2
    images[0] = MappedImage("colour", lambda: colour, CAMERA, images[0].world_from_cam)
    mosaic = write_mosaic(tmp_path / "m.tif", images, ElevationGrid.flat(0.0))
    with rasterio.open(mosaic.path) as raster:
        red, _, blue, alpha = raster.read().astype(float)
    ratio = (blue[alpha > 0] + 1) / (red[alpha > 0] + 1)
    assert np.percentile(ratio, 2) < 0.55
    assert np.percentile(ratio, 70) == pytest.approx(1.0)


def test_a_film_is_thinned_but_loses_no_ground(tmp_path: Path) -> None:
    texture = rendered(CAMERA, Pose(LOOKING_DOWN, np.array([2.0, 3.0, 3.0])), level)
    film = [
        MappedImage(str(n), lambda: texture, CAMERA, Pose(LOOKING_DOWN, np.array([1.0 + 0.02 * n, 3.0, 3.0])))
        for n in range(150)
    ]
    mosaic = write_mosaic(tmp_path / "m.tif", film, ElevationGrid.flat(0.0))
    assert 5 <= mosaic.n_images <= 20
    assert mosaic.fraction_seen > 0.93  # an upright rectangle


@pytest.mark.parametrize("fisheye", [False, True])
def test_distortion_does_not_fold_far_ground_into_the_picture(fisheye: bool) -> None:
    strong = (-0.35, 0.1, 0.0, 0.0)
    kind = Distortion.EQUIDISTANT if fisheye else Distortion.RADIAL_TANGENTIAL
    camera = Camera(200, 150, 110.0, 110.0, 99.5, 74.5, kind, (0.02, -0.01, 0.0, 0.0) if fisheye else strong)
    image = MappedImage(
        "x", lambda: np.zeros((150, 200), np.uint8), camera, Pose(LOOKING_DOWN, np.array([0, 0, 2.0]))
    )
    view = view_of(image, ElevationGrid.flat(0.0), (0.0, 0.0))
    assert view is not None
    far = np.array([[60.0 * np.cos(a), 60.0 * np.sin(a), 0.0] for a in np.linspace(0, 6, 50)])
    px, cost = look_up(view, camera, far)
    assert np.isinf(cost).all()
    assert ((px < 0) | (px > [199, 149])).any(axis=1).all()


def test_pictures_that_do_not_look_down_make_no_mosaic(tmp_path: Path) -> None:
    up = MappedImage(
        "up", lambda: np.zeros((150, 200), np.uint8), CAMERA, Pose(np.eye(3), np.array([0, 0, 3.0]))
    )
    below = MappedImage("below", up.load, CAMERA, Pose(LOOKING_DOWN, np.array([0, 0, -1.0])))
    for images in ([], [up, below]):
        with pytest.raises(OutputError, match=r"m\.tif"):
            write_mosaic(tmp_path / "m.tif", images, ElevationGrid.flat(0.0))
    assert list(tmp_path.iterdir()) == []


# --- public flights ---------------------------------------------------------------------------------


def survey_images(folder: Path, first: int, last: int) -> list[MappedImage]:
    sensor = yaml.safe_load((folder / "mav0/cam0/sensor.yaml").read_text())
    width, height = sensor["resolution"]
    camera = Camera(
        width, height, *sensor["intrinsics"], coefficients=tuple(sensor["distortion_coefficients"])
    )
    truth = read_tum(folder / "truth/groundtruth_cam0.tum")
    with (folder / "mav0/cam0/data.csv").open() as table:
        rows = [row for row in csv.reader(table) if not row[0].startswith("#")]
    names = {int(row[0]): row[1].strip() for row in rows}
    images = []
    for index in range(first, last):
        name = names[int(truth.t_ns[index])]
        path = folder / "mav0/cam0/data" / name
        images.append(
            MappedImage(
                name, lambda path=path: cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), camera, truth.pose(index)
            )
        )
    return images


@pytest.mark.data
def test_survey_lies_on_the_true_orthophoto(data_dir: Path, tmp_path: Path) -> None:
    folder = data_dir / "flights" / "survey"
    scene = json.loads((folder / "truth/scene/scene.json").read_text())
    dsm, ortho = scene["dsm"], scene["ortho"]
    heights = np.load(folder / "truth/scene/dsm.npz")["dsm"].astype(np.float32)
    half = 0.5 * dsm["cell_m"]
    ground = ElevationGrid(
        dsm["gx0"] - half, dsm["gy1"] + half, dsm["cell_m"], heights, np.zeros_like(heights)
    )
    mosaic = write_mosaic(tmp_path / "m.tif", survey_images(folder, 0, 40), ground)
    gray, seen, x, y = read(mosaic)
    truth = cv2.imread(str(folder / "truth/scene/ortho.jpg"), cv2.IMREAD_GRAYSCALE)
    texel_m = ortho["texel_m"] * ortho["width"] / truth.shape[1]
    column, row = (x - ortho["x0"]) / texel_m - 0.5, (ortho["y1"] - y) / texel_m - 0.5
    expected = cv2.remap(truth, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR).astype(
        float
    )
    shifts = np.linalg.norm(shift_px(gray, np.where(seen, expected, np.nan)), axis=1)
    assert len(shifts) > 200
    assert np.median(shifts) < 0.25  # most of it is the noise of comparing single patches
    assert np.percentile(shifts, 95) < 0.6


def test_each_picture_is_read_once_for_brightness_and_once_for_the_ground(tmp_path: Path) -> None:
    reads: list[str] = []

    def counted(image: MappedImage) -> MappedImage:
        def load() -> NDArray[np.uint8]:
            reads.append(image.name)
            return image.load()

        return MappedImage(image.name, load, image.camera, image.world_from_cam)

    write_mosaic(
        tmp_path / "m.tif", [counted(image) for image in flight()], ElevationGrid.flat(0.0), gsd_m=0.006
    )
    assert sorted(reads) == sorted(2 * [str(number) for number in range(9)])
