"""Rays meet the height field where they should, however they come."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overfly.simulation.relief import HeightField, build_relief
from overfly.simulation.terrain import Terrain


def rough(seed: int = 4) -> HeightField:
    """Steep random ground, 40 x 30 cells of 0.1 m, level at its rim."""
    z = 0.4 * np.random.default_rng(seed).random((31, 41))
    z[[0, -1]] = z[:, [0, -1]] = 0.0
    return build_relief(z, -2.0, -1.5, 0.1)


GROUND = rough()
coordinate = st.floats(-2.5, 2.5)


@given(coordinate, coordinate, st.floats(0.5, 4.0), st.floats(-0.9, 0.9), st.floats(-0.9, 0.9))
@settings(max_examples=300, deadline=None)
def test_first_crossing_as_a_fine_march_finds_it(x: float, y: float, z: float, dx: float, dy: float) -> None:
    origin, direction = np.array([[x, y, z]]), np.array([[dx, dy, -1.0]])
    t = float(GROUND.ranges(origin, direction)[0])
    hit = origin[0] + t * direction[0]
    assert abs(hit[2] - GROUND.height(hit[:1], hit[1:2])[0]) < 1e-6 or _on_border(hit)
    marched = origin + np.linspace(0.0, max(t - 2e-3, 0.0), 800)[:, None] * direction
    assert (marched[:, 2] >= GROUND.height(marched[:, 0], marched[:, 1]) - 1e-6).all(), (
        "nothing was passed through"
    )


def _on_border(point: np.ndarray) -> bool:
    """At the very edge of the grid the height is that of the grid or of the plane, depending on rounding."""
    return min(abs(point[0] + 2.0), abs(point[0] - 2.0), abs(point[1] + 1.5), abs(point[1] - 1.5)) < 1e-6


def test_the_grid_is_met_from_outside_and_the_plane_beyond() -> None:
    relief = build_relief(np.pad(np.full((5, 5), 1.0), 2), 0.0, 0.0, 0.5, border_m=0.0)
    origins = np.array([[-3.0, 2.0, 3.0], [10.0, 10.0, 3.0], [2.0, 2.0, 5.0]])
    directions = np.array([[1.8, 0.0, -1.0], [0.1, 0.1, -1.0], [0.0, 0.0, -1.0]])
    ranges = relief.ranges(origins, directions)
    assert math.isclose(ranges[0], 2.0, abs_tol=0.7)  # onto the block from the side
    assert ranges[0] < 3.0
    assert math.isclose(ranges[1], 3.0)
    assert math.isclose(ranges[2], 4.0)


def test_rays_that_do_not_descend_meet_nothing() -> None:
    assert np.isinf(
        GROUND.ranges(np.array([[0.0, 0.0, 3.0]] * 2), np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    ).all()


def test_boxes_have_their_height_and_cast_shadows() -> None:
    terrain = Terrain((-4.0, -4.0, 4.0, 4.0), 0.05).box((0.0, 0.0), (1.0, 0.6), 0.5)
    relief = terrain.build()
    assert math.isclose(relief.height(np.array([0.0]), np.array([0.0]))[0], 0.5, abs_tol=1e-6)
    assert relief.height(np.array([0.8]), np.array([0.0]))[0] == 0.0
    # the sun stands in the south-west: the shade falls north-east, 0.5 m of box throw about 0.35 m
    lit = relief.light[round(4.0 / 0.05) - 14, round(4.0 / 0.05)]
    shade = relief.light[round((4.0 + 0.4) / 0.05), round(4.0 / 0.05)]
    assert shade < 0.5
    assert lit > 0.95


def test_open_level_ground_has_full_light() -> None:
    assert np.allclose(Terrain((0.0, 0.0, 5.0, 5.0), 0.1).build().light, 1.0)


@pytest.mark.parametrize("bad", [np.zeros(4), np.full((3, 3), np.nan), np.zeros((1, 9))])
def test_impossible_grids_are_refused(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="finite heights"):
        build_relief(bad, 0.0, 0.0, 1.0)


def test_trees_stand_up_and_end_at_their_radius() -> None:
    relief = Terrain((-20.0, -20.0, 20.0, 20.0), 0.2).tree((3.0, -2.0), 3.0, 6.0, 1).build()
    assert 4.0 < relief.highest_m <= 6.0
    assert relief.height(np.array([3.0 + 3.3]), np.array([-2.0]))[0] == 0.0
    assert relief.height(np.array([3.0]), np.array([-2.0]))[0] > 3.5
