"""Where products lie on Earth, and the Cloud Optimised GeoTIFFs that say so."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.shutil
from affine import Affine
from rasterio.crs import CRS
from rasterio.enums import Resampling

from overfly.errors import OutputError
from overfly.files import atomic_path
from overfly.geometry.poses import FloatArray

# Metres from the origin of the map, which lies nowhere in particular: programs that measure, measure right.
LOCAL_CRS = (
    'LOCAL_CS["Overfly map",LOCAL_DATUM["Origin of the map",32767],UNIT["metre",1],'
    'AXIS["East",EAST],AXIS["North",NORTH]]'
)


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


@contextmanager
def cloud_optimised_geotiff(
    path: str | Path, crs: str, resampling: Resampling = Resampling.average, **profile: Any
) -> Iterator[Any]:
    """A raster to be written window by window; when the block ends it becomes a COG with overviews, under
    ``path``.

    profile: width, height, count, dtype, transform, nodata as rasterio has them. The pixels pass through a
    plain tiled file beside the target, so that memory does not grow with the raster. Raises OutputError.
    """
    path = Path(path)
    working = {"tiled": True, "blockxsize": 256, "blockysize": 256, "compress": "lzw", "bigtiff": "if_safer"}
    with atomic_path(path) as final:
        draft = final.with_name(final.name + ".draft.tif")
        try:
            with rasterio.open(
                draft, "w", driver="GTiff", crs=CRS.from_user_input(crs), **working, **profile
            ) as raster:
                yield raster
            is_float = np.issubdtype(np.dtype(profile["dtype"]), np.floating)
            rasterio.shutil.copy(
                draft,
                final,
                driver="COG",
                compress="DEFLATE",
                predictor="FLOATING_POINT" if is_float else "STANDARD",
                blocksize=512,
                overview_resampling=resampling.name,
                num_threads="ALL_CPUS",
                bigtiff="IF_SAFER",
            )
        except rasterio.errors.RasterioError as error:
            raise OutputError(f"cannot write {path}: {error}") from error
        finally:
            draft.unlink(missing_ok=True)
