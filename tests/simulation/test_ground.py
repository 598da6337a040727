"""The painted ground: without seams, the same at every scale, exact where shapes and pictures are."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.simulation import fields, materials, paving, strewn
from overfly.simulation.ground import Ground, Layer, Picture
from overfly.simulation.kernels import LEVELS, TILE, find_tile, tile_key
from overfly.simulation.noise import _lattice_gradients, fractal_noise, hashed_uniform
from overfly.simulation.patches import Patch, band, disc, line_coverage, rectangle
from overfly.simulation.scatter import Outline, draw
from overfly.simulation.tiles import TileCache

MATERIALS = {
    "grass": materials.grass,
    "meadow": materials.meadow,
    "soil": materials.soil,
    "sand": materials.sand,
    "gravel": materials.gravel_bed,
    "forest": materials.forest_floor,
    "crown": materials.crown,
    "plain": materials.plain(0.3, 0.2, 0.1),
    "slabs": paving.slabs(),
    "bricks": paving.bricks(),
    "asphalt": paving.asphalt,
    "concrete": paving.concrete,
    "wood": paving.wood_floor(),
    "tiles": paving.tiled_floor(),
    "carpet": paving.carpet_tiles(),
    "farmland": fields.farmland,
}


@pytest.mark.parametrize("name", MATERIALS)
def test_materials_have_no_seams_and_are_reflectances(name: str) -> None:
    whole = MATERIALS[name](Patch(-0.37, 1.21, 0.004, 96), 5)
    part = MATERIALS[name](Patch(-0.37 + 40 * 0.004, 1.21 + 24 * 0.004, 0.004, 48), 5)
    assert whole.shape == (96, 96, 3)
    assert np.abs(whole[24:72, 40:88] - part).max() < 2e-3
    assert 0.0 <= np.clip(whole, 0, 1).mean() < 0.8
    assert not np.array_equal(whole, MATERIALS[name](Patch(-0.37, 1.21, 0.004, 96), 6)) or name == "plain"


@pytest.mark.parametrize("name", ["grass", "slabs", "wood", "farmland", "asphalt"])
def test_scales_agree(name: str) -> None:
    """A coarse patch is about the fine one averaged: what is seen from higher up is the same ground."""
    texel = 0.16 if name == "farmland" else 0.01
    fine = Ground((Layer(MATERIALS[name]),), seed=2).paint(Patch(0.0, 0.0, texel, 128))[..., 1]
    coarse = Ground((Layer(MATERIALS[name]),), seed=2).paint(Patch(0.0, 0.0, 2 * texel, 64))[..., 1]
    averaged = fine.reshape(64, 2, 64, 2).mean(axis=(1, 3))
    assert np.corrcoef(averaged.ravel(), coarse.ravel())[0, 1] > 0.8
    assert math.isclose(averaged.mean(), coarse.mean(), rel_tol=0.05)


def test_strewn_things_do_not_stop_at_patch_edges() -> None:
    ground = Ground((Layer(paving.concrete, None, (strewn.LEAVES, strewn.TWIGS, strewn.PEBBLES)),), seed=9)
    whole = ground.paint(Patch(0.0, 0.0, 0.005, 120))
    for row, col in ((0, 0), (0, 60), (60, 0), (60, 60)):
        part = ground.paint(Patch(col * 0.005, row * 0.005, 0.005, 60))
        assert np.abs(whole[row : row + 60, col : col + 60] - part).max() < 1e-3
    bare = Ground((Layer(paving.concrete),), seed=9).paint(Patch(0.0, 0.0, 0.005, 120))
    assert 0.002 < (np.abs(whole - bare).max(axis=2) > 0.05).mean() < 0.3


def test_the_tiled_floor_repeats() -> None:
    """Two tiles on, the pattern is the same but for dirt; one tile on, it is not."""
    floor = paving.tiled_floor(0.30)
    here = floor(Patch(0.0, 0.0, 0.003, 100), 1)
    two_on = floor(Patch(0.6, 0.0, 0.003, 100), 1)
    one_on = floor(Patch(0.3, 0.0, 0.003, 100), 1)
    assert np.corrcoef(here.ravel(), two_on.ravel())[0, 1] > 0.99
    assert np.abs(here - two_on).mean() < 0.15 * np.abs(here - one_on).mean()


def noise_twin(x: np.ndarray, y: np.ndarray, gradients: np.ndarray) -> np.ndarray:
    """Gradient noise in NumPy, one octave."""
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    u, v = x - i, y - j
    corner = {
        (b, a): gradients[j + b, i + a, 0] * (u - a) + gradients[j + b, i + a, 1] * (v - b)
        for a in (0, 1)
        for b in (0, 1)
    }
    wu, wv = (t**3 * (t * (6 * t - 15) + 10) for t in (u, v))
    low = corner[0, 0] + wu * (corner[0, 1] - corner[0, 0])
    high = corner[1, 0] + wu * (corner[1, 1] - corner[1, 0])
    return low + wv * (high - low)


def test_noise_equals_its_twin() -> None:
    made = fractal_noise(0.013, 0.021, 0.01, (40, 50), 3, 0.25, finest_m=0.2)
    x = (0.013 + (np.arange(50) + 0.5) * 0.01)[None, :] / 0.25 + np.zeros((40, 1))
    y = (0.021 + (np.arange(40) + 0.5) * 0.01)[:, None] / 0.25 + np.zeros((1, 50))
    twin = noise_twin(x, y, _lattice_gradients(0, 0, 4, 4, 3).astype(float))
    assert np.abs(made - 4.0 * twin).max() < 1e-4  # one octave is scaled by 1 / 0.25


def test_noise_has_about_unit_deviation_and_no_offset() -> None:
    made = fractal_noise(0.0, 0.0, 0.01, (500, 500), 1, 0.2)
    assert 0.7 < made.std() < 1.3
    assert abs(made.mean()) < 0.1
    assert np.abs(fractal_noise(0.0, 0.0, 1.0, (50, 50), 1, 0.2)).max() == 0.0, "too fine to be seen"


@given(st.integers(0, 2**31), st.integers(0, 50))
@settings(max_examples=20, deadline=None)
def test_hashed_numbers_are_uniform_and_repeat(seed: int, channel: int) -> None:
    i, j = np.meshgrid(np.arange(-40, 40), np.arange(-40, 40))
    u = hashed_uniform(i, j, channel, seed)
    assert np.array_equal(u, hashed_uniform(i, j, channel, seed))
    assert abs(u.mean() - 0.5) < 0.03
    assert abs(u.var() - 1 / 12) < 0.01
    assert abs(np.corrcoef(u[:, 1:].ravel(), u[:, :-1].ravel())[0, 1]) < 0.06


@given(st.floats(-0.3, 0.3), st.floats(0.001, 0.2), st.floats(0.001, 0.2))
def test_line_coverage_is_an_exact_box_filter(distance: float, width: float, texel: float) -> None:
    low, high = max(distance - texel / 2, -width / 2), min(distance + texel / 2, width / 2)
    expected = max(0.0, high - low) / texel
    assert math.isclose(float(line_coverage(np.array([distance]), width, texel)[0]), expected, abs_tol=1e-6)


@pytest.mark.parametrize(
    ("shape", "area"),
    [
        (rectangle((0.1, -0.2), (1.0, 0.5), 0.4), 0.5),
        (disc((0.0, 0.1), 0.6), math.pi * 0.36),
        (band(np.array([[-0.5, 0.0], [0.5, 0.0]]), 0.2), 0.2 + math.pi * 0.01),
    ],
)
def test_shapes_cover_their_area(shape, area: float) -> None:  # type: ignore[no-untyped-def]
    patch = Patch(-1.5, -1.5, 0.01, 300)
    assert math.isclose(shape.coverage(patch.x, patch.y, 0.01).sum() * 0.01**2, area, rel_tol=0.01)
    far = Patch(50.0, 50.0, 0.01, 30)
    assert not shape.coverage(far.x, far.y, 0.01).any()


@pytest.mark.parametrize("texel", [0.002, 0.005, 0.02, 0.06])
@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_pictures_stay_where_they_are_at_every_scale(texel: float, angle: float) -> None:
    y, x = np.mgrid[-1:1:128j, -1:1:128j]
    blob = np.repeat(np.exp(-(x**2 + y**2) / 0.08)[..., None], 3, axis=2).astype(np.float32)
    ground = Ground(
        (Layer(materials.plain(0.0, 0.0, 0.0)),), (Picture("dot", blob, (0.37, -0.21), 0.6, angle),)
    )
    patch = Patch(-0.4, -1.0, texel, round(1.6 / texel))
    seen = ground.paint(patch)[..., 0].astype(float)
    assert abs((seen * patch.x).sum() / seen.sum() - 0.37) < 0.02 * texel
    assert abs((seen * patch.y).sum() / seen.sum() + 0.21) < 0.02 * texel


def test_pictures_face_the_right_way() -> None:
    image = np.zeros((64, 64, 3), dtype=np.float32)
    image[:32, :32] = 1.0  # top left of the picture: -x, +y on the ground
    ground = Ground((Layer(materials.plain(0.0, 0.0, 0.0)),), (Picture("corner", image, (0.0, 0.0), 1.0),))
    patch = Patch(-0.5, -0.5, 0.01, 100)
    seen = ground.paint(patch)[..., 0]
    assert seen[75, 25] > 0.99  # row 75 is y = +0.25
    assert seen[25, 25] < 0.01
    assert seen[75, 75] < 0.01


def test_tile_keys_are_distinct_and_the_cache_is_bounded() -> None:
    keys = {
        tile_key(level, i, j) for level in (0, 5, LEVELS - 1) for i in (-900, -1, 0, 7) for j in (-3, 0, 800)
    }
    assert len(keys) == 36

    def paint(patch: Patch) -> np.ndarray:
        return np.full((patch.n, patch.n, 3), 0.5, dtype=np.float32)

    cache = TileCache(paint, channels=1, capacity=8)
    for i in range(30):
        cache.tick()
        cache.add(np.array([tile_key(4, i, 0)]))
    assert cache.pool.shape == (8, TILE + 1, TILE + 1, 1)
    present = [i for i in range(30) if find_tile(tile_key(4, i, 0), cache.keys, cache.table) >= 0]
    assert present == list(range(22, 30)), "the youngest are kept"
    assert abs(int(cache.pool.max()) - 32768) <= 1


def test_tiles_one_and_three_channels_agree() -> None:
    ground = Ground((Layer(materials.grass),), seed=1)
    grey, colour = TileCache(ground.paint, 1, 4), TileCache(ground.paint, 3, 4)
    for cache in (grey, colour):
        cache.add(np.array([tile_key(4, 1, 2)]))
    luminance = colour.pool[0] @ np.array([0.2126, 0.7152, 0.0722])
    assert np.abs(grey.pool[0, ..., 0] - luminance).max() < 2.0
    with pytest.raises(ValueError, match="1 or 3 channels"):
        TileCache(ground.paint, 2)


@pytest.mark.parametrize(
    ("outline", "share"),
    [(Outline.ELLIPSE, math.pi / 4), (Outline.RECTANGLE, 1.0), (Outline.LEAF, 2 / 3), (Outline.BLADE, 0.5)],
)
def test_strewn_things_cover_their_area(outline: Outline, share: float) -> None:
    """Ellipse pi/4, rectangle 1, leaf (a parabola) 2/3, blade (a wedge) 1/2 of length times width."""
    albedo = np.zeros((200, 200, 3), dtype=np.float32)
    thing = np.array([[0.5, 0.5, 0.6, 0.3, 0.1, 1.0, 1.0, 1.0, 0.0]])
    draw(albedo, Patch(0.0, 0.0, 0.005, 200), thing, np.ones(1), outline)
    covered = float((albedo[..., 0] > 0.5).sum()) * 0.005**2
    assert math.isclose(covered, share * 0.6 * 0.2, rel_tol=0.05)
