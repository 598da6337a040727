"""A plant and a pilot's parts in a loop without pictures: fixes are the truth with noise."""

from __future__ import annotations

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.navigation.estimator import Estimator, PlaceFix, VehicleState
from overfly.navigation.vehicle import Airframe
from overfly.simulation.plants import Plant
from overfly.simulation.vehicles import BLIMP, HELICOPTER, MULTIROTOR, Vehicle

PERIOD_NS = 100_000_000
VEHICLES = (BLIMP, HELICOPTER, MULTIROTOR)


def airframe(vehicle: Vehicle) -> Airframe:
    return Airframe(
        vehicle.name,
        vehicle.max_speed_m_s,
        min(vehicle.max_acceleration_m_s2, 1.5),
        vehicle.max_climb_m_s,
        vehicle.max_yaw_rate_rad_s,
        vehicle.velocity_lag_s,
        vehicle.attitude_lag_s,
    )


def true_state(plant: Plant) -> VehicleState:
    """What a perfect estimator would say."""
    return VehicleState(
        round(plant.time_s * 1e9),
        plant.position.copy(),
        plant.velocity.copy(),
        float(plant.euler[2]),
        0.0,
        np.eye(8) * 1e-6,
    )


def fix_of(plant: Plant, sigma_m: float, generator: np.random.Generator) -> PlaceFix:
    noise: FloatArray = generator.normal(0.0, sigma_m, 3)
    yaw = float(plant.euler[2] + generator.normal(0.0, 0.005))
    return PlaceFix(
        round(plant.time_s * 1e9), plant.position + noise, yaw, np.diag([sigma_m**2] * 3 + [0.005**2])
    )


def error_of(estimator: Estimator, plant: Plant, t_ns: int) -> FloatArray:
    """(6,) estimate less truth: position, velocity."""
    state = estimator.at(t_ns)
    assert state is not None
    return np.concatenate([state.position - plant.position, state.velocity - plant.velocity])
