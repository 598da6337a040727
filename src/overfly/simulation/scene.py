"""The world as files for evaluation: orthophoto, heights, and the numbers that place them."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import cv2
import numpy as np

from overfly.simulation import layout
from overfly.simulation.patches import Patch
from overfly.simulation.relief import SUN
from overfly.simulation.scenario import Scenario
from overfly.simulation.tiles import texel_of_level
from overfly.types import UInt8Array

MOST_PIXELS = 3000  # along the longer side of the orthophoto
_MOST_NODES = 1500
_TILE = 256


def write_scene(scenario: Scenario, folder: Path) -> None:
    """ortho.jpg, dsm.npz and scene.json of the scenario's bounds."""
    x0, y0, x1, y1 = scenario.bounds_m
    side = max(x1 - x0, y1 - y0)
    texel = texel_of_level(math.ceil(math.log2(side / MOST_PIXELS) + 12))
    width, height = math.ceil((x1 - x0) / texel), math.ceil((y1 - y0) / texel)
    top = y0 + height * texel
    picture = orthophoto(scenario, texel, width, height)
    done, data = cv2.imencode(
        ".jpg", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 92]
    )
    assert done
    layout.write_bytes(folder / "ortho.jpg", data.tobytes())
    cell = max(scenario.relief.cell_m, side / _MOST_NODES)
    gx = x0 + np.arange(math.ceil((x1 - x0) / cell) + 1) * cell
    gy = top - np.arange(math.ceil((top - y0) / cell) + 1) * cell
    heights = scenario.relief.height(*np.meshgrid(gx, gy)).astype(np.float32)
    stream = io.BytesIO()
    np.savez_compressed(stream, dsm=heights)
    layout.write_bytes(folder / "dsm.npz", stream.getvalue())
    facts = {
        "ortho": {
            "file": "ortho.jpg",
            "texel_m": texel,
            "x0": x0,
            "y1": top,
            "width": width,
            "height": height,
            "world_of_pixel": "x = x0 + (col + 0.5) * texel_m ; y = y1 - (row + 0.5) * texel_m",
            "linear_reflectance": "(code / 255) ** 2.2",
        },
        "dsm": {
            "file": "dsm.npz",
            "cell_m": cell,
            "gx0": x0,
            "gy1": top,
            "world_of_node": "x = gx0 + col * cell_m ; y = gy1 - row * cell_m",
            "surface": "bilinear between nodes, extended flat beyond the grid",
            "unit": "m, world z",
        },
        "origin_lat_lon_alt": list(scenario.origin_lat_lon_alt),
        "landmarks": [_place(scenario, mark.name, mark.x_m, mark.y_m) for mark in scenario.landmarks],
        "blind_intervals_s": [list(interval) for interval in scenario.trouble.black_s],
        "sun_direction": SUN.tolist(),
    }
    layout.write_text(folder / "scene.json", json.dumps(facts, indent=1) + "\n")


def orthophoto(scenario: Scenario, texel_m: float, width: int, height: int) -> UInt8Array:
    """(height, width, 3) RGB of the ground from the south-west corner of the bounds on; first row in the
    north.
    """
    picture = np.zeros((height, width, 3), dtype=np.uint8)
    x0, y0 = scenario.bounds_m[:2]
    for row in range(0, height, _TILE):
        for col in range(0, width, _TILE):
            albedo = scenario.ground.paint(Patch(x0 + col * texel_m, y0 + row * texel_m, texel_m, _TILE))
            codes = np.round(255.0 * albedo ** (1 / 2.2)).astype(np.uint8)
            rows, cols = min(_TILE, height - row), min(_TILE, width - col)
            # rows run north to south in the picture, south to north in the patch
            picture[height - row - rows : height - row, col : col + cols] = codes[:rows, :cols][::-1]
    return picture


def _place(scenario: Scenario, name: str, x: float, y: float) -> dict[str, object]:
    z = float(scenario.relief.height(np.array([x]), np.array([y]))[0])
    return {"name": name, "x": x, "y": y, "z": z, "kind": "landmark"}
