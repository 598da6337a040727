"""Where the map's world lies for an autopilot: its local frame, and latitude and
longitude if they are known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from overfly.geometry.aerospace import FRD_FROM_FLU, NED_FROM_ENU
from overfly.geometry.geodesy import GeoOrigin, geodetic_from_enu
from overfly.geometry.poses import FloatArray, rotation_z


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """origin: latitude, longitude and height of the world's origin, None for a map without GPS.

    enu_from_world_rad: how the world's x axis is turned against east, anticlockwise. scale: metres of the
    Earth per metre of the world, one within rounding for a map with a metre of its own.
    """

    origin: GeoOrigin | None = None
    enu_from_world_rad: float = 0.0
    scale: float = 1.0

    @property
    def is_north_aligned(self) -> bool:
        """Whether north is known, so that the local frame is NED and not just FRD."""
        return self.origin is not None

    def local_from_world(self) -> FloatArray:
        """(3, 3): rotation to north-east-down, or to forward-right-down along the world's own x axis."""
        if self.origin is None:
            return FRD_FROM_FLU
        return np.asarray(NED_FROM_ENU @ rotation_z(self.enu_from_world_rad))

    def local(self, place_m: FloatArray) -> FloatArray:
        """(3,) metres of the world -> (3,) metres of the local frame."""
        return np.asarray(self.scale * self.local_from_world() @ place_m)

    def geodetic(self, place_m: FloatArray) -> FloatArray | None:
        """(3,) metres of the world -> latitude, longitude (degrees), height (m); None without an origin."""
        if self.origin is None:
            return None
        enu = self.scale * rotation_z(self.enu_from_world_rad) @ place_m
        return np.asarray(geodetic_from_enu(enu[None, :], self.origin)[0])
