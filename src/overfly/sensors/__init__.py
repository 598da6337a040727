"""Recorded flights as sequences of frames: one reader per file, chosen by what the path holds."""

from overfly.sensors.flight import (
    Flight,
    Quantity,
    ReadOptions,
    SensorSummary,
    SourceKind,
)
from overfly.sensors.scale import ScaleSource, choose_scale_source
from overfly.sensors.sniffing import open_flight
from overfly.types import ImuRecord

__all__ = [
    "Flight",
    "ImuRecord",
    "Quantity",
    "ReadOptions",
    "ScaleSource",
    "SensorSummary",
    "SourceKind",
    "choose_scale_source",
    "open_flight",
]
