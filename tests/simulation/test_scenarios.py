"""Every scenario is what its title says, looks like ground, and is the same every time."""

from __future__ import annotations

import inspect
import math
from pathlib import Path

import numpy as np
import pytest

from overfly.errors import UsageError
from overfly.simulation import Scenario, SimulatedFlight, simulate
from overfly.simulation.scenario import SCENARIOS, declared

declared("demo")  # declares them all
NAMES = sorted(SCENARIOS)


@pytest.fixture(scope="module")
def built() -> dict[str, Scenario]:
    return {name: SCENARIOS[name].build(1) for name in NAMES}


def length_m(scenario: Scenario) -> float:
    positions = scenario.path.poses(np.arange(0.0, scenario.path.end_s, 0.5))[1]
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


@pytest.mark.parametrize("name", NAMES)
def test_pictures_look_like_ground(name: str, built: dict[str, Scenario]) -> None:
    """Neither flat nor noise: there is contrast, most of it at scales above a pixel, nothing saturated."""
    flight = SimulatedFlight(built[name], 1)
    frame = flight.frame(0)
    image = frame.images[0].astype(float)
    image = image if image.ndim == 2 else image.mean(axis=2)
    assert image.shape == (built[name].cameras[0].camera.height, built[name].cameras[0].camera.width)
    blurred = 0.25 * (image[:-1, :-1] + image[1:, :-1] + image[:-1, 1:] + image[1:, 1:])
    assert 2.0 < blurred.std() < 80.0
    assert blurred.std() > 0.55 * image.std()
    assert 25.0 < image.mean() < 190.0
    assert (image > 250).mean() < 0.05
    assert len(frame.images) == len(flight.rig.cameras)
    suite = built[name].sensors
    assert (frame.attitude is not None) == (suite.attitude is not None)
    assert (frame.position is not None) == (suite.gps is not None)


@pytest.mark.parametrize("name", NAMES)
def test_vehicles_stay_over_the_world_and_above_it(name: str, built: dict[str, Scenario]) -> None:
    scenario = built[name]
    positions = scenario.path.poses(np.arange(0.0, scenario.path.end_s, 0.2))[1]
    x0, y0, x1, y1 = scenario.bounds_m
    assert (positions[:, :2] > (x0, y0)).all()
    assert (positions[:, :2] < (x1, y1)).all()
    clearance = positions[:, 2] - scenario.relief.height(positions[:, 0], positions[:, 1])
    assert clearance.min() > 0.4


def test_dimensions_of_the_papers_experiments(built: dict[str, Scenario]) -> None:
    assert math.isclose(length_m(built["outdoor"]), 190.0, rel_tol=0.04)
    assert len(built["outdoor"].cameras) == len(built["corridor"].cameras) == 2
    start, end = (built["outdoor"].path.pose(t).translation for t in (8.0, built["outdoor"].path.end_s))
    assert np.linalg.norm(start - end) < 6.0, "the loop is closed"
    places = {mark.name: np.array([mark.x_m, mark.y_m]) for mark in built["corridor"].landmarks}
    gaps = [float(np.linalg.norm(places[a] - places[b])) for a, b in ("AB", "BC", "CD", "DE", "EF", "FA")]
    assert gaps == [5.0, 5.0, 1.5, 5.0, 5.0, 1.5]
    blimp = built["blimp"]
    assert [mark.x_m for mark in blimp.landmarks] == [0.0, 5.0]
    assert blimp.sensors.attitude is None
    assert blimp.sensors.sonar is not None
    assert math.isclose(built["hold"].path.duration_s, 18 * 60.0, abs_tol=1.0)
    assert built["hold"].frames == built["long-haul"].frames == 10_800
    helicopter = built["helicopter"]
    assert math.isclose(length_m(helicopter), 35.0, rel_tol=0.12)
    assert helicopter.sensors.attitude is None
    assert helicopter.sensors.sonar is None
    assert helicopter.cameras[0].quality.radio is not None


@pytest.mark.parametrize("name", ["corridor", "blimp", "helicopter", "outdoor", "survey"])
def test_landmarks_are_seen(name: str, built: dict[str, Scenario]) -> None:
    flight = SimulatedFlight(built[name], 1)
    for mark, point in flight.landmarks.items():
        seen = [
            k for k in flight.near(point, len(flight)) if np.isfinite(flight.project(k, point[None])).all()
        ]
        assert len(seen) >= 2, f"{mark} is in no two frames"


def test_the_book_has_its_size_in_the_first_frame() -> None:
    flight = simulate("helicopter", 3, frames=1)
    book = flight.scale_landmark
    assert book is not None
    corners = book.corners_px
    height = float(flight.truth[0].translation[2])
    focal = flight.rig.cam0.camera.fx
    for a, b, metres in ((0, 1, 0.30), (1, 2, 0.20)):
        assert math.isclose(np.linalg.norm(corners[a] - corners[b]) * height / focal, metres, rel_tol=0.08)


def test_same_seed_same_bytes_and_another_seed_another_flight() -> None:
    first, again, other = (simulate("corridor", seed, frames=3) for seed in (5, 5, 6))
    for index in range(2):
        one, two, three = (flight.render(index) for flight in (first, again, other))
        assert [shot.encoded for shot in one.shots] == [shot.encoded for shot in two.shots]
        assert one.frame.attitude == two.frame.attitude
        assert not np.array_equal(one.frame.images[0], three.frame.images[0])
    assert np.array_equal(first.truth[1].matrix(), again.truth[1].matrix())


def test_frames_do_not_depend_on_what_was_rendered_before() -> None:
    forward, alone = simulate("demo", 2, frames=4), simulate("demo", 2, frames=4)
    pictures = [frame.images[0] for frame in forward]
    assert np.array_equal(alone.frame(3).images[0], pictures[3])


def test_size_and_frames() -> None:
    flight = simulate("demo", 0, frames=2, size=(160, 120))
    frames = list(flight)
    assert len(frames) == len(flight) == len(flight.truth) == 2
    assert frames[1].images[0].shape == (120, 160, 3)
    assert flight.rig.cam0.camera.width == 160
    assert [frame.t_ns for frame in frames] == flight.stamps_ns.tolist()
    with pytest.raises(UsageError, match="frames"):
        simulate("demo", 0, frames=100_000)
    with pytest.raises(UsageError, match="corridor"):
        simulate("no-such-thing")


def test_kidnapping_is_black_and_ends_elsewhere(built: dict[str, Scenario]) -> None:
    scenario = built["kidnap"]
    flight = SimulatedFlight(scenario, 1)
    states = [flight.is_black(k) for k in range(len(flight))]
    first, last = states.index(True), len(states) - 1 - states[::-1].index(True)
    assert all(states[first : last + 1])
    before, after = flight.truth[first - 1].translation, flight.truth[last + 1].translation
    assert np.linalg.norm(after - before) > 2.0
    speeds = np.linalg.norm(np.diff([pose.translation for pose in flight.truth], axis=0), axis=1)
    assert speeds[~np.array(states[1:]) & ~np.array(states[:-1])].max() < 0.5, (
        "and it moves like a vehicle while seen"
    )


def test_frames_get_lost_but_never_the_first(built: dict[str, Scenario]) -> None:
    flight = SimulatedFlight(built["dropouts"], 1)
    gaps = np.diff(flight.stamps_ns) / 1e8
    assert len(flight) < built["dropouts"].frames
    assert set(np.round(gaps)) >= {1.0, 2.0}


def test_wrong_calibration_is_wrong_only_in_what_is_told(built: dict[str, Scenario]) -> None:
    wrong, right = SimulatedFlight(built["wrong-calibration"], 1), SimulatedFlight(built["demo"], 1)
    assert np.array_equal(wrong.frame(5).images[0], right.frame(5).images[0])
    assert wrong.rig.cam0.camera != right.rig.cam0.camera
    assert np.allclose(wrong.truth[5].matrix(), right.truth[5].matrix())


def test_moving_things_move(built: dict[str, Scenario]) -> None:
    movers = built["moving-shadows"].movers
    assert not np.allclose(movers(1.0).discs[:, :2], movers(2.0).discs[:, :2])
    assert movers(1.0).cloud_offset_m != movers(2.0).cloud_offset_m
    moving, still = SimulatedFlight(built["moving-shadows"], 1), SimulatedFlight(built["demo"], 1)
    assert (np.abs(moving.frame(9).images[0].astype(int) - still.frame(9).images[0]) > 12).mean() > 0.01


def test_declarations_are_short() -> None:
    """Adding a scenario that varies another takes under 30 lines."""
    stress = [name for name in NAMES if "stress" in inspect.getmodule(SCENARIOS[name].build).__name__]  # type: ignore[union-attr]
    assert len(stress) >= 9
    for name in stress:
        assert len(inspect.getsource(SCENARIOS[name].build).splitlines()) < 30


def test_the_manual_names_every_scenario() -> None:
    manual = (Path(__file__).parents[2] / "docs" / "simulation.md").read_text()
    assert [name for name in NAMES if f"`{name}`" not in manual] == []
