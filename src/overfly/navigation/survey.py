"""Flying over ground that no map shows yet: lines side by side, half a picture apart."""

from __future__ import annotations

import math

import numpy as np

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray

LINES_APART = 0.5  # of the picture's smaller side on the ground
DEFAULT_PICTURES = (3.0, 2.5)  # size of a survey when nobody says, in pictures


def picture_m(camera: Camera, height_m: float) -> tuple[float, float]:
    """Width and height of the picture on flat ground, metres."""
    return height_m * camera.width / camera.fx, height_m * camera.height / camera.fy


def survey_places(
    centre: FloatArray, size_m: tuple[float, float], camera: Camera, height_m: float
) -> FloatArray:
    """Places (n, 2) of a survey of width x depth about centre (2,), which begins and ends there.

    Lines run along x; the way back crosses all of them, so that neighbours are tied together twice.
    """
    half_x, half_y = 0.5 * size_m[0], 0.5 * size_m[1]
    apart = LINES_APART * min(picture_m(camera, height_m))
    lines = max(2, math.ceil(2.0 * half_y / apart) + 1)
    corners = []
    for number, y in enumerate(np.linspace(-half_y, half_y, lines)):
        side = half_x if number % 2 else -half_x
        corners += [(side, y), (-side, y)]
    corners += [(corners[-1][0], half_y), (0.0, half_y), (0.0, -half_y), (0.0, 0.0)]
    places = [np.zeros(2)]
    for corner in corners:  # places no further apart than the lines: the way between is straight
        away = np.array(corner) - places[-1]
        steps = max(1, math.ceil(float(np.linalg.norm(away)) / (2.0 * apart)))
        places += [places[-1] + away * (step + 1) / steps for step in range(steps)]
    return np.asarray(centre + np.array(places[1:]))
