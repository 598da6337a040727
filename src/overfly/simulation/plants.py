"""Vehicles in a loop: a plant takes a velocity command and says where the vehicle is a moment later."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from overfly.geometry.poses import FloatArray, Pose, rotation_from_euler, wrap_angle
from overfly.simulation.paths import STATE_RATE_HZ, Path, smoothed, wobble
from overfly.simulation.vehicles import GRAVITY, Vehicle
from overfly.types import VelocityCommand

_STEP_S = 0.01


@dataclass(frozen=True, slots=True)
class Wind:
    """Mean wind in the world and gusts about it (first-order Gauss-Markov, as in the Dryden model at low
    height).
    """

    mean_m_s: tuple[float, float] = (0.0, 0.0)
    gust_m_s: float = 0.0
    gust_time_s: float = 3.0


class Plant:
    """The vehicle with its own inner loops; ``pose`` is world_from_body after each :meth:`step`.

    Rotors and propellers pull with a lag, limited by the tilt that the vehicle dares; drag acts on the
    velocity through the air, so wind carries it along; the body leans into its pull. A fixed wing keeps its
    speed above the stall and turns by banking; what it is asked to do sideways it does by turning there.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        position_m: FloatArray,
        yaw_rad: float = 0.0,
        *,
        wind: Wind = Wind(),
        seed: int = 0,
    ) -> None:
        self.vehicle, self.wind = vehicle, wind
        self.position = np.array(position_m, dtype=np.float64)
        self.velocity = np.zeros(3)
        self.euler = np.array([0.0, 0.0, yaw_rad])
        self.time_s = 0.0
        self._pull = np.zeros(2)
        self._yaw_rate = 0.0
        self._gust = np.zeros(2)
        self._generator = np.random.default_rng([seed, 81])
        if vehicle.min_speed_m_s:
            self.velocity[:2] = vehicle.min_speed_m_s * np.array([math.cos(yaw_rad), math.sin(yaw_rad)])

    @property
    def pose(self) -> Pose:
        """world_from_body."""
        return Pose(rotation_from_euler(*self.euler), self.position.copy())

    def push(self, velocity_change_m_s: FloatArray) -> None:
        """Somebody pushes the vehicle: its velocity (3,) changes at once."""
        self.velocity += np.asarray(velocity_change_m_s)

    def step(self, command: VelocityCommand, dt_s: float) -> Pose:
        """Follow the command for dt_s seconds; returns world_from_body."""
        count = max(1, math.ceil(dt_s / _STEP_S))
        for _ in range(count):
            self._blow(dt_s / count)
            if self.vehicle.min_speed_m_s:
                self._step_wing(command, dt_s / count)
            else:
                self._step_hovering(command, dt_s / count)
            self.time_s += dt_s / count
        return self.pose

    def _blow(self, dt: float) -> None:
        keep = math.exp(-dt / self.wind.gust_time_s)
        drive = self._generator.normal(0.0, 1.0, 2) * self.wind.gust_m_s * math.sqrt(1.0 - keep * keep)
        self._gust = keep * self._gust + drive

    def _step_hovering(self, command: VelocityCommand, dt: float) -> None:
        vehicle = self.vehicle
        air = np.asarray(self.wind.mean_m_s) + self._gust
        asked = _limited(np.array([command.forward_m_s, command.left_m_s]), vehicle.max_speed_m_s)
        c, s = math.cos(self.euler[2]), math.sin(self.euler[2])
        asked = np.array([c * asked[0] - s * asked[1], s * asked[0] + c * asked[1]])
        drag = vehicle.drag_per_s * (self.velocity[:2] - air)
        wanted = (asked - self.velocity[:2]) / vehicle.velocity_lag_s + drag
        strongest = min(vehicle.max_acceleration_m_s2, GRAVITY * math.tan(vehicle.max_tilt_rad))
        if vehicle.tilt_per_acceleration < 1.0:
            strongest = vehicle.max_acceleration_m_s2
        share = min(1.0, dt / vehicle.attitude_lag_s)
        self._pull += share * (_limited(wanted, strongest) - self._pull)
        self.velocity[:2] += dt * (self._pull - drag)
        self._climb_and_turn(command, dt)
        lean = vehicle.tilt_per_acceleration * np.arctan(self._pull / GRAVITY)
        self.euler[1] = c * lean[0] + s * lean[1]
        self.euler[0] = s * lean[0] - c * lean[1]

    def _climb_and_turn(self, command: VelocityCommand, dt: float) -> None:
        vehicle = self.vehicle
        climb = float(np.clip(command.up_m_s, -vehicle.max_climb_m_s, vehicle.max_climb_m_s))
        self.velocity[2] += min(1.0, dt / vehicle.velocity_lag_s) * (climb - self.velocity[2])
        self.position += dt * self.velocity
        rate = float(np.clip(command.yaw_rate_rad_s, -vehicle.max_yaw_rate_rad_s, vehicle.max_yaw_rate_rad_s))
        self._yaw_rate += min(1.0, dt / max(0.15, vehicle.attitude_lag_s)) * (rate - self._yaw_rate)
        self.euler[2] += dt * self._yaw_rate

    def _step_wing(self, command: VelocityCommand, dt: float) -> None:
        vehicle = self.vehicle
        air = np.asarray(self.wind.mean_m_s) + self._gust
        through_air = self.velocity[:2] - air
        speed = float(np.clip(np.linalg.norm(through_air), vehicle.min_speed_m_s, vehicle.max_speed_m_s))
        asked = math.hypot(command.forward_m_s, command.left_m_s)
        asked = min(max(asked, vehicle.min_speed_m_s), vehicle.max_speed_m_s)
        speed += min(1.0, dt / vehicle.velocity_lag_s) * (asked - speed)
        turn = (
            math.atan2(command.left_m_s, command.forward_m_s) / vehicle.velocity_lag_s
            + command.yaw_rate_rad_s
        )
        turn = float(np.clip(turn, -vehicle.max_yaw_rate_rad_s, vehicle.max_yaw_rate_rad_s))
        bank = float(np.clip(-math.atan(speed * turn / GRAVITY), -vehicle.max_tilt_rad, vehicle.max_tilt_rad))
        self.euler[0] += min(1.0, dt / vehicle.attitude_lag_s) * (bank - self.euler[0])
        self.euler[2] -= dt * GRAVITY * math.tan(self.euler[0]) / speed
        self.velocity[:2] = speed * np.array([math.cos(self.euler[2]), math.sin(self.euler[2])]) + air
        climb = float(np.clip(command.up_m_s, -vehicle.max_climb_m_s, vehicle.max_climb_m_s))
        self.velocity[2] += min(1.0, dt / vehicle.velocity_lag_s) * (climb - self.velocity[2])
        self.euler[1] = -math.atan2(self.velocity[2], speed)
        self.position += dt * self.velocity


def _limited(vector: FloatArray, longest: float) -> FloatArray:
    length = float(np.linalg.norm(vector))
    return vector if length <= longest else vector * (longest / length)


def towards(
    plant: Plant, place_m: FloatArray, *, gain_per_s: float = 0.25, yaw_rad: float | None = None
) -> VelocityCommand:
    """The plainest controller there is: fly straight at the place, slower when near. For recorded flights and
    tests.
    """
    away = np.asarray(place_m) - plant.position
    c, s = math.cos(plant.euler[2]), math.sin(plant.euler[2])
    turn = 0.0 if yaw_rad is None else wrap_angle(yaw_rad - plant.euler[2])
    return VelocityCommand(
        gain_per_s * (c * away[0] + s * away[1]),
        gain_per_s * (c * away[1] - s * away[0]),
        gain_per_s * away[2],
        gain_per_s * turn,
    )


def hold_position(
    vehicle: Vehicle,
    place: tuple[float, float, float],
    *,
    duration_s: float,
    push_every_s: float,
    push_m: float,
    seed: int,
) -> Path:
    """A recorded flight that stays over a place, pushed about push_m away from it again and again, in any
    direction.
    """
    generator = np.random.default_rng([seed, 82])
    plant = Plant(vehicle, np.array(place), wind=Wind(gust_m_s=0.05, gust_time_s=8.0), seed=seed)
    dt = 1.0 / STATE_RATE_HZ
    times = np.arange(0.0, duration_s + dt, dt)
    states = np.empty((len(times), 6))
    next_push, free_until = 0.5 * push_every_s, 0.0
    direction = np.zeros(3)
    hand_s = 4.0
    for n, time in enumerate(times):
        states[n, :3], states[n, 3:] = plant.position, plant.euler
        if time >= next_push:
            angle = generator.uniform(0.0, 2.0 * math.pi)
            direction = np.array([math.cos(angle), math.sin(angle), 0.0])
            free_until, next_push = time + hand_s, time + push_every_s * generator.uniform(0.8, 1.2)
        if time < free_until:  # a hand leads it away: up to speed within a second, and lets go
            target = direction * push_m / hand_s
            plant.push(np.append((target[:2] - plant.velocity[:2]) * min(1.0, dt / 0.4), 0.0))
            plant.step(VelocityCommand(), dt)
        else:
            plant.step(towards(plant, np.array(place), yaw_rad=0.0), dt)
    states = smoothed(states, 0.15, STATE_RATE_HZ)
    for axis in (3, 4):
        states[:, axis] += wobble(times, vehicle.wobble_tilt_rad, vehicle.band_hz, generator)
    return Path(times, states)
