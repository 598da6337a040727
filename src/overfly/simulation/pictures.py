"""Flat pictures to lay on the ground: landmarks with a letter, survey targets, papers, a book."""

from __future__ import annotations

import math

import cv2
import numpy as np

from overfly.simulation.ground import Picture
from overfly.simulation.patches import Colour
from overfly.types import Float32Array

_PIXELS = 256


def _write(image: Float32Array, text: str, origin: tuple[int, int], scale: float, colour: Colour) -> None:
    """Letters with soft edges, drawn in place; origin (column, row) of their lower left corner."""
    mask = np.zeros(image.shape[:2], dtype=np.uint8)
    cv2.putText(mask, text, origin, cv2.FONT_HERSHEY_DUPLEX, scale, 255, 4, cv2.LINE_AA)
    image += (mask[..., None] / np.float32(255.0)) * (np.asarray(colour, dtype=np.float32) - image)


def landmark(
    name: str, centre: tuple[float, float], width_m: float = 0.30, angle_rad: float = 0.0
) -> Picture:
    """A white sheet with its name, a frame, and a chequered cross whose middle is the landmark."""
    image = np.full((_PIXELS, _PIXELS, 3), 0.70, dtype=np.float32)
    cv2.rectangle(image, (8, 8), (_PIXELS - 9, _PIXELS - 9), (0.03, 0.03, 0.03), 5)
    half, arm = _PIXELS // 2, 44
    image[half - arm : half, half - arm : half] = 0.03
    image[half : half + arm, half : half + arm] = 0.03
    generator = np.random.default_rng([ord(letter) for letter in name])
    for row in range(3):  # a small code, different on each sheet
        for col in range(10):
            if generator.random() < 0.5:
                image[200 + 14 * row : 212 + 14 * row, 24 + 21 * col : 43 + 21 * col] = 0.05
    _write(image, name, (20, 66), 1.7, (0.04, 0.04, 0.25))
    return Picture(name, image, centre, width_m, angle_rad)


def target(name: str, centre: tuple[float, float], width_m: float = 1.2, angle_rad: float = 0.0) -> Picture:
    """A photogrammetric ground control target: two black and two white quarters on a board."""
    image = np.full((_PIXELS, _PIXELS, 3), 0.85, dtype=np.float32)
    half = _PIXELS // 2
    image[:half, :half] = 0.02
    image[half:, half:] = 0.02
    return Picture(name, image, centre, width_m, angle_rad)


def paper(
    name: str, centre: tuple[float, float], seed: int, width_m: float = 0.21, angle_rad: float = 0.0
) -> Picture:
    """A printed page: lines of words, sometimes a photograph."""
    generator = np.random.default_rng([seed, 5])
    height = round(_PIXELS * math.sqrt(2.0))
    image = np.full((height, _PIXELS, 3), 0.62, dtype=np.float32) * generator.uniform(0.85, 1.1)
    top = 24
    if generator.random() < 0.6:
        top = 130
        speckle = generator.random((12, 18, 1)).astype(np.float32) * generator.uniform(0.1, 0.6, 3).astype(
            np.float32
        )
        image[24:116, 24 : _PIXELS - 24] = cv2.resize(
            speckle, (_PIXELS - 48, 92), interpolation=cv2.INTER_CUBIC
        )
    for line in range(top, height - 24, 16):
        col = 24
        while col < _PIXELS - 30:
            word = int(generator.integers(8, 34))
            image[line : line + 8, col : min(col + word, _PIXELS - 24)] = 0.07
            col += word + 8
    return Picture(name, np.clip(image, 0.0, 1.0), centre, width_m, angle_rad)


def book(
    name: str, centre: tuple[float, float], width_m: float, height_m: float, angle_rad: float = 0.0
) -> Picture:
    """A book of known size, seen from above: dark cover, bright title and a picture on it."""
    rows = round(_PIXELS * height_m / width_m)
    image = np.empty((rows, _PIXELS, 3), dtype=np.float32)
    image[:] = (0.23, 0.035, 0.03)
    cv2.rectangle(image, (14, 14), (_PIXELS - 15, rows - 15), (0.62, 0.52, 0.25), 4)
    _write(image, "ATLAS", (40, rows // 3), 1.7, (0.8, 0.75, 0.6))
    cv2.circle(image, (_PIXELS // 3, 2 * rows // 3), rows // 6, (0.12, 0.30, 0.45), -1)
    cv2.rectangle(image, (150, rows // 2), (225, rows - 36), (0.55, 0.6, 0.62), -1)
    return Picture(name, image, centre, width_m, angle_rad)


def strewn_papers(
    count: int, x_range: tuple[float, float], y_range: tuple[float, float], seed: int
) -> tuple[Picture, ...]:
    """Pages that somebody dropped, at random places in the rectangle."""
    generator = np.random.default_rng([seed, 6])
    return tuple(
        paper(
            f"paper{k}",
            (float(generator.uniform(*x_range)), float(generator.uniform(*y_range))),
            seed + k,
            float(generator.uniform(0.15, 0.30)),
            float(generator.uniform(0.0, 2.0 * math.pi)),
        )
        for k in range(count)
    )


def manhole(name: str, centre: tuple[float, float], diameter_m: float = 0.6) -> Picture:
    """A cast-iron lid in a square concrete frame."""
    image: Float32Array = np.full((_PIXELS, _PIXELS, 3), 0.30, dtype=np.float32)
    half = _PIXELS // 2
    cv2.circle(image, (half, half), half - 14, (0.075, 0.07, 0.065), -1)
    for k in range(-5, 6):
        cv2.line(image, (half + 18 * k, 40), (half + 18 * k, _PIXELS - 40), (0.15, 0.14, 0.13), 5)
    cv2.circle(image, (half, half), half - 22, (0.16, 0.15, 0.14), 4)
    return Picture(name, image, centre, diameter_m * 1.15)
