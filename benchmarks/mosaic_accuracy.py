"""Mosaic and elevation against the true orthophoto and surface.

python benchmarks/mosaic_accuracy.py OUT FLIGHT [OUT FLIGHT ...] [--sim3]

OUT: a folder that `overfly map` left; FLIGHT: the simulated flight it was made from, with its truth. The map
is laid on the truth by the rigid motion that fits the cameras' positions best (a similarity with --sim3), so
what is left is what the products add to the poses, and the poses' own errors.

Mosaic: corners of the mosaic are found again in the true orthophoto by pyramidal Lucas-Kanade, both ways; how
far they are off is given in pixels of the mosaic: as the cameras lay it (cameras that all hang askew by an
angle stand beside the ground by their height times that), as the rigid motion of the plane lays it that fits
the ground itself best, and as the similarity does. Elevation: every known cell against the true surface.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from affine import Affine
from scipy import ndimage

from overfly.evaluation import Align, Similarity, evaluate
from overfly.geometry.poses import FloatArray
from overfly.mapstore import Map
from overfly.products.elevation import ElevationGrid, read_elevation
from overfly.products.georeference import GeoReference, transform_points
from overfly.trajectory import read_tum
from overfly.types import BoolArray, UInt8Array

RETURN_PX = 0.5  # a corner that is not found again this near, coming back, is a wrong match
WINDOW_PX = 31
MOST_CORNERS = 20_000
LARGEST_SIDE_PX = 6000


@dataclass(frozen=True)
class Truth:
    """The ground as the simulator knows it: ortho (h, w) gray with its place, dsm with its place."""

    ortho: UInt8Array
    ortho_x0: float
    ortho_y1: float
    texel_m: float
    dsm: FloatArray
    dsm_x0: float
    dsm_y1: float
    cell_m: float

    @staticmethod
    def read(scene: Path) -> Truth:
        tree = json.loads((scene / "scene.json").read_text())
        ortho = np.asarray(cv2.imread(str(scene / "ortho.jpg"), cv2.IMREAD_GRAYSCALE), np.uint8)
        place, dsm = tree["ortho"], tree["dsm"]
        texel = place["texel_m"] * place["width"] / ortho.shape[1]  # some are kept at half their resolution
        heights = np.load(scene / "dsm.npz")["dsm"].astype(np.float64)
        return Truth(ortho, place["x0"], place["y1"], texel, heights, dsm["gx0"], dsm["gy1"], dsm["cell_m"])

    def height_at(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """(n,) metres, bilinear."""
        place = ((self.dsm_y1 - y) / self.cell_m, (x - self.dsm_x0) / self.cell_m)
        return ndimage.map_coordinates(self.dsm, place, order=1, mode="nearest")

    def steepness_at(self, x: FloatArray, y: FloatArray, reach_m: float) -> FloatArray:
        """(n,) how much the true height changes within reach_m."""
        size = 2 * max(1, round(reach_m / self.cell_m)) + 1
        change = ndimage.maximum_filter(self.dsm, size) - ndimage.minimum_filter(self.dsm, size)
        place = ((self.dsm_y1 - y) / self.cell_m, (x - self.dsm_x0) / self.cell_m)
        return ndimage.map_coordinates(change, place, order=0, mode="nearest")

    def picture_at(self, x: FloatArray, y: FloatArray) -> UInt8Array:
        column = ((x - self.ortho_x0) / self.texel_m - 0.5).astype(np.float32)
        row = ((self.ortho_y1 - y) / self.texel_m - 0.5).astype(np.float32)
        found = cv2.remap(self.ortho, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return np.asarray(found, np.uint8)


def elevation_errors(grid: ElevationGrid, truth_from_world: Similarity, truth: Truth) -> FloatArray:
    """(k, 3): error in metres, in sigmas, and the true relief within two cells, of every known cell."""
    rows, columns = np.nonzero(np.isfinite(grid.heights))
    x = grid.x0_m + (columns + 0.5) * grid.cell_m
    y = grid.y0_m - (rows + 0.5) * grid.cell_m
    there = truth_from_world.transform(np.column_stack([x, y, grid.heights[rows, columns]]))
    error = there[:, 2] - truth.height_at(there[:, 0], there[:, 1])
    relief = truth.steepness_at(there[:, 0], there[:, 1], 2 * grid.cell_m)
    return np.column_stack([error, error / grid.sigma[rows, columns], relief])


def mosaic_displacements(
    path: Path,
    reference: GeoReference,
    ground: ElevationGrid | None,
    truth_from_world: Similarity,
    truth: Truth,
) -> tuple[FloatArray, FloatArray, float]:
    """(k, 2) corners that were found again and (k, 2) their displacements, in mosaic pixels; their share."""
    with rasterio.open(path) as raster:
        factor = max(1.0, max(raster.width, raster.height) / LARGEST_SIDE_PX)
        size = (round(raster.height / factor), round(raster.width / factor))
        rgba = raster.read(out_shape=(4, *size)).transpose(1, 2, 0)
        transform = raster.transform @ Affine.scale(raster.width / size[1], raster.height / size[0])
    world_from_pixel = ~reference.crs_from_world() @ transform
    gray, seen = cv2.cvtColor(rgba[..., :3], cv2.COLOR_RGB2GRAY), rgba[..., 3] == 255
    there = truth_picture(world_from_pixel, gray.shape, ground, truth_from_world, truth)
    corners, shifts, share = displacements(gray, there, seen & (there > 0))
    return corners * factor, shifts * factor, share


def truth_picture(
    world_from_pixel: Affine,
    shape: tuple[int, int],
    ground: ElevationGrid | None,
    truth_from_world: Similarity,
    truth: Truth,
) -> UInt8Array:
    """The true orthophoto on the mosaic's pixels."""
    picture = np.zeros(shape, np.uint8)
    column = np.arange(shape[1]) + 0.5
    for top in range(0, shape[0], 256):
        row = np.arange(top, min(top + 256, shape[0])) + 0.5
        world = transform_points(world_from_pixel, np.stack(np.meshgrid(column, row), axis=-1))
        z = np.zeros(world.shape[:2]) if ground is None else ground.height_at(world[..., 0], world[..., 1])
        there = truth_from_world.transform(np.concatenate([world, z[..., None]], axis=-1))
        picture[top : top + len(row)] = truth.picture_at(there[..., 0], there[..., 1])
    return picture


def displacements(
    one: UInt8Array, other: UInt8Array, both: BoolArray
) -> tuple[FloatArray, FloatArray, float]:
    """(k, 2) corners of one picture that the other has, too, (k, 2) pixels from there to where it has them,
    and their share."""
    inner = cv2.erode(both.astype(np.uint8), np.ones((WINDOW_PX, WINDOW_PX), np.uint8))
    a, b = flattened(one), flattened(other)
    corners = cv2.goodFeaturesToTrack(a, MOST_CORNERS, 0.02, 6.0, mask=inner)
    window = (WINDOW_PX, WINDOW_PX)
    start = np.empty_like(corners)
    there, ok, _ = cv2.calcOpticalFlowPyrLK(a, b, corners, start, winSize=window, maxLevel=4)
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(b, a, there, start.copy(), winSize=window, maxLevel=4)
    good = (ok.ravel() == 1) & (ok_back.ravel() == 1)
    good &= np.linalg.norm((back - corners).reshape(-1, 2), axis=1) < RETURN_PX
    places, shifts = (part.reshape(-1, 2)[good].astype(np.float64) for part in (corners, there - corners))
    return places, shifts, float(good.mean())


def laid_on_ground(places: FloatArray, shifts: FloatArray, with_scale: bool) -> FloatArray:
    """(k, 2) what is left of shifts (k, 2) at places (k, 2) when the whole is moved and turned, and scaled,
    as fits best: least absolute values, by reweighting."""
    x, y = (places - places.mean(axis=0)).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    columns = [(one, zero), (zero, one), (-y, x), (x, y)][: 4 if with_scale else 3]
    design = np.array([np.concatenate(column) for column in columns]).T
    left, weight = shifts, np.ones(len(x))
    for _ in range(20):
        root = np.sqrt(np.tile(weight, 2))
        fit = np.linalg.lstsq(design * root[:, None], shifts.T.ravel() * root, rcond=None)[0]
        left = (shifts.T.ravel() - design @ fit).reshape(2, -1).T
        weight = 1.0 / np.maximum(np.linalg.norm(left, axis=1), 0.1)
    return left


def flattened(picture: UInt8Array) -> UInt8Array:
    """Local contrast alone: brightness and its fall-off are other matters."""
    values = picture.astype(np.float32)
    mean = cv2.GaussianBlur(values, (0, 0), 12.0)
    spread = np.sqrt(np.maximum(cv2.GaussianBlur((values - mean) ** 2, (0, 0), 12.0), 4.0))
    return np.clip(128 + 40 * (values - mean) / spread, 0, 255).astype(np.uint8)


def measure(out: Path, flight: Path, align: Align) -> dict[str, float | int]:
    """All figures of one map."""
    truth = Truth.read(flight / "truth" / "scene")
    known = Map.open(out / "map.overfly")
    reference = known.georeference or GeoReference.local()
    poses = read_tum(flight / "truth" / "groundtruth_cam0.tum")
    fitted = evaluate(read_tum(out / "trajectory.tum"), poses, align)
    figures: dict[str, float | int] = {"ate_m": fitted.ate_m.rmse}
    ground = None
    height = float(
        np.median(fitted.truth.positions[:, 2] - truth.height_at(*fitted.truth.positions[:, :2].T))
    )
    figures["height_m"] = height
    if (out / "elevation.tif").exists():
        ground = read_elevation(out / "elevation.tif", known.georeference)
        error, sigmas, relief = elevation_errors(ground, fitted.truth_from_estimate, truth).T
        plain = relief < 0.05 * height
        figures |= {
            "cell_m": ground.cell_m,
            "cells": len(error),
            "rmse_m": float(np.sqrt(np.mean(error**2))),
            "rmse_plain_m": float(np.sqrt(np.mean(error[plain] ** 2))),
            "median_m": float(np.median(error)),
            "p95_m": float(np.percentile(np.abs(error), 95)),
            "rms_sigmas_plain": float(np.sqrt(np.mean(sigmas[plain] ** 2))),
            "median_sigmas": float(np.median(np.abs(sigmas))) / 0.6745,
            "plain_share": float(np.mean(plain)),
        }
    if (out / "mosaic.tif").exists():
        places, shifts, share = mosaic_displacements(
            out / "mosaic.tif", reference, ground, fitted.truth_from_estimate, truth
        )
        figures |= {"corners": len(places), "found_again": share}
        for name, left in (
            ("", shifts),
            ("_laid_on_ground", laid_on_ground(places, shifts, with_scale=False)),
            ("_laid_and_scaled", laid_on_ground(places, shifts, with_scale=True)),
        ):
            length = np.linalg.norm(left, axis=1)
            figures[f"median_px{name}"] = float(np.median(length))
            figures[f"p95_px{name}"] = float(np.percentile(length, 95))
    return figures


def main() -> None:
    arguments = [word for word in sys.argv[1:] if not word.startswith("--")]
    align = Align.SIM3 if "--sim3" in sys.argv else Align.SE3
    for out, flight in zip(arguments[::2], arguments[1::2], strict=True):
        print(Path(flight).name)
        for name, value in measure(Path(out), Path(flight), align).items():
            print(f"  {name:22s} {value:.4g}")


if __name__ == "__main__":
    main()
