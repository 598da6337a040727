"""How exact positions are whose source states no accuracy: what they leave against the map says it as far as
it can, and what is usual says the rest.
"""

from __future__ import annotations

import math

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.types import IntArray

# Errors of GPS positions change slowly: those of so many seconds count as one.
CORRELATION_S = 20.0
USUAL_WITHIN = math.log(3.0)  # deviation of the logarithm of a receiver's accuracy from the usual one
MOST_COMPARED = 500  # of the fixes, spread evenly: more are alike
MEDIAN_LENGTH = {1: 0.6745, 2: 1.1774}  # of a residual of deviation 1 in each of so many dimensions
OUTLIER = 3.0  # deviations, more than which one fix does not say
LEAST_LEFT = 1e-6  # of the errors, below which nothing is left to tell from


def accuracy_shown(residual: FloatArray, place: FloatArray, t_ns: IntArray, usual_m: float) -> float:
    """Standard deviation along each axis, metres, of fixes that state none, where usual_m is to be expected.

    residual (n, d), metres, at times t_ns (n,) in order: horizontal (d = 2) of the similarity that takes
    place (n, 2) or (n, 3) in the map to the fixes, or of heights (d = 1) less a shift. Errors are a
    first-order process, of which the fit takes more the shorter the flight is; what is left tells its
    variance like chi-square with a degree of freedom along each axis for each time in which errors change,
    less those of the fit. How fixes differ within such a time says nothing: receivers smooth them. Posterior
    mean of the logarithm: a short flight leaves it at what is usual.
    """
    n, d = residual.shape
    t_s = 1e-9 * (t_ns - t_ns[0])
    freedom = d * (min(float(n), 1.0 + float(t_s[-1]) / CORRELATION_S) - d)
    if freedom <= 0.0:
        return usual_m
    some = np.unique(np.linspace(0, n - 1, MOST_COMPARED).round().astype(np.int64))
    left = _left_by_fit(place[some] if d == 2 else place[some, :0], t_s[some])
    share = max(float(np.trace(left).real) / len(some), LEAST_LEFT)
    length = np.linalg.norm(residual, axis=1)
    most = OUTLIER * float(np.median(length)) / MEDIAN_LENGTH[d]
    variance = float(np.mean(np.minimum(length, most) ** 2)) / (d * share)
    # Logarithms of what the deviation may be, over the usual.
    off = np.linspace(-6.0, 6.0, 601) * USUAL_WITHIN
    likely = -0.5 * (off / USUAL_WITHIN) ** 2 - freedom * off
    likely -= 0.5 * freedom * variance / usual_m**2 * np.exp(-2.0 * off)
    weight = np.exp(likely - likely.max())
    return usual_m * math.exp(float(weight @ off / weight.sum()))


def _left_by_fit(place: FloatArray, t_s: FloatArray) -> np.ndarray[tuple[int, int], np.dtype[np.complex128]]:
    """(n, n) covariance, for errors of deviation 1, of what a fit leaves: shift, and by places (n, 2 or 3)
    turn and size; complex, as x + iy; none of places (n, 0)."""
    alike = np.exp(-2.0 * np.abs(t_s[:, None] - t_s) / CORRELATION_S)
    fitted = np.ones((len(t_s), 1), np.complex128)
    if place.shape[1]:
        fitted = np.column_stack([fitted, place[:, 0] + 1j * place[:, 1]])
    basis = np.linalg.qr(fitted)[0]
    left = alike - basis @ (basis.conj().T @ alike)
    return np.asarray(left - (left @ basis) @ basis.conj().T)
