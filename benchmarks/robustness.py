"""How much each feature type bears: python benchmarks/robustness.py [FOLDER]

A straight simulated flight over the garden of the demonstration, 320x240, one thing made worse at a time.
Writes robustness.json, robustness.svg and a table in Markdown: share of frames located, and the error of
those (RMS against the truth after alignment, in % of the height over ground).
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import dataclasses
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path as FilePath

import cv2
import numpy as np

from overfly.config import load_config
from overfly.errors import OverflyError
from overfly.evaluation import Align, evaluate
from overfly.simulation import SimulatedFlight
from overfly.simulation.paths import Path
from overfly.simulation.scenario import Scenario, declared
from overfly.slam import Slam
from overfly.trajectory import Trajectory
from overfly.types import Frame, UInt8Array

HEIGHT_M, SPEED_M_S, RATE_HZ, FRAMES = 3.1, 2.0, 30.0, 60
FEATURES = ("hessian-teblid", "orb", "sift", "surf", "descriptors only")
AXES: dict[str, tuple[float, ...]] = {
    "blur length, px": (0, 5, 10, 15, 20),
    "noise, grey levels": (0, 5, 10, 20, 30),
    "contrast, share": (1.0, 0.5, 0.25, 0.12, 0.06),
    "yaw rate, deg/s": (0, 45, 90, 135, 180),
    "frame gap, frames": (1, 2, 4, 7, 10),
    "tilt, deg": (0, 8, 16, 25),
}


def flight(yaw_rate_rad_s: float = 0.0, tilt_rad: float = 0.0) -> SimulatedFlight:
    """Straight across the garden at constant height, turning at a constant rate or tilted by an angle."""
    base: Scenario = declared("demo").build(1)
    times = np.arange(0.0, FRAMES / RATE_HZ + 1.0, 0.02)
    zeros = np.zeros_like(times)
    x = SPEED_M_S * (times - times[-1] / 2.0)
    states = np.column_stack([x, zeros, zeros + HEIGHT_M, zeros + tilt_rad, zeros, yaw_rate_rad_s * times])
    cameras = tuple(dataclasses.replace(setup, color=False, exposure_s=0.0) for setup in base.cameras)
    scenario = dataclasses.replace(base, path=Path(times, states), cameras=cameras, rate_hz=RATE_HZ)
    return SimulatedFlight(scenario, 1, FRAMES)


def smeared(length_px: float) -> Callable[[UInt8Array, int], UInt8Array]:
    side = 2 * math.ceil(length_px / 2.0) + 1
    along = np.clip(length_px / 2.0 + 0.5 - np.abs(np.arange(side) - side // 2), 0.0, 1.0)
    kernel = np.zeros((side, side), np.float32)
    kernel[:, side // 2] = along / along.sum()  # along the flight, which is up and down in the picture
    return lambda image, _: np.asarray(cv2.filter2D(image, -1, kernel), np.uint8)


def noisy(sigma: float) -> Callable[[UInt8Array, int], UInt8Array]:
    def degrade(image: UInt8Array, index: int) -> UInt8Array:
        noise = np.random.default_rng([7, index]).normal(0.0, sigma, image.shape)
        return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)

    return degrade


def faded(share: float) -> Callable[[UInt8Array, int], UInt8Array]:
    return lambda image, _: np.clip(np.rint((image - 128.0) * share + 128.0), 0, 255).astype(np.uint8)


def degraded(frames: list[Frame], degrade: Callable[[UInt8Array, int], UInt8Array]) -> list[Frame]:
    return [
        dataclasses.replace(frame, images=tuple(degrade(image, frame.index) for image in frame.images))
        for frame in frames
    ]


class Flights:
    """Rendered once each."""

    def __init__(self) -> None:
        self._rendered: dict[tuple[float, float], tuple[SimulatedFlight, list[Frame]]] = {}

    def of(self, axis: str, value: float) -> tuple[SimulatedFlight, list[Frame]]:
        yaw = math.radians(value) if axis.startswith("yaw") else 0.0
        tilt = math.radians(value) if axis.startswith("tilt") else 0.0
        if (yaw, tilt) not in self._rendered:
            made = flight(yaw, tilt)
            self._rendered[yaw, tilt] = made, list(made)
        made, frames = self._rendered[yaw, tilt]
        if axis.startswith("blur"):
            frames = degraded(frames, smeared(value))
        elif axis.startswith("noise"):
            frames = degraded(frames, noisy(value))
        elif axis.startswith("contrast"):
            frames = degraded(frames, faded(value))
        elif axis.startswith("frame gap"):
            frames = frames[:: int(value)]
        return made, frames


def fly(made: SimulatedFlight, frames: list[Frame], feature: str) -> tuple[float, float]:
    """Share of the frames located, and RMS error in % of the height; NaN where too few were located."""
    settings = (
        ["tracking.enabled=false"] if feature == "descriptors only" else [f"features.extractor={feature}"]
    )
    slam = Slam(made.rig, load_config(None, settings))
    for frame in frames:
        slam.process(frame)
    truth = dict(zip(made.stamps_ns.tolist(), made.truth, strict=True))
    stamps = [record.t_ns for record in slam.records]
    share = len(stamps) / len(frames)
    if len(stamps) < 3:
        return share, math.nan
    found = Trajectory.from_poses(stamps, [slam.pose_of(record) for record in slam.records])
    real = Trajectory.from_poses(list(truth), list(truth.values()))
    try:
        error = evaluate(found, real, Align("se3")).ate_m.rmse
    except OverflyError:
        return share, math.nan
    return share, 100.0 * error / HEIGHT_M


def chart(results: dict[str, dict[str, list[tuple[float, float]]]]) -> str:
    """Two rows of small charts: share located above, error below."""
    colours = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#555555")
    width, height, left, top = 190, 110, 40, 30
    whole = f'width="{left + 6 * (width + 30)}" height="{2 * height + 130}"'
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {whole} '
        'font-family="sans-serif" font-size="10"><rect width="100%" height="100%" fill="white"/>'
    ]
    for n, (axis, values) in enumerate(AXES.items()):
        x0 = left + n * (width + 30)
        low, high = min(values), max(values)
        for row, (name, top_value) in enumerate((("located", 1.0), ("error, % of height", 5.0))):
            y0 = top + row * (height + 45)
            out.append(
                f'<rect x="{x0}" y="{y0}" width="{width}" height="{height}" fill="none" stroke="#999"/>'
            )
            out.append(f'<text x="{x0}" y="{y0 - 4}">{name} (0 to {top_value:g})</text>')
            out.append(f'<text x="{x0}" y="{y0 + height + 12}">{axis}: {low:g} to {high:g}</text>')
            for colour, feature in zip(colours, FEATURES, strict=True):
                points = [
                    f"{x0 + (v - low) / (high - low) * width:.1f},"
                    f"{y0 + height * (1.0 - min(pair[row], top_value) / top_value):.1f}"
                    for v, pair in zip(values, results[axis][feature], strict=True)
                    if math.isfinite(pair[row])
                ]
                line = " ".join(points)
                out.append(f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
    for n, (colour, feature) in enumerate(zip(colours, FEATURES, strict=True)):
        out.append(f'<text x="{left + 140 * n}" y="{2 * height + 115}" fill="{colour}">{feature}</text>')
    return "\n".join([*out, "</svg>"]) + "\n"


def table(results: dict[str, dict[str, list[tuple[float, float]]]]) -> str:
    """Markdown: share located (error in % of the height)."""
    lines = []
    for axis, values in AXES.items():
        lines += ["", f"| {axis} | " + " | ".join(f"{value:g}" for value in values) + " |"]
        lines.append("|---|" + "---|" * len(values))
        for feature in FEATURES:
            cells = [f"{share:.2f} ({error:.2f})" for share, error in results[axis][feature]]
            lines.append(f"| {feature} | " + " | ".join(cells).replace("(nan)", "(-)") + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    folder = FilePath(sys.argv[1] if len(sys.argv) > 1 else ".")
    flights = Flights()
    results: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for axis, values in AXES.items():
        results[axis] = {feature: [] for feature in FEATURES}
        for value in values:
            made, frames = flights.of(axis, value)
            for feature in FEATURES:
                results[axis][feature].append(fly(made, frames, feature))
            print(
                axis,
                value,
                {f: tuple(round(x, 2) for x in results[axis][f][-1]) for f in FEATURES},
                flush=True,
            )
    (folder / "robustness.json").write_text(json.dumps(results, indent=1))
    (folder / "robustness.svg").write_text(chart(results))
    (folder / "robustness.md").write_text(table(results))


if __name__ == "__main__":
    main()
