"""Band-limited noise and hashed random numbers: the raw material of procedural ground.

Everything is a function of world position and seed alone, so that a piece of ground looks the same whenever,
and at whatever scale, it is made. Octaves too fine for the texel size are left out instead of aliased.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray
from overfly.types import Float32Array, IntArray

_MIX = (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)  # splitmix64 (Steele, Lea, Flood 2014)


def hashed_uniform(i: IntArray, j: IntArray, channel: int, seed: int) -> FloatArray:
    """Uniform numbers in [0, 1) that depend on the integers (i, j, channel, seed) only; shape of i and j."""
    with np.errstate(over="ignore"):
        state = np.asarray(i, dtype=np.int64).astype(np.uint64) * np.uint64(_MIX[0])
        state ^= np.asarray(j, dtype=np.int64).astype(np.uint64) * np.uint64(_MIX[1])
        state += np.uint64((channel * _MIX[2] + seed * _MIX[0]) & 0xFFFFFFFFFFFFFFFF)
        for factor in _MIX[1:]:
            state = (state ^ (state >> np.uint64(30))) * np.uint64(factor)
        state ^= state >> np.uint64(31)
    return (state >> np.uint64(11)).astype(np.float64) * 2.0**-53


def fractal_noise(
    x0: float,
    y0: float,
    texel_m: float,
    shape: tuple[int, int],
    seed: int,
    wavelength_m: float,
    *,
    finest_m: float = 0.0,
    gain: float = 0.6,
    stretch: float = 1.0,
    angle_rad: float = 0.0,
    ridged: bool = False,
) -> Float32Array:
    """Sum of gradient-noise octaves on the texel centres x0 + (col + 0.5) texel, y0 + (row + 0.5) texel.

    wavelength_m: of the coarsest octave; each next one has half the wavelength and ``gain`` of the amplitude,
    down to finest_m or to what the texel can carry. stretch: how much longer features are along angle_rad
    than across. ridged: creases at the zero crossings instead of smooth hills. Returns float32 of ``shape``;
    standard deviation near 1 when all octaves are there (a scale that cannot be seen takes its share of the
    contrast with it). Perlin, "Improving noise", 2002.
    """
    wavelengths, weights = octaves(wavelength_m, max(finest_m, 1e-6), texel_m, gain)
    out = np.zeros(shape, dtype=np.float32)
    _add_octaves(out, x0, y0, texel_m, seed, wavelengths, weights, float(stretch), float(angle_rad), ridged)
    return out


def octaves(
    wavelength_m: float, finest_m: float, texel_m: float, gain: float
) -> tuple[FloatArray, FloatArray]:
    """Wavelengths and weights of the octaves that a texel size can carry; weights of unit sum of squares over
    all.
    """
    finest = max(finest_m, wavelength_m / 1024.0)
    count = max(1, 1 + math.floor(math.log2(max(1.0, wavelength_m / finest))))
    wavelengths = wavelength_m * 0.5 ** np.arange(count)
    weights = gain ** np.arange(count)
    weights /= np.linalg.norm(weights) * 0.25  # one octave of gradient noise has a deviation near 0.25
    weights *= np.clip(wavelengths / texel_m / 2.0 - 1.0, 0.0, 1.0)  # Nyquist, faded in over one octave
    seen = weights > 0
    return np.asarray(wavelengths[seen], dtype=np.float64), np.asarray(weights[seen], dtype=np.float64)


@njit(cache=True, nogil=True)
def _lattice_hash(i, j, seed):  # type: ignore[no-untyped-def]
    state = np.uint64(i) * np.uint64(0x9E3779B97F4A7C15)
    state ^= np.uint64(j) * np.uint64(0xBF58476D1CE4E5B9)
    state += np.uint64(seed) * np.uint64(0x94D049BB133111EB)
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


@njit(cache=True, nogil=True)
def _lattice_gradients(i0, j0, rows, cols, seed):  # type: ignore[no-untyped-def]
    """Unit gradients of lattice nodes (j0 .. j0+rows, i0 .. i0+cols): (rows, cols, 2) float32."""
    gradients = np.empty((rows, cols, 2), dtype=np.float32)
    for r in range(rows):
        for c in range(cols):
            angle = float(_lattice_hash(i0 + c, j0 + r, seed) >> np.uint64(40)) * (2.0 * math.pi / 2.0**24)
            gradients[r, c, 0] = math.cos(angle)
            gradients[r, c, 1] = math.sin(angle)
    return gradients


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _add_octaves(out, x0, y0, texel, seed, wavelengths, weights, stretch, angle, ridged):  # type: ignore[no-untyped-def]
    height, width = out.shape
    for octave in range(len(wavelengths)):
        # Octaves of isotropic noise are turned against each other, which hides the lattice.
        turn = angle if stretch != 1.0 else angle + 0.6 * octave
        cu, su = (
            math.cos(turn) / (wavelengths[octave] * stretch),
            math.sin(turn) / (wavelengths[octave] * stretch),
        )
        cv, sv = math.cos(turn) / wavelengths[octave], math.sin(turn) / wavelengths[octave]
        xs, ys = x0 + 0.5 * texel, y0 + 0.5 * texel
        u_corner, v_corner = xs * cu + ys * su, -xs * sv + ys * cv
        du_col, dv_col, du_row, dv_row = texel * cu, -texel * sv, texel * su, texel * cv
        du, dv = (width - 1) * du_col, (width - 1) * dv_col
        eu, ev = (height - 1) * du_row, (height - 1) * dv_row
        i0 = math.floor(u_corner + min(0.0, du) + min(0.0, eu))
        j0 = math.floor(v_corner + min(0.0, dv) + min(0.0, ev))
        cols = math.floor(u_corner + max(0.0, du) + max(0.0, eu)) - i0 + 3
        rows = math.floor(v_corner + max(0.0, dv) + max(0.0, ev)) - j0 + 3
        gradients = _lattice_gradients(i0, j0, rows, cols, seed + 7919 * octave)
        weight = np.float32(weights[octave])
        u_corner -= i0
        v_corner -= j0
        for row in range(height):
            for col in range(width):
                u = np.float32(u_corner + col * du_col + row * du_row)
                v = np.float32(v_corner + col * dv_col + row * dv_row)
                i, j = int(u), int(v)
                value = _gradient_noise(gradients, i, j, u - np.float32(i), v - np.float32(j))
                if ridged:
                    value = np.float32(0.25) - abs(value)
                out[row, col] += weight * value


@njit(cache=True, nogil=True, inline="always")
def _gradient_noise(gradients, i, j, fu, fv):  # type: ignore[no-untyped-def]
    one = np.float32(1.0)
    a = gradients[j, i, 0] * fu + gradients[j, i, 1] * fv
    b = gradients[j, i + 1, 0] * (fu - one) + gradients[j, i + 1, 1] * fv
    c = gradients[j + 1, i, 0] * fu + gradients[j + 1, i, 1] * (fv - one)
    d = gradients[j + 1, i + 1, 0] * (fu - one) + gradients[j + 1, i + 1, 1] * (fv - one)
    wu = fu * fu * fu * (fu * (fu * np.float32(6.0) - np.float32(15.0)) + np.float32(10.0))
    wv = fv * fv * fv * (fv * (fv * np.float32(6.0) - np.float32(15.0)) + np.float32(10.0))
    top = a + wu * (b - a)
    return top + wv * (c + wu * (d - c) - top)
