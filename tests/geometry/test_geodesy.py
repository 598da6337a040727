"""Geodesy against the ellipsoid's own numbers, and there and back."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from overfly.geometry.geodesy import GeoOrigin, enu_from_geodetic, geodetic_from_enu, utm_crs, utm_epsg

# WGS 84 (NIMA TR8350.2): semi-major axis and flattening
A, F = 6378137.0, 1.0 / 298.257223563
E2 = F * (2.0 - F)

origins = st.builds(GeoOrigin, st.floats(-89.0, 89.0), st.floats(-180.0, 180.0), st.floats(-400.0, 8000.0))


@given(origins, st.lists(st.tuples(*[st.floats(-5000.0, 5000.0)] * 3), min_size=1, max_size=5))
def test_there_and_back(origin: GeoOrigin, points: list[tuple[float, float, float]]) -> None:
    enu = np.array(points)
    np.testing.assert_allclose(enu_from_geodetic(geodetic_from_enu(enu, origin), origin), enu, atol=1e-5)


@given(origins)
def test_the_origin_is_zero_and_up_is_up(origin: GeoOrigin) -> None:
    here = [origin.latitude_deg, origin.longitude_deg, origin.altitude_m]
    above = [origin.latitude_deg, origin.longitude_deg, origin.altitude_m + 100.0]
    np.testing.assert_allclose(
        enu_from_geodetic(np.array([here, above]), origin), [[0, 0, 0], [0, 0, 100]], atol=1e-6
    )


@given(st.floats(-85.0, 85.0), st.floats(-180.0, 180.0))
def test_small_steps_follow_the_radii_of_curvature(latitude: float, longitude: float) -> None:
    origin = GeoOrigin(latitude, longitude, 0.0)
    step_deg = 1e-5
    north = enu_from_geodetic(np.array([[latitude + step_deg, longitude, 0.0]]), origin)[0]
    east = enu_from_geodetic(np.array([[latitude, longitude + step_deg, 0.0]]), origin)[0]
    sine = math.sin(math.radians(latitude))
    prime = A / math.sqrt(1.0 - E2 * sine**2)
    meridian = prime * (1.0 - E2) / (1.0 - E2 * sine**2)
    step = math.radians(step_deg)
    np.testing.assert_allclose(north, [0.0, meridian * step, 0.0], atol=2e-6)
    np.testing.assert_allclose(east, [prime * math.cos(math.radians(latitude)) * step, 0.0, 0.0], atol=2e-6)


@pytest.mark.parametrize(
    ("latitude", "longitude", "code"),
    [
        (46.84, -91.99, 32615),  # Duluth
        (60.4, 22.46, 32634),  # Turku
        (-35.36, 149.16, 32755),  # Canberra
        (0.0, 179.999, 32660),
        (0.0, 180.0, 32601),
        (-0.1, -180.0, 32701),
        (60.4, 5.3, 32632),  # Bergen, in the widened zone
        (78.2, 15.6, 32633),  # Longyearbyen
        (78.2, 8.9, 32631),
        (78.2, 33.0, 32637),
        (85.0, 0.0, 32661),
        (-85.0, 0.0, 32761),
    ],
)
def test_utm_zones(latitude: float, longitude: float, code: int) -> None:
    assert utm_epsg(latitude, longitude) == code


@given(st.floats(-79.9, 83.9), st.floats(-180.0, 179.99))
def test_the_zone_covers_the_place(latitude: float, longitude: float) -> None:
    area = utm_crs(latitude, longitude).area_of_use
    assert area is not None
    slack = 3.0 if latitude >= 56.0 else 1e-9  # the widened zones reach into their neighbours
    assert area.west - slack <= longitude <= area.east + slack
    assert (area.south >= 0) == (latitude >= 0)
