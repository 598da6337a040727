"""The simulator: flights over textured ground with exact truth, for tests, for the demonstration and for planning."""

from overfly.simulation.flight import SimulatedFlight, simulate
from overfly.simulation.scenario import Scenario, scenario

__all__ = ["Scenario", "SimulatedFlight", "scenario", "simulate"]
