"""Robust kernels: how much a constraint counts, given its chi2 (iteratively reweighted least squares).

weight = d rho(s) / d s with s = e^T Omega e; the cost of a constraint is rho(s). Sources: Huber 1964; Cauchy
as in Lee et al., "Robust pose-graph loop-closures with expectation-maximization", IROS 2013; dynamic
covariance scaling, Agarwal et al., ICRA 2013; truncated least squares by graduated non-convexity, Yang et
al., RA-L 2020.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from overfly.geometry.poses import FloatArray


class Kernel(StrEnum):
    NONE = "none"
    HUBER = "huber"
    CAUCHY = "cauchy"
    DCS = "dcs"


# In standard deviations: 95 % efficiency on one Gaussian residual, as usual; for DCS its own phi.
DEFAULT_SCALE = {Kernel.NONE: 1.0, Kernel.HUBER: 1.345, Kernel.CAUCHY: 2.385, Kernel.DCS: 5.0}


@dataclass(frozen=True)
class Robust:
    """A kernel and its scale: residuals up to about ``scale`` standard deviations count fully (DCS: phi)."""

    kernel: Kernel = Kernel.NONE
    scale: float | None = None

    @property
    def width(self) -> float:
        return DEFAULT_SCALE[self.kernel] if self.scale is None else self.scale

    def weights(self, chi2: FloatArray) -> FloatArray:
        """(k,) weights in (0, 1] of constraints with these chi2 (k,)."""
        width = self.width
        match self.kernel:
            case Kernel.HUBER:
                return width / np.maximum(np.sqrt(chi2), width)
            case Kernel.CAUCHY:
                return 1.0 / (1.0 + chi2 / width**2)
            case Kernel.DCS:
                return np.minimum(1.0, 2.0 * width / (width + chi2)) ** 2
            case Kernel.NONE:
                return np.ones_like(chi2)

    def costs(self, chi2: FloatArray) -> FloatArray:
        """(k,) rho(chi2)."""
        width = self.width
        match self.kernel:
            case Kernel.HUBER:
                root = np.sqrt(chi2)
                return np.where(root <= width, chi2, 2.0 * width * root - width**2)
            case Kernel.CAUCHY:
                return width**2 * np.log1p(chi2 / width**2)
            case Kernel.DCS:
                # s^2 chi2 + (1 - s)^2 phi with the switch s = 2 phi / (phi + chi2) eliminated
                return np.where(chi2 <= width, chi2, width * (3.0 * chi2 - width) / (chi2 + width))
            case Kernel.NONE:
                return chi2.copy()


PLAIN = Robust()
CAUCHY = Robust(Kernel.CAUCHY)
