"""Pieces of the map: a camera that is lost over new ground goes on mapping, and both pieces become one when
they see the same ground."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from overfly.config import Config
from overfly.evaluation import Align, evaluate
from overfly.frame_result import FrameResult
from overfly.geometry.levelling import NADIR_BODY_FROM_CAM
from overfly.geometry.poses import Pose, rotation_z
from overfly.graph.pose_graph import PoseGraph, State
from overfly.pieces import LostWatch, dead_reckon, find_pieces, lay_onto, main_piece
from overfly.simulation import SimulatedFlight
from overfly.simulation.scenarios.demo import demo
from overfly.slam import Slam
from overfly.trajectory import Trajectory
from overfly.types import Attitude, Constraint, ConstraintKind, Features, Frame
from overfly.vision.features import create_extractor
from overfly.vision.refine import HeightPrior, TiltPrior

CARRIED_S = (3.0, 6.0)  # of the demo's loop, flown without a picture


def test_pieces_are_what_is_tied_by_more_than_dead_reckoning() -> None:
    graph = PoseGraph()
    for _ in range(6):
        graph.add_node(Pose.identity())
    for i, j, kind in (
        (0, 1, ConstraintKind.ODOMETRY),
        (1, 2, ConstraintKind.DEAD_RECKONING),
        (2, 3, ConstraintKind.ODOMETRY),
        (3, 4, ConstraintKind.DEAD_RECKONING),
        (4, 5, ConstraintKind.ODOMETRY),
    ):
        graph.add_constraint(Constraint(i, j, Pose.identity(), np.eye(6), kind))
    assert find_pieces(graph).tolist() == [0, 0, 2, 2, 4, 4]
    assert main_piece(graph, np.array([0, 3, 3, 2, 5])).tolist() == [False, False, True, True, False, False]
    graph.add_constraint(Constraint(1, 5, Pose.identity(), np.eye(6), ConstraintKind.REVISIT))
    assert find_pieces(graph).tolist() == [0, 0, 2, 2, 0, 0]
    graph.states[5] = State.REJECTED  # voted out: no longer one piece
    assert find_pieces(graph).tolist() == [0, 0, 2, 2, 4, 4]


@given(st.floats(-math.pi, math.pi), st.floats(-5, 5), st.floats(-5, 5), st.floats(-1, 1))
def test_a_piece_is_laid_rigidly_to_where_its_camera_was_found(
    turn: float, x: float, y: float, z: float
) -> None:
    graph = PoseGraph()
    poses = [Pose.exp(np.array([k, 0.5 * k, 2.0, 0.02 * k, 0.01, 0.3 * k])) for k in range(4)]
    for pose in poses:
        graph.add_node(pose)
    moved = Pose(rotation_z(turn), np.array([x, y, z]))
    lay_onto(graph, np.array([1, 2, 3]), moved @ poses[2], poses[2])
    np.testing.assert_allclose(graph.pose(0).matrix(), poses[0].matrix(), atol=1e-12)
    for k in (1, 2, 3):
        np.testing.assert_allclose(graph.pose(k).matrix(), (moved @ poses[k]).matrix(), atol=1e-9)


def frame_at(t_s: float, attitude: Attitude | None = None) -> Frame:
    return Frame(0, int(t_s * 1e9), "", (), attitude=attitude)


def test_dead_reckoning_knows_less_the_longer_it_lasts() -> None:
    last = Pose(rotation_z(0.7) @ NADIR_BODY_FROM_CAM, np.array([3.0, -2.0, 2.5]))
    tilt = TiltPrior(NADIR_BODY_FROM_CAM, 0.01)
    height = HeightPrior(2.0, 0.05)
    sizes = []
    for gap_s in (1.0, 4.0, 30.0):
        reckoned = dead_reckon(last, np.zeros(3), 0, frame_at(gap_s), tilt, height, NADIR_BODY_FROM_CAM)
        np.testing.assert_allclose(reckoned.pose.translation, [3.0, -2.0, 2.0])
        np.testing.assert_allclose(reckoned.pose.rotation, last.rotation, atol=1e-12)
        sizes.append(np.sqrt(np.linalg.eigvalsh(reckoned.covariance[:3, :3])))
        assert math.isclose(sizes[-1][0], 0.05, rel_tol=1e-6)  # the range sensor still knows the height
    assert sizes[0][2] < sizes[1][2] < sizes[2][2]


@given(st.floats(0.0, 20.0), st.floats(-3.0, 3.0), st.floats(0.05, 60.0))
def test_neither_stopping_nor_going_on_surprises_dead_reckoning(
    forward: float, sideways: float, gap_s: float
) -> None:
    """A camera that stops where it was lost, and one that keeps its velocity: within two standard deviations
    each, once there was time to stop; and the region is no wider than the way that may have been flown."""
    last = Pose(rotation_z(0.7) @ NADIR_BODY_FROM_CAM, np.array([3.0, -2.0, 2.0]))
    velocity = np.array([forward, sideways, 0.0])
    tilt = TiltPrior(NADIR_BODY_FROM_CAM, 0.01)
    reckoned = dead_reckon(last, velocity, 0, frame_at(gap_s), tilt, None, NADIR_BODY_FROM_CAM)
    turn = reckoned.pose.rotation
    sigma = float(np.sqrt((turn @ reckoned.covariance[:3, :3] @ turn.T)[0, 0]))
    kept = last.translation + gap_s * velocity - reckoned.pose.translation
    stopped = last.translation - reckoned.pose.translation
    assert np.linalg.norm(kept[:2]) <= 2.0 * sigma + 1e-6
    if gap_s >= 0.5:
        assert np.linalg.norm(stopped[:2]) <= 2.0 * sigma + 1e-6
    assert sigma <= gap_s * math.hypot(1.0, float(np.linalg.norm(velocity)))


def test_a_compass_keeps_the_heading() -> None:
    last = Pose(rotation_z(0.7) @ NADIR_BODY_FROM_CAM, np.array([0.0, 0.0, 2.5]))
    tilt = TiltPrior(NADIR_BODY_FROM_CAM, 0.01)
    facing = Attitude(0.0, 0.0, 0.01, yaw_rad=-1.2, yaw_sigma_rad=0.05)
    reckoned = dead_reckon(last, np.zeros(3), 0, frame_at(60.0, facing), tilt, None, NADIR_BODY_FROM_CAM)
    np.testing.assert_allclose(reckoned.pose.rotation, rotation_z(-1.2) @ NADIR_BODY_FROM_CAM, atol=1e-12)
    assert math.isclose(math.sqrt(np.linalg.eigvalsh(reckoned.covariance[3:, 3:])[-1]), 0.05, rel_tol=1e-6)


def features(seed: int, count: int = 100) -> Features:
    """Descriptors that hardly resemble each other."""
    extractor = create_extractor("hessian-teblid", 400)
    picture = np.random.default_rng(seed).integers(0, 255, (60, 80)).astype(np.uint8)
    found = extractor.extract(np.kron(picture, np.ones((4, 4), np.uint8)))
    assert len(found) >= count
    return found


def test_waiting_is_over_when_the_same_unknown_ground_was_seen_for_a_while() -> None:
    extractor = create_extractor("hessian-teblid", 400)
    watch = LostWatch(1.0, 30, extractor)
    ground = features(1)
    over = [watch.is_over(int(k * 0.2e9), ground) for k in range(10)]
    assert over == [False] * 6 + [True] * 4  # the first has none to be compared with
    watch.found()
    assert not watch.is_over(int(3e9), ground)


def test_noise_never_begins_a_piece() -> None:
    watch = LostWatch(1.0, 30, create_extractor("hessian-teblid", 400))
    assert not any(watch.is_over(int(k * 0.2e9), features(k)) for k in range(12))


@pytest.fixture(scope="module")
def carried() -> tuple[Slam, list[FrameResult], SimulatedFlight, list[np.ndarray]]:
    """The demo's loop with a stretch, longer than a view, that no picture shows; it closes at the end."""
    base = demo(3)
    first, second = base.path.cut(0.0, CARRIED_S[0]), base.path.cut(CARRIED_S[1], base.path.duration_s)
    scenario = dataclasses.replace(base, path=first.followed_by(second, gap_s=2.0))
    black = dataclasses.replace(scenario.trouble, black_s=((CARRIED_S[0], CARRIED_S[0] + 2.05),))
    flight = SimulatedFlight(dataclasses.replace(scenario, trouble=black), 3)
    slam = Slam(flight.rig, Config())
    results, pieces = [], []
    for frame in flight:
        results.append(slam.process(frame))
        pieces.append(slam.map.pieces().copy())
    return slam, results, flight, pieces


def test_a_lost_camera_maps_on_in_a_new_piece(
    carried: tuple[Slam, list[FrameResult], SimulatedFlight, list[np.ndarray]],
) -> None:
    slam, results, _, pieces = carried
    names = [set(piece.tolist()) for piece in pieces]
    assert max(len(name) for name in names) == 2
    begun = next(n for n, name in enumerate(names) if len(name) == 2)
    before = [result for result in results[:begun] if result.pose is not None]
    assert all(result.pose is not None for result in results[begun : begun + 20])
    assert results[begun].piece == results[begun].node != 0
    assert results[begun].covariance is not None and before[-1].covariance is not None
    # What it reckons it says to be uncertain: by more than a flying height.
    assert np.sqrt(np.linalg.eigvalsh(results[begun + 5].covariance[:3, :3])[-1]) > 1.0
    assert np.sqrt(np.linalg.eigvalsh(before[-1].covariance[:3, :3])[-1]) < 0.1
    # No jump to the origin: it goes on from where the camera was lost.
    assert before[-1].pose is not None and results[begun].pose is not None
    apart = results[begun].pose.translation - before[-1].pose.translation
    assert np.linalg.norm(apart) < 2.0  # for a second, at two metres per second
    assert slam.map.graph.kinds.tolist().count(2) == 1


def test_both_pieces_become_one_when_the_loop_closes(
    carried: tuple[Slam, list[FrameResult], SimulatedFlight, list[np.ndarray]],
) -> None:
    slam, results, flight, pieces = carried
    assert set(pieces[-1].tolist()) == {0}
    assert results[-1].piece == 0
    slam.finish()
    assert len(slam.placed()) == len(slam.records)
    estimate = Trajectory.from_poses(
        [record.t_ns for record in slam.records], [slam.pose_of(record) for record in slam.records]
    )
    truth = Trajectory.from_poses(flight.stamps_ns, flight.truth)
    found = evaluate(estimate, truth, Align.SE3)
    assert 1e-4 < found.ate_m.rmse < 0.15


def test_until_then_only_the_main_piece_is_placed(
    carried: tuple[Slam, list[FrameResult], SimulatedFlight, list[np.ndarray]],
) -> None:
    """The first frames alone, and some of the second piece: nobody knows where these are."""
    _, results, flight, pieces = carried
    begun = next(n for n, piece in enumerate(pieces) if len(set(piece.tolist())) == 2)
    slam = Slam(flight.rig, Config())
    for n, frame in enumerate(flight):
        if n == begun + 8:
            break
        slam.process(frame)
    assert len(slam.records) > len(slam.placed()) > 0
    assert {record.piece for record in slam.placed()} == {0}
    assert all(result.pose is not None for result in results[begun : begun + 8])
