"""mosaic.tif on elevation.tif as textured meshes, tile by tile, coarse enough for a browser."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from rasterio.enums import Resampling
from rasterio.errors import RasterioError

from overfly.errors import SourceError
from overfly.geometry.poses import FloatArray
from overfly.products.elevation import ElevationGrid
from overfly.products.georeference import GeoReference, transform_points
from overfly.types import BoolArray, UInt8Array
from overfly.viewer.glb import grid_faces, textured_mesh
from overfly.viewer.ground import Surface

TILE_PX = 512  # of the texture
LONGEST_SIDE_PX, MOST_PIXELS = 6000, 12_000_000  # of the mosaic as it is shown
CELLS = 32  # of a tile's mesh, per side
MOST_ELEVATION_CELLS = 4_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """Heights of the ground in the world's frame, from elevation.tif or level.

    surface: for clicks; grid: heights in metres of the world, on a grid in the CRS.
    """

    grid: ElevationGrid
    reference: GeoReference

    @staticmethod
    def level(height_m: float, reference: GeoReference) -> Terrain:
        return Terrain(ElevationGrid.flat(height_m), reference)

    @staticmethod
    def read(path: Path, reference: GeoReference) -> Terrain:
        """Raises SourceError when the file is no elevation of ours."""
        try:
            with rasterio.open(path) as raster:
                coarser = max(1, math.ceil(math.sqrt(raster.width * raster.height / MOST_ELEVATION_CELLS)))
                shape = (max(1, raster.height // coarser), max(1, raster.width // coarser))
                heights = raster.read(1, out_shape=shape, resampling=Resampling.average)
                place, cell = raster.transform, raster.transform.a * raster.width / shape[1]
        except RasterioError as error:
            raise SourceError(f"{path}: cannot be read: {error}") from error
        in_world = (heights - reference.translation_m[2]) / reference.scale
        grid = ElevationGrid(place.c, place.f, cell, in_world.astype(np.float32), np.zeros_like(in_world))
        return Terrain(grid.extended(), reference)

    def height_at(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """World coordinates -> height in the world, metres."""
        placed = transform_points(self.reference.crs_from_world(), np.stack([x_m, y_m], axis=-1))
        return self.grid.height_at(placed[..., 0], placed[..., 1])

    @property
    def surface(self) -> Surface:
        low, high = float(self.grid.heights.min()), float(self.grid.heights.max())
        return Surface(self.height_at, low, high)


def mosaic_meshes(path: Path, terrain: Terrain) -> Iterator[bytes]:
    """The mosaic on the ground, one binary glTF after the other. Raises SourceError when it is unreadable."""
    try:
        with rasterio.open(path) as raster:
            shrink = max(
                1.0,
                max(raster.width, raster.height) / LONGEST_SIDE_PX,
                math.sqrt(raster.width * raster.height / MOST_PIXELS),
            )
            shape = (max(1, int(raster.height / shrink)), max(1, int(raster.width / shrink)))
            bands = raster.read((1, 2, 3, 4), out_shape=(4, *shape), resampling=Resampling.average)
            scale = Affine.scale(raster.width / shape[1], raster.height / shape[0])
            world_from_pixel = ~terrain.reference.crs_from_world() @ raster.transform @ scale
    except (RasterioError, IndexError) as error:
        raise SourceError(f"{path}: cannot be read: {error}") from error
    picture = np.ascontiguousarray(bands.transpose(1, 2, 0))
    for top in range(0, shape[0], TILE_PX):
        for left in range(0, shape[1], TILE_PX):
            tile = picture[top : top + TILE_PX, left : left + TILE_PX]
            if (tile[..., 3] > 0).any():
                yield _tile_mesh(tile, world_from_pixel @ Affine.translation(left, top), terrain)


def _tile_mesh(tile: UInt8Array, world_from_pixel: Affine, terrain: Terrain) -> bytes:
    height, width = tile.shape[:2]
    rows, columns = (max(2, math.ceil(CELLS * size / TILE_PX) + 1) for size in (height, width))
    u, v = np.meshgrid(np.linspace(0.0, 1.0, columns), np.linspace(0.0, 1.0, rows))
    flat = transform_points(world_from_pixel, np.stack([u * width, v * height], axis=-1)).reshape(-1, 2)
    vertices = np.column_stack([flat, terrain.height_at(flat[:, 0], flat[:, 1])])
    faces = grid_faces(rows, columns)[np.repeat(_cells_with_ground(tile, rows, columns), 2)]
    return textured_mesh(vertices, np.column_stack([u.ravel(), v.ravel()]), faces, tile)


def _cells_with_ground(tile: UInt8Array, rows: int, columns: int) -> BoolArray:
    """((rows-1) (columns-1),) which cells of the mesh hold a pixel that was seen."""
    row_edges = np.linspace(0, tile.shape[0], rows).astype(np.int64)
    column_edges = np.linspace(0, tile.shape[1], columns).astype(np.int64)
    seen = tile[..., 3] > 0
    counts = np.add.reduceat(
        np.add.reduceat(seen, row_edges[:-1], axis=0, dtype=np.int64), column_edges[:-1], axis=1
    )
    return np.asarray(counts.ravel() > 0)
