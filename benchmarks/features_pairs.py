"""Pairs of views of real aerial pictures with exactly known homographies, and how well features match across
them."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from overfly.vision.features import Extractor
from overfly.vision.matching import match_mutual

GOOD_PX = 2.0  # a match, or a homography, nearer to the truth than this is right
WRONG_PX = 6.0  # a match further off than this is surely another place
SUPERSAMPLING = 3
SOURCE_WIDTH = 1400  # large pictures are reduced to this width first; a pixel of view A is two of theirs
SETS = {
    "brighton_beach": "brighton_beach/images/*.JPG",
    "caliterra": "caliterra/images/*.jpg",
    "cuav": "cuav/mav0/cam0/data/*",
    "opticflow": "opticflow/mav0/cam0/data/*",
}
# Limits of what differs between the two views, uniform between them; what is not named keeps the value of
# every kind.
LIMITS: dict[str, dict[str, tuple[float, float]]] = {
    "odometry": {"rotation_deg": (-10.0, 10.0), "octaves": (-0.1, 0.1)},  # neighbours in time
    "rotation": {},
    "scale": {"octaves": (-1.0, 1.0)},
    "tilt": {"tilt_deg": (10.0, 35.0)},
    "blur": {"blur_px": (0.0, 9.0)},
    "heavy blur": {"blur_px": (9.0, 15.0)},
    "noise": {"noise_sigma": (4.0, 12.0)},
    "contrast": {"contrast": (0.2, 0.6), "brightness": (-40.0, 40.0)},
    "mixed": {
        "octaves": (-0.5, 0.5),
        "tilt_deg": (0.0, 20.0),
        "blur_px": (0.0, 6.0),
        "noise_sigma": (1.0, 5.0),
        "contrast": (0.5, 1.2),
        "brightness": (-20.0, 20.0),
    },
}
KINDS = tuple(LIMITS)


@dataclass(frozen=True)
class Change:
    """What differs between view A and view B; the defaults are: nothing."""

    rotation_deg: float = 0.0
    octaves: float = 0.0  # binary logarithm of the size of things in B over that in A
    tilt_deg: float = 0.0
    tilt_direction_deg: float = 0.0
    shift_px: tuple[float, float] = (0.0, 0.0)
    blur_px: float = 0.0  # length of the straight motion blur in B
    blur_direction_deg: float = 0.0
    noise_sigma: float = 0.0  # grey levels, on top of what the picture has, in both views
    contrast: float = 1.0  # B about its mean
    brightness: float = 0.0  # grey levels added to B


@dataclass(frozen=True)
class Pair:
    """Two views (H, W) uint8 and the homography (3, 3) that takes pixels of A to pixels of B."""

    a: np.ndarray
    b: np.ndarray
    b_from_a: np.ndarray
    group: str
    kind: str


@dataclass
class Outcome:
    """What one extractor did on one pair."""

    group: str
    kind: str
    milliseconds: float
    features: int
    matches: int
    correct: int
    localisation_px: float
    success: bool
    right_distances: np.ndarray = field(repr=False)
    wrong_distances: np.ndarray = field(repr=False)


def load_pictures(data: Path, per_set: int) -> dict[str, list[np.ndarray]]:
    """Gray pictures of each set, evenly spread over the flight."""
    pictures = {}
    for name, pattern in SETS.items():
        files = sorted(path for path in data.glob(pattern) if path.suffix.lower() in {".jpg", ".png"})
        chosen = (
            [files[k] for k in np.linspace(0, len(files) - 1, per_set + 2).astype(int)[1:-1]] if files else []
        )
        pictures[name] = [_reduced(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) for path in chosen]
    return pictures


def _reduced(picture: np.ndarray) -> np.ndarray:
    height, width = picture.shape
    if width <= SOURCE_WIDTH:
        return picture
    return cv2.resize(
        picture, (SOURCE_WIDTH, round(height * SOURCE_WIDTH / width)), interpolation=cv2.INTER_AREA
    )


def draw_change(kind: str, rng: np.random.Generator) -> Change:
    """A random change of one kind; every kind has a rotation and a shift, as two visits of one place have."""
    base = Change(
        rotation_deg=rng.uniform(-180.0, 180.0),
        shift_px=(rng.uniform(-30.0, 30.0), rng.uniform(-30.0, 30.0)),
        noise_sigma=1.0,
        tilt_direction_deg=rng.uniform(0.0, 360.0),
        blur_direction_deg=rng.uniform(0.0, 180.0),
    )
    drawn: dict[str, Any] = {name: rng.uniform(*limits) for name, limits in LIMITS[kind].items()}
    return replace(base, **drawn)


def make_pair(
    picture: np.ndarray,
    size: tuple[int, int],
    change: Change,
    rng: np.random.Generator,
    group: str,
    kind: str,
) -> Pair:
    """Two views of size (width, height) of one picture (H, W) uint8."""
    width, height = size
    pixel = min(2.0, picture.shape[1] / width)
    centre = np.array([picture.shape[1] - 1.0, picture.shape[0] - 1.0]) / 2.0
    source_from_a = (
        _translation(*centre) @ np.diag([pixel, pixel, 1.0]) @ _translation((1 - width) / 2, (1 - height) / 2)
    )
    b_from_a = view_homography(size, change)
    source_from_b = source_from_a @ np.linalg.inv(b_from_a)
    a, b = _render(picture, source_from_a, size), _render(picture, source_from_b, size)
    b = _motion_blur(b, change.blur_px, change.blur_direction_deg)
    b = (b - b.mean()) * change.contrast + b.mean() + change.brightness
    a = a + rng.normal(0.0, change.noise_sigma, a.shape)
    b = b + rng.normal(0.0, change.noise_sigma, b.shape)
    return Pair(_to_uint8(a), _to_uint8(b), b_from_a, group, kind)


def view_homography(size: tuple[int, int], change: Change) -> np.ndarray:
    """(3, 3) b_from_a of a change: tilt, rotation and scale about the image centre, then the shift."""
    width, height = size
    focal = 0.9 * width
    tilt = math.radians(change.tilt_deg)
    c, s = math.cos(tilt), math.sin(tilt)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    direction = _rotation(change.tilt_direction_deg)
    # A camera that turns by the tilt and moves so that the centre of the scene stays in the middle at its
    # distance.
    turn = direction @ about_x @ direction.T
    plane = turn.copy()
    plane[:, 2] = (0.0, 0.0, 1.0)
    intrinsics = np.diag([focal, focal, 1.0])
    homography = intrinsics @ plane @ np.linalg.inv(intrinsics)
    scaling = np.diag([2.0**change.octaves, 2.0**change.octaves, 1.0])
    to_centre, back = (
        _translation((1 - width) / 2, (1 - height) / 2),
        _translation((width - 1) / 2, (height - 1) / 2),
    )
    return (
        _translation(*change.shift_px)
        @ back
        @ _rotation(change.rotation_deg)
        @ scaling
        @ homography
        @ to_centre
    )


def _translation(x: float, y: float) -> np.ndarray:
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def _rotation(degrees: float) -> np.ndarray:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _render(picture: np.ndarray, source_from_view: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The view as float32 grey levels; each pixel is the mean of 3 x 3 samples."""
    n = SUPERSAMPLING
    view_from_fine = _translation(-(n - 1) / (2 * n), -(n - 1) / (2 * n)) @ np.diag([1 / n, 1 / n, 1.0])
    fine = cv2.warpPerspective(
        picture.astype(np.float32),
        source_from_view @ view_from_fine,
        (size[0] * n, size[1] * n),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REFLECT_101,
    )
    return cv2.resize(fine, size, interpolation=cv2.INTER_AREA)


def _motion_blur(image: np.ndarray, length_px: float, direction_deg: float) -> np.ndarray:
    """Mean along a centred line, so that the truth stays true."""
    if length_px < 0.5:
        return image
    half = math.ceil(length_px / 2.0) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for t in np.linspace(-length_px / 2.0, length_px / 2.0, 8 * half + 1):
        x, y = (
            half + t * math.cos(math.radians(direction_deg)),
            half + t * math.sin(math.radians(direction_deg)),
        )
        i, j = int(y), int(x)
        fy, fx = y - i, x - j
        kernel[i : i + 2, j : j + 2] += np.outer([1 - fy, fy], [1 - fx, fx])
    return cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT_101)


def _to_uint8(image: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def make_pairs(
    pictures: dict[str, list[np.ndarray]], size: tuple[int, int], kinds: tuple[str, ...], seed: int
) -> list[Pair]:
    """One pair of each kind for every picture."""
    rng = np.random.default_rng(seed)
    return [
        make_pair(picture, size, draw_change(kind, rng), rng, group, kind)
        for kind in kinds
        for group, members in pictures.items()
        for picture in members
    ]


def evaluate(extractor: Extractor, pair: Pair) -> Outcome:
    """Features of both views, mutual matches without a limit on their distance, and their truth."""
    start = time.thread_time()
    a = extractor.extract(pair.a)
    b = extractor.extract(pair.b)
    milliseconds = 500.0 * (time.thread_time() - start)
    index_a, index_b, distance = match_mutual(a.descriptors, b.descriptors, extractor.metric, np.inf)
    error = np.linalg.norm(_transfer(pair.b_from_a, a.px[index_a]) - b.px[index_b], axis=1)
    gated = distance <= extractor.max_distance
    right = gated & (error <= GOOD_PX)
    return Outcome(
        group=pair.group,
        kind=pair.kind,
        milliseconds=milliseconds,
        features=(len(a) + len(b)) // 2,
        matches=int(gated.sum()),
        correct=int(right.sum()),
        localisation_px=float(np.median(error[right])) if right.any() else math.nan,
        success=_homography_is_good(a.px[index_a[gated]], b.px[index_b[gated]], pair),
        right_distances=distance[error <= GOOD_PX],
        wrong_distances=distance[error > WRONG_PX],
    )


def _transfer(homography: np.ndarray, px: np.ndarray) -> np.ndarray:
    ahead = np.column_stack([px.astype(np.float64), np.ones(len(px))]) @ homography.T
    return ahead[:, :2] / ahead[:, 2:]


def _homography_is_good(a: np.ndarray, b: np.ndarray, pair: Pair) -> bool:
    """Whether a robust homography from the matches is within 2 px of the truth over what both views show."""
    if len(a) < 6:
        return False
    cv2.setRNGSeed(1)
    estimate, _ = cv2.findHomography(a, b, cv2.RANSAC, 2.0, maxIters=2000, confidence=0.999)
    if estimate is None:
        return False
    height, width = pair.a.shape
    grid = np.stack(
        np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 9)), axis=-1
    ).reshape(-1, 2)
    truth = _transfer(pair.b_from_a, grid)
    seen = ((truth >= 0) & (truth <= [width - 1, height - 1])).all(axis=1)
    error = np.linalg.norm(_transfer(estimate, grid) - truth, axis=1)[seen]
    return bool(len(error) > 0 and np.mean(error) <= GOOD_PX)
