"""Elevation grids: heights from scattered points, their interpolation and their file."""

from __future__ import annotations

import resource
from pathlib import Path

import numpy as np
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from rio_cogeo.cogeo import cog_validate

from overfly.errors import OutputError
from overfly.products.elevation import ElevationGrid, elevation_from_points, without_noise, write_elevation
from overfly.products.georeference import GeoReference


def centres(grid: ElevationGrid) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = grid.heights.shape
    x = grid.x0_m + (np.arange(columns) + 0.5) * grid.cell_m
    y = grid.y0_m - (np.arange(rows) + 0.5) * grid.cell_m
    return np.meshgrid(x, y)


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-50, 50), st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_bilinear_heights_of_a_slope_are_exact(a: float, b: float, c: float, seed: int) -> None:
    grid = ElevationGrid(-3.0, 5.0, 0.5, np.zeros((17, 23), np.float32), np.zeros((17, 23), np.float32))
    x, y = centres(grid)
    grid = ElevationGrid(-3.0, 5.0, 0.5, (a * x + b * y + c).astype(np.float32), grid.sigma)
    generator = np.random.default_rng(seed)
    px, py = generator.uniform(x.min(), x.max(), 20), generator.uniform(y.min(), y.max(), 20)
    np.testing.assert_allclose(grid.height_at(px, py), a * px + b * py + c, atol=1e-4)


def test_unknown_cells_are_unknown_until_extended() -> None:
    heights = np.full((9, 9), 2.0, np.float32)
    heights[4:, 4:] = np.nan
    grid = ElevationGrid(0.0, 9.0, 1.0, heights, np.zeros_like(heights))
    inside = grid.height_at(np.array([1.0, 8.0]), np.array([8.0, 1.0]))
    assert inside[0] == 2.0
    assert np.isnan(inside[1])
    np.testing.assert_allclose(grid.extended().height_at(np.array([8.0]), np.array([1.0])), 2.0)
    assert ElevationGrid.flat(3.5).height_at(np.array([1e6]), np.array([-1e6])) == 3.5


def test_points_give_their_surface_in_spite_of_outliers() -> None:
    generator = np.random.default_rng(0)
    xy = generator.uniform(0, 10, (8000, 2))
    sigma = generator.uniform(0.02, 0.05, 8000)
    z = 0.2 * xy[:, 0] - 0.1 * xy[:, 1] + generator.normal(0, sigma)
    wrong = generator.random(8000) < 0.15
    z[wrong] += generator.uniform(2, 20, wrong.sum())
    grid = elevation_from_points(np.column_stack([xy, z]), sigma, 0.5)
    x, y = centres(grid)
    error = grid.heights - (0.2 * x - 0.1 * y)
    assert not np.isnan(grid.heights).any()
    assert np.abs(error).max() < 0.08
    assert np.sqrt(np.mean(error**2)) < 0.02  # 0.05 / sqrt(17) and the slope inside a cell
    assert 0.3 < np.sqrt(np.mean((error / grid.sigma) ** 2)) < 1.6  # the sigma means what it says


@given(st.integers(0, 500), st.floats(0.1, 3.0))
@settings(max_examples=25, deadline=None)
def test_every_cell_with_a_point_lies_within_its_points(seed: int, cell_m: float) -> None:
    generator = np.random.default_rng(seed)
    points = generator.normal(0, 3, (int(generator.integers(1, 60)), 3))
    grid = elevation_from_points(points, np.full(len(points), 0.1), cell_m)
    known = grid.heights[~np.isnan(grid.heights)]
    assert 1 <= len(known) <= len(points)
    assert known.min() >= points[:, 2].min() - 1e-5
    assert known.max() <= points[:, 2].max() + 1e-5
    assert (np.isnan(grid.sigma) == np.isnan(grid.heights)).all()
    assert grid.x0_m <= points[:, 0].min()
    assert grid.y0_m >= points[:, 1].max()


def robust_mean(z: np.ndarray, sigma: np.ndarray) -> tuple[float, float]:
    """Twin of what a cell is given: mean and standard deviation of the points near the median."""
    away = np.abs(z - np.median(z))
    near = away <= 3.5 * np.maximum(1.4826 * np.median(away), sigma)
    weight = 1.0 / sigma[near] ** 2
    mean = np.average(z[near], weights=weight)
    scatter = np.average((z[near] - mean) ** 2, weights=weight) / max(near.sum() - 1, 1)
    return float(mean), float(np.sqrt(max(1.0 / weight.sum(), scatter)))


@given(counts=st.lists(st.integers(1, 80), min_size=1, max_size=6), seed=st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_cells_are_their_robust_means(counts: list[int], seed: int) -> None:
    generator = np.random.default_rng(seed)
    cell = np.repeat(np.arange(len(counts)), counts)
    z = generator.normal(cell, 0.1) + 5.0 * (generator.random(len(cell)) < 0.1)
    sigma = generator.uniform(0.05, 0.2, len(cell))
    x, y = cell + generator.uniform(0.01, 0.99, len(cell)), np.full(len(cell), 0.5)
    shuffled = generator.permutation(len(cell))
    grid = elevation_from_points(np.column_stack([x, y, z])[shuffled], sigma[shuffled], 1.0)
    first = round(grid.x0_m)
    for number in range(len(counts)):
        expected = robust_mean(z[cell == number], sigma[cell == number])
        found = grid.heights[0, number - first], grid.sigma[0, number - first]
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_small_holes_are_filled_and_large_ones_are_not() -> None:
    x, y = np.meshgrid(np.arange(0.25, 20, 0.5), np.arange(0.25, 20, 0.5))
    z = 0.3 * x
    small = (np.abs(x - 5) < 0.6) & (np.abs(y - 5) < 0.6)
    large = (np.abs(x - 14) < 3) & (np.abs(y - 14) < 3)
    kept = ~(small | large)
    points = np.column_stack([x[kept], y[kept], z[kept]])
    grid = elevation_from_points(points, np.full(len(points), 0.02), 0.5, largest_hole_m=1.0)
    gx, gy = centres(grid)
    was_small = (np.abs(gx - 5) < 0.6) & (np.abs(gy - 5) < 0.6)
    middle = (np.abs(gx - 14) < 0.6) & (np.abs(gy - 14) < 0.6)
    assert np.abs(grid.heights[was_small] - 0.3 * gx[was_small]).max() < 0.1
    assert (grid.sigma[was_small] > 0.02).all()
    assert np.isnan(grid.heights[middle]).all()


def test_no_point_is_an_error() -> None:
    with pytest.raises(OutputError, match="no point"):
        elevation_from_points(np.full((3, 3), np.nan), np.ones(3), 1.0)


def test_file_holds_height_and_sigma_where_they_belong(tmp_path: Path) -> None:
    generator = np.random.default_rng(1)
    heights = generator.normal(0, 1, (700, 600)).astype(np.float32)
    heights[:50, :50] = np.nan
    sigma = np.where(np.isnan(heights), np.nan, 0.1).astype(np.float32)
    grid = ElevationGrid(-10.0, 20.0, 0.25, heights, sigma)
    reference = GeoReference("EPSG:32635", 2.0, 0.3, (470000.0, 6700000.0, 50.0))
    write_elevation(tmp_path / "elevation.tif", grid, reference)
    valid, errors, _ = cog_validate(tmp_path / "elevation.tif")
    assert valid, errors
    with rasterio.open(tmp_path / "elevation.tif") as raster:
        height_band, sigma_band = raster.read()
        assert np.isnan(raster.nodata)
        assert raster.dtypes == ("float32", "float32")
        east, north = raster.transform @ (100.5, 200.5)
    np.testing.assert_allclose(height_band, 2.0 * heights + 50.0, atol=1e-4)
    np.testing.assert_allclose(sigma_band, 2.0 * sigma, atol=1e-6)
    x, y = -10.0 + 100.5 * 0.25, 20.0 - 200.5 * 0.25
    c, s = np.cos(0.3), np.sin(0.3)
    assert (east - 470000.0, north - 6700000.0) == pytest.approx((2 * (c * x - s * y), 2 * (s * x + c * y)))


@pytest.mark.parametrize("limit_bytes", [1000, 500_000, 2_500_000, 4_500_000])
def test_a_disk_that_fills_up_leaves_the_old_file_and_one_clear_line(
    tmp_path: Path, limit_bytes: int
) -> None:
    heights = np.random.default_rng(0).normal(0, 1, (900, 700)).astype(np.float32)  # noise: does not compress
    path = tmp_path / "elevation.tif"
    path.write_text("old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
    try:
        with pytest.raises(OutputError, match=r"cannot write .*elevation\.tif") as caught:
            write_elevation(path, ElevationGrid(5.0, 9.0, 0.5, heights, np.abs(heights)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "\n" not in str(caught.value)
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["elevation.tif"]


def test_noise_goes_and_relief_stays() -> None:
    """Level ground with noise of the promised sigma beside a house of thirty sigmas, and a hole."""
    generator = np.random.default_rng(3)
    truth = np.zeros((80, 120), np.float32)
    truth[20:60, 70:100] = 3.0
    heights = (truth + generator.normal(0.0, 0.1, truth.shape)).astype(np.float32)
    heights[:30, :10] = np.nan
    grid = ElevationGrid(0.0, 0.0, 1.0, heights, np.full_like(heights, 0.1))
    found = without_noise(grid)
    np.testing.assert_array_equal(np.isnan(found.heights), np.isnan(heights))
    np.testing.assert_array_equal(found.sigma, grid.sigma)
    level = np.s_[5:75, 12:60]
    left = np.std(found.heights[level]) / np.std(heights[level])
    assert 0.1 < left < 0.5  # a window of some 50 cells, and where it happens to scatter more, less of it
    edge = np.s_[15:65, 65:105]
    assert np.abs(found.heights - truth)[edge].max() < 0.5  # the edge is as sharp as it was


def test_exact_heights_are_left_alone() -> None:
    row, column = np.mgrid[:40, :50]
    heights = (np.sin(row / 3.0) + 0.1 * column).astype(np.float32)
    grid = ElevationGrid(0.0, 0.0, 1.0, heights, np.full_like(heights, 1e-4))
    np.testing.assert_allclose(without_noise(grid).heights, heights, atol=1e-4)
