"""Cloud Optimised GeoTIFFs, tile by tile: each is compressed once, on the thread that made it, and smaller
versions are made from the tiles while these are still in memory.

The layout (cogeo.org): header, directories from the full size to the smallest, then the tiles, the smallest
size first. Nobody knows how long compressed tiles will be, so those of each size wait in a file of their own.
What the directories say of place and bands is taken from a file of one tile that GDAL writes in memory, so
that only GDAL needs to know how that is told.
"""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from affine import Affine
from isal import isal_zlib  # zlib's format in a quarter of zlib's time
from numba import njit
from numpy.typing import NDArray

from overfly.files import atomic_path
from overfly.products.tiff import Directory, around_tile, described, write_tiff

TILE_PX = 512
DEFLATE_LEVEL = 1  # as fast as 0, and smaller
SPOOL_BYTES = 64 * 2**20  # of tiles of the full size that wait in memory; then they go into a file

Pixels = NDArray[Any]


@dataclass(frozen=True, slots=True)
class Bands:
    """What the numbers of a raster are. names and unit: of each band, for programs that show them."""

    dtype: str
    count: int
    names: tuple[str, ...] = ()
    unit: str = ""

    @property
    def is_colour(self) -> bool:
        return self.dtype == "uint8"


RGBA = Bands("uint8", 4)  # nothing known where the last is 0


@dataclass(frozen=True, slots=True)
class RasterFrame:
    """crs: "EPSG:32635" or WKT; crs_from_pixel: of the plane, pixel corners; size in pixels. Of float bands
    NaN is what is unknown."""

    crs: str
    crs_from_pixel: Affine
    width: int
    height: int
    bands: Bands = RGBA

    def corners(self) -> list[tuple[int, int]]:
        """(x, y) of the top-left pixel of each tile, in the order in which they are written."""
        return [(x, y) for y in range(0, self.height, TILE_PX) for x in range(0, self.width, TILE_PX)]


@dataclass(frozen=True, slots=True, eq=False)
class PackedTile:
    """data: compressed; half (TILE_PX / 2, TILE_PX / 2, bands): the tile at half its size."""

    data: bytes
    half: Pixels


def pack_tile(tile: Pixels) -> PackedTile:
    """tile: (TILE_PX, TILE_PX, bands) uint8 or float32, transparent or NaN beyond the raster. Threads may
    share the work: no tile needs another."""
    half = _halved_colour(tile) if tile.dtype == np.uint8 else _halved_heights(tile)
    return PackedTile(isal_zlib.compress(_differences(tile), DEFLATE_LEVEL), half)


def _differences(tile: Pixels) -> NDArray[np.uint8]:
    """Each pixel less the one before it, as TIFF's predictors 2 (integers) and 3 (floats) have it."""
    bands = tile.shape[2]
    if tile.dtype == np.uint8:
        rows = tile.reshape(len(tile), -1)
    else:  # all first bytes of a row, all second ones and so on: the highest hardly change
        parts = tile.astype(">f4").reshape(len(tile), -1, 1).view(np.uint8)
        rows = np.ascontiguousarray(parts.transpose(0, 2, 1)).reshape(len(tile), -1)
    found = rows.copy()
    found[:, bands:] -= rows[:, :-bands]
    return found


@njit(cache=True, nogil=True)
def _halved_colour(tile):  # type: ignore[no-untyped-def]
    """The mean colour of what is seen in two by two pixels, and how much of them that is."""
    rows, columns = tile.shape[0] // 2, tile.shape[1] // 2
    half = np.zeros((rows, columns, 4), np.uint8)
    for r in range(rows):
        above, below = tile[2 * r], tile[2 * r + 1]
        for c in range(columns):
            left, right = 2 * c, 2 * c + 1
            a, b = np.int32(above[left, 3]), np.int32(above[right, 3])
            d, e = np.int32(below[left, 3]), np.int32(below[right, 3])
            seen = a + b + d + e
            if seen == 1020:  # all of it: the same, without a division
                for k in range(3):
                    total = np.int32(above[left, k]) + above[right, k] + below[left, k] + below[right, k]
                    half[r, c, k] = (total + 2) >> 2
            elif seen > 0:
                for k in range(3):
                    total = a * above[left, k] + b * above[right, k]
                    total += d * below[left, k] + e * below[right, k]
                    half[r, c, k] = (total + seen // 2) // seen
            half[r, c, 3] = (seen + 2) // 4
    return half


def _halved_heights(tile: Pixels) -> Pixels:
    """The mean of what is known in two by two pixels."""
    rows, columns, bands = tile.shape
    four = tile.reshape(rows // 2, 2, columns // 2, 2, bands).swapaxes(1, 2).reshape(-1, 4, bands)
    known = np.isfinite(four)
    count = known.sum(axis=1)
    total = np.where(known, four, 0.0).sum(axis=1, dtype=np.float64)
    mean = np.divide(total, count, out=np.full(count.shape, np.nan), where=count > 0)
    return np.asarray(mean.reshape(rows // 2, columns // 2, bands), tile.dtype)


@dataclass(slots=True, eq=False)
class _Spool:
    """Compressed tiles in the order in which they come: in memory, as they are, and beyond that in a file."""

    file: IO[bytes]
    most_bytes: int
    waiting: list[bytes] = field(default_factory=list)
    n_bytes: int = 0

    def add(self, data: bytes) -> None:
        self.waiting += around_tile(data)
        self.n_bytes += len(data)
        if self.n_bytes > self.most_bytes:
            self.file.writelines(self.waiting)
            self.waiting.clear()
            self.n_bytes = 0

    def copy_to(self, file: IO[bytes]) -> None:
        self.file.seek(0)
        shutil.copyfileobj(self.file, file, 1 << 20)
        file.writelines(self.waiting)


@dataclass(slots=True, eq=False)
class _Level:
    """One size of the raster. n_bytes: of its tiles so far, in their order, 0 for empty ones; parents: tiles
    of the next smaller size that are being put together."""

    width: int
    height: int
    spool: _Spool
    n_bytes: list[int] = field(default_factory=list)
    parents: dict[tuple[int, int], Pixels] = field(default_factory=dict)

    @property
    def columns(self) -> int:
        return -(-self.width // TILE_PX)

    @property
    def rows(self) -> int:
        return -(-self.height // TILE_PX)


@dataclass(frozen=True, slots=True, eq=False)
class CogWriter:
    """A raster in the making, to which tiles are added in the order of its corners."""

    frame: RasterFrame
    levels: list[_Level]

    def add(self, tile: PackedTile | None) -> None:
        """The next tile; None where nothing is known."""
        self._add(0, tile)

    def write(self, pixels: Pixels) -> None:
        """The next rows, (h, width, bands): a multiple of TILE_PX of them, or all that are left."""
        bands = self.frame.bands
        empty = 0 if bands.is_colour else np.nan
        for top in range(0, len(pixels), TILE_PX):
            for left in range(0, self.frame.width, TILE_PX):
                part = pixels[top : top + TILE_PX, left : left + TILE_PX]
                tile = np.full((TILE_PX, TILE_PX, bands.count), empty, bands.dtype)
                tile[: part.shape[0], : part.shape[1]] = part
                known = tile[..., -1] > 0 if bands.is_colour else np.isfinite(tile)
                self.add(pack_tile(tile) if known.any() else None)

    def _add(self, number: int, tile: PackedTile | None) -> None:
        level = self.levels[number]
        row, column = divmod(len(level.n_bytes), level.columns)
        level.n_bytes.append(0 if tile is None else len(tile.data))
        if tile is not None:
            level.spool.add(tile.data)
        if number + 1 == len(self.levels):
            return
        place = (row // 2, column // 2)
        if tile is not None:
            parent = level.parents.get(place)
            if parent is None:
                empty = 0 if self.frame.bands.is_colour else np.nan
                shape = (TILE_PX, TILE_PX, self.frame.bands.count)
                parent = level.parents[place] = np.full(shape, empty, tile.half.dtype)
            top, left = TILE_PX // 2 * (row % 2), TILE_PX // 2 * (column % 2)
            parent[top : top + TILE_PX // 2, left : left + TILE_PX // 2] = tile.half
        is_last = (row % 2 == 1 or row + 1 == level.rows) and (column % 2 == 1 or column + 1 == level.columns)
        if is_last:
            whole = level.parents.pop(place, None)
            self._add(number + 1, None if whole is None else pack_tile(whole))

    def directories(self) -> list[Directory]:
        return [Directory(level.width, level.height, level.n_bytes) for level in self.levels]


@contextmanager
def cloud_optimised_geotiff(path: str | Path, frame: RasterFrame) -> Iterator[CogWriter]:
    """A raster to be written tile by tile; when the block ends it is whole, with its smaller versions.

    Memory does not grow with the raster, but for a row of tiles. Raises OutputError.
    """
    with atomic_path(path) as final, ExitStack() as open_files:
        description = described(Path(path), frame.crs, frame.crs_from_pixel, frame.bands)
        levels = []
        for k in range(1 + _halvings(frame.width, frame.height)):
            beyond_memory = open_files.enter_context(tempfile.TemporaryFile(dir=final.parent))
            spool = _Spool(beyond_memory, SPOOL_BYTES >> 2 * k)
            levels.append(_Level(-(-frame.width >> k), -(-frame.height >> k), spool))
        writer = CogWriter(frame, levels)
        yield writer
        with final.open("wb") as file:
            write_tiff(file, writer.directories(), description, TILE_PX)
            for level in reversed(levels):
                level.spool.copy_to(file)


def _halvings(width: int, height: int) -> int:
    """Until the picture is a single tile."""
    return max(0, math.ceil(math.log2(max(width, height) / TILE_PX)))
