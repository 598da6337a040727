"""Real ground: a user's GeoTIFF orthophoto, with a surface model when there is one."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from affine import Affine

from overfly.errors import SourceError, UsageError
from overfly.geometry.poses import FloatArray
from overfly.simulation.patches import Patch
from overfly.simulation.relief import HeightField, build_relief, flat_relief
from overfly.simulation.scenario import Scenario
from overfly.types import BoolArray, Float32Array, UInt8Array

_MOST_PIXELS = 80_000_000
_SIDE_OF_DSM = 3000


@dataclass(frozen=True, slots=True, eq=False)
class OrthoGround:
    """An orthophoto as ground. levels: the picture and its halves (h, w, 3); pixel_from_world (2, 3) of the
    first.
    """

    levels: tuple[UInt8Array, ...]
    pixel_from_world: FloatArray
    pixel_m: float

    def paint(self, patch: Patch) -> Float32Array:
        """(n, n, 3) linear reflectance; mid grey beyond the picture."""
        fitting = math.floor(math.log2(max(1.0, patch.texel_m / self.pixel_m)))
        level = min(len(self.levels) - 1, fitting)
        scale = 0.5**level
        A = self.pixel_from_world
        step = patch.texel_m
        corner = A[:, :2] @ np.array([patch.x0 + 0.5 * step, patch.y0 + 0.5 * step]) + A[:, 2]
        placed = np.column_stack([A[:, :2] * step * scale, (corner + 0.5) * scale - 0.5])
        finer = level == 0 and step < self.pixel_m
        codes = cv2.warpAffine(
            self.levels[level],
            placed,
            (patch.n, patch.n),
            flags=(cv2.INTER_CUBIC if finer else cv2.INTER_LINEAR) | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(110.0, 110.0, 110.0),
        )
        return np.asarray((codes.astype(np.float32) / np.float32(255.0)) ** np.float32(2.2), dtype=np.float32)


def over_orthophoto(
    built: Scenario, ortho: Path, dsm: Path | None, height_m: float | None, seed: int
) -> Scenario:
    """The scenario with its world replaced: the middle of its bounds lies on the middle of the orthophoto.

    ``survey`` is planned anew over the whole picture, at height_m (80 m unless said). Heights are above the
    median of the surface model. Raises SourceError for files that cannot be used and UsageError when the
    flight does not fit.
    """
    if built.name != "survey" and height_m is not None:
        raise UsageError("--height-m plans a survey: use the scenario 'survey' with it")
    x0, y0, x1, y1 = built.bounds_m
    survey = built.name == "survey"
    middle = (0.0, 0.0) if survey else (0.5 * (x0 + x1), 0.5 * (y0 + y1))
    ground, bounds, place = load_orthophoto(ortho, middle)
    relief = load_relief(dsm, place) if dsm is not None else flat_relief()
    if survey:
        from overfly.simulation.scenarios.surveys import survey_over

        height = height_m or 80.0
        margin = min(0.5 * height, 0.25 * min(bounds[2] - bounds[0], bounds[3] - bounds[1]))
        made = survey_over("survey", ground, relief, bounds, seed, height_m=height, margin_m=margin)
        return dataclasses.replace(made, origin_lat_lon_alt=place.origin, crs=place.crs)
    if x1 - x0 > bounds[2] - bounds[0] or y1 - y0 > bounds[3] - bounds[1]:
        raise UsageError(
            f"'{built.name}' needs {x1 - x0:.0f} m x {y1 - y0:.0f} m of ground; {ortho} shows "
            f"{bounds[2] - bounds[0]:.0f} m x {bounds[3] - bounds[1]:.0f} m: use a larger one, or 'survey'"
        )
    return dataclasses.replace(
        built, ground=ground, relief=relief, landmarks=(), scale_object=None,
        origin_lat_lon_alt=place.origin, crs=place.crs,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Place:
    """Where the world's origin is: its map coordinates in ``crs``, and its geographic position."""

    crs: str
    east_m: float
    north_m: float
    origin: tuple[float, float, float]


def load_orthophoto(
    path: Path, middle: tuple[float, float]
) -> tuple[OrthoGround, tuple[float, float, float, float], Place]:
    """The picture as ground, the box that it fills in the world, and where the world's origin is.

    The middle of that box lies at world ``middle``. What the file leaves empty around it has the mean colour.
    """
    with _opened(path) as source:
        if source.count not in (1, 3, 4):
            raise SourceError(f"{path}: an orthophoto has 1, 3 or 4 bands, this file has {source.count}")
        if source.dtypes[0] != "uint8":
            raise SourceError(f"{path}: an orthophoto of 8-bit values is wanted, not {source.dtypes[0]}")
        shrink = max(1.0, math.sqrt(source.width * source.height / _MOST_PIXELS))
        rows, cols = int(source.height / shrink), int(source.width / shrink)
        bands = [1, 1, 1] if source.count == 1 else [1, 2, 3]
        picture = np.ascontiguousarray(np.moveaxis(source.read(bands, out_shape=(3, rows, cols)), 0, -1))
        affine = _scaled(source.transform, source.width / cols, source.height / rows)
        crs = source.crs
        shown = (source.dataset_mask(out_shape=(rows, cols)) > 0) & (picture.max(axis=2) > 0)
    if not shown.any():
        raise SourceError(f"{path}: the orthophoto is empty")
    picture[~shown] = picture[shown][:: max(1, int(shown.sum()) // 10_000)].mean(axis=0)
    row0, row1, col0, col1 = _full_box(shown)
    east, north = _apply(affine, 0.5 * (col0 + col1), 0.5 * (row0 + row1))
    east, north = east - middle[0], north - middle[1]
    # world -> map -> pixel; pixel centres at half coordinates of the file's own transform
    back = ~affine
    A = np.array([[back.a, back.b, 0.0], [back.d, back.e, 0.0]])
    A[:, 2] = np.array(_apply(back, east, north)) - 0.5
    pixel = math.sqrt(abs(affine.a * affine.e - affine.b * affine.d))
    corners = np.array(
        [_apply(affine, *corner) for corner in ((col0, row0), (col1, row0), (col0, row1), (col1, row1))]
    )
    low, high = corners.min(axis=0) - (east, north), corners.max(axis=0) - (east, north)
    levels = [picture]
    while min(levels[-1].shape[:2]) >= 4:
        half = cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(half, dtype=np.uint8))
    bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    return OrthoGround(tuple(levels), A, pixel), bounds, _place(crs, east, north)


def load_relief(path: Path, place: Place) -> HeightField:
    """A surface model as relief, in the world of ``place``; holes take the height nearest to them.

    It adds no light and shade of its own: the orthophoto has those of its day.
    """
    from rasterio.warp import Resampling
    from scipy.ndimage import distance_transform_edt

    with _opened(path, place.crs) as source:
        shrink = max(1.0, max(source.width, source.height) / _SIDE_OF_DSM)
        shape = (int(source.height / shrink), int(source.width / shrink))
        z = source.read(1, out_shape=shape, resampling=Resampling.average, masked=True).astype(np.float64)
        affine = _scaled(source.transform, source.width / shape[1], source.height / shape[0])
    z = np.where(np.isfinite(z.filled(np.nan)), z.filled(np.nan), np.nan)
    empty = np.isnan(z)
    if empty.all():
        raise SourceError(f"{path}: the surface model holds no heights")
    nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
    z = z[tuple(nearest)]
    z -= np.median(z[~empty])
    if affine.b or affine.d or abs(affine.a + affine.e) > 1e-6 * affine.a:
        raise SourceError(
            f"{path}: the surface model must be north-up with square cells: warp it first (gdalwarp)"
        )
    x0, y_top = _apply(affine, 0.5, 0.5)
    y0 = y_top + affine.e * (z.shape[0] - 1)
    rim = np.concatenate([z[0], z[-1], z[:, 0], z[:, -1]])
    return build_relief(
        z[::-1], x0 - place.east_m, y0 - place.north_m, affine.a, border_m=float(np.median(rim)), shaded=False
    )


def _opened(path: Path, crs: str | None = None):  # type: ignore[no-untyped-def]
    """The raster in map coordinates of metres: its own, those of ``crs``, or the UTM zone of its middle."""
    import rasterio
    from rasterio.vrt import WarpedVRT

    try:
        source = rasterio.open(path)
    except rasterio.RasterioIOError as error:
        raise SourceError(f"{path}: not a raster that can be read: {error}") from error
    if source.crs is None:
        raise SourceError(f"{path}: the file has no coordinate system: give it one (gdal_edit.py -a_srs)")
    wanted = crs or (source.crs if source.crs.is_projected else _utm_of(source))
    if source.crs == rasterio.crs.CRS.from_user_input(wanted):
        return source
    return WarpedVRT(source, crs=wanted, resampling=rasterio.enums.Resampling.bilinear)


def _full_box(shown: BoolArray) -> tuple[int, int, int, int]:
    """Rows and columns (first, end, first, end) of a box nearly all shown: the emptiest side gives way."""
    box = [0, shown.shape[0], 0, shown.shape[1]]
    step = max(1, max(shown.shape) // 200)
    while min(box[1] - box[0], box[3] - box[2]) > 8 * step:
        inside = shown[box[0] : box[1], box[2] : box[3]]
        if inside.mean() > 0.98:
            break
        sides = (inside[:step], inside[-step:], inside[:, :step], inside[:, -step:])
        emptiest = int(np.argmin([side.mean() for side in sides]))
        box[emptiest] += step if emptiest % 2 == 0 else -step
    return box[0], box[1], box[2], box[3]


def _scaled(transform: Affine, x: float, y: float) -> Affine:
    """The transform of a raster that was read with pixels x and y times as large."""
    a, b, c, d, e, f = transform[:6]
    return Affine(a * x, b * y, c, d * x, e * y, f)


def _apply(transform: Affine, col: float, row: float) -> tuple[float, float]:
    a, b, c, d, e, f = transform[:6]
    return a * col + b * row + c, d * col + e * row + f


def _utm_of(source) -> str:  # type: ignore[no-untyped-def]
    middle = 0.5 * (source.bounds.left + source.bounds.right)
    north = source.bounds.top + source.bounds.bottom > 0
    return f"EPSG:{(32600 if north else 32700) + int((middle + 180.0) // 6.0) + 1}"


def _place(crs, east: float, north: float) -> Place:  # type: ignore[no-untyped-def]
    from pyproj import Transformer

    to_geographic = Transformer.from_crs(crs.to_wkt(), "EPSG:4326", always_xy=True)
    longitude, latitude = to_geographic.transform(east, north)
    return Place(crs.to_wkt(), east, north, (latitude, longitude, 0.0))
