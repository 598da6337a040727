"""The scenarios. Importing this package declares them all."""

from overfly.simulation.scenarios import demo

__all__ = ["demo"]
