"""Where products lie on Earth, and the Cloud Optimised GeoTIFFs that say so."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import rasterio
import rasterio.shutil
from affine import Affine
from numpy.typing import NDArray
from rasterio._err import CPLE_BaseError  # GDAL's own; has no public name
from rasterio.crs import CRS
from rasterio.enums import Resampling
from rasterio.windows import Window

from overfly.errors import OutputError
from overfly.files import atomic_path
from overfly.geometry.poses import FloatArray

# Metres from the origin of the map, which lies nowhere in particular: programs that measure, measure right.
LOCAL_CRS = (
    'LOCAL_CS["Overfly map",LOCAL_DATUM["Origin of the map",32767],UNIT["metre",1],'
    'AXIS["East",EAST],AXIS["North",NORTH]]'
)

CACHE_MB = 128  # GDAL takes a twentieth of the machine's memory if it is let
DRAFT: dict[str, Any] = {
    "driver": "GTiff",
    "tiled": True,
    "blockxsize": 256,
    "blockysize": 256,
    "bigtiff": "if_safer",
    "sparse_ok": True,  # and not compressed: it is read once, soon
}
BLOCK_PX = 512
OVERVIEW_RESAMPLING = Resampling.average
FINAL: dict[str, Any] = {
    "compress": "DEFLATE",
    "level": "1",  # twice as fast as the default for two percent more bytes
    "blocksize": BLOCK_PX,
    "num_threads": "ALL_CPUS",
    "bigtiff": "IF_SAFER",
    "sparse_ok": True,
}


@dataclass(frozen=True, slots=True)
class GeoReference:
    """Similarity from the world to a map projection: crs_xy = scale * Rz(rotation) world_xy + translation.

    crs: "EPSG:32635" or WKT of a projection in metres; rotation_rad counter-clockwise; translation_m
    (east, north, up), metres of the CRS; heights are scaled and shifted alike.
    """

    crs: str
    scale: float
    rotation_rad: float
    translation_m: tuple[float, float, float]

    @staticmethod
    def local() -> GeoReference:
        """World coordinates as they are, in an engineering CRS."""
        return GeoReference(LOCAL_CRS, 1.0, 0.0, (0.0, 0.0, 0.0))

    def crs_from_world(self) -> Affine:
        """Of the plane: (x, y) metres of the world -> (east, north) metres of the CRS."""
        c = self.scale * math.cos(self.rotation_rad)
        s = self.scale * math.sin(self.rotation_rad)
        return Affine(c, -s, self.translation_m[0], s, c, self.translation_m[1])

    def height_in_crs(self, z_m: FloatArray) -> FloatArray:
        return self.scale * z_m + self.translation_m[2]


def transform_points(transform: Affine, points: FloatArray) -> FloatArray:
    """points: (..., 2) -> (..., 2) under a transform of the plane."""
    matrix = np.array([[transform.a, transform.b], [transform.d, transform.e]])
    return np.asarray(points @ matrix.T + np.array([transform.c, transform.f]))


@dataclass(slots=True)
class CheckedRaster:
    """A raster being written, with checksums: on a full disk GDAL can lose blocks without a word."""

    raster: Any
    written: list[tuple[Window, int]] = field(default_factory=list)

    def write(self, pixels: NDArray[Any], left: int = 0, top: int = 0) -> None:
        """pixels: (bands, h, w), whose top-left pixel goes to column ``left``, row ``top``."""
        window = Window(left, top, pixels.shape[2], pixels.shape[1])
        self.raster.write(pixels, window=window)
        self.written.append((window, crc32(pixels.tobytes())))

    def is_in(self, path: Path) -> bool:
        """Whether a file holds all that was written."""
        with rasterio.open(path) as raster:
            return all(
                crc32(raster.read(window=window).tobytes()) == checksum for window, checksum in self.written
            )


@contextmanager
def cloud_optimised_geotiff(path: str | Path, crs: str, **profile: Any) -> Iterator[CheckedRaster]:
    """A raster to be written window by window; when the block ends it becomes a COG with overviews.

    profile: width, height, count, dtype, transform, nodata as rasterio has them. The pixels pass through a
    plain tiled file beside the target, so that memory does not grow with the raster, and are read back and
    compared before the file gets its name. Raises OutputError.
    """
    path = Path(path)
    with rasterio.Env(GDAL_CACHEMAX=CACHE_MB), atomic_path(path) as final:
        draft = final.with_name(final.name + ".draft.tif")
        try:
            with rasterio.open(draft, "w", crs=CRS.from_user_input(crs), **DRAFT, **profile) as raster:
                checked = CheckedRaster(raster)
                yield checked
                # the COG driver takes them over; left to make them itself, it takes six times as long
                raster.build_overviews(_overview_factors(raster.width, raster.height), OVERVIEW_RESAMPLING)
            is_float = np.issubdtype(np.dtype(profile["dtype"]), np.floating)
            predictor = "FLOATING_POINT" if is_float else "STANDARD"
            rasterio.shutil.copy(draft, final, driver="COG", predictor=predictor, **FINAL)
            whole = checked.is_in(final)
        except (rasterio.errors.RasterioError, CPLE_BaseError) as error:
            raise OutputError(
                f"cannot write {path}: {error.__cause__ or error}; is the disk full?"
            ) from error
        finally:
            draft.unlink(missing_ok=True)
        if not whole:
            raise OutputError(f"cannot write {path}: what was written does not read back; is the disk full?")


def _overview_factors(width: int, height: int) -> list[int]:
    """Halvings until the picture is a single block."""
    halvings = max(0, math.ceil(math.log2(max(width, height) / BLOCK_PX)))
    return [2 << k for k in range(halvings)]
