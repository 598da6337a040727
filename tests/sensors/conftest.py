"""A small flight in the EuRoC layout, written with known contents."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

SENSOR_YAML = """\
# a comment
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0, -1, 0, {x},
         -1, 0, 0, {y},
         0, 0, -1, -0.03,
         0, 0, 0, 1]
rate_hz: 10
resolution: [32, 24]
camera_model: pinhole
intrinsics: [30, 31, 16.5, 11.5]
distortion_model: radial-tangential
distortion_coefficients: [-0.1, 0.05, 0.001, -0.0004]
"""
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000

WriteFlight = Callable[..., Path]


def picture(n: int, camera: int = 0) -> np.ndarray:
    """(24, 32) gray: a ramp whose level tells which picture it is."""
    ramp = np.add.outer(np.arange(24), np.arange(32))
    return (ramp + 3 * n + 60 * camera).astype(np.uint8)


@pytest.fixture
def write_flight(tmp_path: Path) -> WriteFlight:
    """write(frames, cameras, files): a flight of gray PNGs at 10 Hz; files: more texts, by path in mav0."""

    def write(frames: int = 6, cameras: int = 1, files: dict[str, str] | None = None) -> Path:
        flight = tmp_path / "flight"
        for camera in range(cameras):
            folder = flight / "mav0" / f"cam{camera}"
            (folder / "data").mkdir(parents=True)
            rows = ["#timestamp [ns],filename"]
            for n in range(frames):
                stamp = START_NS + n * PERIOD_NS
                rows.append(f"{stamp},{stamp}.png")
                Image.fromarray(picture(n, camera)).save(folder / "data" / f"{stamp}.png")
            (folder / "data.csv").write_text("\n".join(rows) + "\n")
            (folder / "sensor.yaml").write_text(SENSOR_YAML.format(x=0.05, y=0.06 - 0.12 * camera))
        for name, text in (files or {}).items():
            path = flight / "mav0" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return flight

    return write
