"""The live view beside its loop: cheap, of the newest frame, and harmless when it fails."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.exports.world import make_map, write_map
from tests.viewer.flights import COVARIANCE, RIG, above, frame_of, new_slam, plain_picture, result_at
from tests.viewer.test_finished_page import GROUND_M, write_ground

from overfly.localizer import Fix
from overfly.pipeline.recording import record_flight
from overfly.sensors import open_flight
from overfly.slam import Slam
from overfly.viewer.interface import NullViewer, Viewer
from overfly.viewer.live import PERIOD_S, LiveViewer
from overfly.viewer.moment import Moment
from overfly.viewer.panel import length
from overfly.viewer.scene import ELLIPSE_POINTS, GraphState, ellipse
from overfly.viewer.server import open_page

PICTURE = plain_picture((80, 90, 100))


@pytest.fixture
def slam() -> Slam:
    return new_slam()


@pytest.fixture
def live(slam: Slam) -> Iterator[LiveViewer]:
    viewer = LiveViewer(open_page("test", port=0), RIG.cam0.camera, slam.map, slam)
    yield viewer
    viewer.close()


def wait_for(moments: list[Moment], count: int) -> None:
    end = time.monotonic() + 20.0
    while len(moments) < count:
        assert time.monotonic() < end, f"{len(moments)} of {count} drawings"
        time.sleep(0.02)


def test_nobody_watching_is_a_viewer_too(slam: Slam) -> None:
    viewer = NullViewer()
    viewer.show_frame(frame_of(0, PICTURE), result_at(slam, 0, above(0.0, 0.0), is_node=True))
    viewer.close()


def test_frames_that_come_faster_than_they_are_drawn_cost_almost_nothing(
    live: LiveViewer, slam: Slam
) -> None:
    moments: list[Moment] = []
    live.on_tick.append(moments.append)
    live.show_frame(frame_of(0, PICTURE), result_at(slam, 0, above(0.0, 0.0), is_node=True))
    wait_for(moments, 1)
    results = [result_at(slam, n, above(0.001 * n, 0.0), is_node=False) for n in range(1, 2001)]
    frames = [frame_of(n, PICTURE) for n in range(1, 2001)]
    began, cpu = time.perf_counter(), time.thread_time()
    for frame, result in zip(frames, results, strict=True):
        live.show_frame(frame, result)
    spent, seconds = time.thread_time() - cpu, time.perf_counter() - began
    assert spent / len(frames) < 50e-6  # a hundredth of the time that a small picture takes to map
    time.sleep(2 * PERIOD_S)
    assert 1 <= len(moments) <= 3 + seconds / PERIOD_S


def test_the_newest_frame_is_drawn_and_every_node_gets_its_ground(live: LiveViewer, slam: Slam) -> None:
    moments: list[Moment] = []
    live.on_tick.append(moments.append)
    for number in range(6):
        pose = above(2.0 * number, 0.0)
        live.show_frame(frame_of(number, PICTURE), result_at(slam, number, pose, is_node=True))
    time.sleep(PERIOD_S)
    live.show_frame(frame_of(6, PICTURE), result_at(slam, 6, above(10.5, 0.0), is_node=False))
    wait_for(moments, 1)
    time.sleep(PERIOD_S)
    assert moments[-1].n_frames == 7
    assert sorted(live._pieces) == list(range(6))
    assert live.surface is not None
    place = live.surface.meet(np.array([3.0, 0.0, 4.0]), np.array([0.0, 0.0, -1.0]))
    assert place is not None
    assert abs(place[2]) < 0.3  # the points of the made-up map scatter by 0.2 m


def test_ground_follows_its_nodes_when_the_map_moves(live: LiveViewer, slam: Slam) -> None:
    moments: list[Moment] = []
    live.on_tick.append(moments.append)
    for number in range(3):
        live.show_frame(
            frame_of(number, PICTURE), result_at(slam, number, above(2.0 * number, 0.0), is_node=True)
        )
    wait_for(moments, 1)
    slam.map.graph.set_pose(2, above(4.0, 1.5, 0.3))
    end = time.monotonic() + 20.0
    while abs(float(live._pieces[2].handle.position[1]) - 1.5) > 1e-6 if 2 in live._pieces else True:
        assert time.monotonic() < end
        live.show_frame(frame_of(3, PICTURE), result_at(slam, 3, above(4.2, 1.5), is_node=False))
        time.sleep(PERIOD_S)
    assert abs(float(live._pieces[1].handle.position[1])) < 1e-9


def test_a_view_that_fails_is_logged_and_the_loop_goes_on(
    live: LiveViewer, slam: Slam, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(_moment: Moment) -> None:
        raise RuntimeError("no more")

    live.on_tick.append(fail)
    with caplog.at_level(logging.ERROR, "overfly.viewer"):
        for number in range(4):
            pose = above(float(number), 0.0)
            live.show_frame(frame_of(number, PICTURE), result_at(slam, number, pose, is_node=True))
            time.sleep(PERIOD_S)
    assert [record.message for record in caplog.records] == ["the live view failed and is no longer updated"]


def test_a_state_of_the_graph_stays_as_it_was() -> None:
    graph = make_map(None).visual.graph
    state = GraphState.of(graph)
    before = state.positions.copy()
    graph.positions[:] += 7.0
    np.testing.assert_array_equal(state.positions, before)
    part = state.up_to(3)
    assert len(part.positions) == 3
    assert sorted(zip(part.i.tolist(), part.j.tolist(), strict=True)) == [(0, 1), (1, 2)]


def test_the_region_is_the_three_sigma_ellipse() -> None:
    covariance = np.array([[0.09, 0.03], [0.03, 0.04]])
    outline = ellipse(covariance)
    assert outline.shape == (ELLIPSE_POINTS, 2)
    mahalanobis = np.sqrt(np.einsum("ni,ij,nj->n", outline, np.linalg.inv(covariance), outline))
    np.testing.assert_allclose(mahalanobis, 3.0, rtol=1e-9)


@pytest.mark.parametrize(
    ("metres", "text"), [(None, "unknown"), (0.0031, "3.1 mm"), (0.042, "4.2 cm"), (3.14, "3.1 m")]
)
def test_lengths_read_well(metres: float | None, text: str) -> None:
    assert length(metres) == text


@pytest.mark.data
def test_the_map_is_the_same_to_the_last_bit_with_and_without_a_viewer(data_dir: Path) -> None:
    flight = open_flight(data_dir / "flights" / "corridor")
    frames = [frame for index in range(60) if (frame := flight.read_frame(index)) is not None]
    maps = []
    for watched in (False, True):
        slam = Slam(flight.rig)
        viewer: Viewer = NullViewer()
        if watched:
            page = open_page("test", port=0)
            viewer = LiveViewer(page, flight.rig.cam0.camera, slam.map, slam)
        recording = record_flight(frames, slam, lambda _count, _result: None, viewer=viewer)
        viewer.close()
        graph = slam.map.graph
        maps.append(
            (
                graph.positions.tobytes(),
                graph.quaternions.tobytes(),
                graph.information.tobytes(),
                recording.online().positions.tobytes(),
            )
        )
    assert len(maps[0][0]) > 24 * 3  # a few nodes
    assert maps[0] == maps[1]


def test_frames_found_in_a_known_map_are_shown_over_its_mosaic(tmp_path: Path) -> None:
    known = write_map(tmp_path)
    assert known.georeference is not None
    write_ground(tmp_path, known.georeference)
    live = LiveViewer(open_page("test", port=0), RIG.cam0.camera, known.visual, None, known)
    try:
        moments: list[Moment] = []
        live.on_tick.append(moments.append)
        fix = Fix(0, above(2.0, 0.2), COVARIANCE, node=2, n_inliers=40)
        live.show_frame(frame_of(0, PICTURE), fix)
        wait_for(moments, 1)
        assert live.surface is not None
        place = live.surface.meet(np.array([1.0, 0.5, 5.0]), np.array([0.1, 0.0, -1.0]))
        assert place is not None
        assert place[2] == pytest.approx(GROUND_M, abs=0.02)
        assert any("/ground/mosaic/" in name for name in live.page.server.scene._handle_from_node_name)
        np.testing.assert_allclose(moments[0].points, known.visual.points_in_world(known.visual.nodes[2]))
    finally:
        live.close()
