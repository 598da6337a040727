"""Places seen again: found where they are, never where they are not, and worth something to the map."""

from __future__ import annotations

import numpy as np
import pytest

from overfly.geometry.poses import Pose
from overfly.graph.pose_graph import KINDS
from overfly.revisit.outcome import Revisit, RevisitStatus
from overfly.types import ConstraintKind, NotFound, Reason
from overfly.vision.odometry import Located

from .world import HEIGHT_M, Flight, Ground, pose_at

STEP_M = 0.6
DRIFT = np.array([0.004, 0.003, 0.001, 0.0005, -0.0004, 0.001])


def seek_last(flight: Flight, query: object) -> Revisit:
    index = len(flight.map) - 1
    rows = np.arange(len(flight.map.nodes[index].features))
    return flight.places.seek(index, query, rows)  # type: ignore[arg-type]


def there_and_back(flight: Flight, nodes: int, drift: np.ndarray | None, sigma: float) -> list[Revisit]:
    """Along x, a step aside, and back over the same ground."""
    there = [pose_at(1.0 + STEP_M * k, 0.0) for k in range(nodes)]
    back = [pose_at(1.0 + STEP_M * k, 0.15, 0.4) for k in reversed(range(nodes))]
    return [seek_last(flight, flight.add(pose, drift, sigma)) for pose in there + back]


def true_error(flight: Flight, number: int) -> Pose:
    graph = flight.map.graph
    i, j = int(graph.i[number]), int(graph.j[number])
    return (flight.truth[i].inverse() @ flight.truth[j]).inverse() @ graph.constraint(number).i_from_j


def test_the_way_back_is_recognised_and_the_drift_removed() -> None:
    flight = Flight(Ground(1, (20.0, 4.0)))
    outcomes = there_and_back(flight, 24, DRIFT, 0.01)
    returning = outcomes[-10:]
    assert all(outcome.status is RevisitStatus.NONE_NEAR for outcome in outcomes[:11])
    assert all(outcome.status is RevisitStatus.ACCEPTED for outcome in returning)
    loops = [outcome.constraint for outcome in outcomes if outcome.constraint is not None]
    assert loops
    for number in loops:
        assert KINDS[flight.map.graph.kinds[number]] is ConstraintKind.REVISIT
        assert np.linalg.norm(true_error(flight, number).translation) < 0.01 * HEIGHT_M
    alone = Flight(Ground(1, (20.0, 4.0)))
    for pose in flight.truth:
        alone.add(pose, DRIFT, 0.01)
    last = len(flight.map) - 1
    assert alone.error_m(last) > 0.1
    assert flight.error_m(last) < 0.25 * alone.error_m(last)


def around(nodes: int) -> list[Pose]:
    """A circle over ground of 12 by 12 metres, and on over its first quarter again."""
    angles = 2.0 * np.pi / nodes * np.arange(nodes + nodes // 4)
    return [pose_at(6.0 + 4.0 * np.cos(angle), 4.0 * np.sin(angle)) for angle in angles]


def test_drift_that_nobody_believed_is_found_and_believed_from_then_on() -> None:
    """Odometry that errs in one direction, so that the loop is off by five times what it claims."""
    flight, alone = Flight(Ground(1, (12.0, 12.0))), Flight(Ground(1, (12.0, 12.0)))
    outcomes = []
    for pose in around(40):
        alone.add(pose, DRIFT, 0.004)
        outcomes.append(seek_last(flight, flight.add(pose, DRIFT, 0.004)))
    waited = [k for k, outcome in enumerate(outcomes) if outcome.status is RevisitStatus.WAITING]
    accepted = [k for k, outcome in enumerate(outcomes) if outcome.status is RevisitStatus.ACCEPTED]
    assert waited  # one sighting alone is not enough to believe it
    assert waited[0] < accepted[0]
    last = len(flight.map) - 1
    assert alone.error_m(last) > 0.15
    assert flight.error_m(last) < 0.25 * alone.error_m(last)
    claimed, shown = (one.map.graph.information[20][0, 0] ** -0.5 for one in (alone, flight))
    assert 1.5 < shown / claimed < 9.0


@pytest.mark.parametrize("seed", range(3))
def test_ground_that_repeats_itself_is_no_reason_to_believe_in_drift(seed: int) -> None:
    """The same picture every 0.5 m, odometry that is right: no pose a period off is believed."""
    flight = Flight(Ground(20 + seed, (20.0, 4.0), period_m=0.5))
    for outcome in there_and_back(flight, 16, None, 0.03):
        if outcome.constraint is not None:
            assert np.linalg.norm(true_error(flight, outcome.constraint).translation) < 0.05
    assert flight.error_m(len(flight.map) - 1) < 0.1


def test_a_map_that_knows_already_gets_no_constraint() -> None:
    flight = Flight(Ground(2, (20.0, 4.0)))
    outcomes = there_and_back(flight, 16, None, 1e-5)
    accepted = [outcome for outcome in outcomes if outcome.status is RevisitStatus.ACCEPTED]
    assert len(accepted) >= 8
    assert all(outcome.constraint is None and not outcome.moved for outcome in accepted)
    assert flight.map.graph.n_constraints == len(flight.map) - 1


def test_ground_never_seen_before_is_not_recognised() -> None:
    flight = Flight(Ground(3, (40.0, 4.0)))
    for k in range(30):
        query = flight.add(pose_at(1.0 + 1.2 * k, 0.0), None, 0.5)  # so uncertain that many nodes may be near
        outcome = seek_last(flight, query)
        assert outcome.status is not RevisitStatus.ACCEPTED
    assert outcome.candidates > 0
    assert outcome.status is RevisitStatus.REJECTED
    assert outcome.reason is not None


def test_what_lies_outside_the_region_is_rejected() -> None:
    """A camera that claims to know its way and does not: a jump of 0.4 m with a standard deviation of
    millimetres."""
    flight = Flight(Ground(4, (20.0, 6.0)))
    for k in range(14):
        flight.add(pose_at(1.0 + STEP_M * k, 0.0), None, 1e-3)
    jump = np.array([0.0, 0.4, 0.0, 0.0, 0.0, 0.0])
    query = flight.add(pose_at(1.0, 0.3), jump, 1e-3)
    outcome = seek_last(flight, query)
    assert outcome.status is RevisitStatus.REJECTED
    assert outcome.constraint is None


@pytest.mark.parametrize("seed", range(4))
def test_ground_that_repeats_itself_closes_no_wrong_loop(seed: int) -> None:
    """The same picture every 0.5 m; odometry is a period off and uncertain enough to believe it."""
    flight = Flight(Ground(10 + seed, (20.0, 4.0), period_m=0.5))
    outcomes = there_and_back(flight, 16, np.array([0.012, 0.004, 0.0, 0.0, 0.0, 0.0]), 0.05)
    tried = [outcome for outcome in outcomes if outcome.status is not RevisitStatus.NONE_NEAR]
    assert len(tried) >= 10
    for outcome in tried:
        if outcome.constraint is not None:
            assert np.linalg.norm(true_error(flight, outcome.constraint).translation) < 0.05
    assert any(outcome.reason is Reason.IMPLAUSIBLE for outcome in tried)


def test_a_lost_camera_is_found_where_it_is() -> None:
    flight = Flight(Ground(5, (20.0, 4.0)))
    for k in range(24):
        flight.add(pose_at(1.0 + STEP_M * k, 0.0), None, 0.01)
    for x, yaw in ((3.1, 2.0), (12.4, -1.0), (7.7, 3.1)):
        true_pose = pose_at(x, 0.2, yaw, 1.15 * HEIGHT_M)
        query, _ = flight.ground.observe(true_pose)
        located, outcome = flight.places.relocalise(query, 10**12)
        assert isinstance(located, Located)
        assert outcome.status is RevisitStatus.ACCEPTED
        error = (true_pose.inverse() @ located.pose).log()
        assert np.linalg.norm(error[:3]) < 0.02 * HEIGHT_M
        assert np.linalg.norm(error[3:]) < 0.02


def test_a_lost_camera_over_unknown_ground_stays_lost() -> None:
    flight = Flight(Ground(6, (20.0, 4.0)))
    for k in range(12):
        flight.add(pose_at(1.0 + STEP_M * k, 0.0), None, 0.01)
    elsewhere = Ground(7, (20.0, 4.0))
    for x in (2.0, 6.0, 12.0):
        query, _ = elsewhere.observe(pose_at(x, 0.0))
        located, outcome = flight.places.relocalise(query, 10**12)
        assert isinstance(located, NotFound)
        assert outcome.status is RevisitStatus.REJECTED


def test_a_lost_camera_over_ground_that_repeats_itself_stays_lost() -> None:
    flight = Flight(Ground(8, (20.0, 4.0), period_m=0.5))
    for k in range(16):
        flight.add(pose_at(1.0 + STEP_M * k, 0.0), None, 0.01)
    for x in (3.3, 6.1):
        query, _ = flight.ground.observe(pose_at(x, 0.1))
        located, outcome = flight.places.relocalise(query, 10**12)
        assert isinstance(located, NotFound)
        assert outcome.reason is Reason.IMPLAUSIBLE


def test_the_same_flight_gives_the_same_map_bit_for_bit() -> None:
    first, second = Flight(Ground(9, (20.0, 4.0))), Flight(Ground(9, (20.0, 4.0)))
    for flight in (first, second):
        there_and_back(flight, 14, DRIFT, 0.01)
    assert np.array_equal(first.map.graph.positions, second.map.graph.positions)
    assert first.map.graph.n_constraints == second.map.graph.n_constraints


def test_tending_the_map_between_nodes_changes_what_it_costs_and_not_what_is_found() -> None:
    poses = around(40)
    outcomes = []
    for frames_between in (0, 1, 20):
        flight = Flight(Ground(1, (12.0, 12.0)))
        found = []
        for pose in poses:
            one = seek_last(flight, flight.add(pose, DRIFT, 0.004))
            found.append((one.status, one.node, one.inliers, one.constraint))
            for _ in range(frames_between):
                flight.places.tend()
        query, _ = flight.ground.observe(poses[3])
        located, _ = flight.places.relocalise(query, 10**12)
        assert isinstance(located, Located)
        outcomes.append((found, located.pose.translation.tolist()))
    assert outcomes[0] == outcomes[1] == outcomes[2]


def test_covariances_of_several_nodes_at_once_are_those_of_pairs() -> None:
    """Of X_i^-1 X_j by both nodes' joint covariance."""
    flight = Flight(Ground(1, (12.0, 12.0)))
    for pose in around(24):
        seek_last(flight, flight.add(pose, DRIFT, 0.004))
    graph, exact = flight.map.graph, flight.optimiser._current_covariance()
    last = len(graph) - 1
    nodes = [0, 3, 11, last - 1]
    for i, together in zip(nodes, flight.optimiser.relative_covariances(nodes, last), strict=True):
        difference = np.hstack([-(graph.pose(last).inverse() @ graph.pose(i)).adjoint(), np.eye(6)])
        expected = difference @ exact.joint(i, last) @ difference.T
        assert np.allclose(together, expected, rtol=1e-6, atol=1e-10 * np.abs(expected).max())
