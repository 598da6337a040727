"""WGS 84 positions, local east-north-up coordinates about an origin, and the UTM zone of a place.

Angles are in degrees here, as GPS receivers give them; heights are above the ellipsoid unless the source
means something else, which then cancels in local coordinates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from pyproj import CRS, Transformer

from overfly.geometry.poses import FloatArray

_GEODETIC = 4979  # EPSG: WGS 84, latitude, longitude, ellipsoidal height
_GEOCENTRIC = 4978  # EPSG: WGS 84, earth-centred x y z in metres


@dataclass(frozen=True, slots=True)
class GeoOrigin:
    """Where a local east-north-up frame stands."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float = 0.0


def enu_from_geodetic(geodetic: FloatArray, origin: GeoOrigin) -> FloatArray:
    """geodetic (n, 3): latitude, longitude (deg), height (m) -> (n, 3) metres east, north, up of it."""
    offset = _geocentric(geodetic) - _geocentric(_row(origin))
    return np.asarray(offset @ _ecef_from_enu(origin))


def geodetic_from_enu(points_m: FloatArray, origin: GeoOrigin) -> FloatArray:
    """points_m (n, 3) east, north, up of the origin -> (n, 3) latitude, longitude (degrees), height (m)."""
    points = np.asarray(points_m, dtype=np.float64).reshape(-1, 3)
    ecef = points @ _ecef_from_enu(origin).T + _geocentric(_row(origin))
    longitude, latitude, height = _transformer().transform(
        ecef[:, 0], ecef[:, 1], ecef[:, 2], direction="INVERSE"
    )
    return np.column_stack([latitude, longitude, height])


def utm_epsg(latitude_deg: float, longitude_deg: float) -> int:
    """EPSG code of a place's UTM zone (WGS 84), those of Norway and Svalbard included; UPS at the poles."""
    if latitude_deg >= 84.0:
        return 32661
    if latitude_deg < -80.0:
        return 32761
    longitude = (longitude_deg + 180.0) % 360.0 - 180.0
    zone = min(int((longitude + 180.0) // 6.0), 59) + 1
    if 56.0 <= latitude_deg < 64.0 and 3.0 <= longitude < 12.0:
        zone = 32
    elif latitude_deg >= 72.0 and 0.0 <= longitude < 42.0:
        zone = 31 + 2 * int((longitude + 3.0) // 12.0)
    return (32600 if latitude_deg >= 0.0 else 32700) + zone


def utm_crs(latitude_deg: float, longitude_deg: float) -> CRS:
    """Coordinate reference system of :func:`utm_epsg`."""
    return CRS.from_epsg(utm_epsg(latitude_deg, longitude_deg))


@lru_cache(maxsize=1)
def _transformer() -> Transformer:
    return Transformer.from_crs(_GEODETIC, _GEOCENTRIC, always_xy=True)


def _row(origin: GeoOrigin) -> FloatArray:
    return np.array([[origin.latitude_deg, origin.longitude_deg, origin.altitude_m]])


def _geocentric(geodetic: FloatArray) -> FloatArray:
    """(n, 3) latitude, longitude, height -> (n, 3) earth-centred metres."""
    rows = np.asarray(geodetic, dtype=np.float64).reshape(-1, 3)
    return np.column_stack(_transformer().transform(rows[:, 1], rows[:, 0], rows[:, 2]))


def _ecef_from_enu(origin: GeoOrigin) -> FloatArray:
    """(3, 3): columns are east, north and up at the origin, in earth-centred axes."""
    latitude, longitude = math.radians(origin.latitude_deg), math.radians(origin.longitude_deg)
    sin_lat, cos_lat = math.sin(latitude), math.cos(latitude)
    sin_lon, cos_lon = math.sin(longitude), math.cos(longitude)
    return np.array(
        [
            [-sin_lon, -sin_lat * cos_lon, cos_lat * cos_lon],
            [cos_lon, -sin_lat * sin_lon, cos_lat * sin_lon],
            [0.0, cos_lat, sin_lat],
        ]
    )
