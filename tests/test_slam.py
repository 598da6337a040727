"""The whole loop on simulated flights whose truth is exact: what it finds, what it says when it does not."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from overfly.config import AttitudeSettings, AttitudeUse, Config, TrackingSettings
from overfly.evaluation import Align, Evaluation, evaluate
from overfly.frame_result import FrameResult
from overfly.geometry.poses import Pose, vector_from_rotation
from overfly.simulation import SimulatedFlight, simulate
from overfly.slam import Slam
from overfly.trajectory import Trajectory
from overfly.types import Altitude, AltitudeKind, Frame, Reason, Rig

FRAMES = 50


@dataclass(frozen=True)
class Flown:
    """A simulated flight, rendered once, with its truth."""

    rig: Rig
    frames: tuple[Frame, ...]
    truth: tuple[Pose, ...]


@pytest.fixture(scope="module")
def demo() -> Flown:
    flight: SimulatedFlight = simulate("demo", 0, FRAMES)
    return Flown(flight.rig, tuple(flight), flight.truth)


def fly(
    flown: Flown, config: Config | None = None, frames: Iterable[Frame] | None = None
) -> tuple[Slam, list[FrameResult]]:
    slam = Slam(flown.rig, config)
    return slam, [slam.process(frame) for frame in (flown.frames if frames is None else frames)]


def dark(frame: Frame) -> Frame:
    """The same frame with the lens covered."""
    return replace(frame, images=tuple(np.zeros_like(image) for image in frame.images))


def trajectory(slam: Slam) -> Trajectory:
    return Trajectory.from_poses(
        [record.t_ns for record in slam.records], [slam.pose_of(record) for record in slam.records]
    )


def against_truth(slam: Slam, flown: Flown, align: Align = Align.SE3) -> Evaluation:
    truth = Trajectory.from_poses([frame.t_ns for frame in flown.frames], list(flown.truth))
    return evaluate(trajectory(slam), truth, align)


@pytest.fixture(scope="module")
def flown_demo(demo: Flown) -> tuple[Slam, list[FrameResult]]:
    return fly(demo)


def test_every_frame_is_found_where_it_was(demo: Flown, flown_demo: tuple[Slam, list[FrameResult]]) -> None:
    """Ground that rolls by 1 % of the height may cost 1 % of the path; nothing real is exact to 0.1 mm."""
    slam, results = flown_demo
    assert all(result.pose is not None for result in results)
    assert len(slam.records) == FRAMES
    found = against_truth(slam, demo)
    assert found.path_m > 4.0
    assert 1e-4 < found.ate_m.rmse < 0.01 * found.path_m
    turned = [
        (slam.pose_of(slam.records[0]).inverse() @ slam.pose_of(record)).rotation.T
        @ (demo.truth[0].inverse() @ demo.truth[record.frame_index]).rotation
        for record in slam.records[1:]
    ]
    angles = [float(np.linalg.norm(vector_from_rotation(turn))) for turn in turned]
    assert 1e-4 < np.sqrt(np.mean(np.square(angles))) < 0.02
    assert found.scale_error is not None
    assert abs(found.scale_error) < 0.02  # the range sensor gives the metre


def test_results_tell_how_good_they_are(flown_demo: tuple[Slam, list[FrameResult]]) -> None:
    slam, results = flown_demo
    assert results[0].node == 0
    nodes = [result.node for result in results if result.node is not None]
    assert nodes == list(range(len(slam.map)))
    assert 2 < len(nodes) < FRAMES / 2  # a node is a frame that shows enough that is new
    for result in results[1:]:
        assert result.reason is None
        assert result.covariance is not None
        assert np.linalg.eigvalsh(result.covariance).min() > 0
        assert result.n_inliers <= result.n_matches
        assert 0.01 < result.rms_px < 2.0
        assert sum(result.timings_s.values()) > 0


def test_frames_hang_on_nodes_of_the_graph(flown_demo: tuple[Slam, list[FrameResult]]) -> None:
    slam, results = flown_demo
    for record, result in zip(slam.records, results, strict=True):
        assert record.t_ns == result.t_ns
        assert 0 <= record.node < len(slam.map)
        assert result.pose is not None
        np.testing.assert_array_equal(record.online.matrix(), result.pose.matrix())
    assert slam.start is not None
    assert slam.start.source == "range"
    assert not slam.measures_depth


def test_the_map_hangs_together(flown_demo: tuple[Slam, list[FrameResult]]) -> None:
    slam, _ = flown_demo
    graph = slam.map.graph
    for node in slam.map.nodes[1:]:
        assert 0 <= node.parent < node.index
        constraint = graph.constraint(node.constraint)
        assert (constraint.i, constraint.j) == (node.parent, node.index)
    points, sigmas = slam.map.all_points()
    assert len(points) > 50 * len(slam.map)
    assert (sigmas > 0).all()
    # the ground is z = 0 within its relief, its crates and their sigma
    assert np.abs(np.median(points[:, 2])) < 0.05
    assert np.percentile(np.abs(points[:, 2]), 90) < 0.4


def test_same_input_same_bytes(demo: Flown, flown_demo: tuple[Slam, list[FrameResult]]) -> None:
    first, _ = flown_demo
    second, _ = fly(demo)
    for name in (
        "positions",
        "quaternions",
        "measured_positions",
        "measured_quaternions",
        "information",
        "i",
        "j",
    ):
        ours, theirs = getattr(first.map.graph, name), getattr(second.map.graph, name)
        assert ours.tobytes() == theirs.tobytes(), name
    assert trajectory(first).positions.tobytes() == trajectory(second).positions.tobytes()
    assert trajectory(first).quaternions_xyzw.tobytes() == trajectory(second).quaternions_xyzw.tobytes()


def test_a_blank_frame_is_lost_with_a_reason_and_the_next_is_found(demo: Flown) -> None:
    covered = {20, 21, 22, 23, 24}
    frames = [dark(frame) if n in covered else frame for n, frame in enumerate(demo.frames)]
    slam, results = fly(demo, frames=frames)
    for n, result in enumerate(results):
        if n in covered:
            assert result.pose is None
            assert result.reason is Reason.FEW_FEATURES
            assert result.detail
            assert result.covariance is None and result.node is None
        else:
            assert result.pose is not None, f"frame {n}: {result.reason}"
    assert len(slam.records) == FRAMES - len(covered)
    assert against_truth(slam, demo).ate_m.rmse < 0.1


def test_nothing_is_mapped_before_there_is_something_to_see(demo: Flown) -> None:
    slam, results = fly(demo, frames=[dark(demo.frames[0]), *demo.frames[1:10]])
    assert results[0].pose is None
    assert results[0].reason is Reason.FEW_FEATURES
    assert slam.records[0].frame_index == demo.frames[1].index
    assert all(result.pose is not None for result in results[1:])


def test_noise_is_not_taken_for_ground(demo: Flown) -> None:
    """Frames of pure noise in the middle of a flight: no pose rather than a wrong one."""
    rng = np.random.default_rng(0)
    shape = demo.frames[0].images[0].shape
    noise = [replace(frame, images=(rng.integers(0, 256, shape, np.uint8),)) for frame in demo.frames[12:15]]
    _, results = fly(demo, frames=[*demo.frames[:12], *noise, *demo.frames[15:20]])
    assert [result.pose is None for result in results] == [False] * 12 + [True] * 3 + [False] * 5


@pytest.mark.parametrize(
    "config",
    [
        Config(tracking=TrackingSettings(enabled=False)),
        Config(attitude=AttitudeSettings(use=AttitudeUse.FIXED)),
        Config(attitude=AttitudeSettings(use=AttitudeUse.NONE, level_sigma_deg=8.0)),
    ],
    ids=["descriptors in every frame", "attitude as truth", "no attitude"],
)
def test_other_ways_to_fly(demo: Flown, config: Config) -> None:
    slam, results = fly(demo, config, demo.frames[:30])
    located = sum(result.pose is not None for result in results)
    assert located >= 28
    found = against_truth(slam, demo)
    assert 1e-4 < found.ate_m.rmse < 0.25


def test_scale_is_that_of_the_height_that_was_given(demo: Flown) -> None:
    """Without a range sensor the map is as large as the given height makes it."""
    silent = [replace(frame, altitude=None) for frame in demo.frames[:25]]
    maps = {}
    for height in (3.0, 6.0):
        config = Config.model_validate({"height": {"given_m": height}})
        slam, results = fly(demo, config, silent)
        assert all(result.pose is not None for result in results)
        assert slam.start is not None and slam.start.source == "given"
        positions = trajectory(slam).positions
        maps[height] = float(np.linalg.norm(positions[-1] - positions[0]))
    assert maps[6.0] == pytest.approx(2.0 * maps[3.0], rel=0.01)


def test_a_first_range_that_was_an_echo_does_not_set_the_metre(demo: Flown) -> None:
    """The first reading half as long again as the truth; those that follow agree on another metre."""
    first = demo.frames[0].altitude
    assert first is not None
    wrong = Altitude(1.5 * first.value_m, first.sigma_m, AltitudeKind.RANGE)
    frames = [replace(demo.frames[0], altitude=wrong), *demo.frames[1:]]
    slam, _ = fly(demo, frames=frames)
    found = against_truth(slam, demo)
    assert found.scale_error is not None
    assert abs(found.scale_error) < 0.05


@pytest.mark.parametrize("given_m", [None, 6.0])
def test_a_range_sensor_that_speaks_late_gives_the_metre(demo: Flown, given_m: float | None) -> None:
    """Drones take off below the sensor's reach, and sonars miss echoes: the first frames have no reading."""
    frames = [replace(frame, altitude=None) if k < 12 else frame for k, frame in enumerate(demo.frames)]
    slam, results = fly(demo, Config.model_validate({"height": {"given_m": given_m}}), frames)
    assert all(result.pose is not None for result in results)
    assert slam.start is not None
    assert slam.start.source == "range"
    found = against_truth(slam, demo)
    assert found.scale_error is not None
    assert abs(found.scale_error) < 0.05


def test_an_object_of_known_size_is_clicked_in_the_picture_as_it_came() -> None:
    """Pictures of 320 pixels, worked on at 160: the object tells the same height."""
    flight = simulate("helicopter", seed=3, frames=1)
    heights = []
    for width in (320, 160):
        slam = Slam(
            flight.rig, Config.model_validate({"features": {"max_width_px": width}}), flight.scale_landmark
        )
        slam.process(flight.frame(0))
        assert slam.start is not None
        assert slam.start.source == "landmark"
        heights.append(slam.start.height_m)
    assert heights[1] == pytest.approx(heights[0], rel=0.005)


def test_rescaling_scales_the_whole_flight(demo: Flown) -> None:
    slam, _ = fly(demo, frames=demo.frames[:20])
    before = trajectory(slam)
    slam.rescale(2.0, "gps")
    after = trajectory(slam)
    np.testing.assert_allclose(after.positions, 2.0 * before.positions, atol=1e-9)
    np.testing.assert_allclose(after.quaternions_xyzw, before.quaternions_xyzw, atol=1e-12)
    assert slam.start is not None and slam.start.source == "gps"
    # and the flight goes on at the new scale
    silent = [replace(frame, altitude=None) for frame in demo.frames[20:25]]
    results = [slam.process(frame) for frame in silent]
    assert all(result.pose is not None for result in results)
    step = float(np.linalg.norm(results[0].pose.translation - after.positions[-1]))  # type: ignore[union-attr]
    true_step = float(np.linalg.norm(demo.truth[20].translation - demo.truth[19].translation))
    assert step == pytest.approx(2.0 * true_step, rel=0.3)


def test_pictures_may_be_grey(demo: Flown) -> None:
    grey = [
        replace(frame, images=(np.ascontiguousarray(frame.images[0][..., 1]),)) for frame in demo.frames[:12]
    ]
    _, results = fly(demo, frames=grey)
    assert all(result.pose is not None for result in results)
