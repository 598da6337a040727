"""Flights over one piece of ground, rendered once, written as recorded flights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from overfly.geometry.poses import Pose
from overfly.simulation import simulate, write_flight
from overfly.simulation.paths import Route
from overfly.simulation.scenario import declared
from overfly.simulation.vehicles import MULTIROTOR, fly_route

FRAMES = 40


def write_first(folder: Path) -> tuple[Pose, ...]:
    """A flight of 40 frames over the demo's garden; its truth, world_from_cam."""
    flight = simulate(declared("demo").build(0), 0, FRAMES)
    write_flight(flight, folder)
    return flight.truth


def write_second(folder: Path, height_m: float, frames: int) -> tuple[Pose, ...]:
    """The same ground on another day: the other way round, crooked, at another height, other noise."""
    corners = np.array([[0.6, -3.0], [-1.5, -3.6], [-3.6, -3.0], [-4.2, -1.0]])
    route = Route(np.column_stack([corners, np.full(len(corners), height_m)]), 1.5, ramp_s=0.5)
    again = replace(declared("demo").build(0), path=fly_route(route, MULTIROTOR, 9))
    flight = simulate(again, 9, frames)
    write_flight(flight, folder)
    return flight.truth
