"""The simulator: flights over textured ground with exact truth, for tests, for the demonstration and for
planning.
"""

from overfly.simulation.flight import SimulatedFlight, simulate, with_camera
from overfly.simulation.scenario import Scenario, scenario
from overfly.simulation.writer import write_flight

__all__ = ["Scenario", "SimulatedFlight", "scenario", "simulate", "with_camera", "write_flight"]
