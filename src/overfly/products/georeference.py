"""Where products lie on Earth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from affine import Affine

from overfly.geometry.poses import FloatArray

# Metres from the origin of the map, which lies nowhere in particular: programs that measure, measure right.
LOCAL_CRS = (
    'LOCAL_CS["Overfly map",LOCAL_DATUM["Origin of the map",32767],UNIT["metre",1],'
    'AXIS["East",EAST],AXIS["North",NORTH]]'
)


@dataclass(frozen=True, slots=True)
class GeoReference:
    """Similarity from the world to a map projection: crs_xy = scale * Rz(rotation) world_xy + translation.

    crs: "EPSG:32635" or WKT of a projection in metres; rotation_rad counter-clockwise; translation_m
    (east, north, up), metres of the CRS; heights are scaled and shifted alike.
    """

    crs: str
    scale: float
    rotation_rad: float
    translation_m: tuple[float, float, float]

    @staticmethod
    def local() -> GeoReference:
        """World coordinates as they are, in an engineering CRS."""
        return GeoReference(LOCAL_CRS, 1.0, 0.0, (0.0, 0.0, 0.0))

    def crs_from_world(self) -> Affine:
        """Of the plane: (x, y) metres of the world -> (east, north) metres of the CRS."""
        c = self.scale * math.cos(self.rotation_rad)
        s = self.scale * math.sin(self.rotation_rad)
        return Affine(c, -s, self.translation_m[0], s, c, self.translation_m[1])

    def height_in_crs(self, z_m: FloatArray) -> FloatArray:
        return self.scale * z_m + self.translation_m[2]


def transform_points(transform: Affine, points: FloatArray) -> FloatArray:
    """points: (..., 2) -> (..., 2) under a transform of the plane."""
    matrix = np.array([[transform.a, transform.b], [transform.d, transform.e]])
    return np.asarray(points @ matrix.T + np.array([transform.c, transform.f]))
