"""The map put over another one: an occupancy grid, a floor plan, a satellite picture (paper, Fig. 9).

Two maps are laid on each other by a similarity of the plane, from points that are known in both, or by their
coordinate reference systems where both have one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
import yaml
from affine import Affine

from overfly.errors import OutputError, SourceError
from overfly.files import atomic_path
from overfly.geometry.poses import FloatArray
from overfly.products.cog import TILE_PX, RasterFrame, cloud_optimised_geotiff
from overfly.products.georeference import LOCAL_CRS, transform_points
from overfly.products.pictures import MapPicture
from overfly.types import UInt8Array

MOST_PIXELS = 60_000_000
FINEST = 8  # pixels of the drawing along one of the other map's, at most
PICTURES = (".png", ".jpg", ".jpeg")  # written with a world file beside them, all else as GeoTIFF


@dataclass(frozen=True, slots=True, eq=False)
class OtherMap:
    """rgba (h, w, 4); xy_from_pixel: pixel corners to its own coordinates, y up; crs: WKT, empty for none."""

    path: Path
    rgba: UInt8Array
    xy_from_pixel: Affine
    crs: str

    @property
    def pixel(self) -> float:
        """Length of a pixel in its own unit."""
        return float(np.sqrt(abs(self.xy_from_pixel.determinant)))


@dataclass(frozen=True, slots=True, eq=False)
class PlaneFit:
    """xy_from_world: similarity of the plane; residuals (n,) in units of the other map, of the pairs."""

    xy_from_world: Affine
    residuals: FloatArray

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(self.residuals**2))) if len(self.residuals) else 0.0


def fit_plane(world: FloatArray, xy: FloatArray) -> PlaneFit:
    """Least-squares similarity from points (n, 2) of the world to (n, 2) of the other map, n >= 2.

    Raises SourceError when all of either are in one place.
    """
    a, b = world[:, 0] + 1j * world[:, 1], xy[:, 0] + 1j * xy[:, 1]
    from_middle = a - a.mean()
    spread = float((np.abs(from_middle) ** 2).sum())
    if len(a) < 2 or spread <= 0 or np.ptp(xy, axis=0).max() <= 0:
        raise SourceError("two maps are laid on each other by two points or more, at different places")
    turn = (np.conj(from_middle) * (b - b.mean())).sum() / spread
    shift = b.mean() - turn * a.mean()
    fit = Affine(turn.real, -turn.imag, shift.real, turn.imag, turn.real, shift.imag)
    return PlaneFit(fit, np.abs(turn * a + shift - b))


def read_other_map(path: Path) -> OtherMap:
    """A GeoTIFF, a picture with or without a world file, or a YAML of ROS's map_server.

    A picture that says nothing of its place has x = column and y = -row. Raises SourceError.
    """
    if path.suffix.lower() in (".yaml", ".yml"):
        return _read_grid_map(path)
    try:
        with rasterio.open(path) as raster:
            bands = raster.read(list(range(1, min(raster.count, 4) + 1)))
            mask = raster.dataset_mask()
            transform, crs = raster.transform, raster.crs.to_wkt() if raster.crs else ""
    except (rasterio.errors.RasterioError, OSError) as error:
        raise SourceError(f"cannot read {path}: {error}") from error
    if transform == Affine.identity():
        transform = Affine(1.0, 0.0, 0.0, 0.0, -1.0, 0.0)
    return OtherMap(path, _as_rgba(bands, mask), transform, crs)


def _read_grid_map(path: Path) -> OtherMap:
    try:
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
        picture = path.parent / tree["image"]
        step = float(tree["resolution"])
        x, y, yaw = (float(value) for value in tree["origin"])
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise SourceError(f"{path} is no map of ROS's map_server: {error}") from error
    pixels = cv2.imread(str(picture), cv2.IMREAD_COLOR)
    if pixels is None:
        raise SourceError(f"{path}: its image {picture} cannot be read")
    place = Affine.translation(x, y) @ Affine.rotation(np.degrees(yaw)) @ Affine.scale(step, -step)
    place = place @ Affine.translation(0.0, -pixels.shape[0])
    rgba = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGBA), np.uint8)
    return OtherMap(path, rgba, place, "")


def _as_rgba(bands: np.ndarray, mask: UInt8Array) -> UInt8Array:
    """(h, w, 4) of one to four bands of any type; heights and the like are stretched to gray."""
    if bands.dtype != np.uint8:
        low, high = np.nanpercentile(bands[0], [2, 98])
        gray = np.clip((np.nan_to_num(bands[:1], nan=low) - low) / max(high - low, 1e-9), 0, 1)
        bands = np.asarray(255 * gray, np.uint8)
    colours = bands[:3] if len(bands) >= 3 else np.repeat(bands[:1], 3, axis=0)
    return np.ascontiguousarray(np.concatenate([colours, mask[None]]).transpose(1, 2, 0))


def write_overlay(
    path: Path,
    picture: MapPicture,
    other: OtherMap,
    world_from_xy: Callable[[FloatArray], FloatArray],
    opacity: float = 0.8,
) -> tuple[int, int]:
    """Draw the map over the other one, over the ground of both; returns width and height in pixels.

    world_from_xy: (..., 2) coordinates of the other map to the world's. A .png or .jpg gets a world file, all
    else is a Cloud Optimised GeoTIFF in the other map's CRS. Raises OutputError.
    """
    xy_from_pixel, width, height = _frame(picture, other, world_from_xy)

    def rows(top: int, count: int) -> UInt8Array:
        column, row = np.arange(width) + 0.5, np.arange(top, top + count) + 0.5
        xy = transform_points(xy_from_pixel, np.stack(np.meshgrid(column, row), axis=-1))
        under = _sampled(other.rgba, transform_points(~other.xy_from_pixel, xy))
        over = _sampled(picture.rgba, picture.pixels_from_world(world_from_xy(xy)))
        share = opacity * over[..., 3:] / 255.0
        share = np.where(under[..., 3:] > 0, share, (over[..., 3:] > 0) * 1.0)
        colour = under[..., :3] * (1.0 - share) + over[..., :3] * share
        alpha = np.maximum(under[..., 3:], over[..., 3:])
        return np.concatenate([np.clip(colour + 0.5, 0, 255), alpha], axis=-1).astype(np.uint8)

    blocks = [(top, min(TILE_PX, height - top)) for top in range(0, height, TILE_PX)]
    if path.suffix.lower() in PICTURES:
        _write_picture(path, np.concatenate([rows(*block) for block in blocks]), xy_from_pixel)
        return width, height
    with cloud_optimised_geotiff(
        path, RasterFrame(other.crs or LOCAL_CRS, xy_from_pixel, width, height)
    ) as raster:
        for block in blocks:
            raster.write(rows(*block))
    return width, height


def _frame(
    picture: MapPicture, other: OtherMap, world_from_xy: Callable[[FloatArray], FloatArray]
) -> tuple[Affine, int, int]:
    """xy_from_pixel, width and height of a raster parallel to the other map's, around both."""
    rows, columns = other.rgba.shape[:2]
    # how the world lies in the other map, from three points of it: also through a change of projection
    corners = transform_points(other.xy_from_pixel, np.array([[0.0, 0.0], [columns, 0.0], [0.0, rows]]))
    a, b, c = world_from_xy(corners)
    world_from_other = np.column_stack([(b - a) / columns, (c - a) / rows])
    h, w = picture.rgba.shape[:2]
    outline = np.array([[0, 0], [w, 0], [0, h], [w, h]], float)
    mine = (transform_points(picture.world_from_pixel, outline) - a) @ np.linalg.inv(world_from_other).T
    both = np.concatenate([mine, [[0.0, 0.0], [columns, rows]]])
    low, high = np.floor(both.min(axis=0)), np.ceil(both.max(axis=0))
    size = high - low
    per_pixel = float(np.sqrt(abs(np.linalg.det(world_from_other)))) / picture.metres_per_px
    finest = np.sqrt(MOST_PIXELS / float(np.prod(size)))
    scale = min(float(np.clip(np.ceil(per_pixel), 1, FINEST)), finest)
    place = other.xy_from_pixel @ Affine.translation(*low) @ Affine.scale(1.0 / scale)
    return place, max(1, int(size[0] * scale)), max(1, int(size[1] * scale))


def _sampled(rgba: UInt8Array, px: FloatArray) -> np.ndarray:
    """(h, w, 4) float32 at pixel corners px (h, w, 2); transparent beyond the picture."""
    place = (px - 0.5).astype(np.float32)
    return np.asarray(
        cv2.remap(rgba, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT),
        np.float32,
    )


def _write_picture(path: Path, rgba: UInt8Array, xy_from_pixel: Affine) -> None:
    """A picture and its world file, whose first letters are the first and last of the picture's ending."""
    bgr = cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA if path.suffix.lower() == ".png" else cv2.COLOR_RGBA2BGR)
    with atomic_path(path) as temporary:
        if not cv2.imwrite(str(temporary), bgr):
            raise OutputError(f"cannot write {path}; is the disk full, or the folder missing?")
    t = xy_from_pixel @ Affine.translation(0.5, 0.5)  # world files mean the middle of the first pixel
    numbers = (t.a, t.d, t.b, t.e, t.c, t.f)
    with atomic_path(path.with_suffix(f".{path.suffix[1]}{path.suffix[-1]}w")) as temporary:
        temporary.write_text("".join(f"{number:.12g}\n" for number in numbers), encoding="ascii")
