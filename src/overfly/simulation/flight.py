"""A simulated flight: frames as the vehicle would have recorded them, and the truth beside them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from overfly.errors import UsageError
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.simulation import sensors
from overfly.simulation.degradation import Sensor, Shot
from overfly.simulation.optics import CameraSetup, Eye
from overfly.simulation.paths import wobble
from overfly.simulation.scenario import LEAD_S, Landmark, Scenario, declared
from overfly.simulation.sensors import Readings
from overfly.simulation.tiles import TileCache
from overfly.types import (
    Altitude,
    AltitudeKind,
    Attitude,
    Frame,
    GeoPosition,
    IntArray,
    MountedCamera,
    Rig,
    ScaleLandmark,
)

START_NS = 1_000_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """Readings of all sensors over the whole flight; None where there is no such sensor."""

    attitude: Readings | None
    imu: Readings | None
    sonar: Readings | None
    barometer: Readings | None
    gps: Readings | None


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedFrame:
    """A frame with what only the simulator knows: shots as encoded files, and whether the pictures are any
    good.
    """

    frame: Frame
    shots: tuple[Shot, ...]
    state: str  # ok | black


class SimulatedFlight:
    """Iterable of :class:`overfly.types.Frame`, rendered when asked for; nothing touches the disk.

    rig: the cameras as their calibration says. stamps_ns (n,): middle of each exposure. truth: world_from_cam
    of cam0, as it really was, one pose per frame.
    """

    def __init__(self, scenario: Scenario, seed: int, frames: int | None = None) -> None:
        self.scenario, self.seed = scenario, seed
        count = scenario.frames if frames is None else frames
        if not 0 < count <= scenario.frames:
            raise UsageError(f"scenario '{scenario.name}' has 1 to {scenario.frames} frames, not {count}")
        self._times = np.arange(count) / scenario.rate_hz
        generator = np.random.default_rng([seed, 31])
        kept = generator.random(count) >= scenario.trouble.dropped
        kept[0] = True
        self._times = self._times[kept] + scenario.path.start_s + LEAD_S
        self.stamps_ns: IntArray = START_NS + np.round(self._times * 1e9).astype(np.int64)
        self.rig = Rig(tuple(MountedCamera(c.name, c.camera, c.body_from_cam) for c in scenario.cameras))
        self.recorded = _record(scenario, seed)
        channels = 3 if any(setup.color for setup in scenario.cameras) else 1
        self.tiles = TileCache(scenario.ground.paint, channels)
        self._eyes = [Eye(setup, scenario.relief, self.tiles) for setup in scenario.cameras]
        self._sensors = [
            Sensor(c.quality, c.camera.width, c.camera.height, seed + n)
            for n, c in enumerate(scenario.cameras)
        ]
        self._gains = [
            wobble(self._times, c.quality.gain_drift, (0.01, 0.2), generator) for c in scenario.cameras
        ]

    def __len__(self) -> int:
        return len(self._times)

    def __iter__(self) -> Iterator[Frame]:
        for index in range(len(self)):
            yield self.render(index, store=False).frame

    def frame(self, index: int) -> Frame:
        return self.render(index, store=False).frame

    @property
    def truth(self) -> tuple[Pose, ...]:
        mount = self.scenario.cameras[0].real_mount
        return tuple(body @ mount for body in self.body_truth)

    @property
    def body_truth(self) -> tuple[Pose, ...]:
        """world_from_body, one per frame."""
        rotations, positions = self.scenario.path.poses(self._times)
        return tuple(Pose(R, t) for R, t in zip(rotations, positions, strict=True))

    @property
    def landmarks(self) -> dict[str, FloatArray]:
        """World positions (3,) of the scenario's named landmarks."""
        return {mark.name: self._on_ground(mark) for mark in self.scenario.landmarks}

    @property
    def scale_landmark(self) -> ScaleLandmark | None:
        """The object of known size as somebody would click its corners in the first frame, not exactly."""
        thing = self.scenario.scale_object
        if thing is None:
            return None
        corners = thing.corners_world()
        z = self.scenario.relief.height(corners[:, 0], corners[:, 1])
        px = self._project(0, np.column_stack([corners, z]), 0)
        px = px + np.random.default_rng([self.seed, 41]).normal(0.0, 0.25, px.shape)
        name = self.scenario.cameras[0].name
        return ScaleLandmark(thing.name, int(self.stamps_ns[0]), name, thing.corners_local(), px)

    def render(self, index: int, *, store: bool = True) -> SimulatedFrame:
        """Frame number ``index`` with its shots; store: encode lossless pictures, too."""
        time_s = float(self._times[index])
        black = self.is_black(index)
        movers = self.scenario.movers(time_s)
        shots = []
        for number, (eye, sensor) in enumerate(zip(self._eyes, self._sensors, strict=True)):
            generator = np.random.default_rng([self.seed, 51 + number, index])
            if black:
                shots.append(sensor.black(self.tiles.channels, generator))
                continue
            radiance = eye.expose(self.scenario.path, time_s, movers)
            shots.append(sensor.picture(radiance, float(self._gains[number][index]), generator, store=store))
        return SimulatedFrame(self._frame(index, shots), tuple(shots), "black" if black else "ok")

    def is_black(self, index: int) -> bool:
        """Whether the lens is covered in this frame."""
        time_s = float(self._times[index])
        return any(first <= time_s < last for first, last in self.scenario.trouble.black_s)

    def near(self, point: FloatArray, count: int) -> list[int]:
        """Frames below ``count`` whose cameras could have the world point (3,) in view, at first sight."""
        _, positions = self.scenario.path.poses(self._times[:count])
        away = np.linalg.norm(positions[:, :2] - point[:2], axis=1)
        return np.flatnonzero(away < 3.0 * np.abs(positions[:, 2] - point[2]) + 0.5).tolist()

    def project(self, index: int, points: FloatArray, camera: int = 0) -> FloatArray:
        """Pixels (n, 2) of world points (n, 3) in the picture as it was really taken; NaN where they are not
        in it.

        A rolling shutter is followed: each point is seen at the time of the row that it falls on. Points
        hidden behind the relief are not in the picture.
        """
        px = self._project(index, points, camera)
        real = self.scenario.cameras[camera].real_camera
        inside = (px >= -0.5).all(axis=1) & (px[:, 0] < real.width - 0.5) & (px[:, 1] < real.height - 0.5)
        px[~inside] = np.nan
        _, centres = self._eyes[camera].row_poses(self.scenario.path, float(self._times[index]))
        eye = np.repeat(centres[real.height // 2][None], len(points), axis=0)
        hidden = self.scenario.relief.ranges(eye, points - eye) < 1.0 - 0.02
        px[hidden] = np.nan
        return px

    def _project(self, index: int, points: FloatArray, camera: int) -> FloatArray:
        eye = self._eyes[camera]
        rotations, centres = eye.row_poses(self.scenario.path, float(self._times[index]))
        rows = np.full(len(points), eye.camera.height // 2)
        px = np.full((len(points), 2), np.nan)
        for _ in range(4 if eye.setup.readout_s else 1):
            in_cam = np.einsum("nji,nj->ni", rotations[rows], points - centres[rows])
            px = eye.camera.project(in_cam)
            rows = np.clip(np.nan_to_num(px[:, 1]), 0, eye.camera.height - 1).round().astype(np.int64)
        return px

    def _on_ground(self, mark: Landmark) -> FloatArray:
        z = self.scenario.relief.height(np.array([mark.x_m]), np.array([mark.y_m]))
        return np.array([mark.x_m, mark.y_m, float(z[0])])

    def _frame(self, index: int, shots: list[Shot]) -> Frame:
        t_ns = int(self.stamps_ns[index])
        return Frame(
            index,
            t_ns,
            f"{t_ns}",
            tuple(shot.image for shot in shots),
            self._attitude(t_ns),
            self._altitude(t_ns),
            self._position(t_ns),
        )

    def _attitude(self, t_ns: int) -> Attitude | None:
        kind, readings = self.scenario.sensors.attitude, self.recorded.attitude
        values = readings.at(t_ns) if readings is not None else None
        if kind is None or values is None:
            return None
        sigma = float(np.hypot(kind.sigma_rad, kind.bias_sigma_rad))
        if kind.yaw_sigma_rad is None:
            return Attitude(float(values[0]), float(values[1]), sigma)
        return Attitude(float(values[0]), float(values[1]), sigma, float(values[2]), kind.yaw_sigma_rad)

    def _altitude(self, t_ns: int) -> Altitude | None:
        suite, recorded = self.scenario.sensors, self.recorded
        if suite.sonar is not None and recorded.sonar is not None:
            values = recorded.sonar.at(t_ns)
            return (
                None
                if values is None
                else Altitude(
                    float(values[0]), suite.sonar.sigma_m, AltitudeKind.RANGE, suite.sonar.cone_half_angle_rad
                )
            )
        if suite.barometer is not None and recorded.barometer is not None:
            values = recorded.barometer.at(t_ns)
            sigma = float(np.hypot(suite.barometer.sigma_m, suite.barometer.drift_m))
            return None if values is None else Altitude(float(values[0]), sigma, AltitudeKind.ABOVE_START)
        return None

    def _position(self, t_ns: int) -> GeoPosition | None:
        kind, readings = self.scenario.sensors.gps, self.recorded.gps
        values = readings.at(t_ns) if readings is not None else None
        if kind is None or values is None:
            return None
        latitude, longitude, altitude = map(
            float, geographic(values[None], self.scenario.origin_lat_lon_alt)[0]
        )
        horizontal = float(np.hypot(kind.sigma_horizontal_m, kind.bias_horizontal_m))
        vertical = float(np.hypot(kind.sigma_vertical_m, kind.bias_vertical_m))
        return GeoPosition(latitude, longitude, altitude, horizontal, vertical)


def simulate(
    scenario: str | Scenario,
    seed: int = 0,
    frames: int | None = None,
    size: tuple[int, int] | None = None,
) -> SimulatedFlight:
    """The flight of a named or given scenario: iterable of frames, with ``.rig`` and ``.truth``.

    frames: only so many of its first frames. size: (width, height) in pixels, same field of view. Raises
    UsageError for a name that does not exist or more frames than the scenario has. The same arguments give
    the same bytes.
    """
    built = declared(scenario).build(seed) if isinstance(scenario, str) else scenario
    if size is not None:
        cameras = tuple(_resized(setup, *size) for setup in built.cameras)
        built = dataclasses.replace(built, cameras=cameras)
    return SimulatedFlight(built, seed, frames)


def with_camera(scenario: Scenario, camera: Camera) -> Scenario:
    """The scenario flown with another camera: its size, field of view and lens, mounted as before."""
    cameras = tuple(dataclasses.replace(setup, camera=camera, true_camera=None) for setup in scenario.cameras)
    return dataclasses.replace(scenario, cameras=cameras)


def _resized(setup: CameraSetup, width: int, height: int) -> CameraSetup:
    real = setup.true_camera.scaled(width, height) if setup.true_camera else None
    return dataclasses.replace(setup, camera=setup.camera.scaled(width, height), true_camera=real)


def geographic(enu_m: FloatArray, origin: tuple[float, float, float]) -> FloatArray:
    """(n, 3) east, north, up metres about the origin -> latitude and longitude in degrees, altitude in metres
    (WGS 84).
    """
    from pyproj import Transformer

    pipeline = (
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 "
        f"+lat_0={origin[0]!r} +lon_0={origin[1]!r} +h_0={origin[2]!r} "
        "+step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    east, north, up = enu_m.T
    found = Transformer.from_pipeline(pipeline).transform(east, north, up)
    return np.asarray(np.column_stack([found[1], found[0], found[2]]), dtype=np.float64)


def _record(scenario: Scenario, seed: int) -> Recorded:
    suite, path = scenario.sensors, scenario.path
    return Recorded(
        attitude=sensors.attitude_readings(suite.attitude, path, START_NS, seed) if suite.attitude else None,
        imu=sensors.imu_readings(suite.imu, path, START_NS, seed) if suite.imu else None,
        sonar=sensors.sonar_readings(suite.sonar, path, scenario.relief, START_NS, seed)
        if suite.sonar
        else None,
        barometer=sensors.barometer_readings(suite.barometer, path, START_NS, seed)
        if suite.barometer
        else None,
        gps=sensors.gps_readings(suite.gps, path, START_NS, seed) if suite.gps else None,
    )


def reduced(camera: Camera, share: float) -> Camera:
    """The camera with its focal length multiplied by ``share``: a wrong calibration."""
    return dataclasses.replace(camera, fx=camera.fx * share, fy=camera.fy * share)
