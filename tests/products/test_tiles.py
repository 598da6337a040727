"""Tiles drawn block by block beside the same drawn pixel by pixel: who wins, seams, brightness."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from affine import Affine
from numpy.typing import NDArray

from overfly.geometry.cameras import Camera, Distortion
from overfly.geometry.poses import Pose, rotation_from_euler
from overfly.products.cog import TILE_PX
from overfly.products.elevation import ElevationGrid
from overfly.products.exposure import KNOTS, Exposure, radius
from overfly.products.georeference import transform_points
from overfly.products.tiles import Canvas, canvas, draw_tile
from overfly.products.views import MappedImage, look_up, view_of
from overfly.products.visibility import is_hidden

Array = NDArray[np.floating]
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])
CAMERAS = (
    Camera(320, 240, 260.0, 262.0, 161.0, 117.0, coefficients=(-0.08, 0.02, 0.001, -0.0005)),
    Camera(320, 240, 200.0, 201.0, 158.0, 121.0, Distortion.EQUIDISTANT, (-0.01, 0.002, 0.0, 0.0)),
)
GSD_M, SIDE, BEYOND = 0.012, 640, 64  # of the pixelwise drawing, around the tile


def relief(cell_m: float) -> ElevationGrid:
    side = round(10.0 / cell_m)
    x, y = np.meshgrid((np.arange(side) + 0.5) * cell_m - 2.0, 8.0 - (np.arange(side) + 0.5) * cell_m)
    heights = (0.3 * np.sin(0.9 * x) * np.cos(1.1 * y)).astype(np.float32)
    heights[(np.abs(x - 3.0) < 0.3) & (np.abs(y - 2.5) < 0.3)] += 0.6  # something to stand behind
    return ElevationGrid(-2.0, 8.0, cell_m, heights, np.zeros_like(heights))


def scene(seed: int, channels: int, ground: ElevationGrid, camera: Camera) -> Canvas:
    """Pictures that do not show the same, so that it can be seen which is taken."""
    random = np.random.default_rng(seed)
    images = []
    for number in range(7):
        shape = (
            (camera.height, camera.width)
            if channels == 1 or number == 3
            else (camera.height, camera.width, 3)
        )
        grain = cv2.GaussianBlur(random.normal(size=shape), (0, 0), 2.0)
        picture = np.clip(60 + 20 * number + 30 * grain / grain.std(), 0, 255).astype(np.uint8)
        rotation = rotation_from_euler(*random.normal(0, 0.06, 2), random.uniform(-3, 3)) @ LOOKING_DOWN
        place = np.array([*random.uniform(0.5, 5.5, 2), random.uniform(2.8, 3.4)])
        images.append(MappedImage(str(number), lambda shown=picture: shown, camera, Pose(rotation, place)))
    views = [view_of(image, ground, ground.height_range_m()) for image in images]
    exposure = Exposure(
        random.normal(0, 0.1, 7), -0.2 * KNOTS**2 - 0.1 * KNOTS**4 - 0.3 * np.exp(-5.0 * KNOTS)
    )
    return canvas(
        [view for view in views if view], exposure, ground, Affine(GSD_M, 0, -0.2, 0, -GSD_M, 6.2), GSD_M
    )


def between(nodes: Array, step: int) -> Array:
    """Values of blocks of step pixels, at their middles, on each pixel."""
    size = (nodes.shape[1] * step, nodes.shape[0] * step)
    return np.asarray(cv2.resize(nodes.astype(np.float32), size, interpolation=cv2.INTER_LINEAR))


def seen_by(plan: Canvas, ground: ElevationGrid, index: int, step: int) -> tuple[Array, Array]:
    """Places (k, k, 2) and cost (k, k) of the blocks of step pixels in and around the tile."""
    middles = np.arange(step / 2, SIDE, step) - BEYOND
    world = transform_points(plan.world_from_pixel, np.stack(np.meshgrid(middles, middles), axis=-1))
    points = np.concatenate(
        [world, ground.height_at(world[..., 0], world[..., 1])[..., None]], axis=-1
    ).reshape(-1, 3)
    view = plan.views[index]
    px, cost = look_up(view, plan.pictures.camera(index), points)
    cost[is_hidden(ground, points, view.image.world_from_cam.translation, plan.highest_m)] *= 1e4
    return px.reshape(*world.shape), np.minimum(cost, 1e12).reshape(world.shape[:2])


def shades_of(plan: Canvas, ground: ElevationGrid, channels: int) -> list[Array]:
    """For each view (SIDE, SIDE, 1 + channels): gain, and what is to be added."""
    places, costs = zip(*(seen_by(plan, ground, index, 8) for index in range(len(plan.views))), strict=True)
    best = np.where(np.min(costs, axis=0) < 1e12, np.argmin(costs, axis=0), -1)
    gains, tints, smooth, weights = [], [], [], []
    for index, (px, cost) in enumerate(zip(places, costs, strict=True)):
        camera = plan.pictures.camera(index)
        gain = np.exp(-plan.exposure.log_brightness(index, camera, px.reshape(-1, 2))).reshape(cost.shape)
        small = plan.pictures.get(index).small.astype(np.float32)
        place = ((px + 0.5) / 8 - 0.5).astype(np.float32)
        shown = cv2.remap(
            small, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        tint = np.ones((*cost.shape, channels))
        if small.ndim == 3 and small.shape[2] == 3:
            radii = radius(camera, px.reshape(-1, 2)).reshape(cost.shape)
            tint = np.dstack([np.exp(-np.interp(radii, KNOTS, own)) for own in plan.exposure.tint])
        shown = np.broadcast_to(shown.reshape(*cost.shape, -1), tint.shape) * tint * gain[..., None]
        seen = (cost < 1e12).astype(np.float64)
        blurred = cv2.GaussianBlur(np.dstack([shown * seen[..., None], seen]), (0, 0), 14 / 8)
        smooth.append(blurred[..., :-1] / np.maximum(blurred[..., -1:], 1e-6))
        weights.append(cv2.GaussianBlur((best == index).astype(np.float64), (15, 15), 14 / 8)[..., None])
        gains.append(gain)
        tints.append(tint)
    mixed = sum(w * s for w, s in zip(weights, smooth, strict=True)) / np.maximum(sum(weights), 1e-12)
    return [
        np.dstack([between(gain, 8), between(mixed - colour / tint, 8).reshape(SIDE, SIDE, -1)])
        for gain, tint, colour in zip(gains, tints, smooth, strict=True)
    ]


def drawn_by_pixel(plan: Canvas, ground: ElevationGrid, channels: int) -> tuple[Array, Array]:
    """(TILE_PX, TILE_PX, channels) colours and (TILE_PX, TILE_PX) which view wins, -1 for none."""
    shades = shades_of(plan, ground, channels)
    costs, places = [], []
    for index in range(len(plan.views)):
        px, cost = seen_by(plan, ground, index, plan.step_px)
        u, v = between(px[..., 0], plan.step_px), between(px[..., 1], plan.step_px)
        camera = plan.pictures.camera(index)
        inside = (u >= 1) & (v >= 1) & (u <= camera.width - 2) & (v <= camera.height - 2)
        costs.append(np.where(inside, between(np.log(cost), plan.step_px), np.inf))
        places.append((u, v))
    label = np.where(np.isfinite(np.min(costs, axis=0)), np.argmin(costs, axis=0), -1)
    colour, total = np.zeros((SIDE, SIDE, channels)), np.full((SIDE, SIDE, 1), 1e-12)
    for index, (u, v) in enumerate(places):
        warped = cv2.remap(
            plan.pictures.get(index).pixels, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        )
        mine = (label == index).astype(np.float32)
        weight = cv2.GaussianBlur(mine, (0, 0), 1.5) * np.isfinite(costs[index]) + 1e-6 * mine
        gain, shift = shades[index][..., :1], shades[index][..., 1:]
        colour += weight[..., None] * (warped.reshape(SIDE, SIDE, -1) * gain + shift)
        total += weight[..., None]
    inner = slice(BEYOND, BEYOND + TILE_PX)
    return np.clip(colour / total + 0.5, 0, 255)[inner, inner].astype(np.uint8), label[inner, inner]


@pytest.mark.parametrize("camera", CAMERAS, ids=["pinhole", "fisheye"])
@pytest.mark.parametrize(("cell_m", "step"), [(None, 8), (0.048, 4), (0.024, 2), (0.012, 1)])
@pytest.mark.parametrize("channels", [1, 3])
def test_blocks_are_drawn_as_pixels_are(
    camera: Camera, cell_m: float | None, step: int, channels: int
) -> None:
    ground = ElevationGrid.flat(0.1) if cell_m is None else relief(cell_m)
    plan = scene(step + 10 * channels, channels, ground, camera)
    assert plan.step_px == step
    tile = draw_tile(plan, (0, 0))
    assert tile is not None
    wanted, label = drawn_by_pixel(plan, ground, channels)
    assert len(np.unique(label)) >= 4
    known = tile[..., 3] == 255
    assert np.mean(known == (label >= 0)) > 0.9999
    off = np.abs(tile[..., :3].astype(int) - wanted).max(axis=2)[known & (label >= 0)]
    # slivers behind what stands out, far from all nodes that their picture wins, are left to others
    assert np.mean(off <= 1) > (0.999 if cell_m is None else 0.997)


def test_a_tile_may_be_drawn_over_another() -> None:
    plan = scene(5, 3, ElevationGrid.flat(0.0), CAMERAS[0])
    out = np.full((TILE_PX, TILE_PX, 4), 77, np.uint8)
    assert draw_tile(plan, (64, 0), out) is out
    np.testing.assert_array_equal(out, draw_tile(replace(plan), (64, 0)))


def test_no_tile_where_nobody_looks() -> None:
    plan = scene(5, 3, ElevationGrid.flat(0.0), CAMERAS[0])
    assert draw_tile(plan, (100 * TILE_PX, 0)) is None
