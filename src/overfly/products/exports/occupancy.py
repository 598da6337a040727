"""Where a robot on the ground could drive: an occupancy grid as ROS map_server reads it (YAML and PGM)."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import yaml

from overfly.files import atomic_path
from overfly.products.elevation import ElevationGrid
from overfly.types import BoolArray, UInt8Array

OCCUPIED, FREE, UNKNOWN = 0, 254, 205
OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196  # map_server's own, which sort the three values above
WIDTH_PER_HEIGHT = 20.0  # things up to so many times wider than an obstacle's least height stand out whole


def occupancy_of(grid: ElevationGrid, obstacle_m: float) -> UInt8Array:
    """(rows, columns) of OCCUPIED, FREE and UNKNOWN.

    Occupied is what stands out of the ground around it by ``obstacle_m`` or more (the morphological top-hat
    of the heights), and what is steeper than 45 degrees over such a height: the walls of what is too wide to
    stand out.
    """
    known = np.isfinite(grid.heights)
    heights = np.asarray(cv2.medianBlur(grid.extended().heights.astype(np.float32), 3), np.float32)
    radius = max(1, round(0.5 * WIDTH_PER_HEIGHT * obstacle_m / grid.cell_m))
    # a wide window at a reduced size: the level of the ground changes slowly
    factor = max(1, radius // 16)
    reach = -(-radius // factor)
    # mirrored about its edge, a slope goes on beyond it
    small = np.pad(-_pooled(-heights, factor), reach, mode="reflect", reflect_type="odd")
    small = np.asarray(cv2.morphologyEx(small, cv2.MORPH_OPEN, _disc(reach)), np.float32)
    small = small[reach:-reach, reach:-reach]
    size = (heights.shape[1], heights.shape[0])
    ground = cv2.resize(small, size, interpolation=cv2.INTER_LINEAR)
    stands_out = heights - ground >= obstacle_m
    occupied = stands_out | _walls(heights, grid.cell_m, obstacle_m)
    return np.where(known, np.where(occupied, OCCUPIED, FREE), UNKNOWN).astype(np.uint8)


def write_occupancy(path: Path, grid: ElevationGrid, obstacle_m: float) -> None:
    """path: the YAML; the PGM gets the same name. Both in world coordinates, metres. Raises OutputError."""
    cells = occupancy_of(grid, obstacle_m)
    picture = path.with_suffix(".pgm")
    description = {
        "image": picture.name,
        "mode": "trinary",
        "resolution": float(grid.cell_m),
        "origin": [float(grid.x0_m), float(grid.y0_m - cells.shape[0] * grid.cell_m), 0.0],
        "negate": 0,
        "occupied_thresh": OCCUPIED_THRESH,
        "free_thresh": FREE_THRESH,
    }
    header = f"P5\n{cells.shape[1]} {cells.shape[0]}\n255\n".encode("ascii")
    with atomic_path(picture) as temporary:
        temporary.write_bytes(header + cells.tobytes())
    with atomic_path(path) as temporary:
        temporary.write_text(yaml.safe_dump(description, sort_keys=False), encoding="utf-8")


def _walls(heights: np.ndarray, cell_m: float, obstacle_m: float) -> BoolArray:
    """Cells about which the heights change by obstacle_m or more, steeper than 45 degrees."""
    reach = max(1, round(0.5 * obstacle_m / cell_m))
    disc = _disc(reach)
    change = cv2.dilate(heights, disc) - cv2.erode(heights, disc)
    return np.asarray(change >= max(obstacle_m, 2.0 * reach * cell_m))


def _disc(radius: int) -> np.ndarray:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)))


def _pooled(values: np.ndarray, factor: int) -> np.ndarray:
    """Largest value of each block of factor x factor, the last ones smaller."""
    if factor == 1:
        return values
    rows, columns = values.shape
    padded = np.pad(values, ((0, -rows % factor), (0, -columns % factor)), mode="edge")
    blocks = padded.reshape(padded.shape[0] // factor, factor, padded.shape[1] // factor, factor)
    return np.asarray(blocks.max(axis=(1, 3)))
