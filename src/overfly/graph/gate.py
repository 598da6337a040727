"""Which loops to believe: the innovation against the covariance of the estimate, and how far that covariance
can be trusted.

A measurement belongs to the estimate when its squared Mahalanobis distance lies inside the 3 sigma region.
Where a graph states its noise far too large, everything lies inside; then the distances themselves tell:
their lower quartile, which up to three quarters of wrong loops cannot raise, gives the scale of the noise
(the variance factor of geodesy).
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri
from scipy.special import ndtr as normal_distribution

from overfly.geometry.poses import FloatArray

SAFETY = 4.0  # the scale is taken this much larger than the quartile says: twice the standard deviation
WINDOW = 400  # distances remembered


def chi2_quantile(probability: float, degrees: int) -> float:
    return float(chdtri(degrees, 1.0 - probability))


def gate_bound(sigma: float, degrees: int) -> float:
    """Bound of the squared distance in so many dimensions that a normal variable keeps as often as +-sigma in
    one.
    """
    return chi2_quantile(float(2.0 * normal_distribution(sigma) - 1.0), degrees)


class Gate:
    """Judges squared distances; with ``calibrate`` > 0, from so many on by the scale they show, and none
    before.
    """

    def __init__(self, sigma: float, degrees: int, calibrate: int) -> None:
        self.sigma, self.degrees = sigma, degrees
        self._outside = float(2.0 - 2.0 * normal_distribution(sigma))  # part of true ones beyond the bound
        self.stated = gate_bound(sigma, degrees)
        self._quartile = chi2_quantile(0.25, degrees)
        self._calibrate = calibrate
        self._distances: list[float] = []
        self._shown = self.stated  # what the settled estimate showed to hold the true ones

    @property
    def ready(self) -> bool:
        """Whether enough distances have been seen to judge."""
        return len(self._distances) >= self._calibrate

    def remember(self, distance: float) -> None:
        """Take the distance of a new measurement into the scale."""
        self._distances = [*self._distances[-WINDOW + 1 :], distance]

    def narrow(self, bound: float) -> None:
        """All true distances lie within this bound, as a settled estimate shows."""
        self._shown = min(self.stated, bound)

    @property
    def is_narrowed(self) -> bool:
        """Whether a settled estimate has shown the noise to be stated far too large."""
        return self.overstates(self._shown)

    def overstates(self, bound: float) -> bool:
        """Whether true distances lie so far inside the stated bound that the noise is stated too large."""
        return SAFETY * bound < self.stated

    @property
    def is_overstated(self) -> bool:
        """Whether most measurements agree far better than their stated noise lets expect."""
        few = len(self._distances) == 0
        return not few and SAFETY * float(np.quantile(self._distances, 0.25)) < self._quartile

    @property
    def bound(self) -> float:
        """Largest squared distance that is believed."""
        return self._shown if self._calibrate == 0 else self.bound_for(np.array(self._distances))

    def bound_for(self, distances: FloatArray) -> float:
        """The bound at the scale these distances show, at most the stated one."""
        return self.stated * min(1.0, SAFETY * float(np.quantile(distances, 0.25)) / self._quartile)

    def bound_for_all(self, distances: FloatArray) -> float:
        """A bound inside which all true distances lie together, at 3 sigma; at most the stated one.

        Distances are taken as a multiple of a power of chi2, for noise is rarely as even as it is stated. The
        smallest quarter, which is true, tells which; then the outer ones of those inside the bound it gives.
        """
        first = SAFETY * self._outermost(distances, 0.1, 0.25)
        return self._outermost(distances[distances <= first], 0.9, 0.99)

    def _outermost(self, distances: FloatArray, low: float, high: float) -> float:
        """The bound as these two quantiles foretell it."""
        lower, upper = np.quantile(distances, (low, high))
        if not lower > 0.0:
            return self.stated
        expected = chi2_quantile(low, self.degrees), chi2_quantile(high, self.degrees)
        power = max(np.log(upper / lower) / np.log(expected[1] / expected[0]), 1.0)
        outermost = chi2_quantile(1.0 - self._outside / len(distances), self.degrees)
        return float(min(self.stated, upper * (outermost / expected[1]) ** power))

    def keeps(self, distance: float) -> bool:
        return self.ready and distance <= self.bound
