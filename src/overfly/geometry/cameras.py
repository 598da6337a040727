"""Pinhole cameras with radial-tangential or equidistant (fisheye) distortion.

Optical frame: x right, y down, z forward. Pixel (0, 0) is the centre of the top-left pixel. A ray is written
as its undistorted image coordinates (x/z, y/z).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numba import njit
from numpy.typing import NDArray

from overfly.errors import CalibrationError
from overfly.geometry.poses import FloatArray


class Distortion(StrEnum):
    """How rays are bent before they meet the image plane."""

    RADIAL_TANGENTIAL = "radial-tangential"  # Brown 1966; k1 k2 p1 p2 (k3), the order of OpenCV and EuRoC
    EQUIDISTANT = "equidistant"  # Kannala and Brandt 2006; k1 k2 k3 k4 of theta, as in OpenCV and Kalibr


@dataclass(frozen=True, slots=True)
class Camera:
    """Intrinsic calibration: size in pixels, focal lengths and centre in pixels, distortion coefficients."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion = Distortion.RADIAL_TANGENTIAL
    coefficients: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.coefficients)
        if not all(math.isfinite(number) for number in numbers):
            raise CalibrationError("camera calibration holds a number that is not finite")
        if self.width <= 0 or self.height <= 0 or self.fx <= 0 or self.fy <= 0:
            raise CalibrationError("camera calibration needs a positive image size and focal length")
        if not (-self.width < self.cx < 2 * self.width and -self.height < self.cy < 2 * self.height):
            raise CalibrationError(f"camera centre ({self.cx:g}, {self.cy:g}) is far outside the image")
        if len(self.coefficients) not in (4, 5):
            raise CalibrationError(
                f"{len(self.coefficients)} distortion coefficients; "
                "known are 4 (k1 k2 p1 p2, or fisheye) and 5 (k3)"
            )

    @property
    def focal_px(self) -> float:
        """Mean focal length in pixels: what turns image angles into pixels in thresholds."""
        return math.sqrt(self.fx * self.fy)

    def project(self, points_in_cam: FloatArray) -> FloatArray:
        """points_in_cam: (n, 3) metres, optical frame -> (n, 2) pixels; NaN for points not in front of the
        camera.
        """
        points = np.ascontiguousarray(points_in_cam, dtype=np.float64).reshape(-1, 3)
        with np.errstate(divide="ignore", invalid="ignore"):
            rays = points[:, :2] / points[:, 2:]
        rays[points[:, 2] <= 0] = np.nan
        return self.pixels_from_rays(rays)

    def pixels_from_rays(self, rays: FloatArray) -> FloatArray:
        """rays: (n, 2) undistorted image coordinates -> (n, 2) pixels."""
        rays = np.ascontiguousarray(rays, dtype=np.float64).reshape(-1, 2)
        return np.asarray(_distort(rays, *self._kernel_arguments()))

    def rays_from_pixels(self, px: FloatArray | NDArray[np.float32]) -> FloatArray:
        """px: (n, 2) pixels -> (n, 2) undistorted image coordinates (x/z, y/z); NaN where the model cannot be
        inverted.
        """
        places = np.ascontiguousarray(px, dtype=np.float64).reshape(-1, 2)
        return np.asarray(_undistort(places, *self._kernel_arguments()))

    def scaled(self, width: int, height: int) -> Camera:
        """The same camera with its image resized to width x height pixels (area resampling keeps pixel areas,
        hence the 0.5).
        """
        sx, sy = width / self.width, height / self.height
        return Camera(
            width,
            height,
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
            self.distortion,
            self.coefficients,
        )

    def matrix(self) -> FloatArray:
        """(3, 3) intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def _kernel_arguments(self) -> tuple[FloatArray, FloatArray, bool]:
        coefficients = np.zeros(5)
        coefficients[: len(self.coefficients)] = self.coefficients
        return (
            np.array([self.fx, self.fy, self.cx, self.cy]),
            coefficients,
            self.distortion is Distortion.EQUIDISTANT,
        )


@njit(cache=True, nogil=True)
def _bend(x, y, k, equidistant):  # type: ignore[no-untyped-def]
    """Distorted coordinates of one ray and their Jacobian: (u, v, du/dx, du/dy, dv/dx, dv/dy)."""
    r2 = x * x + y * y
    if equidistant:
        r = math.sqrt(r2)
        if r < 1e-9:
            return x, y, 1.0, 0.0, 0.0, 1.0
        theta = math.atan(r)
        t2 = theta * theta
        theta_d = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
        slope = 1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])))
        scale = theta_d / r
        # d(scale)/dr divided by r, so that it multiplies x*x, x*y, y*y
        bend = (slope / (1.0 + r2) - scale) / r2
        return (
            x * scale,
            y * scale,
            scale + bend * x * x,
            bend * x * y,
            bend * x * y,
            scale + bend * y * y,
        )
    radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    slope2 = 2.0 * (k[0] + r2 * (2.0 * k[1] + r2 * 3.0 * k[4]))  # d(radial)/d(r2) * 2
    p1, p2 = k[2], k[3]
    u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    ux = radial + slope2 * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    uy = slope2 * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    vy = radial + slope2 * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    return u, v, ux, uy, uy, vy


@njit(cache=True, nogil=True)
def _distort(rays, intrinsics, k, equidistant):  # type: ignore[no-untyped-def]
    px = np.empty_like(rays)
    for n in range(rays.shape[0]):
        u, v, _, _, _, _ = _bend(rays[n, 0], rays[n, 1], k, equidistant)
        px[n, 0] = intrinsics[0] * u + intrinsics[2]
        px[n, 1] = intrinsics[1] * v + intrinsics[3]
    return px


@njit(cache=True, nogil=True)
def _undistort(px, intrinsics, k, equidistant):  # type: ignore[no-untyped-def]
    """Newton's method on the distortion, started at the distorted place (equidistant: the ideal fisheye)."""
    rays = np.empty_like(px)
    for n in range(px.shape[0]):
        u = (px[n, 0] - intrinsics[2]) / intrinsics[0]
        v = (px[n, 1] - intrinsics[3]) / intrinsics[1]
        x, y = u, v
        if equidistant:
            r = math.sqrt(u * u + v * v)
            if 1e-9 < r < 1.5:
                x, y = u * math.tan(r) / r, v * math.tan(r) / r
        error = 1.0
        for _ in range(30):
            uu, vv, ux, uy, vx, vy = _bend(x, y, k, equidistant)
            du, dv = uu - u, vv - v
            error = abs(du) + abs(dv)
            if error < 1e-13:
                break
            determinant = ux * vy - uy * vx
            if determinant <= 1e-9:  # past the fold of the model: half a step back towards the centre
                x, y = 0.5 * x, 0.5 * y
                continue
            x -= (vy * du - uy * dv) / determinant
            y -= (ux * dv - vx * du) / determinant
        rays[n, 0] = x if error < 1e-9 else math.nan
        rays[n, 1] = y if error < 1e-9 else math.nan
    return rays
