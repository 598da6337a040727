"""The map file: one SQLite database, the only place that knows SQL. Its format is described in docs/map-
file.md."""

from overfly.mapstore.content import FlightEntry, FrameEntry
from overfly.mapstore.frame_log import FrameLog
from overfly.mapstore.map import Map
from overfly.mapstore.writer import MapWriter

__all__ = ["FlightEntry", "FrameEntry", "FrameLog", "Map", "MapWriter"]
