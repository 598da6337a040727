"""The painted ground: layers of materials, small things strewn over them, pictures (landmarks, papers) laid
on top.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from overfly.simulation import scatter
from overfly.simulation.patches import Material, Patch, Shape
from overfly.simulation.scatter import Scatter
from overfly.types import Float32Array


@dataclass(frozen=True, slots=True)
class Layer:
    """A material, where it lies (None: everywhere), and what lies strewn on it."""

    material: Material
    shape: Shape | None = None
    strewn: tuple[Scatter, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A flat picture on the ground: image (h, w, 3) linear reflectance, first row at its own +y; width_m
    along its own x.
    """

    name: str
    image: Float32Array
    centre: tuple[float, float]
    width_m: float
    angle_rad: float = 0.0

    @property
    def height_m(self) -> float:
        return self.width_m * float(self.image.shape[0] / self.image.shape[1])

    @property
    def reach_m(self) -> float:
        return 0.5 * math.hypot(self.width_m, self.height_m)


@dataclass(frozen=True, slots=True)
class Ground:
    """Everything that has a colour. Later layers cover earlier ones, pictures cover all."""

    layers: tuple[Layer, ...]
    pictures: tuple[Picture, ...] = ()
    seed: int = 0

    def paint(self, patch: Patch) -> Float32Array:
        """(n, n, 3) float32 linear reflectance of the patch."""
        albedo = np.zeros((patch.n, patch.n, 3), dtype=np.float32)
        shares = [
            None if layer.shape is None else layer.shape.coverage(patch.x, patch.y, patch.texel_m)
            for layer in self.layers
        ]
        for number in range(_lowest_seen(shares), len(self.layers)):
            seed = self.seed + 1000 * (number + 1)
            _paint_layer(albedo, patch, self.layers[number], shares[number], seed)
        for picture in self.pictures:
            _lay(albedo, patch, picture)
        return np.clip(albedo, 0.0, 1.0, out=albedo)


def _lowest_seen(shares: list[Float32Array | None]) -> int:
    """Index of the topmost layer that covers everything: what lies below it is never seen."""
    for number in range(len(shares) - 1, 0, -1):
        share = shares[number]
        if share is None or bool((share >= 1.0).all()):
            return number
    return 0


def _paint_layer(
    albedo: Float32Array, patch: Patch, layer: Layer, share: Float32Array | None, seed: int
) -> None:
    """Paint one layer over what is there and strew its things; share (n, n) in each texel, None: all."""
    if share is not None and not share.any():
        return
    colour = layer.material(patch, seed)
    if share is None:
        albedo[:] = colour
    else:
        albedo += share[..., None] * (colour - albedo)
    for number, kind in enumerate(layer.strewn):
        things = kind.objects(patch, seed + 100 + 17 * number)
        # Fade out what is about to become too small to see, so that scales agree with each other.
        fade = min(1.0, max(0.0, kind.length_m[1] / patch.texel_m - 1.0) / 2.0)
        opacity = np.full(len(things), fade)
        if layer.shape is not None and len(things):
            opacity *= layer.shape.coverage(things[:, 0], things[:, 1], 0.01)
        scatter.draw(albedo, patch, things, opacity, kind.outline)


def _lay(albedo: Float32Array, patch: Patch, picture: Picture) -> None:
    """Draw the picture: shrunk to the texel size first (area average), then placed with linear interpolation.

    Edges are soft over about one texel, symmetrically, so that its centre stays where it is at every scale.
    """
    reach = picture.reach_m + 2.0 * patch.texel_m
    x, y = picture.centre
    if not (patch.x0 - reach < x < patch.x0 + patch.side_m + reach):
        return
    if not (patch.y0 - reach < y < patch.y0 + patch.side_m + reach):
        return
    image = _shrunk(picture, patch.texel_m)
    h, w = image.shape[:2]
    padded = cv2.copyMakeBorder(image, 2, 2, 2, 2, cv2.BORDER_REPLICATE)
    mask = cv2.copyMakeBorder(np.ones((h, w), dtype=np.float32), 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=0.0)
    c, s = math.cos(picture.angle_rad), math.sin(picture.angle_rad)
    per_col, per_row = w / picture.width_m, h / picture.height_m  # pixels per metre
    step_col, step_row = patch.texel_m * per_col, patch.texel_m * per_row
    # texel (col, row) -> metres from the picture's centre -> its pixel (its rows run against its own y)
    dx0, dy0 = patch.x0 + 0.5 * patch.texel_m - x, patch.y0 + 0.5 * patch.texel_m - y
    placed = np.array(
        [
            [c * step_col, s * step_col, (c * dx0 + s * dy0) * per_col + 0.5 * (w - 1) + 2],
            [s * step_row, -c * step_row, (s * dx0 - c * dy0) * per_row + 0.5 * (h - 1) + 2],
        ]
    )
    size = (patch.n, patch.n)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    share = cv2.warpAffine(mask, placed, size, flags=flags, borderMode=cv2.BORDER_CONSTANT)
    colour = cv2.warpAffine(padded, placed, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    albedo += share[..., None] * (colour - albedo)


def _shrunk(picture: Picture, texel_m: float) -> Float32Array:
    """The picture's image with pixels of about one texel, when its own are finer."""
    w = picture.image.shape[1]
    cols, rows = round(picture.width_m / texel_m), round(picture.height_m / texel_m)
    if 2 * cols > w:
        return picture.image
    image = cv2.resize(picture.image, (max(1, cols), max(1, rows)), interpolation=cv2.INTER_AREA)
    return np.asarray(image, dtype=np.float32)
