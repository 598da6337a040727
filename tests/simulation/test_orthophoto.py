"""A user's own ground: pixels and heights of GeoTIFFs end up where their coordinates say."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio import Affine

from overfly.errors import SourceError, UsageError
from overfly.simulation.degradation import CLEAN
from overfly.simulation.flight import SimulatedFlight
from overfly.simulation.optics import CameraSetup, looking_down
from overfly.simulation.orthophoto import load_orthophoto, load_relief, over_orthophoto
from overfly.simulation.patches import Patch
from overfly.simulation.relief import flat_relief
from overfly.simulation.scenario import declared

from .scenes import BACKGROUND, CAMERA, PEAK, centroids, still

EAST, NORTH, PIXEL = 412_000.0, 5_317_000.0, 0.2


def write(
    path: Path, bands: np.ndarray, pixel: float = PIXEL, crs: str = "EPSG:32632", **extra: object
) -> Path:
    count, rows, cols = bands.shape
    with rasterio.open(
        path, "w", driver="GTiff", count=count, height=rows, width=cols, dtype=bands.dtype, crs=crs,
        transform=Affine(pixel, 0.0, EAST, 0.0, -pixel, NORTH), **extra,
    ) as out:  # fmt: skip
        out.write(bands)
    return path


@pytest.fixture
def ortho(tmp_path: Path) -> Path:
    """600 x 400 pixels of 0.2 m, dark, with a bright dot at 30 m east, 20 m south of the corner."""
    y, x = np.mgrid[0:400, 0:600]
    r2 = ((x + 0.5) * PIXEL - 30.0) ** 2 + ((y + 0.5) * PIXEL - 20.0) ** 2
    light = BACKGROUND + (PEAK - BACKGROUND) * np.exp(-0.5 * r2 / 0.8**2)
    codes = np.round(255.0 * light ** (1 / 2.2)).astype(np.uint8)
    return write(tmp_path / "ortho.tif", np.repeat(codes[None], 3, axis=0))


def test_a_dot_is_seen_where_its_coordinates_are(ortho: Path) -> None:
    ground, bounds, place = load_orthophoto(ortho, (0.0, 0.0))
    assert bounds == pytest.approx((-60.0, -40.0, 60.0, 40.0))
    assert (place.east_m, place.north_m) == pytest.approx((EAST + 60.0, NORTH - 40.0))
    assert place.origin[0] == pytest.approx(48.0, abs=0.1)
    dot = np.array([[-30.0, 20.0, 0.0]])
    scenario = dataclasses.replace(
        declared("demo").build(0), ground=ground,
        path=still(np.array([-30.5, 19.0, 60.0]), np.array([0.02, 0.0, 0.5])),
        relief=flat_relief(), cameras=(CameraSetup("cam0", CAMERA, looking_down(), quality=CLEAN),),
    )  # fmt: skip
    flight = SimulatedFlight(scenario, 0, frames=2)
    expected = flight.project(1, dot)
    radiance = flight._eyes[0].expose(scenario.path, float(flight._times[1]))
    assert np.linalg.norm(centroids(radiance, expected, 14) - expected) < 0.1
    assert radiance[..., 0].max() == pytest.approx(PEAK, rel=0.08)


def test_heights_come_from_the_surface_model(ortho: Path, tmp_path: Path) -> None:
    z = np.full((1, 80, 120), 500.0, dtype=np.float32)
    z[0, 20:24, 30:34] = 507.0  # 1 m cells: a block at 30 m east, 20 m south
    z[0, 60, 60] = np.nan
    dsm = write(tmp_path / "dsm.tif", z, 1.0)
    _, _, place = load_orthophoto(ortho, (0.0, 0.0))
    relief = load_relief(dsm, place)
    points = np.array([[-28.0, 18.0], [0.5, -20.5], [-50.0, -30.0], [900.0, 0.0]])
    assert relief.height(points[:, 0], points[:, 1]) == pytest.approx([7.0, 0.0, 0.0, 0.0], abs=1e-4)


def test_a_survey_is_planned_over_it_and_other_flights_must_fit(ortho: Path) -> None:
    made = over_orthophoto(declared("survey").build(0), ortho, None, 30.0, 0)
    assert made.bounds_m == pytest.approx((-60.0, -40.0, 60.0, 40.0))
    positions = made.path.poses(np.arange(0.0, made.path.end_s, 1.0))[1]
    assert np.abs(positions[:, 0]).max() < 60.0
    assert 28.0 < np.median(positions[:, 2]) < 40.0
    garden = over_orthophoto(declared("demo").build(0), ortho, None, None, 0)
    assert garden.landmarks == ()
    with pytest.raises(UsageError, match="ground"):
        over_orthophoto(declared("fixed-wing").build(0), ortho, None, None, 0)
    with pytest.raises(UsageError, match="survey"):
        over_orthophoto(declared("demo").build(0), ortho, None, 30.0, 0)


def test_geographic_files_are_warped(tmp_path: Path) -> None:
    bands = np.full((3, 50, 60), 90, dtype=np.uint8)
    with rasterio.open(
        tmp_path / "g.tif", "w", driver="GTiff", count=3, height=50, width=60, dtype="uint8", crs="EPSG:4326",
        transform=Affine(1e-5, 0.0, 8.0, 0.0, -1e-5, 48.0),
    ) as out:  # fmt: skip
        out.write(bands)
    ground, bounds, place = load_orthophoto(tmp_path / "g.tif", (0.0, 0.0))
    assert bounds[2] - bounds[0] == pytest.approx(60 * 1e-5 * 111_320 * np.cos(np.radians(48.0)), rel=0.05)
    assert place.origin[1] == pytest.approx(8.0003, abs=1e-4)
    assert ground.paint(Patch(0.0, 0.0, 0.5, 8)).mean() == pytest.approx((90 / 255) ** 2.2, rel=0.02)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda p: p.write_text("no picture"), "not a raster"),
        (lambda p: write(p, np.zeros((2, 8, 8), dtype=np.uint8)), "bands"),
        (lambda p: write(p, np.zeros((3, 8, 8), dtype=np.uint16)), "8-bit"),
        (lambda p: write(p, np.zeros((3, 8, 8), dtype=np.uint8), crs=None), "coordinate system"),
    ],
)
def test_unusable_files_are_named(tmp_path: Path, make, words: str) -> None:  # type: ignore[no-untyped-def]
    make(tmp_path / "bad.tif")
    with pytest.raises(SourceError, match=words) as caught:
        load_orthophoto(tmp_path / "bad.tif", (0.0, 0.0))
    assert "bad.tif" in str(caught.value)


def test_the_empty_rim_of_an_orthophoto_is_not_flown_over(tmp_path: Path) -> None:
    codes = np.zeros((3, 200, 300), dtype=np.uint8)
    codes[:, 50:180, 20:220] = 120
    ground, bounds, place = load_orthophoto(write(tmp_path / "rim.tif", codes), (0.0, 0.0))
    assert bounds == pytest.approx((-20.0, -13.0, 20.0, 13.0), abs=0.5)
    assert place.east_m == pytest.approx(EAST + 120 * PIXEL, abs=0.5)
    assert ground.paint(Patch(25.0, 15.0, 0.1, 8)).mean() == pytest.approx((120 / 255) ** 2.2, rel=0.03)
    with pytest.raises(SourceError, match="empty"):
        load_orthophoto(write(tmp_path / "void.tif", np.zeros((3, 20, 20), dtype=np.uint8)), (0.0, 0.0))
