"""The simulator: flights over textured ground with exact truth, for tests, for the demonstration and for
planning.
"""

from overfly.simulation.flight import SimulatedFlight, simulate, with_camera
from overfly.simulation.live import LiveFlight
from overfly.simulation.plants import Plant, Wind
from overfly.simulation.scenario import Scenario, scenario
from overfly.simulation.writer import write_flight
from overfly.types import VelocityCommand

__all__ = [
    "LiveFlight",
    "Plant",
    "Scenario",
    "SimulatedFlight",
    "VelocityCommand",
    "Wind",
    "scenario",
    "simulate",
    "with_camera",
    "write_flight",
]
