"""Pieces of a map over ground that repeats itself: joined where views tell its places apart, else never."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from overfly.revisit.evidence import FEWEST_DECIDED, FEWEST_VIEWS, Support, share_of_rival
from overfly.types import ConstraintKind

from .world import Flight, Ground, pose_at

PERIOD_M = 0.7
STEP_M = 0.5
UNLIKE = 0.3  # of the points: too few for one view to be believed
RECKONED = np.array([0.5, 0.4, 0.0, 0.0, 0.0, 0.05])


def two_pieces(ground: Ground, first: int, second_from_m: float, second: int) -> Flight:
    """A piece along x, then, after a gap that was only reckoned, another one a step beside it."""
    flight = Flight(ground)
    for k in range(first):
        flight.add(pose_at(1.5 + STEP_M * k, 0.0))
    for k in range(second):
        pose = pose_at(second_from_m + STEP_M * k, 0.1, 0.05)
        lost = (RECKONED, 1.5, ConstraintKind.DEAD_RECKONING)
        query = flight.add(pose, *lost) if k == 0 else flight.add(pose)
        flight.places.seek(first + k, query, np.arange(len(query.features)))
    return flight


def is_joined(flight: Flight) -> bool:
    return len(np.unique(flight.map.pieces())) == 1


@pytest.mark.parametrize("seed", [1, 2])
def test_exactly_repeated_ground_never_joins_pieces(seed: int) -> None:
    assert not is_joined(two_pieces(Ground(seed, (14.0, 4.0), PERIOD_M), 16, 2.0, 10))


@pytest.mark.parametrize("seed", [1, 2])
def test_what_is_unlike_the_rest_tells_where_a_piece_lies(seed: int) -> None:
    assert not is_joined(two_pieces(Ground(seed, (14.0, 4.0), PERIOD_M, UNLIKE), 16, 2.0, 1))
    flight = two_pieces(Ground(seed, (14.0, 4.0), PERIOD_M, UNLIKE), 16, 2.0, 10)
    assert is_joined(flight)
    assert 1e-5 < max(flight.error_m(node) for node in range(16, 26)) < 0.1


@pytest.mark.parametrize("seed", [1, 2])
def test_a_piece_beside_the_other_is_not_joined_to_it(seed: int) -> None:
    """The same ground, but the older piece shows none of what the newer one does."""
    assert not is_joined(two_pieces(Ground(seed, (22.0, 4.0), PERIOD_M, UNLIKE), 12, 12.0, 10))


def supports(fits: np.ndarray, distance: np.ndarray) -> dict[int, Support]:
    held = np.ones(fits.shape[1], np.bool_)
    return {k: Support(held, fits[k], distance[k], None) for k in range(len(fits))}


@given(st.integers(0, 2**32 - 1), st.floats(0.3, 0.9), st.floats(0.3, 0.9))
def test_shares_of_two_hypotheses_are_each_others_inverse(seed: int, likely: float, other: float) -> None:
    generator = np.random.default_rng(seed)
    shape = (FEWEST_VIEWS, 4 * FEWEST_DECIDED)
    one, two = (
        supports(generator.random(shape) < share, generator.random(shape).astype(np.float32))
        for share in (likely, other)
    )
    forth, back = share_of_rival(one, two), share_of_rival(two, one)
    assert forth is not None and back is not None
    assert forth * back == pytest.approx(1.0)
    if abs(likely - other) > 0.2:
        assert (forth < 1.0) == (likely > other)


def test_too_little_common_ground_tells_nothing() -> None:
    fits = np.ones((FEWEST_VIEWS - 2, 400), np.bool_)
    one, two = (
        supports(fits, np.ones(fits.shape, np.float32)),
        supports(~fits, np.ones(fits.shape, np.float32)),
    )
    assert share_of_rival(one, two) is None
    alike = np.ones((FEWEST_VIEWS, 400), np.bool_)
    same = supports(alike, np.ones(alike.shape, np.float32))
    assert share_of_rival(same, same) is None
