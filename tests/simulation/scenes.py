"""Worlds whose truth is known in closed form, shared by the tests of the simulator."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray
from overfly.simulation.degradation import CLEAN
from overfly.simulation.flight import SimulatedFlight
from overfly.simulation.optics import CameraSetup, looking_down
from overfly.simulation.patches import Patch
from overfly.simulation.paths import Path
from overfly.simulation.relief import HeightField, flat_relief
from overfly.simulation.scenario import Scenario
from overfly.types import Float32Array

BACKGROUND, PEAK = 0.15, 0.7
CAMERA = Camera(320, 240, 288.0, 288.0, 161.4, 116.6, coefficients=(-0.12, 0.05, 0.0006, -0.0004))
BOUNDS = (-1000.0, -1000.0, 1000.0, 1000.0)


@dataclass(frozen=True)
class Dots:
    """Dark ground with bright Gaussian dots at points (n, 2); sigma_m: their size."""

    points: FloatArray
    sigma_m: float

    def paint(self, patch: Patch) -> Float32Array:
        value = np.full((patch.n, patch.n), BACKGROUND)
        for x, y in self.points:
            # mean over the texel, not the value at its centre, as area sampling has it
            edges = [
                np.array([math.erf(v / (math.sqrt(2) * self.sigma_m)) for v in np.append(c - h, c[-1] + h)])
                for c, h in (
                    ((patch.x.ravel() - x), patch.texel_m / 2),
                    ((patch.y.ravel() - y), patch.texel_m / 2),
                )
            ]
            bump = [np.diff(e) * self.sigma_m * math.sqrt(math.pi / 2) / patch.texel_m for e in edges]
            value += (PEAK - BACKGROUND) * bump[1][:, None] * bump[0][None, :]
        return np.repeat(value[..., None], 3, axis=2).astype(np.float32)


def still(position: FloatArray, euler: FloatArray, seconds: float = 2.0) -> Path:
    """A vehicle that does not move."""
    times = np.linspace(0.0, seconds, 12)
    return Path(times, np.tile(np.concatenate([position, euler]), (12, 1)))


def steady(position: FloatArray, velocity: FloatArray, euler: FloatArray, rates: FloatArray) -> Path:
    """A vehicle that moves and turns at constant rates; position and euler are those at one second."""
    times = np.linspace(0.0, 2.0, 41)
    first = np.concatenate([position, euler])
    return Path(times, first + (times[:, None] - 1.0) * np.concatenate([velocity, rates]))


def dots_flight(
    points: FloatArray,
    path: Path,
    *,
    sigma_m: float,
    relief: HeightField | None = None,
    cameras: tuple[CameraSetup, ...] | None = None,
) -> SimulatedFlight:
    """A clean flight over dots; frame 1 is at one second."""
    setups = cameras or (CameraSetup("cam0", CAMERA, looking_down(tilt_x_rad=0.01), quality=CLEAN),)
    ground = Dots(points[:, :2], sigma_m)
    scenario = Scenario("dots", ground, relief or flat_relief(), path, setups, 1.0, BOUNDS)
    return SimulatedFlight(scenario, 0)


def centroids(radiance: Float32Array, expected_px: FloatArray, half_px: int) -> FloatArray:
    """Centres of brightness (n, 2) in windows about the expected pixels, the background taken away."""
    found = []
    for u, v in expected_px:
        c, r = round(float(u)), round(float(v))
        window = radiance[r - half_px : r + half_px + 1, c - half_px : c + half_px + 1, 0].astype(float)
        weight = np.clip(window - BACKGROUND * 1.02, 0.0, None)
        rows, cols = np.mgrid[r - half_px : r + half_px + 1, c - half_px : c + half_px + 1]
        found.append([(weight * cols).sum() / weight.sum(), (weight * rows).sum() / weight.sum()])
    return np.array(found)


@dataclass(frozen=True)
class Errors:
    """Distances between seen and projected dots, pixels."""

    px: FloatArray = field(repr=False)

    @property
    def mean(self) -> float:
        return float(self.px.mean())

    @property
    def worst(self) -> float:
        return float(self.px.max())


def measure(
    flight: SimulatedFlight, points: FloatArray, half_px: int, camera: int = 0, index: int = 1
) -> Errors:
    """How far the dots are seen from where they project to."""
    expected = flight.project(index, points, camera)
    width, height = CAMERA.width, CAMERA.height
    inside = (expected > half_px + 1).all(axis=1)
    inside &= (expected[:, 0] < width - half_px - 2) & (expected[:, 1] < height - half_px - 2)
    assert inside.sum() >= 5, "too few dots in view: the test itself is wrong"
    eye = flight._eyes[camera]
    radiance = eye.expose(flight.scenario.path, float(flight._times[index]))
    seen = centroids(radiance, expected[inside], half_px)
    return Errors(np.linalg.norm(seen - expected[inside], axis=1))


def measure_disparity(flight: SimulatedFlight, points: FloatArray, half_px: int, index: int = 1) -> Errors:
    """How far the shift of each dot from the left picture to the right is from what the dots' places say."""
    expected = [flight.project(index, points, camera) for camera in (0, 1)]
    high = np.array([CAMERA.width, CAMERA.height]) - half_px - 2
    inside = np.all([((px > half_px + 1) & (px < high)).all(axis=1) for px in expected], axis=0)
    assert inside.sum() >= 5, "too few dots in both views: the test itself is wrong"
    path, time_s = flight.scenario.path, float(flight._times[index])
    left, right = (
        centroids(eye.expose(path, time_s), px[inside], half_px) - px[inside]
        for eye, px in zip(flight._eyes, expected, strict=True)
    )
    return Errors(np.linalg.norm(left - right, axis=1))
