"""The metre of one camera from a barometer: where the flight climbs, and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from overfly.evaluation import Align, evaluate
from overfly.geometry.poses import FloatArray
from overfly.scale import ScaleKeeper
from overfly.simulation import simulate
from overfly.simulation.paths import Route
from overfly.simulation.scenario import declared
from overfly.simulation.sensors import AttitudeSensor, Barometer, SensorSuite
from overfly.simulation.vehicles import MULTIROTOR, fly_route
from overfly.slam import Slam
from overfly.trajectory import Trajectory

SIGMA_M = 0.5


def metre_of(heights: FloatArray, source: str, map_metre: float, seed: int) -> tuple[float, str]:
    """What a map is multiplied with in the end, whose lengths are map_metre times too short, and by whom."""
    keeper, factor = ScaleKeeper(source), 1.0
    noise = np.random.default_rng(seed).normal(0.0, 0.15, len(heights))
    for above_start, height in zip(heights - heights[0] + 0.7 + noise, heights, strict=True):
        keeper.observe_climb(factor * height / map_metre, float(above_start), SIGMA_M)
        factor *= keeper.due_factor() or 1.0
    return factor, keeper.source


@pytest.mark.parametrize("map_metre", [0.4, 1.3, 5.0])
def test_a_climb_gives_the_metre(map_metre: float) -> None:
    factor, source = metre_of(np.linspace(1.2, 15.0, 160), "none", map_metre, 1)
    assert factor == pytest.approx(map_metre, rel=0.03)
    assert source == "altitude"


def test_level_flight_gives_none() -> None:
    heights = 10.0 + 0.3 * np.sin(np.linspace(0, 9, 160))
    assert metre_of(heights, "none", 1.3, 2) == (1.0, "none")


def test_a_height_that_was_known_well_is_kept() -> None:
    """Begun at forty metres above the start, to half a metre: a climb of twelve tells no better."""
    keeper = ScaleKeeper("altitude")
    for height in np.linspace(40.0, 52.0, 160):
        keeper.observe_climb(float(height), float(1.03 * height), SIGMA_M)
        assert keeper.due_factor() is None


def test_a_flight_from_take_off_has_its_metre_from_the_barometer() -> None:
    points = [[-3, -2, 1.2], [-2, -1, 3], [0, 0, 6], [1, 1, 10], [2, 0.5, 12], [0, -1, 11], [-2, 0, 8]]
    path = fly_route(Route(np.array(points, np.float64), 1.5, ramp_s=1.0), MULTIROTOR, 2)
    sensors = SensorSuite(AttitudeSensor(), barometer=Barometer())
    flight = simulate(replace(declared("demo").build(2), sensors=sensors, path=path), seed=2)
    slam = Slam(flight.rig)
    for frame in flight:
        slam.process(frame)
    slam.finish()
    assert slam.start is not None
    assert slam.start.source == "altitude"
    assert len(slam.placed()) == len(flight.stamps_ns)
    records = slam.placed()
    found = Trajectory.from_poses([r.t_ns for r in records], [slam.pose_of(r) for r in records])
    scale = evaluate(found, Trajectory.from_poses(flight.stamps_ns, flight.truth), Align.SE3).scale_error
    assert scale is not None
    assert abs(scale) < 0.06  # half a metre of drift in a climb of eleven; begun with 1 for 1.2 m
