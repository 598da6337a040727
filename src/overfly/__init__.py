"""Overfly: visual SLAM, mapping and navigation for vehicles that fly and look down."""

__version__ = "0.1.0"
