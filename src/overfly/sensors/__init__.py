"""Recorded flights as sequences of frames: one reader per file, chosen by what the path holds."""

from overfly.sensors.flight import (
    Flight,
    ImuRecord,
    Quantity,
    ReadOptions,
    SensorSummary,
    SourceKind,
)
from overfly.sensors.sniffing import open_flight

__all__ = ["Flight", "ImuRecord", "Quantity", "ReadOptions", "SensorSummary", "SourceKind", "open_flight"]
