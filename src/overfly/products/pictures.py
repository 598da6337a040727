"""Rasters as small pictures for a page."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from affine import Affine

from overfly.errors import OutputError
from overfly.geometry.poses import FloatArray
from overfly.products.elevation import ElevationGrid
from overfly.products.georeference import GeoReference, transform_points
from overfly.types import UInt8Array


@dataclass(frozen=True, slots=True, eq=False)
class MapPicture:
    """A picture of the ground: rgba (h, w, 4); world_from_pixel: of the plane, pixel corners, metres."""

    rgba: UInt8Array
    world_from_pixel: Affine

    def pixels_from_world(self, xy: FloatArray) -> FloatArray:
        """xy: (n, 2) metres, world -> (n, 2) pixels, corner of the picture at 0, 0."""
        return transform_points(~self.world_from_pixel, xy)

    @property
    def metres_per_px(self) -> float:
        return float(np.sqrt(abs(self.world_from_pixel.determinant)))

    @property
    def turn_deg(self) -> float:
        """By how much the picture's top lies clockwise from the world's y."""
        return float(np.degrees(np.arctan2(-self.world_from_pixel.b, -self.world_from_pixel.e)))


def map_picture(
    path: str | Path, reference: GeoReference | None = None, longest_px: int = 1600
) -> MapPicture:
    """A mosaic file at a size for the screen, from its overviews.

    reference: as it was written with. Raises OutputError.
    """
    crs_from_world = (reference or GeoReference.local()).crs_from_world()
    try:
        with rasterio.open(path) as raster:
            factor = max(1.0, max(raster.width, raster.height) / longest_px)
            width, height = max(1, round(raster.width / factor)), max(1, round(raster.height / factor))
            rgba = raster.read(out_shape=(4, height, width)).transpose(1, 2, 0)
            crs_from_pixel = raster.transform @ Affine.scale(raster.width / width, raster.height / height)
    except (rasterio.errors.RasterioError, OSError) as error:
        raise OutputError(f"cannot read the mosaic {path}: {error}") from error
    return MapPicture(np.ascontiguousarray(rgba), ~crs_from_world @ crs_from_pixel)


def elevation_picture(grid: ElevationGrid, longest_px: int = 900) -> MapPicture:
    """Heights as shaded colours, light from the north-west, transparent where unknown."""
    rows, columns = grid.heights.shape
    factor = max(1, int(max(rows, columns) / longest_px))
    heights = grid.heights[::factor, ::factor].astype(np.float64)
    known = np.isfinite(heights)
    low, high = grid.shown_range_m()
    code = np.clip((np.nan_to_num(heights, nan=low) - low) / max(high - low, 1e-9), 0, 1)
    bgr = cv2.applyColorMap((255 * code).astype(np.uint8), cv2.COLORMAP_CIVIDIS)
    slope_y, slope_x = np.gradient(cv2.GaussianBlur(np.where(known, heights, low), (0, 0), 1.0))
    noise = float(np.median(grid.sigma[np.isfinite(grid.heights)])) if known.any() else 1.0
    steepest = max(float(np.percentile(np.hypot(slope_x, slope_y)[known], 98)) if known.any() else 1.0, noise)
    steepest = max(steepest, 1e-9)
    shade = np.clip(1.0 - 0.25 * (slope_x + slope_y) / steepest, 0.6, 1.3)
    rgba = np.zeros((*heights.shape, 4), np.uint8)
    rgba[..., :3] = np.clip(bgr[..., ::-1] * shade[..., None], 0, 255)
    rgba[..., 3] = np.where(known, 255, 0)
    cell = grid.cell_m * factor
    return MapPicture(rgba, Affine(cell, 0.0, grid.x0_m, 0.0, -cell, grid.y0_m))


def data_url(rgba: UInt8Array) -> str:
    """The picture inside a URL, so that a page needs no other file."""
    done, encoded = cv2.imencode(
        ".webp", cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA), [cv2.IMWRITE_WEBP_QUALITY, 82]
    )
    if not done:
        raise OutputError("a picture of the report could not be encoded")
    return "data:image/webp;base64," + base64.b64encode(encoded.tobytes()).decode("ascii")
