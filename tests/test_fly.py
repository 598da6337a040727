"""overfly fly: short closed loops in the simulator, and the judgement of flights whose course is known."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest

from overfly.cli import main
from overfly.errors import SourceError, UsageError
from overfly.frame_result import FrameResult
from overfly.geometry.poses import Pose, rotation_z
from overfly.mapstore import Map
from overfly.navigation.commands import GoTo
from overfly.navigation.mission import Place
from overfly.navigation.pilot import Situation
from overfly.pipeline.control import ControlLoop, MapShape
from overfly.pipeline.flying import FlyRequest, run
from overfly.pipeline.judging import FlightLog, judge
from overfly.types import Frame, VelocityCommand

KEYS = {
    "images", "realtime_factor", "pushes", "rms_error_m", "max_error_m", "lost_s", "arrived", "final_error_m",
}  # fmt: skip


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of a small survey by the blimp of seed 1, with a short hold after it."""
    folder = tmp_path_factory.mktemp("surveyed")
    map_file = folder / "blimp.overfly"
    run(FlyRequest(map_file, "blimp", folder / "out", minutes=0.05, survey_m=(1.6, 1.0), seed=1))
    return map_file


def test_a_pushed_vehicle_comes_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The paper's flight in short: the map begins with the first picture, and grows with the push."""
    map_file = tmp_path / "map.overfly"
    arguments = ["fly", str(map_file), "--sim", "blimp", "--seed", "3", "--hold", "--survey", "0x0", "--json"]
    assert main([*arguments, "--minutes", "0.75", "--pushes", "1", "-o", str(tmp_path / "out")]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers.keys() >= KEYS
    assert numbers["images"] == pytest.approx(450, abs=3)
    assert numbers["pushes"] == numbers["returned"] == 1
    assert numbers["max_error_m"] > 1.5
    assert 0.001 < numbers["rms_error_m"] < 0.06
    assert numbers["longest_lost_s"] < 1.0
    known = Map.open(tmp_path / "out" / "map.overfly")
    assert len(known) == numbers["map_nodes"] > 4
    assert len(known.frames) == len(known), "of the flight the frames are kept that made the map"
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/webp") >= 8
    assert "a hand takes it" in page
    rows = (tmp_path / "out" / "flight.csv").read_text(encoding="utf-8").splitlines()
    assert len(rows) == numbers["images"] + 1


def test_it_goes_to_places_of_a_map_that_exists(surveyed: Path, tmp_path: Path) -> None:
    before = surveyed.read_bytes()
    places = ((0.6, 0.3), (-0.5, -0.3))
    outcome = run(FlyRequest(surveyed, "blimp", tmp_path / "out", places, wind_m_s=0.15, seed=1))
    assert outcome.numbers["arrived"] == 2
    assert max(outcome.numbers["arrival_errors_m"]) < 0.10
    assert outcome.numbers["final_error_m"] < 0.10
    assert outcome.numbers["longest_lost_s"] == 0.0
    assert surveyed.read_bytes() == before, "the map that was given stays as it is"
    grown = Map.open(tmp_path / "out" / "map.overfly")
    assert len(grown.flights) == 2
    assert len(grown) > len(Map.open(surveyed))


def test_over_ground_that_it_knows_it_makes_no_nodes(surveyed: Path, tmp_path: Path) -> None:
    """There and back again: the first way makes nodes, the others use them."""
    there, back = (0.6, 0.3), (-0.6, -0.3)
    nodes: list[int] = []  # by the leg that made each
    orders = (there, back) * 3

    def count(_frame: Frame, result: FrameResult, situation: Situation) -> None:
        target = situation.target
        if target is not None and (not legs or abs(target.x_m - legs[-1].x_m) > 0.6):
            legs.append(target)
        if result.node is not None:
            nodes.append(len(legs))

    legs: list[Place] = []
    run(FlyRequest(surveyed, "blimp", tmp_path / "out", orders, seed=1, minutes=1.4), count)
    assert len(legs) >= 4
    assert len(nodes) >= 2
    assert not [leg for leg in nodes if leg >= 4]


def test_blackouts_are_flown_through(surveyed: Path, tmp_path: Path) -> None:
    request = FlyRequest(surveyed, "blimp", tmp_path / "out", minutes=0.6, drop_outs=True, seed=1)
    numbers = run(request).numbers
    assert 0.2 < numbers["longest_lost_s"] < 1.5
    assert numbers["max_error_m"] < 0.3
    table = (tmp_path / "out" / "flight.csv").read_text(encoding="utf-8")
    assert "lost; keeping still" in table


def test_an_operator_is_obeyed(surveyed: Path, tmp_path: Path) -> None:
    """What comes into the queue while it flies decides where it goes; places follow when the map moves."""
    seen: list[Place | None] = []

    def begin(loop: ControlLoop) -> None:
        loop.orders.put(GoTo(50.0, 0.0))  # refused: outside the geofence, once there is one

        def watch(frame: Frame, result: FrameResult, situation: Situation) -> None:
            inner(frame, result, situation)
            seen.append(situation.target)
            if len(seen) == 20:
                loop.orders.put(GoTo(0.4, 0.2))
            loop.interrupted = len(seen) == 40

        inner, loop.watch = loop.watch, watch

    outcome = run(FlyRequest(surveyed, "blimp", tmp_path / "out", seed=1, endless=True), begin=begin)
    assert outcome.interrupted
    assert seen[-1] == Place(0.4, 0.2)


def test_what_cannot_be_flown_is_said(
    surveyed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    with pytest.raises(SourceError, match="does not find itself"):
        run(FlyRequest(surveyed, "helicopter", out, seed=5))
    with pytest.raises(UsageError, match="geofence"):
        run(FlyRequest(surveyed, "blimp", out, ((40.0, 0.0),), seed=1))
    with pytest.raises(UsageError, match="cannot hover"):
        run(FlyRequest(tmp_path / "new.overfly", "fixed-wing", out))
    bad = tmp_path / "places.txt"
    bad.write_text("1,2\nhere\n", encoding="utf-8")
    wrong = (
        (["fly"], "--sim"),
        (["fly", "--sim", "blimp", "--goto", "here"], "X,Y"),
        (["fly", "--sim", "blimp", "--goto", "1,2", "--hold"], "choose one"),
        (["fly", "--sim", "blimp", "--survey", "big"], "6x4"),
        (["fly", "--sim", "blimp", "--waypoints", str(bad)], "places.txt:2"),
        (["fly", "--sim", "zeppelin"], "no scenario"),
    )
    for arguments, words in wrong:
        assert main(arguments) != 0
        assert words in capsys.readouterr().err


def logged(distances: list[float], held: list[bool], *, turn_rad: float = 0.8) -> FlightLog:
    """A flight along a line out of its place, in a map that is turned and shifted against the world."""
    world_from_map = Pose(rotation_z(turn_rad), np.array([5.0, -2.0, 0.0]))
    log = FlightLog()
    for row, (away, hand) in enumerate(zip(distances, held, strict=True)):
        place = np.array([1.0 + away * math.cos(0.1 * row), 2.0 + away * math.sin(0.1 * row), 1.5])
        state = None
        situation = Situation(row * 100_000_000, "", state, Place(1.0, 2.0), VelocityCommand(), 0.0)  # type: ignore[arg-type]
        log.add(situation, world_from_map @ Pose(np.eye(3), place), 1, held=hand, arrived=False)
        log.fix[-1], log.located[-1] = place, True
    return log


def test_a_flight_is_judged_by_its_true_distances() -> None:
    calm, out, back = [0.05] * 50, list(np.linspace(0.1, 3.0, 40)), list(np.linspace(3.0, 0.02, 60))
    distances = calm + out + back + [0.08] * 60
    held = [False] * 50 + [True] * 40 + [False] * 120
    found = judge(logged(distances, held))
    np.testing.assert_allclose(found.distance_m, distances, atol=1e-9)
    assert found.numbers["pushes"] == found.numbers["returned"] == 1
    assert found.numbers["max_error_m"] == pytest.approx(3.0)
    assert found.numbers["final_error_m"] == pytest.approx(0.08)
    assert not found.settled[:20].any()
    assert found.settled[25:50].all()
    assert not found.settled[50:160].any()
    assert found.settled[175:].all()
    assert 0.05 < found.numbers["rms_error_m"] < 0.08
    assert found.numbers["longest_return_s"] == pytest.approx(5.7, abs=0.3)


def test_a_vehicle_that_does_not_come_back_is_not_settled() -> None:
    found = judge(logged([0.05] * 40 + [1.0] * 40, [False] * 40 + [True] * 5 + [False] * 35))
    assert found.numbers["returned"] == 0
    assert not found.settled[40:].any()
    assert found.returns_s == (math.inf,)


def test_time_without_a_fix_counts_from_fix_to_fix() -> None:
    log = logged([0.05] * 60, [False] * 60)
    for row in (20, 21, 22, 40):
        log.located[row] = False
    found = judge(log)
    assert found.numbers["longest_lost_s"] == pytest.approx(0.4)
    assert found.numbers["lost_s"] == pytest.approx(0.6)


def test_places_stay_on_their_ground_when_the_map_is_corrected() -> None:
    generator = np.random.default_rng(0)
    positions = generator.uniform(-3.0, 3.0, (20, 3))
    poses = [
        Pose(rotation_z(angle), place)
        for angle, place in zip(generator.uniform(-3, 3, 20), positions, strict=True)
    ]
    before = MapShape(positions, np.array([pose.quaternion() for pose in poses]), 2.0, 0)
    move, factor = Pose(rotation_z(0.3), np.array([0.5, -0.2, 0.0])), 1.1
    moved = [(move @ pose).scaled(factor) for pose in poses]
    after = MapShape(
        np.array([pose.translation for pose in moved]),
        np.array([pose.quaternion() for pose in moved]),
        2.2,
        1,
    )
    place = np.array([0.7, -1.1])
    expected = (move.transform(np.append(place, 0.0)) * factor)[:2]
    np.testing.assert_allclose(before.followed(place, after), expected, atol=1e-9)
    same = dataclasses.replace(before, n_rescaled=1)
    np.testing.assert_allclose(before.followed(place, same), place)
