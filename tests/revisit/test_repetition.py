"""Ground that repeats itself where the map does not show the true place: nothing is believed that dead
reckoning cannot tell from it, and nothing is lost that it can."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from overfly.geometry.poses import Pose
from overfly.revisit import repetition
from overfly.revisit.found import Doubt
from overfly.revisit.outcome import Revisit, RevisitStatus
from overfly.types import Reason

from .test_places import seek_last, true_error
from .world import CAMERA, Flight, Ground, pose_at

PERIOD_M = 1.2  # of a view 1.92 metres long
SIZE_M = (12.0, 16.0)


def out_and_back(flight: Flight, aside_m: float, sigma: float) -> list[Revisit]:
    """Across the ground along y, and back aside of it; the outcomes of the way back."""
    y = np.arange(-4.0, 4.0, 0.6)
    there = [pose_at(3.0, float(one)) for one in y]
    back = [pose_at(3.0 + aside_m, float(one)) for one in y[::-1]]
    for pose in there:
        seek_last(flight, flight.add(pose, None, sigma))
    return [seek_last(flight, flight.add(pose, None, sigma)) for pose in back]


def errors_m(flight: Flight, outcomes: list[Revisit]) -> list[float]:
    numbers = [outcome.constraint for outcome in outcomes if outcome.constraint is not None]
    return [float(np.linalg.norm(true_error(flight, number).translation)) for number in numbers]


def test_a_place_that_only_looks_right_is_ambiguous_though_the_map_shows_no_other() -> None:
    """One period further aside than ground the map shows: of the true place it shows a fifth, too little to
    be tied there, or to be a rival everywhere along the way."""
    n_doubted = 0
    for seed in range(30, 34):
        flight = Flight(Ground(seed, SIZE_M, period_m=PERIOD_M))
        outcomes = out_and_back(flight, PERIOD_M + 0.35, 0.045)
        doubted = [outcome for outcome in outcomes if outcome.detail == str(Doubt.REPEATED)]
        assert all(outcome.reason is Reason.IMPLAUSIBLE for outcome in doubted)
        assert not errors_m(flight, outcomes)
        n_doubted += len(doubted)
    assert n_doubted >= 4


@pytest.mark.parametrize("seed", range(3))
def test_small_drift_tells_the_true_place_from_its_copies(seed: int) -> None:
    flight = Flight(Ground(40 + seed, SIZE_M, period_m=PERIOD_M))
    outcomes = out_and_back(flight, 0.1, 0.04)
    accepted = [outcome for outcome in outcomes if outcome.status is RevisitStatus.ACCEPTED]
    assert len(accepted) >= 2
    errors = errors_m(flight, outcomes)
    assert errors
    assert max(errors) < 0.05


@pytest.mark.parametrize("seed", range(3))
def test_a_copy_that_the_map_shows_to_be_different_is_no_rival(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of the points are alike nowhere: the ground still repeats itself, dead reckoning tells nothing,
    and the map does."""
    compared = []
    inliers_at = repetition._n_inliers_at

    def noted(*arguments: object) -> int:
        compared.append(inliers_at(*arguments))  # type: ignore[arg-type]
        return compared[-1]

    monkeypatch.setattr(repetition, "_n_inliers_at", noted)
    flight = Flight(Ground(50 + seed, SIZE_M, period_m=1.0, unlike_share=0.5))
    outcomes = out_and_back(flight, 0.1, 0.08)
    assert compared  # the question arose
    accepted = [outcome for outcome in outcomes if outcome.status is RevisitStatus.ACCEPTED]
    assert len(accepted) >= 5
    errors = errors_m(flight, outcomes)
    assert errors
    assert max(errors) < 0.05


def test_ground_out_of_sight_from_the_place_found_cannot_show_itself_again() -> None:
    """A pose that looks away from all of it: no shift, and no warning of means of nothing."""
    ground = np.column_stack([np.linspace(-0.5, 0.5, 9), np.zeros(9), np.zeros(9)])
    here = pose_at(0.0, 0.0)
    away = Pose(here.rotation @ np.diag([1.0, -1.0, -1.0]), here.translation)
    verifier, pool = SimpleNamespace(camera=CAMERA), SimpleNamespace(points=ground)
    near = pose_at(0.1, 0.0)

    def largest(found: Pose) -> float:
        return repetition._largest_shift_px(verifier, pool, here, found, 1e-6 * np.eye(6))  # type: ignore[arg-type]

    assert largest(away) == 0.0
    assert 0.5 < largest(near) / (0.1 / here.translation[2] * CAMERA.fx) < 2.0
