"""A scenario: a world, a flight through it and what the vehicle carries, as one readable declaration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from overfly.errors import UsageError
from overfly.geometry.poses import FloatArray
from overfly.simulation.optics import CameraSetup
from overfly.simulation.patches import Paintable
from overfly.simulation.paths import Path
from overfly.simulation.relief import HeightField
from overfly.simulation.rendering import NO_MOVERS, Movers
from overfly.simulation.sensors import SensorSuite
from overfly.simulation.vehicles import MULTIROTOR, Vehicle

LEAD_S = 0.25  # sensors run so much before the first picture and after the last one
DEFAULT_ORIGIN = (
    47.998,
    7.842,
    278.0,
)  # latitude, longitude in degrees, altitude in metres of the world's origin


@dataclass(frozen=True, slots=True)
class Landmark:
    """A named point on the ground that somebody measured; z follows the relief."""

    name: str
    x_m: float
    y_m: float


@dataclass(frozen=True, slots=True)
class FlatObject:
    """A flat rectangular object of known size on the ground, seen at the start: what gives a mono map its
    scale.
    """

    name: str
    centre: tuple[float, float]
    width_m: float
    height_m: float
    angle_rad: float = 0.0

    def corners_local(self) -> FloatArray:
        """(4, 2) metres in the object's own plane."""
        w, h = 0.5 * self.width_m, 0.5 * self.height_m
        return np.array([[-w, h], [w, h], [w, -h], [-w, -h]])

    def corners_world(self) -> FloatArray:
        """(4, 2) metres, x and y."""
        c, s = np.cos(self.angle_rad), np.sin(self.angle_rad)
        return np.asarray(self.corners_local() @ np.array([[c, s], [-s, c]]) + np.asarray(self.centre))


@dataclass(frozen=True, slots=True)
class Trouble:
    """What goes wrong with pictures: intervals (seconds from the start) of black or blank ones, and a share
    of lost ones.
    """

    black_s: tuple[tuple[float, float], ...] = ()
    dropped: float = 0.0


@dataclass(frozen=True, slots=True)
class Scenario:
    """Everything that :func:`overfly.simulation.simulate` needs. bounds_m: x0, y0, x1, y1 of what the scene
    files show.
    """

    name: str
    ground: Paintable
    relief: HeightField
    path: Path
    cameras: tuple[CameraSetup, ...]
    rate_hz: float
    bounds_m: tuple[float, float, float, float]
    sensors: SensorSuite = field(default_factory=SensorSuite)
    vehicle: Vehicle = MULTIROTOR
    landmarks: tuple[Landmark, ...] = ()
    scale_object: FlatObject | None = None
    trouble: Trouble = Trouble()
    movers: Callable[[float], Movers] = field(default=lambda _: NO_MOVERS)
    origin_lat_lon_alt: tuple[float, float, float] = DEFAULT_ORIGIN
    crs: str | None = None  # of the user's own orthophoto

    @property
    def frames(self) -> int:
        return int((self.path.duration_s - 2.0 * LEAD_S) * self.rate_hz) + 1


@dataclass(frozen=True, slots=True)
class Declared:
    """A scenario by name: build(seed) makes it."""

    name: str
    title: str
    build: Callable[[int], Scenario]


SCENARIOS: dict[str, Declared] = {}


def scenario(title: str) -> Callable[[Callable[[int], Scenario]], Callable[[int], Scenario]]:
    """Decorator: the function name(seed) -> Scenario becomes the scenario of that name."""

    def declare(build: Callable[[int], Scenario]) -> Callable[[int], Scenario]:
        name = build.__name__.replace("_", "-")
        SCENARIOS[name] = Declared(name, title, build)
        return build

    return declare


def declared(name: str) -> Declared:
    """The scenario of that name; raises UsageError with the names that exist."""
    import overfly.simulation.scenarios  # noqa: F401  (declares them)

    if name not in SCENARIOS:
        raise UsageError(f"no scenario is called '{name}'; there are: {', '.join(sorted(SCENARIOS))}")
    return SCENARIOS[name]
