"""From high up: lawn-mower surveys, a long haul, a fixed wing."""

from __future__ import annotations

import numpy as np

from overfly.geometry.cameras import Camera
from overfly.simulation import fields, materials, paving, strewn
from overfly.simulation.degradation import ImageQuality
from overfly.simulation.ground import Ground, Layer
from overfly.simulation.patches import Paintable, band, disc, rectangle
from overfly.simulation.paths import Route, lawn_mower
from overfly.simulation.pictures import target
from overfly.simulation.relief import HeightField
from overfly.simulation.scenario import Landmark, Scenario, scenario
from overfly.simulation.scenarios.kit import mono
from overfly.simulation.sensors import AttitudeSensor, Barometer, Gps, Imu, SensorSuite
from overfly.simulation.terrain import Terrain
from overfly.simulation.vehicles import FIXED_WING, MULTIROTOR, fly_route

MAPPING = Camera(640, 480, 533.0, 533.0, 323.3, 233.7, coefficients=(-0.04, 0.012, 0.0004, -0.0003))
GOOD = ImageQuality(vignetting=0.15, full_well_e=14000, read_noise_e=8, jpeg_quality=92)


def countryside(bounds: tuple[float, float, float, float], seed: int) -> tuple[Ground, HeightField]:
    """Fields, a road, a track, a pond, a farm, single trees and a wood; relief of a few metres."""
    generator = np.random.default_rng([seed, 3])
    x0, y0, x1, y1 = bounds
    w, h = x1 - x0, y1 - y0
    across = np.array([0.0, 0.25, 0.55, 1.0])
    road = np.column_stack([x0 + w * across, y0 + h * np.array([0.30, 0.36, 0.62, 0.70])])
    track = np.column_stack([x0 + w * np.array([0.62, 0.58, 0.70]), y0 + h * np.array([0.0, 0.5, 1.0])])
    farm, wood = np.array([x0 + 0.32 * w, y0 + 0.52 * h]), np.array([x0 + 0.85 * w, y0 + 0.25 * h])
    houses = [(tuple(farm + d), size, a) for d, size, a in
              (((0, 0), (22, 11), 0.4), ((24, 8), (14, 9), 0.4), ((-6, 20), (30, 13), 1.97))]  # fmt: skip
    spread = 0.09 * w
    trees = [tuple(wood + generator.normal(0.0, spread, 2)) for _ in range(70)]
    trees += [(x0 + w * a, y0 + h * b) for a, b in generator.random((40, 2))]
    sizes = generator.uniform(1.8, 4.5, len(trees))
    roofs = ((0.22, 0.09, 0.06), (0.12, 0.12, 0.13), (0.20, 0.10, 0.07))
    layers = (
        Layer(fields.farmland, None, (strewn.TUFTS, strewn.WEEDS)),
        Layer(
            materials.meadow,
            disc(tuple(wood), 2.2 * spread, ragged_m=2.0, blend_m=4.0),
            (strewn.BUSHES, strewn.TUFTS),
        ),
        Layer(materials.sand, band(track, 3.0, ragged_m=0.5), (strewn.STONES,)),
        Layer(paving.asphalt, band(road, 6.0), ()),
        Layer(materials.plain(0.55, 0.55, 0.53), band(road, 0.15)),
        Layer(
            materials.gravel_bed, disc((farm[0] + 6.0, farm[1] + 9.0), 24.0, ragged_m=2.0), (strewn.STONES,)
        ),
        Layer(
            materials.plain(0.035, 0.05, 0.055, 0.03), disc((x0 + 0.72 * w, y0 + 0.8 * h), 14.0, ragged_m=3.0)
        ),
        *(
            Layer(materials.plain(*roofs[k], 0.12), rectangle(at, size, a))
            for k, (at, size, a) in enumerate(houses)
        ),
        *(
            Layer(materials.crown, disc(at, float(r), ragged_m=0.5))
            for at, r in zip(trees, sizes, strict=True)
        ),
    )
    terrain = Terrain(bounds, max(0.4, w / 1500)).roll(2.0, 250.0, seed, 8.0)
    for at, size, turn in houses:
        terrain.box(at, size, 6.0, turn)
    for number, (at, radius) in enumerate(zip(trees, sizes, strict=True)):
        terrain.tree(at, float(radius), 2.2 * float(radius), seed + number)
    return Ground(layers, (), seed), terrain.build()


def survey_over(
    name: str, ground: Paintable, relief: HeightField, bounds: tuple[float, float, float, float], seed: int,
    *, height_m: float = 80.0, speed_m_s: float = 10.0, margin_m: float = 45.0,
    marks: tuple[Landmark, ...] = (),
) -> Scenario:  # fmt: skip
    """A lawn-mower survey of the bounds: 70 % forward and 60 % side overlap, one cross leg 30 % higher."""
    wide, long = height_m * MAPPING.width / MAPPING.fx, height_m * MAPPING.height / MAPPING.fy
    points = lawn_mower(bounds, margin_m, 0.4 * wide, height_m, cross_height_m=1.3 * height_m)
    path = fly_route(Route(points, speed_m_s, ramp_s=4.0), MULTIROTOR, seed)
    rate = speed_m_s / (0.3 * long)
    sensors = SensorSuite(AttitudeSensor(), Imu(), barometer=Barometer(), gps=Gps())
    cameras = mono(MAPPING, 0.002, GOOD, color=True)
    return Scenario(name, ground, relief, path, cameras, rate, bounds, sensors, MULTIROTOR, marks)


@scenario("lawn-mower survey of farmland at 80 m, 640x480, GPS, cross leg at 104 m")
def survey(seed: int) -> Scenario:
    bounds = (-60.0, -60.0, 660.0, 400.0)
    ground, relief = countryside(bounds, seed)
    grid = [(60.0 + 240.0 * a, 40.0 + 130.0 * b) for b in range(3) for a in range(3)]
    marks = tuple(Landmark(f"G{k + 1}", x, y) for k, (x, y) in enumerate(grid))
    ground = Ground(ground.layers, tuple(target(m.name, (m.x_m, m.y_m)) for m in marks), seed)
    return survey_over("survey", ground, relief, bounds, seed, marks=marks)


@scenario("long haul: 10,800 frames at 10 Hz over five kilometres of country, lanes at 30 m")
def long_haul(seed: int) -> Scenario:
    bounds = (-40.0, -40.0, 460.0, 360.0)
    ground, relief = countryside(bounds, seed)
    points = lawn_mower(bounds, 60.0, 30.0, 30.0, cross_height_m=33.0)
    path = fly_route(Route(points, 5.0, ramp_s=4.0).lasting(1080.45), MULTIROTOR, seed)
    camera = Camera(320, 240, 266.0, 266.0, 161.0, 117.0, coefficients=(-0.06, 0.02, 0.0004, -0.0003))
    sensors = SensorSuite(AttitudeSensor(), Imu(rate_hz=100.0), barometer=Barometer(), gps=Gps())
    return Scenario("long-haul", ground, relief, path, mono(camera, 0.004, GOOD), 10.0, bounds, sensors)


@scenario("fixed wing at 100 m, 16 m/s, banks into its turns, rolling shutter")
def fixed_wing(seed: int) -> Scenario:
    bounds = (-150.0, -150.0, 750.0, 650.0)
    ground, relief = countryside(bounds, seed)
    corners = [[0, 0], [250, -20], [500, 0], [590, 120], [480, 230], [250, 250],
               [100, 330], [150, 450], [400, 480], [560, 380],
               [480, 150], [250, 120], [20, 200], [-60, 90]]  # fmt: skip
    points = np.column_stack([corners, np.full(len(corners), 100.0)])
    path = fly_route(Route(points, 16.0, closed=True, ramp_s=0.5), FIXED_WING, seed)
    sensors = SensorSuite(AttitudeSensor(), Imu(), barometer=Barometer(), gps=Gps())
    cameras = mono(MAPPING, 0.002, GOOD, readout_s=0.02)
    return Scenario("fixed-wing", ground, relief, path, cameras, 2.0, bounds, sensors, FIXED_WING)
