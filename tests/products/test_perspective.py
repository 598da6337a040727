"""The map seen from the side: what is left stays left, what is tall hides what is behind it."""

from __future__ import annotations

import numpy as np
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st

from overfly.products.elevation import ElevationGrid
from overfly.products.perspective import PALE, PALE_SHARE, perspective_view
from overfly.products.pictures import MapPicture

ROWS, COLUMNS, CELL_M = 60, 120, 0.1


def coloured(
    heights: np.ndarray, x0: float = 0.0, y0: float = 0.0, cell_m: float = CELL_M
) -> tuple[MapPicture, ElevationGrid]:
    """Red left half, green right half, blue strip along the far (northern) edge; five pixels to a cell."""
    rgba = np.zeros((5 * ROWS, 5 * COLUMNS, 4), np.uint8)
    rgba[..., 3] = 255
    rgba[:, : 5 * COLUMNS // 2, 0] = 200
    rgba[:, 5 * COLUMNS // 2 :, 1] = 200
    rgba[:60] = (0, 0, 200, 255)
    step = cell_m / 5
    grid = ElevationGrid(x0, y0, cell_m, heights.astype(np.float32), np.zeros_like(heights, np.float32))
    return MapPicture(rgba, Affine(step, 0, x0, 0, -step, y0)), grid


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.floats(0.01, 10), st.floats(-50, 50))
def test_level_ground_looks_the_same_wherever_it_lies(x0: float, y0: float, cell: float, z: float) -> None:
    view = perspective_view(*coloured(np.full((ROWS, COLUMNS), z), x0, y0, cell), width_px=200)
    assert view is not None
    rgba = view.rgba
    assert rgba.shape[1] == 200 and 40 < rgba.shape[0] < 200
    seen = rgba[..., 3] > 0
    columns = np.nonzero(seen.any(axis=0))[0]
    assert columns[0] < 14 and columns[-1] > 185  # it fills the picture
    near = rgba[int(0.8 * rgba.shape[0])]
    assert (near[40:90, 0] > 100).all() and (near[110:160, 1] > 100).all()
    blue = np.nonzero(rgba[..., 2] > 100)[0]
    assert len(blue) > 0 and blue.max() < 0.5 * rgba.shape[0]
    assert not seen[0].any() and not seen[-1, :5].any()


def test_a_tower_hides_the_ground_behind_it() -> None:
    heights = np.zeros((ROWS, COLUMNS))
    heights[25:30, 50:70] = 3.0
    flat = perspective_view(*coloured(np.zeros((ROWS, COLUMNS))), width_px=300)
    tower = perspective_view(*coloured(heights), width_px=300)
    assert flat is not None and tower is not None
    assert tower.raised == 1.0
    blue = [
        np.count_nonzero(view.rgba[..., 2] > 100) / np.count_nonzero(view.rgba[..., 3])
        for view in (flat, tower)
    ]
    assert 0.04 < blue[1] < 0.9 * blue[0]


def test_ground_without_a_height_is_pale_and_where_nothing_was_seen_is_nothing() -> None:
    heights = np.zeros((ROWS, COLUMNS))
    whole = perspective_view(*coloured(heights), width_px=200)
    heights[20:40, 40:80] = np.nan
    picture, grid = coloured(heights)
    pale = perspective_view(picture, grid, width_px=200)
    picture.rgba[100:200, 200:400] = 0
    holed = perspective_view(picture, grid, width_px=200)
    assert whole is not None and pale is not None and holed is not None
    assert pale.has_pale and not whole.has_pale and not holed.has_pale
    np.testing.assert_array_equal(pale.rgba[..., 3], whole.rgba[..., 3])
    mixed = pale.rgba != whole.rgba
    ground = np.count_nonzero(whole.rgba[..., 3])
    assert 0.05 < np.count_nonzero(mixed.any(axis=2)) / ground < 0.2  # a ninth of the ground is unknown
    there = mixed.any(axis=2)
    expected = (1.0 - PALE_SHARE) * whole.rgba[there, :3] + PALE_SHARE * PALE
    assert np.abs(pale.rgba[there, :3] - expected).max() <= 1.0
    share = np.count_nonzero(holed.rgba[..., 3]) / ground
    assert 0.8 < share < 0.95
    assert perspective_view(*coloured(np.full((ROWS, COLUMNS), np.nan))) is None
