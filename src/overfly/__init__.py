"""Overfly: visual SLAM, mapping and navigation for vehicles that fly and look down."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from overfly.config import Config as Config
    from overfly.localizer import Localizer as Localizer
    from overfly.mapstore import Map as Map
    from overfly.mapstore.live import Slam as Slam
    from overfly.sensors import open_flight as open_flight

__version__ = "0.1.0"

# What scripts use, and the module of each: imported when first asked for, for they are slow to import.
PUBLIC = {
    "Config": "overfly.config",
    "Localizer": "overfly.localizer",
    "Map": "overfly.mapstore",
    "Slam": "overfly.mapstore.live",
    "open_flight": "overfly.sensors",
}


def __getattr__(name: str) -> Any:
    if name not in PUBLIC:
        raise AttributeError(f"module 'overfly' has no attribute {name!r}")
    return getattr(importlib.import_module(PUBLIC[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *PUBLIC])
