"""A raster that grows in every direction while it is in use: drawn tiles wait compressed in memory, and at
any moment a whole file is made of them, into which they are only copied."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from affine import Affine
from isal import isal_zlib

from overfly.files import atomic_path
from overfly.products.cog import DEFLATE_LEVEL, RGBA, TILE_PX, PackedTile, pack_tile
from overfly.products.georeference import LOCAL_CRS
from overfly.products.tiff import Directory, around_tile, described, write_tiff
from overfly.types import UInt8Array

LEAST_ACROSS = 4  # tiles of the smallest version: a raster begins where a tile of that begins

Place = tuple[int, int]  # row and column of a tile, counted from the world's origin, downwards and eastwards


@dataclass(frozen=True, slots=True)
class _Kept:
    """A tile as it goes into the file, and at half its size, compressed too."""

    data: bytes
    half: bytes

    @staticmethod
    def of(tile: PackedTile) -> _Kept:
        return _Kept(tile.data, isal_zlib.compress(tile.half, DEFLATE_LEVEL))

    def halved(self) -> UInt8Array:
        pixels = np.frombuffer(isal_zlib.decompress(self.half), np.uint8)
        return pixels.reshape(TILE_PX // 2, TILE_PX // 2, RGBA.count)


@dataclass(slots=True, eq=False)
class _Level:
    """One size of the raster. stale: tiles whose parts have changed in the next larger size."""

    tiles: dict[Place, _Kept] = field(default_factory=dict)
    stale: set[Place] = field(default_factory=set)


@dataclass(slots=True, eq=False)
class GrowingRaster:
    """RGBA tiles of TILE_PX pixels, each px_m long; tile (0, 0) has the world's origin at its top left."""

    px_m: float
    _levels: list[_Level] = field(default_factory=lambda: [_Level(), _Level()])

    @property
    def n_bytes(self) -> int:
        """What is kept in memory."""
        kept = (tile for level in self._levels for tile in level.tiles.values())
        return sum(len(tile.data) + len(tile.half) for tile in kept)

    def places(self) -> list[Place]:
        """Of the tiles that show something."""
        return list(self._levels[0].tiles)

    def put(self, place: Place, tile: UInt8Array | None) -> None:
        """A tile as it is from now on, (TILE_PX, TILE_PX, 4); None where nothing is seen."""
        self._put(0, place, tile)

    def coarsen(self) -> None:
        """Pixels twice as long: four tiles become one."""
        self._renew(1)
        del self._levels[0]
        self._levels += [_Level()] if len(self._levels) < 2 else []
        self.px_m *= 2.0

    def save(self, path: str | Path, scale: float = 1.0) -> None:
        """The whole file, in the local CRS. scale: the world's metre by that of px_m. Raises OutputError."""
        places = np.array(self.places())
        low, high = places.min(axis=0), places.max(axis=0) + 1
        n_smaller = _halvings(int((high - low).max()))
        for number in range(1, n_smaller + 1):
            self._renew(number)
        low = (low >> n_smaller) << n_smaller
        px_m = scale * self.px_m
        crs_from_px = Affine(px_m, 0.0, low[1] * TILE_PX * px_m, 0.0, -px_m, -low[0] * TILE_PX * px_m)
        height, width = (TILE_PX * (high - low)).tolist()
        sizes = [self._in_order(k, low >> k, -(-(high - low) >> k)) for k in range(n_smaller + 1)]
        directories = [
            Directory(-(-width >> k), -(-height >> k), [len(data) for data in size])
            for k, size in enumerate(sizes)
        ]
        with atomic_path(path) as final:
            description = described(Path(path), LOCAL_CRS, crs_from_px, RGBA)
            with final.open("wb") as file:
                write_tiff(file, directories, description, TILE_PX)
                for size in reversed(sizes):
                    for data in size:
                        if data:
                            file.writelines(around_tile(data))

    def _put(self, number: int, place: Place, tile: UInt8Array | None) -> None:
        tiles = self._levels[number].tiles
        if tile is not None:
            tiles[place] = _Kept.of(pack_tile(tile))
        elif place in tiles:
            del tiles[place]
        else:
            return
        if number + 1 == len(self._levels):
            self._levels.append(_Level())
        self._levels[number + 1].stale.add((place[0] // 2, place[1] // 2))

    def _renew(self, number: int) -> None:
        """Make the stale tiles of a size anew; the next larger size is as it should be."""
        stale, self._levels[number].stale = self._levels[number].stale, set()
        for row, column in stale:
            whole, half = np.zeros((TILE_PX, TILE_PX, RGBA.count), np.uint8), TILE_PX // 2
            for y in (0, 1):
                for x in (0, 1):
                    part = self._levels[number - 1].tiles.get((2 * row + y, 2 * column + x))
                    if part is not None:
                        whole[half * y : half * (y + 1), half * x : half * (x + 1)] = part.halved()
            self._put(number, (row, column), whole if whole[..., 3].any() else None)

    def _in_order(self, number: int, low: np.ndarray, count: np.ndarray) -> list[bytes]:
        """Compressed tiles of a size, row by row; none where nothing is seen."""
        tiles = self._levels[number].tiles
        rows, columns = (
            range(first, first + n) for first, n in zip(low.tolist(), count.tolist(), strict=True)
        )
        return [
            tiles[row, column].data if (row, column) in tiles else b"" for row in rows for column in columns
        ]


def _halvings(n_tiles: int) -> int:
    """Smaller versions, of a raster that is so many tiles long."""
    return max(0, (n_tiles // LEAST_ACROSS).bit_length() - 1)
