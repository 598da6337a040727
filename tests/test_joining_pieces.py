"""Pieces of a map between which the camera was lost, and which GPS places."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace

import numpy as np
import pytest

from overfly.config import Config
from overfly.evaluation import Align, evaluate
from overfly.graph.pose_graph import KINDS
from overfly.pipeline.georeferencing import georeference
from overfly.pipeline.joining_pieces import join_pieces_by_position
from overfly.pipeline.recording import Recording, record_flight
from overfly.simulation import simulate
from overfly.simulation.scenario import Trouble, declared
from overfly.slam import Slam
from overfly.trajectory import Trajectory
from overfly.types import ConstraintKind


@dataclass(frozen=True)
class Flown:
    """A survey whose lens was covered for a while, before and after GPS joined it."""

    recording: Recording
    truth: Trajectory
    before: Trajectory
    n_pieces: int
    n_seen: int
    joined_by_poor_gps: int
    joined_without_gps: int


@pytest.fixture(scope="module")
def survey() -> Flown:
    scenario = declared("survey").build(1)
    start_s = scenario.path.start_s
    scenario = dataclasses.replace(scenario, trouble=Trouble(((start_s + 24.0, start_s + 38.0),)))
    flight = simulate(scenario, seed=1, frames=36, size=(320, 240))
    recording = record_flight(flight, Slam(flight.rig, Config()), lambda *_: None)
    pieces, before = recording.slam.map.pieces(), recording.trajectory()
    poor = {t: replace(position, sigma_horizontal_m=60.0) for t, position in recording.positions.items()}
    by_poor_gps = join_pieces_by_position(replace(recording, positions=poor))
    without_gps = join_pieces_by_position(replace(recording, positions={}))
    assert georeference(recording) is not None
    truth = Trajectory.from_poses(flight.stamps_ns, flight.truth)
    n_seen = sum(not flight.is_black(index) for index in range(len(flight)))
    return Flown(recording, truth, before, len(np.unique(pieces)), n_seen, by_poor_gps, without_gps)


def test_both_pieces_are_in_the_results(survey: Flown) -> None:
    assert survey.n_pieces == 2
    assert len(np.unique(survey.recording.slam.map.pieces())) == 1
    after = survey.recording.trajectory()
    assert len(after.t_ns) > len(survey.before.t_ns) + 4
    assert len(after.t_ns) >= survey.n_seen - 6  # some are lost until a new piece begins
    kinds = survey.recording.slam.map.graph.kinds
    assert np.count_nonzero(kinds == KINDS.index(ConstraintKind.POSITIONS)) == 1


def test_they_lie_as_exactly_as_gps(survey: Flown) -> None:
    """White noise of 0.6 m and a bias of 1.2 m that wanders slowly."""
    found = evaluate(survey.recording.trajectory(), survey.truth, Align.SE3)
    assert 0.02 < found.ate_m.rmse < 1.5
    assert found.scale_error is not None
    assert abs(found.scale_error) < 0.02


def test_joining_again_changes_nothing(survey: Flown) -> None:
    positions = survey.recording.slam.map.graph.positions.copy()
    assert join_pieces_by_position(survey.recording) == 0
    np.testing.assert_array_equal(survey.recording.slam.map.graph.positions, positions)


def test_positions_that_do_not_tell_a_heading_join_nothing(survey: Flown) -> None:
    assert survey.joined_by_poor_gps == 0
    assert survey.joined_without_gps == 0
