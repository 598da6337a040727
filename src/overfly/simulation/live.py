"""A vehicle in a world, flown by whoever calls: command in, a moment later a frame out. For control loops."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from overfly.geometry.poses import FloatArray, Pose
from overfly.simulation.degradation import Sensor
from overfly.simulation.flight import START_NS, geographic
from overfly.simulation.optics import Eye
from overfly.simulation.paths import STATE_RATE_HZ, Path
from overfly.simulation.plants import Plant, Wind
from overfly.simulation.scenario import Scenario
from overfly.simulation.sensors import cone_directions
from overfly.simulation.tiles import TileCache
from overfly.types import (
    Altitude,
    AltitudeKind,
    Attitude,
    Frame,
    GeoPosition,
    MountedCamera,
    Rig,
    ScaleLandmark,
    VelocityCommand,
)

_KEPT_STATES = 40  # what a picture can still look back on: longer than any exposure and read-out
CLICK_SIGMA_PX = 0.25  # of somebody who clicks corners


class LiveFlight:
    """The scenario's world, cameras and sensors around a plant that starts where the scenario's path does.

    step() moves the vehicle; frame() takes a picture of where it has just been, blurred by how it really
    moved. The stamps follow the simulated time. truth is world_from_body now. Same seed and same commands,
    same frames.
    """

    def __init__(self, scenario: Scenario, seed: int = 0, wind: Wind | None = None) -> None:
        self.scenario = scenario
        start = scenario.path.poses(np.array([scenario.path.start_s]))[1][0]
        heading = float(scenario.path.euler(np.array([scenario.path.start_s]))[0, 2])
        self.plant = Plant(scenario.vehicle, start, heading, wind=wind or Wind(), seed=seed)
        self.rig = Rig(tuple(MountedCamera(c.name, c.camera, c.body_from_cam) for c in scenario.cameras))
        channels = 3 if any(setup.color for setup in scenario.cameras) else 1
        tiles = TileCache(scenario.ground.paint, channels)
        self._eyes = [Eye(setup, scenario.relief, tiles) for setup in scenario.cameras]
        self._sensors = [
            Sensor(c.quality, c.camera.width, c.camera.height, seed + n)
            for n, c in enumerate(scenario.cameras)
        ]
        self._generator = np.random.default_rng([seed, 91])
        self._bias = np.zeros(2)
        self._start_height_m = float(start[2])
        self._longest_s = max(c.exposure_s + c.readout_s for c in scenario.cameras)
        self._frames = 0
        step = 1.0 / STATE_RATE_HZ
        past = [(-step * k, self._state()) for k in range(_KEPT_STATES - 1, -1, -1)]
        self._states: deque[tuple[float, FloatArray]] = deque(past, maxlen=_KEPT_STATES)

    @property
    def time_s(self) -> float:
        return self.plant.time_s

    @property
    def truth(self) -> Pose:
        """world_from_body now."""
        return self.plant.pose

    @property
    def stamp_ns(self) -> int:
        """Of a frame that is taken now: the middle of its exposure."""
        return START_NS + round((self.time_s - 0.5 * self._longest_s) * 1e9)

    @property
    def scale_landmark(self) -> ScaleLandmark | None:
        """The object of known size as somebody would click its corners in a frame taken now."""
        thing, setup = self.scenario.scale_object, self.scenario.cameras[0]
        if thing is None:
            return None
        corners = thing.corners_world()
        z = self.scenario.relief.height(corners[:, 0], corners[:, 1])
        cam_from_world = (self.truth @ setup.real_mount).inverse()
        px = setup.real_camera.project(cam_from_world.transform(np.column_stack([corners, z])))
        px = px + self._generator.normal(0.0, CLICK_SIGMA_PX, px.shape)
        return ScaleLandmark(thing.name, self.stamp_ns, setup.name, thing.corners_local(), px)

    def step(self, command: VelocityCommand, dt_s: float) -> None:
        """Fly for dt_s seconds with this command."""
        for _ in range(max(1, round(dt_s * STATE_RATE_HZ))):
            self.plant.step(command, dt_s / max(1, round(dt_s * STATE_RATE_HZ)))
            self._states.append((self.plant.time_s, self._state()))
        self._wander(dt_s)

    def frame(self) -> Frame:
        """A frame whose exposure has just ended; its stamp is in the middle of it, as always."""
        time_s = self.time_s - 0.5 * self._longest_s
        recent = Path(np.array([t for t, _ in self._states]), np.array([s for _, s in self._states]))
        images = []
        for eye, sensor in zip(self._eyes, self._sensors, strict=True):
            radiance = eye.expose(recent, time_s, self.scenario.movers(time_s))
            images.append(sensor.picture(radiance, 0.0, self._generator, store=False).image)
        t_ns = self.stamp_ns
        pose = recent.pose(time_s)
        found = Frame(
            self._frames, t_ns, str(t_ns), tuple(images),
            self._attitude(recent.euler(np.array([time_s]))[0]), self._altitude(pose), self._position(pose),
        )  # fmt: skip
        self._frames += 1
        return found

    def _state(self) -> FloatArray:
        return np.concatenate([self.plant.position, self.plant.euler])

    def _wander(self, dt_s: float) -> None:
        kind = self.scenario.sensors.attitude
        if kind is not None:
            keep = math.exp(-dt_s / kind.bias_tau_s)
            drive = kind.bias_sigma_rad * math.sqrt(1.0 - keep * keep)
            self._bias = keep * self._bias + self._generator.normal(0.0, drive, 2)

    def _attitude(self, euler: FloatArray) -> Attitude | None:
        kind = self.scenario.sensors.attitude
        if kind is None:
            return None
        roll, pitch = euler[:2] + self._bias + self._generator.normal(0.0, kind.sigma_rad, 2)
        sigma = math.hypot(kind.sigma_rad, kind.bias_sigma_rad)
        if kind.yaw_sigma_rad is None:
            return Attitude(float(roll), float(pitch), sigma)
        yaw = float(euler[2] + self._generator.normal(0.0, kind.yaw_sigma_rad))
        return Attitude(float(roll), float(pitch), sigma, yaw, kind.yaw_sigma_rad)

    def _altitude(self, pose: Pose) -> Altitude | None:
        sonar, barometer = self.scenario.sensors.sonar, self.scenario.sensors.barometer
        if sonar is not None:
            directions = cone_directions(sonar.cone_half_angle_rad) @ pose.rotation.T
            origins = np.repeat(pose.translation[None], len(directions), axis=0)
            range_m = float(self.scenario.relief.ranges(origins, directions).min())
            range_m += float(self._generator.normal(0.0, sonar.sigma_m))
            lost = self._generator.random() < sonar.dropout or range_m > sonar.max_range_m
            cone_rad = sonar.cone_half_angle_rad
            return None if lost else Altitude(range_m, sonar.sigma_m, AltitudeKind.RANGE, cone_rad)
        if barometer is None:
            return None
        height = float(pose.translation[2]) - self._start_height_m
        height += float(self._generator.normal(0.0, barometer.sigma_m))
        return Altitude(height, barometer.sigma_m, AltitudeKind.ABOVE_START)

    def _position(self, pose: Pose) -> GeoPosition | None:
        gps = self.scenario.sensors.gps
        if gps is None:
            return None
        sigmas = np.array([gps.sigma_horizontal_m, gps.sigma_horizontal_m, gps.sigma_vertical_m])
        seen = pose.translation + self._generator.normal(0.0, 1.0, 3) * sigmas
        latitude, longitude, altitude = map(
            float, geographic(seen[None], self.scenario.origin_lat_lon_alt)[0]
        )
        return GeoPosition(latitude, longitude, altitude, gps.sigma_horizontal_m, gps.sigma_vertical_m)
