"""Directories of a tiled GeoTIFF (TIFF 6.0 and BigTIFF; OGC 19-008 GeoTIFF), written by hand, so that they
may stand before the tiles."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio._err import CPLE_BaseError  # GDAL's own; has no public name
from rasterio.crs import CRS
from rasterio.io import MemoryFile

from overfly.errors import OutputError

if TYPE_CHECKING:
    from overfly.products.cog import Bands

SHORT, LONG, LONG8 = 3, 4, 16
TYPE_BYTES = {1: 1, 2: 1, SHORT: 2, LONG: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, LONG8: 8}
# TIFF tags
SUBFILE, WIDTH, LENGTH, BITS, COMPRESSION, PHOTOMETRIC = 254, 256, 257, 258, 259, 262
SAMPLES, PLANAR, PREDICTOR, TILE_WIDTH, TILE_LENGTH, OFFSETS, COUNTS = 277, 284, 317, 322, 323, 324, 325
EXTRA_SAMPLES, SAMPLE_FORMAT = 338, 339
OF_BANDS = {BITS, PHOTOMETRIC, SAMPLES, EXTRA_SAMPLES, SAMPLE_FORMAT}
NO_DATA = 42113
OF_THE_WHOLE = {33550, 33922, 34264, 34735, 34736, 34737, 42112}  # place, CRS, names of bands
DEFLATE, CHUNKY = 8, 1
REDUCED = 1  # a smaller version of the first picture

# how GDAL tells a COG; the last space is room for the YES of a program that breaks the layout
LAYOUT = (
    b"LAYOUT=IFDS_BEFORE_DATA\nBLOCK_ORDER=ROW_MAJOR\nBLOCK_LEADER=SIZE_AS_UINT4\n"
    b"BLOCK_TRAILER=LAST_4_BYTES_REPEATED\nKNOWN_INCOMPATIBLE_EDITION=NO\n "
)
GHOST = b"GDAL_STRUCTURAL_METADATA_SIZE=%06d bytes\n" % len(LAYOUT) + LAYOUT
LEADER_BYTES, TRAILER_BYTES = 4, 4  # around each tile: its size, and its end once more
MOST_IN_CLASSIC = 2**32 - 1


@dataclass(frozen=True, slots=True)
class Tag:
    """data: its values, little-endian."""

    code: int
    kind: int
    data: bytes

    @property
    def count(self) -> int:
        return len(self.data) // TYPE_BYTES[self.kind]


@dataclass(frozen=True, slots=True)
class Directory:
    """One size of the raster. n_bytes: of its compressed tiles, in their order, 0 for empty ones."""

    width: int
    height: int
    n_bytes: Sequence[int]

    def room(self) -> NDArray[np.uint64]:
        """(n,) bytes that each tile takes with what stands around it."""
        counts = np.array(self.n_bytes, dtype=np.uint64)
        return np.where(counts > 0, counts + np.uint64(LEADER_BYTES + TRAILER_BYTES), np.uint64(0))


def around_tile(data: bytes) -> tuple[bytes, bytes, bytes]:
    """A compressed tile as it stands in the file, without a copy of it."""
    return struct.pack("<I", len(data)), data, data[-TRAILER_BYTES:]


def described(path: Path, crs: str, crs_from_pixel: Affine, bands: Bands) -> list[Tag]:
    """Tags for place, CRS and bands as GDAL writes them. path: for the message. Raises OutputError."""
    extra = {"photometric": "RGB", "alpha": "yes"} if bands.is_colour else {"nodata": np.nan}
    try:
        with MemoryFile() as memory:
            with memory.open(
                driver="GTiff", width=16, height=16, count=bands.count, dtype=bands.dtype,
                crs=CRS.from_user_input(crs), transform=crs_from_pixel, interleave="pixel", **extra,
            ) as raster:  # fmt: skip
                if bands.names:
                    raster.descriptions = bands.names
                    raster.units = (bands.unit,) * bands.count
            tags = _first_directory(memory.read())
    except (rasterio.errors.RasterioError, rasterio.errors.CRSError, CPLE_BaseError) as error:
        raise OutputError(f"cannot write {path}: {error.__cause__ or error}") from error
    return [tag for tag in tags if tag.code in OF_BANDS | OF_THE_WHOLE | {NO_DATA}]


def _first_directory(file: bytes) -> list[Tag]:
    """The tags of a little-endian classic TIFF."""
    (start,) = struct.unpack_from("<I", file, 4)
    (count,) = struct.unpack_from("<H", file, start)
    tags = []
    for entry in range(start + 2, start + 2 + 12 * count, 12):
        code, kind, length = struct.unpack_from("<HHI", file, entry)
        size = length * TYPE_BYTES[kind]
        place = entry + 8 if size <= 4 else struct.unpack_from("<I", file, entry + 8)[0]
        tags.append(Tag(code, kind, file[place : place + size]))
    return tags


def write_tiff(
    file: IO[bytes], directories: Sequence[Directory], description: Sequence[Tag], tile_px: int
) -> None:
    """All that stands before the tiles, which must follow without a gap, the last directory's first.

    directories: the full size first. Raises OSError.
    """
    n_bytes = sum(int(directory.room().sum()) for directory in directories)
    n_tiles = sum(len(directory.n_bytes) for directory in directories)
    is_big = n_bytes + 32 * n_tiles + 100_000 > MOST_IN_CLASSIC
    head = (b"II+\0" + struct.pack("<HHQ", 8, 0, 16 + len(GHOST))) if is_big else (
        b"II*\0" + struct.pack("<I", 8 + len(GHOST)))  # fmt: skip
    # their length does not depend on where the tiles begin
    begins = len(head) + len(GHOST) + len(_directories(directories, description, tile_px, 0, 0, is_big))
    body = _directories(directories, description, tile_px, len(head) + len(GHOST), begins, is_big)
    file.write(head + GHOST + body)


def _directories(
    directories: Sequence[Directory],
    description: Sequence[Tag],
    tile_px: int,
    begins: int,
    data_begins: int,
    is_big: bool,
) -> bytes:
    """All directories, from ``begins`` on, of tiles that stand from ``data_begins`` on."""
    starts, place = [], data_begins
    for directory in reversed(directories):
        starts.append(place)
        place += int(directory.room().sum())
    body = b""
    for number, (directory, start) in enumerate(zip(directories, reversed(starts), strict=True)):
        kept = description if number == 0 else [tag for tag in description if tag.code not in OF_THE_WHOLE]
        tags = sorted([*kept, *_tags(directory, kept, number, start, tile_px, is_big)], key=_code)
        is_last = number + 1 == len(directories)
        body += _directory(tags, begins + len(body), is_last, is_big)
    return body


def _code(tag: Tag) -> int:
    return tag.code


def _tags(
    directory: Directory, bands: Sequence[Tag], number: int, start: int, tile_px: int, is_big: bool
) -> list[Tag]:
    """What one directory says of its size and its tiles, which stand from ``start`` on."""
    counts, room = np.array(directory.n_bytes, dtype=np.uint64), directory.room()
    places = np.uint64(start + LEADER_BYTES) + np.cumsum(room) - room
    offsets = np.where(counts > 0, places, np.uint64(0))  # 0: an empty tile
    is_float = any(tag.code == SAMPLE_FORMAT and tag.data[:2] == b"\3\0" for tag in bands)
    wide, wide_type = (LONG8, "<u8") if is_big else (LONG, "<u4")
    return [
        _number(SUBFILE, LONG, REDUCED if number else 0),
        _number(WIDTH, LONG, directory.width),
        _number(LENGTH, LONG, directory.height),
        _number(COMPRESSION, SHORT, DEFLATE),
        _number(PLANAR, SHORT, CHUNKY),
        _number(PREDICTOR, SHORT, 3 if is_float else 2),
        _number(TILE_WIDTH, SHORT, tile_px),
        _number(TILE_LENGTH, SHORT, tile_px),
        Tag(OFFSETS, wide, offsets.astype(wide_type).tobytes()),
        Tag(COUNTS, LONG, counts.astype("<u4").tobytes()),
    ]


def _number(code: int, kind: int, value: int) -> Tag:
    return Tag(code, kind, struct.pack("<H" if kind == SHORT else "<I", value))


def _directory(tags: Sequence[Tag], begins: int, is_last: bool, is_big: bool) -> bytes:
    """One directory at ``begins``, and behind it what does not fit into it; the next follows at once."""
    count, entry, word, inline = ("<Q", "<HHQ", "<Q", 8) if is_big else ("<H", "<HHI", "<I", 4)
    size = struct.calcsize(count) + len(tags) * (struct.calcsize(entry) + inline) + inline
    entries, beyond = struct.pack(count, len(tags)), b""
    for tag in tags:
        if len(tag.data) <= inline:
            value = tag.data.ljust(inline, b"\0")
        else:
            value = struct.pack(word, begins + size + len(beyond))
            beyond += tag.data + b"\0" * (len(tag.data) % 2)  # values begin at even places
        entries += struct.pack(entry, tag.code, tag.kind, tag.count) + value
    after = 0 if is_last else begins + size + len(beyond)
    return entries + struct.pack(word, after) + beyond
