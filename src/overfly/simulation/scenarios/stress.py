"""The hard ones: each takes one thing away that the others have."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from overfly.geometry.poses import Pose
from overfly.simulation import materials, paving, strewn
from overfly.simulation.degradation import ImageQuality
from overfly.simulation.flight import reduced
from overfly.simulation.ground import Ground, Layer
from overfly.simulation.movers import Walker, drifting_clouds, moving
from overfly.simulation.patches import rectangle
from overfly.simulation.paths import Path, Route
from overfly.simulation.pictures import strewn_papers
from overfly.simulation.scenario import Scenario, Trouble, scenario
from overfly.simulation.scenarios.demo import demo
from overfly.simulation.scenarios.kit import mono
from overfly.simulation.scenarios.paper import corridor, outdoor
from overfly.simulation.sensors import AttitudeSensor, Clock, Imu, SensorSuite, Sonar
from overfly.simulation.terrain import Terrain
from overfly.simulation.vehicles import MULTIROTOR, fly_route

SENSORS = SensorSuite(AttitudeSensor(), Imu(), Sonar())


def _loop(width_m: float, depth_m: float, height_m: float, speed_m_s: float, seed: int) -> Path:
    """Once and a quarter around a rounded rectangle."""
    w, d = 0.5 * width_m, 0.5 * depth_m
    ring = [[-w, 0], [-w, -d], [0, -d], [w, -d], [w, 0], [w, d], [0, d], [-w, d]]
    points = np.column_stack([ring + ring[:3], np.full(11, height_m)])
    return fly_route(Route(points, speed_m_s, pause_s=1.0), MULTIROTOR, seed)


@scenario("a tiled floor that repeats itself: the same picture in many places")
def self_similar(seed: int) -> Scenario:
    bounds = (-6.0, -5.0, 6.0, 5.0)
    ground = Ground((Layer(paving.tiled_floor(0.30), None, (strewn.SPOTS,)),), (), seed)
    path = _loop(7.0, 5.0, 1.6, 0.7, seed)
    return Scenario("self-similar", ground, Terrain(bounds, 1.0).build(), path, mono(), 10.0, bounds, SENSORS)


@scenario("smooth concrete with next to nothing to hold on to, dim light")
def low_texture(seed: int) -> Scenario:
    bounds = (-6.0, -5.0, 6.0, 5.0)
    ground = Ground(
        (Layer(paving.concrete, None, (strewn.SPOTS,)),), strewn_papers(3, (-4, 4), (-3, 3), seed), seed
    )
    quality = ImageQuality(brightness=0.08, full_well_e=3000, read_noise_e=20)
    path = _loop(7.0, 5.0, 1.8, 0.7, seed)
    return Scenario(
        "low-texture",
        ground,
        Terrain(bounds, 1.0).build(),
        path,
        mono(quality=quality),
        10.0,
        bounds,
        SENSORS,
    )


@scenario("kidnapped: the lens is covered, the vehicle carried 6 m away, and seen again over known ground")
def kidnap(seed: int) -> Scenario:
    base = demo(seed)
    first, second = base.path.cut(0.0, 11.0), base.path.cut(2.0, 9.0)
    path = first.followed_by(second, gap_s=3.0)
    black = ((10.9, 14.1),)
    return dataclasses.replace(base, name="kidnap", path=path, trouble=Trouble(black))


@scenario("a dirty lens, blackouts of up to a second, and one picture in ten never arrives")
def dropouts(seed: int) -> Scenario:
    black = tuple((k, k + 0.3 + 0.1 * (k % 7)) for k in np.arange(2.0, 17.0, 2.5))
    cameras = mono(quality=ImageQuality(dirt=0.4), color=True, exposure_s=0.004)
    return dataclasses.replace(
        demo(seed), name="dropouts", cameras=cameras, trouble=Trouble(black, dropped=0.1)
    )


@scenario("people walk through the picture, clouds and the vehicle's own shadow move over the ground")
def moving_shadows(seed: int) -> Scenario:
    base = demo(seed)
    generator = np.random.default_rng([seed, 9])
    walkers = tuple(
        Walker(tuple(generator.uniform(-4, 4, 2)), generator.uniform(0, 6.28), generator.uniform(0.4, 1.2))
        for _ in range(6)
    )
    clouds = drifting_clouds(seed, depth=0.6, size_m=6.0, wind_m_s=(1.2, 0.5))
    movers = moving(walkers, clouds, shadow_of=base.path)
    return dataclasses.replace(base, name="moving-shadows", movers=movers)


@scenario("stamps that lie: the attitude clock is 80 ms late with 5 ms of jitter, the sonar 120 ms")
def clock_offset(seed: int) -> Scenario:
    sensors = SensorSuite(
        AttitudeSensor(clock=Clock(0.080, 0.005)), Imu(clock=Clock(0.080)), Sonar(clock=Clock(0.120, 0.01))
    )
    return dataclasses.replace(demo(seed), name="clock-offset", sensors=sensors)


@scenario("a wrong calibration: focal length 3 % off, camera 1.5 degrees askew, distortion left out")
def wrong_calibration(seed: int) -> Scenario:
    base = demo(seed)
    real = base.cameras[0]
    claimed = dataclasses.replace(reduced(real.camera, 1.03), coefficients=(0.0, 0.0, 0.0, 0.0))
    askew = Pose.exp(np.array([0.0, 0.0, 0.0, math.radians(1.0), math.radians(-1.1), 0.0]))
    setup = dataclasses.replace(
        real, camera=claimed, body_from_cam=real.body_from_cam @ askew,
        true_camera=real.camera, true_body_from_cam=real.body_from_cam,
    )  # fmt: skip
    return dataclasses.replace(base, name="wrong-calibration", cameras=(setup,))


@scenario("a stereo rig that was bumped: the right camera is half a degree off its calibration")
def bumped_stereo(seed: int) -> Scenario:
    base = corridor(seed)
    right = base.cameras[1]
    bump = Pose.exp(
        np.array([0.0008, 0.0, 0.0004, math.radians(0.15), math.radians(0.45), math.radians(0.2)])
    )
    bumped = dataclasses.replace(right, true_body_from_cam=right.body_from_cam @ bump)
    return dataclasses.replace(base, name="bumped-stereo", cameras=(base.cameras[0], bumped))


@scenario("fast and low: long exposures, motion blur of 15 pixels and more, rolling shutter")
def blurred(seed: int) -> Scenario:
    base = demo(seed)
    cameras = mono(exposure_s=0.06, readout_s=0.03)
    return dataclasses.replace(base, name="blurred", cameras=cameras)


@scenario("a steep garden: tables, crates up to the propellers, a slope of one in six")
def steep(seed: int) -> Scenario:
    base = outdoor(seed)
    bounds = (-8.0, -7.0, 8.0, 7.0)
    terrain = Terrain(bounds, 0.05).roll(0.35, 6.0, seed)
    tables = (((-3.0, 2.0), (1.6, 0.8), 0.2), ((3.2, -2.2), (1.2, 1.2), 0.7), ((0.2, 2.9), (2.0, 0.7), 1.5))
    for at, size, turn in tables:
        terrain.box(at, size, 0.75, turn)
    layers = (
        Layer(materials.grass, None, (strewn.BLADES, strewn.CLOVER, strewn.LEAVES)),
        Layer(
            materials.forest_floor,
            rectangle((2.0, 2.0), (5.0, 4.0), 0.4, ragged_m=0.3),
            (strewn.LEAVES, strewn.TWIGS),
        ),
        *(Layer(paving.wood_floor(1.0, 0.1), rectangle(at, size, turn)) for at, size, turn in tables),
    )
    return dataclasses.replace(
        base, name="steep", ground=Ground(layers, (), seed), relief=terrain.build(), bounds_m=bounds,
        path=_loop(7.0, 5.5, 2.8, 0.9, seed), landmarks=(),
    )  # fmt: skip
