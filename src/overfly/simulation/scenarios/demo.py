"""The first thing a new user sees: once around a garden."""

from __future__ import annotations

import numpy as np

from overfly.simulation import materials, paving, strewn
from overfly.simulation.ground import Ground, Layer
from overfly.simulation.patches import band, disc, rectangle
from overfly.simulation.paths import Route
from overfly.simulation.pictures import landmark, manhole, strewn_papers
from overfly.simulation.scenario import Landmark, Scenario, scenario
from overfly.simulation.scenarios.kit import mono
from overfly.simulation.sensors import AttitudeSensor, SensorSuite, Sonar
from overfly.simulation.terrain import Terrain
from overfly.simulation.vehicles import MULTIROTOR, fly_route


@scenario("150 frames once around a garden: lawn, gravel path, pavement, crates")
def demo(seed: int) -> Scenario:
    bounds = (-8.0, -7.0, 8.0, 7.0)
    walk = np.array(
        [[-7.5, -4.0], [-3.0, -3.3], [0.0, -4.2], [3.6, -2.6], [4.4, 1.2], [2.0, 4.2], [-1.0, 6.5]]
    )
    crates = (
        ((-3.6, 2.1), 0.55, 0.4),
        ((-2.9, 2.5), 0.40, 1.1),
        ((2.2, -3.9), 0.5, 0.2),
        ((4.6, 2.6), 0.45, 0.8),
    )
    ground = Ground(
        (
            Layer(materials.grass, None, (strewn.BLADES, strewn.CLOVER, strewn.DAISIES, strewn.LEAVES)),
            Layer(materials.soil, disc((1.6, 2.2), 1.1, ragged_m=0.15), (strewn.PEBBLES, strewn.LEAVES)),
            Layer(materials.gravel_bed, band(walk, 1.1, ragged_m=0.10), (strewn.GRAVEL, strewn.TWIGS)),
            Layer(paving.slabs(), rectangle((-3.9, 1.2), (3.5, 5.0)), (strewn.PEBBLES, strewn.LEAVES)),
            Layer(paving.bricks(), rectangle((4.7, 2.3), (2.5, 3.0), 0.15), (strewn.LEAVES,)),
            *(
                Layer(materials.plain(0.33, 0.21, 0.11), rectangle(at, (side, side), turn))
                for at, side, turn in crates
            ),
        ),
        (
            landmark("A", (-4.0, -0.4)),
            landmark("B", (4.0, -0.6), angle_rad=0.6),
            manhole("lid", (-4.9, 3.3)),
            *strewn_papers(6, (-5.0, 5.0), (-4.0, 4.0), seed),
        ),
        seed,
    )
    terrain = Terrain(bounds, 0.05).roll(0.03, 4.0, seed)
    for at, side, turn in crates:
        terrain.box(at, (side, side), 0.30, turn)
    corners = [[-4.0, -3.2], [0.0, -3.4], [4.0, -2.6], [4.6, 0.6],
               [3.2, 3.3], [0.0, 3.2], [-3.6, 3.0], [-4.4, 0.0]]  # fmt: skip
    route = Route(np.column_stack([corners, np.full(8, 3.1)]), 2.0, closed=True, ramp_s=1.0)
    return Scenario(
        "demo", ground, terrain.build(), fly_route(route, MULTIROTOR, seed),
        mono(color=True, exposure_s=0.002), 10.0, bounds, SensorSuite(AttitudeSensor(), sonar=Sonar()),
        MULTIROTOR, (Landmark("A", -4.0, -0.4), Landmark("B", 4.0, -0.6)),
    )  # fmt: skip
