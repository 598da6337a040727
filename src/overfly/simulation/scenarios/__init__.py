"""The scenarios. Importing this package declares them all."""

from overfly.simulation.scenarios import demo, paper, stress, surveys

__all__ = ["demo", "paper", "stress", "surveys"]
