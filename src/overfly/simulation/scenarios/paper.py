"""The paper's experiments with its dimensions (Steder et al. 2008, section V)."""

from __future__ import annotations

import numpy as np

from overfly.geometry.cameras import Camera
from overfly.simulation import materials, paving, strewn
from overfly.simulation.degradation import ImageQuality
from overfly.simulation.ground import Ground, Layer
from overfly.simulation.patches import band, rectangle
from overfly.simulation.paths import Route
from overfly.simulation.pictures import book, landmark, manhole, strewn_papers
from overfly.simulation.plants import hold_position
from overfly.simulation.radio import RadioLink
from overfly.simulation.scenario import FlatObject, Landmark, Scenario, scenario
from overfly.simulation.scenarios.kit import mono, stereo
from overfly.simulation.sensors import AttitudeSensor, Imu, SensorSuite, Sonar
from overfly.simulation.terrain import Terrain
from overfly.simulation.vehicles import BLIMP, HELICOPTER, ROD, fly_route

CHEAP = ImageQuality(vignetting=0.3, full_well_e=6000, read_noise_e=18, jpeg_quality=82)


@scenario("190 m around a building with a stereo rig on a rod, over grass, slabs and asphalt (section V-A)")
def outdoor(seed: int) -> Scenario:
    bounds = (-32.0, -24.0, 32.0, 24.0)
    loop = np.array([[-27, -17], [-9, -18.5], [9, -17.5], [26, -18], [27.5, 0], [26.5, 17],
                     [9, 18], [-9, 17], [-26, 18], [-27.5, 0]])  # fmt: skip
    paved = rectangle((-14.0, -18.0), (22.0, 6.0)), rectangle((27.0, 4.0), (5.0, 16.0), 0.1)
    marks = tuple(Landmark(f"M{k + 1:02d}", *(0.985 * loop[k])) for k in range(len(loop)))
    ground = Ground(
        (
            Layer(
                materials.grass,
                None,
                (strewn.BLADES, strewn.CLOVER, strewn.DAISIES, strewn.LEAVES, strewn.TWIGS),
            ),
            Layer(
                materials.soil,
                rectangle((10.0, -17.0), (6.0, 5.0), ragged_m=0.4),
                (strewn.PEBBLES, strewn.LEAVES),
            ),
            Layer(paving.asphalt, band(loop[4:8], 3.5), (strewn.PEBBLES, strewn.LITTER, strewn.LEAVES)),
            Layer(materials.gravel_bed, band(loop[7:], 1.6, ragged_m=0.2), (strewn.GRAVEL, strewn.LEAVES)),
            *(Layer(paving.slabs(), shape, (strewn.PEBBLES, strewn.LEAVES)) for shape in paved),
            Layer(materials.plain(0.25, 0.10, 0.07), rectangle((0.0, 0.0), (44.0, 28.0))),
        ),
        (*(landmark(m.name, (m.x_m, m.y_m)) for m in marks), manhole("lid", (25.6, 9.0))),
        seed,
    )
    terrain = Terrain(bounds, 0.08).roll(0.15, 14.0, seed, 2.0).box((0.0, 0.0), (44.0, 28.0), 6.0)
    terrain.box((-14.0, -15.2), (22.0, 0.15), 0.10)
    points = np.column_stack(
        [np.vstack([loop, loop[:1], loop[:1] + np.array([6.0, -0.5])]), np.full(12, 2.2)]
    )
    path = fly_route(Route(points, 1.4, pause_s=1.0), ROD, seed)
    sensors = SensorSuite(AttitudeSensor(), Imu())
    cameras = stereo(quality=CHEAP, exposure_s=0.010)
    return Scenario("outdoor", ground, terrain.build(), path, cameras, 10.0, bounds, sensors, ROD, marks)


@scenario("corridor with a wooden floor, six landmarks A to F, 5 m by 1.5 m, stereo on a rod (section V-B)")
def corridor(seed: int) -> Scenario:
    bounds = (-2.5, -1.5, 12.5, 3.0)
    places = {
        "A": (0.0, 0.0),
        "B": (5.0, 0.0),
        "C": (10.0, 0.0),
        "D": (10.0, 1.5),
        "E": (5.0, 1.5),
        "F": (0.0, 1.5),
    }
    marks = tuple(Landmark(name, *place) for name, place in places.items())
    ground = Ground(
        (Layer(paving.wood_floor(), None, (strewn.SPOTS,)),),
        (
            *strewn_papers(18, (-1.2, 11.2), (-0.7, 2.2), seed),
            *(landmark(m.name, (m.x_m, m.y_m), 0.25, 0.1 * k) for k, m in enumerate(marks)),
        ),
        seed,
    )
    around = [(-0.6, 0.1), *list(places.values())[:3], (10.5, 0.75), *list(places.values())[3:],
              (-0.5, 0.8), (0.0, 0.0), (0.8, 0.0)]  # fmt: skip
    points = np.column_stack([around, np.full(len(around), 1.25)])
    path = fly_route(Route(points, 0.45, yaw_rad=0.0, pause_s=1.0), ROD, seed)
    cameras = stereo(quality=CHEAP, exposure_s=0.014)
    relief = Terrain(bounds, 0.25).build()
    return Scenario(
        "corridor",
        ground,
        relief,
        path,
        cameras,
        10.0,
        bounds,
        SensorSuite(AttitudeSensor(), Imu()),
        ROD,
        marks,
    )


def _hall(seed: int, half_m: float = 4.5) -> tuple[Ground, tuple[Landmark, ...]]:
    """The blimp's hall: carpet and boards with papers about, L1 and L2 5 m apart."""
    marks = (Landmark("L1", 0.0, 0.0), Landmark("L2", 5.0, 0.0))
    layers = (
        Layer(paving.carpet_tiles(), None, (strewn.SPOTS, strewn.LITTER)),
        Layer(paving.wood_floor(), rectangle((2.5, 0.0), (5.0, 2.4))),
    )
    papers = strewn_papers(26, (-3.0, 8.0), (-half_m, half_m), seed)
    return Ground(layers, (*papers, *(landmark(m.name, (m.x_m, m.y_m)) for m in marks)), seed), marks


@scenario("blimp with one camera and a sonar over two landmarks 5 m apart, there and back (section V-C)")
def blimp(seed: int) -> Scenario:
    bounds = (-5.0, -5.0, 10.0, 5.0)
    ground, marks = _hall(seed)
    points = np.array([[-1.2, 0.1, 1.8], [0.0, 0.0, 1.8], [2.5, 0.15, 1.9], [5.0, 0.0, 1.85],
                       [6.2, 0.4, 1.9], [6.3, 1.0, 1.9], [5.0, 1.2, 1.8],
                       [2.4, 0.8, 1.8], [0.0, 0.1, 1.8], [-1.4, 0.0, 1.8]])  # fmt: skip
    path = fly_route(Route(points, 0.33, yaw_rad=0.0, pause_s=1.0), BLIMP, seed)
    relief = Terrain(bounds, 0.5).build()
    sensors = SensorSuite(sonar=Sonar())
    return Scenario(
        "blimp",
        ground,
        relief,
        path,
        mono(quality=CHEAP, exposure_s=0.014),
        10.0,
        bounds,
        sensors,
        BLIMP,
        marks,
    )


@scenario("18 minutes over one place, pushed away several metres again and again (section V-C, Fig. 8)")
def hold(seed: int) -> Scenario:
    bounds = (-6.0, -6.0, 10.0, 6.0)
    ground, marks = _hall(seed, 5.0)
    path = hold_position(BLIMP, (2.5, 0.0, 1.9), duration_s=1080.45, push_every_s=45.0, push_m=2.8, seed=seed)
    relief = Terrain(bounds, 0.5).build()
    sensors = SensorSuite(sonar=Sonar())
    return Scenario(
        "hold",
        ground,
        relief,
        path,
        mono(quality=CHEAP, exposure_s=0.014),
        10.0,
        bounds,
        sensors,
        BLIMP,
        marks,
    )


@scenario("helicopter, 35 m, analogue radio camera, scale from a book of known size (section V-D)")
def helicopter(seed: int) -> Scenario:
    bounds = (-3.5, -2.5, 10.0, 8.0)
    thing = FlatObject("book", (0.0, 0.0), 0.30, 0.20, 0.3)
    places = ((4.0, 0.3), (7.0, 1.4), (6.7, 4.6), (3.6, 5.3), (0.6, 4.6), (3.2, 2.7))
    marks = tuple(Landmark(f"X{k + 1}", *place) for k, place in enumerate(places))
    ground = Ground(
        (
            Layer(paving.tiled_floor(0.45), None, (strewn.SPOTS, strewn.LITTER)),
            Layer(paving.carpet_tiles(), rectangle((4.5, 4.2), (7.0, 3.6), 0.05), (strewn.SPOTS,)),
            Layer(paving.concrete, rectangle((0.5, 4.4), (3.0, 4.0)), (strewn.SPOTS, strewn.LITTER)),
        ),
        (
            *strewn_papers(24, (-1.5, 8.5), (-1.0, 6.5), seed),
            book(thing.name, thing.centre, thing.width_m, thing.height_m, thing.angle_rad),
            *(landmark(m.name, (m.x_m, m.y_m)) for m in marks),
        ),
        seed,
    )
    around = [(0.0, 0.05), (2.0, 0.0), *places[:5], (1.2, 3.2), places[5], (4.6, 1.6),
              (2.4, 0.5), (0.3, 0.2), (-0.4, 1.6), (0.8, 2.6), (2.2, 1.2), (0.2, 0.1)]  # fmt: skip
    points = np.column_stack([around, np.full(len(around), 1.5)])
    path = fly_route(Route(points, 0.62, pause_s=1.0, yaw_rad=0.1), HELICOPTER, seed)
    camera = Camera(320, 240, 272.0, 272.0, 161.4, 116.6, coefficients=(-0.18, 0.06, 0.001, -0.0007))
    quality = ImageQuality(
        vignetting=0.35, full_well_e=5000, read_noise_e=25, jpeg_quality=80, radio=RadioLink()
    )
    relief = Terrain(bounds, 0.5).build()
    return Scenario(
        "helicopter",
        ground,
        relief,
        path,
        mono(camera, 0.012, quality),
        15.0,
        bounds,
        SensorSuite(),
        HELICOPTER,
        marks,
        thing,
    )
