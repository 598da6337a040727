"""The files' layout, read back by GDAL and judged by rio-cogeo's validator."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.crs import CRS
from rio_cogeo.cogeo import cog_validate

from overfly.errors import OutputError
from overfly.products import cog, tiff
from overfly.products.cog import TILE_PX, Bands, RasterFrame, cloud_optimised_geotiff
from overfly.products.georeference import LOCAL_CRS

HEIGHTS = Bands("float32", 2, ("height (m)", "standard deviation (m)"), "m")
PLACE = Affine(0.1, 0.0, 470000.0, 0.0, -0.1, 6700000.0)


def picture(height: int, width: int, is_gray: bool) -> np.ndarray:
    """RGBA with a hole larger than a tile's quarter."""
    generator = np.random.default_rng(height + width)
    rgba = generator.integers(0, 256, (height, width, 4), dtype=np.uint8)
    if is_gray:
        rgba[..., 1] = rgba[..., 2] = rgba[..., 0]
    rgba[..., 3] = 255
    rgba[height // 4 :, width // 3 : 3 * width // 4] = 0
    return rgba


def halved(pixels: np.ndarray) -> np.ndarray:
    """Mean of two by two pixels of which something is known, one that lies beyond the raster is not."""
    rows, columns = -(-pixels.shape[0] // 2), -(-pixels.shape[1] // 2)
    padded = np.zeros((2 * rows, 2 * columns, 4))
    padded[: pixels.shape[0], : pixels.shape[1]] = pixels
    four = padded.reshape(rows, 2, columns, 2, 4).swapaxes(1, 2).reshape(rows, columns, 4, 4)
    alpha = four[..., 3].sum(axis=2)
    colour = (four[..., :3] * four[..., 3:]).sum(axis=2) / np.maximum(alpha, 1)[..., None]
    return np.concatenate([colour, alpha[..., None] / 4], axis=2)


@pytest.mark.parametrize(
    ("height", "width", "is_gray"),
    [(1, 1, True), (300, 512, False), (513, 200, True), (1025, 1700, False), (2200, 600, True)],
)
@pytest.mark.parametrize("is_big", [False, True])
def test_a_picture_comes_back_with_its_smaller_versions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, height: int, width: int, is_gray: bool, is_big: bool
) -> None:
    if is_big:
        monkeypatch.setattr(tiff, "MOST_IN_CLASSIC", 0)
    rgba, path = picture(height, width, is_gray), tmp_path / "a.tif"
    with cloud_optimised_geotiff(path, RasterFrame("EPSG:32635", PLACE, width, height)) as raster:
        raster.write(rgba)
    assert path.read_bytes()[2] == (43 if is_big else 42)
    valid, errors, warnings = cog_validate(path)
    assert valid, errors
    assert not warnings
    with rasterio.open(path) as raster:
        assert raster.crs == CRS.from_epsg(32635)
        assert raster.transform == PLACE
        assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert [colour.name for colour in raster.colorinterp] == ["red", "green", "blue", "alpha"]
        np.testing.assert_array_equal(raster.read().transpose(1, 2, 0), rgba)
        factors = raster.overviews(1)
        assert max(height, width) <= TILE_PX * 2 ** len(factors) < 2 * max(height, width, TILE_PX)
    expected = rgba.astype(float)
    for level in range(len(factors)):
        expected = halved(expected)
        with rasterio.open(path, overview_level=level) as raster:
            found = raster.read().transpose(1, 2, 0).astype(float)
        assert found.shape == expected.shape
        seen = found[..., 3] > 2.0 * (level + 1)  # rounded once for each halving
        assert np.abs(found - expected)[..., 3].max() <= 0.5 * (level + 1)
        assert np.abs(found - expected)[seen].max() <= 0.5 * (level + 1) + 2.0
        expected = found


def test_heights_come_back_exactly(tmp_path: Path) -> None:
    generator = np.random.default_rng(1)
    bands = generator.normal(0.0, 30.0, (700, 1300, 2)).astype(np.float32)
    bands[:, 600:] = np.nan  # more than a tile
    turned = Affine(0.4, 0.3, 5.0, 0.3, -0.4, 9.0)
    path = tmp_path / "a.tif"
    with cloud_optimised_geotiff(path, RasterFrame(LOCAL_CRS, turned, 1300, 700, HEIGHTS)) as raster:
        raster.write(bands)
    valid, errors, warnings = cog_validate(path)
    assert valid, errors
    assert not warnings
    with rasterio.open(path) as raster:
        np.testing.assert_array_equal(raster.read().transpose(1, 2, 0), bands)
        assert np.isnan(raster.nodata)
        assert raster.descriptions == HEIGHTS.names
        assert raster.units == ("m", "m")
        assert raster.transform.almost_equals(turned, 1e-12)
        assert 'UNIT["metre",1' in raster.crs.to_wkt()
        assert raster.interleaving.name == "pixel"
    with rasterio.open(path, overview_level=0) as raster:
        first = raster.read(1)
    np.testing.assert_allclose(first[10, 20], bands[20:22, 40:42, 0].mean(), rtol=1e-5)
    assert np.isnan(first[:, 300:]).all()


def test_what_is_not_seen_takes_no_room(tmp_path: Path) -> None:
    rgba = np.zeros((8 * TILE_PX, 8 * TILE_PX, 4), np.uint8)
    path = tmp_path / "a.tif"
    with cloud_optimised_geotiff(path, RasterFrame("EPSG:32635", PLACE, *rgba.shape[1::-1])) as raster:
        raster.write(rgba)
    assert path.stat().st_size < 4000
    with rasterio.open(path) as raster:
        assert not raster.read().any()


def test_an_unknown_crs_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    with (
        pytest.raises(OutputError, match=r"cannot write .*a\.tif") as caught,
        cloud_optimised_geotiff(tmp_path / "a.tif", RasterFrame("EPSG:1", PLACE, 5, 5)),
    ):
        pass
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_tiles_beyond_what_waits_in_memory_wait_in_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = RasterFrame("EPSG:32635", PLACE, 1300, 1100)
    random = np.random.default_rng(3)
    pixels = random.integers(0, 255, (1100, 1300, 4), dtype=np.uint8)
    written = []
    for most_bytes in (2**26, 1000):
        monkeypatch.setattr(cog, "SPOOL_BYTES", most_bytes)
        path = tmp_path / f"{most_bytes}.tif"
        with cloud_optimised_geotiff(path, frame) as raster:
            raster.write(pixels)
        written.append(path.read_bytes())
    assert written[0] == written[1]
