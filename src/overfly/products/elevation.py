"""The shape of the ground as a grid of heights, from scattered points, and its file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from affine import Affine
from numba import njit

from overfly.errors import OutputError
from overfly.geometry.poses import FloatArray
from overfly.products.cog import Bands, RasterFrame, cloud_optimised_geotiff
from overfly.products.georeference import GeoReference
from overfly.types import Float32Array

OUTLIER_SIGMAS = 3.5  # of a cell's own median deviation
HEIGHT_AND_SIGMA = Bands("float32", 2, ("height (m)", "standard deviation (m)"), "m")
NOISE_CELLS = 2.0  # standard deviation of the window in which noise is told from relief
SHOWN_SIGMAS = 12.0  # the least that colours span: four are all of the noise
LEAST_SIGMA_M = 1e-4  # a point that claims to be exact must not outweigh all others


@dataclass(frozen=True, slots=True, eq=False)
class ElevationGrid:
    """Heights on a north-up grid: cell (row, column) has its centre at x0 + (column + 0.5) cell, y0 - (row
    + 0.5) cell.

    x0_m, y0_m: top-left corner, world, metres; heights (rows, columns) float32 metres, NaN where nothing
    is known; sigma alike: standard deviation, NaN where the height is.
    """

    x0_m: float
    y0_m: float
    cell_m: float
    heights: Float32Array
    sigma: Float32Array

    @staticmethod
    def flat(height_m: float) -> ElevationGrid:
        """Level ground everywhere."""
        return ElevationGrid(
            0.0, 0.0, 1.0, np.full((1, 1), height_m, np.float32), np.zeros((1, 1), np.float32)
        )

    def extended(self) -> ElevationGrid:
        """The same with every unknown cell near the height of the nearest known one, smoothly."""
        unknown = np.isnan(self.heights)
        if not unknown.any():
            return self
        if unknown.all():
            return ElevationGrid.flat(0.0)
        _, nearest = cv2.distanceTransformWithLabels(
            unknown.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        of_label = np.zeros(int(nearest.max()) + 1, np.float32)
        of_label[nearest[~unknown]] = self.heights[~unknown]
        filled = of_label[nearest]
        smooth = cv2.GaussianBlur(filled, (0, 0), 3.0)
        return ElevationGrid(self.x0_m, self.y0_m, self.cell_m, np.where(unknown, smooth, filled), self.sigma)

    def height_range_m(self) -> tuple[float, float]:
        """Lowest and highest ground, single wild cells left out."""
        low, high = np.nanpercentile(self.heights, [0.5, 99.5])
        return float(low), float(high)

    def shown_range_m(self) -> tuple[float, float]:
        """Heights that a picture's colours are to span: those of nearly all the ground, and so much more that
        what the deviations explain does not look like hills."""
        known = np.isfinite(self.heights)
        if not known.any():
            return 0.0, 1.0
        low, high = (float(height) for height in np.percentile(self.heights[known], [2, 98]))
        wider = max(0.5 * (SHOWN_SIGMAS * float(np.median(self.sigma[known])) - (high - low)), 0.0)
        return low - wider, high + wider

    def height_at(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """Bilinear height (m) at world points, any shape; NaN beside unknown cells, level beyond the grid."""
        rows, columns = self.heights.shape
        c = np.clip((x_m - self.x0_m) / self.cell_m - 0.5, 0, columns - 1)
        r = np.clip((self.y0_m - y_m) / self.cell_m - 0.5, 0, rows - 1)
        c0, r0 = np.floor(c).astype(np.int64), np.floor(r).astype(np.int64)
        c1, r1 = np.minimum(c0 + 1, columns - 1), np.minimum(r0 + 1, rows - 1)
        fc, fr = c - c0, r - r0
        above = (1 - fc) * self.heights[r0, c0] + fc * self.heights[r0, c1]
        below = (1 - fc) * self.heights[r1, c0] + fc * self.heights[r1, c1]
        return np.asarray((1 - fr) * above + fr * below, dtype=np.float64)


def elevation_from_points(
    points: FloatArray, sigmas_m: FloatArray, cell_m: float, largest_hole_m: float = 0.0
) -> ElevationGrid:
    """Grid of heights from scattered points: per cell the mean, weighted by variance, of those near the
    cell's median.

    points: (n, 3) metres, world; sigmas_m: (n,) standard deviation of their heights. The cell's sigma is
    the larger of what the points promise and what their scatter shows. Unknown cells no further than
    ``largest_hole_m`` from known ones on several sides are interpolated, with a sigma that grows with the
    distance. Raises OutputError when there is no point.
    """
    good = np.isfinite(points).all(axis=1) & np.isfinite(sigmas_m)
    points, sigmas = points[good], np.maximum(sigmas_m[good], LEAST_SIGMA_M)
    if len(points) == 0:
        raise OutputError("no point of the ground is known, so there is no elevation to write")
    x0 = np.floor(points[:, 0].min() / cell_m) * cell_m
    y0 = np.ceil(points[:, 1].max() / cell_m) * cell_m
    columns = int((points[:, 0].max() - x0) / cell_m) + 1
    rows = int((y0 - points[:, 1].min()) / cell_m) + 1
    row = np.clip(((y0 - points[:, 1]) / cell_m).astype(np.int64), 0, rows - 1)
    cell = row * columns + ((points[:, 0] - x0) / cell_m).astype(np.int64)
    heights, deviations = _robust_cells(points[:, 2], sigmas, cell, rows * columns)
    grid = ElevationGrid(
        float(x0),
        float(y0),
        cell_m,
        heights.reshape(rows, columns).astype(np.float32),
        deviations.reshape(rows, columns).astype(np.float32),
    )
    return with_small_holes_filled(grid, largest_hole_m) if largest_hole_m > 0 else grid


def write_elevation(path: str | Path, grid: ElevationGrid, reference: GeoReference | None = None) -> None:
    """elevation.tif: float32 metres in the reference's CRS, band 2 the standard deviation, NaN where
    unknown; a COG.

    Raises OutputError.
    """
    reference = reference or GeoReference.local()
    rows, columns = grid.heights.shape
    world_from_pixel = Affine(grid.cell_m, 0.0, grid.x0_m, 0.0, -grid.cell_m, grid.y0_m)
    heights = reference.height_in_crs(grid.heights.astype(np.float64)).astype(np.float32)
    frame = RasterFrame(
        reference.crs, reference.crs_from_world() @ world_from_pixel, columns, rows, HEIGHT_AND_SIGMA
    )
    sigma = (reference.scale * grid.sigma).astype(np.float32)
    with cloud_optimised_geotiff(path, frame) as raster:
        raster.write(np.stack([heights, sigma], axis=2))


def read_elevation(path: str | Path, reference: GeoReference | None = None) -> ElevationGrid:
    """The grid of an elevation file in the world. reference: as it was written with. Raises OutputError."""
    reference = reference or GeoReference.local()
    try:
        with rasterio.open(path) as raster:
            heights, sigma = raster.read([1, 2]).astype(np.float64)
            world_from_pixel = ~reference.crs_from_world() @ raster.transform
    except (rasterio.errors.RasterioError, OSError, IndexError) as error:
        raise OutputError(f"cannot read the elevation {path}: {error}") from error
    return ElevationGrid(
        float(world_from_pixel.c),
        float(world_from_pixel.f),
        float(world_from_pixel.a),
        ((heights - reference.translation_m[2]) / reference.scale).astype(np.float32),
        (sigma / reference.scale).astype(np.float32),
    )


def _robust_cells(
    z: FloatArray, sigma: FloatArray, cell: np.ndarray[tuple[int], np.dtype[np.int64]], n_cells: int
) -> tuple[FloatArray, FloatArray]:
    """Height and standard deviation of each cell, (n_cells,) each, NaN for empty ones."""
    last = np.cumsum(np.bincount(cell, minlength=n_cells))
    order = np.argsort(cell, kind="stable")
    mean, deviation = _means_near_medians(z[order], sigma[order], last)
    return np.asarray(mean), np.asarray(deviation)


@njit(cache=True, nogil=True)
def _means_near_medians(z, sigma, last):  # type: ignore[no-untyped-def]
    """Of values that lie cell by cell; last (n_cells,): where each cell's end."""
    mean, deviation = np.full(len(last), np.nan), np.full(len(last), np.nan)
    away, scratch = np.empty_like(z), np.empty_like(z)
    first = 0
    for cell in range(len(last)):
        start, first = first, last[cell]
        if start == first:
            continue
        middle = _median(z, start, first, scratch)
        for n in range(start, first):
            away[n] = abs(z[n] - middle)
        spread = 1.4826 * _median(away, start, first, scratch)
        total, weighted, count = 0.0, 0.0, 0
        for n in range(start, first):
            if away[n] <= OUTLIER_SIGMAS * max(spread, sigma[n]):
                total += 1.0 / sigma[n] ** 2
                weighted += z[n] / sigma[n] ** 2
                count += 1
        if count == 0:
            continue
        mean[cell] = weighted / total
        scatter = 0.0
        for n in range(start, first):
            if away[n] <= OUTLIER_SIGMAS * max(spread, sigma[n]):
                scatter += (z[n] - mean[cell]) ** 2 / sigma[n] ** 2
        # the larger of what the points promise and what their scatter shows
        shown = scatter / total / (count - 1) if count > 1 else 0.0
        deviation[cell] = math.sqrt(max(1.0 / total, shown))
    return mean, deviation


@njit(cache=True, nogil=True)
def _median(values, start, stop, scratch):  # type: ignore[no-untyped-def]
    """Of values[start:stop]. scratch: room for as many; sorted in it by insertion, for they are few."""
    count = stop - start
    if count > 50:
        scratch[:count] = np.sort(values[start:stop])
    else:
        for n in range(count):
            value, place = values[start + n], n
            while place > 0 and scratch[place - 1] > value:
                scratch[place] = scratch[place - 1]
                place -= 1
            scratch[place] = value
    return 0.5 * (scratch[(count - 1) // 2] + scratch[count // 2])


def with_small_holes_filled(grid: ElevationGrid, largest_hole_m: float) -> ElevationGrid:
    """Unknown cells so near to known ones, inside their outline, get their weighted mean."""
    known = ~np.isnan(grid.heights)
    radius = max(1, int(np.ceil(largest_hole_m / grid.cell_m)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    padded = np.pad(known.astype(np.uint8), radius)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disc)[radius:-radius, radius:-radius] > 0
    holes = closed & ~known
    if not holes.any():
        return grid
    weight = cv2.GaussianBlur(known.astype(np.float64), (0, 0), 0.5 * radius)
    sums = cv2.GaussianBlur(np.where(known, grid.heights, 0.0).astype(np.float64), (0, 0), 0.5 * radius)
    squares = cv2.GaussianBlur(
        np.where(known, grid.heights.astype(np.float64) ** 2 + grid.sigma.astype(np.float64) ** 2, 0.0),
        (0, 0),
        0.5 * radius,
    )
    holes &= weight > 1e-6
    mean = sums[holes] / weight[holes]
    deviation = np.sqrt(np.maximum(squares[holes] / weight[holes] - mean**2, LEAST_SIGMA_M**2))
    heights, sigma = grid.heights.copy(), grid.sigma.copy()
    heights[holes], sigma[holes] = mean, deviation
    return ElevationGrid(grid.x0_m, grid.y0_m, grid.cell_m, heights, sigma)


def without_noise(grid: ElevationGrid) -> ElevationGrid:
    """The same with each height drawn towards the mean around it, as far as its sigma explains the rest.

    Wiener's filter for pictures (Lee 1980) with known noise: level ground becomes level, and what stands out
    by more than the sigmas stays as it is. The sigmas stay: how far they would sink depends on how alike the
    errors of neighbours are, which nobody knows.
    """
    known = np.isfinite(grid.heights)
    if not known.any():
        return grid
    middle = np.float32(np.median(grid.heights[known]))  # squares of what is left need no more than 32 bits
    heights = np.where(known, grid.heights - middle, np.float32(0.0))
    weight = np.where(known, np.maximum(grid.sigma, np.float32(LEAST_SIGMA_M)), np.float32(np.inf)) ** -2
    total = np.maximum(_around(weight), np.float32(1e-12))
    mean = _around(weight * heights) / total
    variance = np.maximum(_around(weight * heights**2) / total - mean**2, np.float32(1e-12))
    noise = _around(known.astype(np.float32)) / total  # what the sigmas promise of that variance
    relief = np.maximum(variance - noise, np.float32(0.0)) / variance
    filtered = np.where(known, middle + mean + relief * (heights - mean), np.float32(np.nan))
    return ElevationGrid(grid.x0_m, grid.y0_m, grid.cell_m, filtered, grid.sigma)


def _around(values: Float32Array) -> Float32Array:
    """Weighted sums of the cells around each."""
    return np.asarray(cv2.GaussianBlur(values, (0, 0), NOISE_CELLS), np.float32)
