"""A simulated vehicle in the loop: it is pushed, its pictures fail, and what it does takes time."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from overfly.geometry.poses import FloatArray, Pose
from overfly.navigation.vehicle import Airframe
from overfly.simulation import LiveFlight, Wind
from overfly.simulation.scenario import Scenario
from overfly.simulation.vehicles import GRAVITY
from overfly.types import Frame, Rig, ScaleLandmark, VelocityCommand

LATENCY_S = 0.06  # from the picture to the command that takes effect: what a small computer needs
HAND_S = 4.0  # a hand leads the vehicle away for so long,
HAND_RAMP_S = 0.5  # of which it takes this to gather way,
HAND_M = (2.0, 3.0)  # and so far, before it lets go
HAND_STEP_S = 0.02
GENTLE_TILT_RAD = math.radians(3.0)  # without an attitude sensor level is assumed: it may not lean more
BLACKOUT_EVERY_S = 15.0
BLACKOUT_S = (0.3, 0.8)
PICTURES_LOST = 0.05
RANGES_LOST = 0.2


CALM = Wind()


@dataclass(frozen=True, slots=True)
class Disturbances:
    """What the vehicle has to cope with. push_s: when a hand takes it; drop_outs: of pictures and range."""

    wind: Wind = CALM
    push_s: tuple[float, ...] = ()
    drop_outs: bool = False


def airframe_of(scenario: Scenario) -> Airframe:
    """How the scenario's vehicle follows commands, as its maker would say it."""
    vehicle = scenario.vehicle
    strongest = min(vehicle.max_acceleration_m_s2, GRAVITY * math.tan(vehicle.max_tilt_rad))
    if vehicle.tilt_per_acceleration < 1.0:
        strongest = vehicle.max_acceleration_m_s2
    if scenario.sensors.attitude is None:
        strongest = min(strongest, GRAVITY * math.tan(GENTLE_TILT_RAD))
    return Airframe(
        vehicle.name,
        vehicle.max_speed_m_s,
        strongest,
        vehicle.max_climb_m_s,
        vehicle.max_yaw_rate_rad_s,
        vehicle.velocity_lag_s,
        vehicle.attitude_lag_s,
    )


class SimulatedVehicle:
    """The scenario's vehicle, world and sensors as a :class:`overfly.navigation.vehicle.Vehicle`."""

    def __init__(self, scenario: Scenario, seed: int, disturbances: Disturbances) -> None:
        self.scenario = scenario
        self.disturbances = disturbances
        self.airframe = airframe_of(scenario)
        self.mission_began_s = 0.0  # times of pushes count from here
        self._flight = LiveFlight(scenario, seed, disturbances.wind)
        self._command = VelocityCommand()
        self._period_s = 1.0 / scenario.rate_hz
        self._frame_s = 0.0  # of the simulation, when the last picture was ready
        self._generator = np.random.default_rng([seed, 101])
        self._hand: FloatArray | None = None
        self._dark_until_s = -1.0
        self._next_dark_s = math.inf if not disturbances.drop_outs else 0.5 * BLACKOUT_EVERY_S
        self._frames = 0

    @property
    def rig(self) -> Rig:
        return self._flight.rig

    @property
    def scale_landmark(self) -> ScaleLandmark | None:
        """The object of known size in the first picture, where the scenario has one."""
        return self._flight.scale_landmark

    @property
    def now_ns(self) -> int:
        return self._flight.stamp_ns + round(LATENCY_S * 1e9)

    @property
    def time_s(self) -> float:
        """Of the simulation."""
        return self._flight.time_s

    @property
    def truth(self) -> Pose:
        """world_from_body now, for those who judge the flight."""
        return self._flight.truth

    @property
    def is_held(self) -> bool:
        """Whether a hand has it just now."""
        return self._hand is not None

    def command(self, velocity: VelocityCommand) -> None:
        """Until the command takes effect the vehicle flies on as before."""
        self._fly(min(LATENCY_S, self._period_s))
        self._command = velocity

    def sense(self) -> Frame:
        while True:
            if self._frames:
                self._fly(self._frame_s + self._period_s - self._flight.time_s)
            self._frames += 1
            self._frame_s = self._flight.time_s
            frame = self._flight.frame()
            if not self.disturbances.drop_outs:
                return frame
            if self._frames == 1 or self._generator.random() >= PICTURES_LOST:
                return self._spoilt(frame)

    def _fly(self, seconds: float) -> None:
        """The plant under its command, and under the hand when it is time for one."""
        end_s = self._flight.time_s + seconds
        while (left := end_s - self._flight.time_s) > 1e-6:
            step = min(left, HAND_STEP_S)
            self._push()
            self._flight.step(self._command, step)

    def _push(self) -> None:
        time_s = self._flight.time_s - self.mission_began_s
        began = [push_s for push_s in self.disturbances.push_s if 0.0 <= time_s - push_s < HAND_S]
        if not began:
            self._hand = None
            return
        if self._hand is None:
            angle = self._generator.uniform(0.0, 2.0 * math.pi)
            speed = self._generator.uniform(*HAND_M) / (HAND_S - 0.5 * HAND_RAMP_S)
            self._hand = speed * np.array([math.cos(angle), math.sin(angle)])
        share = min(1.0, (time_s - began[-1]) / HAND_RAMP_S)
        plant = self._flight.plant
        plant.push(np.append(share * self._hand - plant.velocity[:2], 0.0))

    def _spoilt(self, frame: Frame) -> Frame:
        """The frame with its picture black and its range missing, as chance will have it."""
        time_s = self._flight.time_s
        if time_s >= self._next_dark_s:
            self._dark_until_s = time_s + self._generator.uniform(*BLACKOUT_S)
            self._next_dark_s = time_s + BLACKOUT_EVERY_S * self._generator.uniform(0.7, 1.3)
        altitude = None if self._generator.random() < RANGES_LOST else frame.altitude
        images = frame.images
        if time_s < self._dark_until_s:
            images = tuple(
                self._generator.integers(0, 4, image.shape, dtype=np.uint8) for image in frame.images
            )
        return replace(frame, images=images, altitude=altitude)
