"""Turns between poses as a gyroscope measured them, beside the points: with faults that all have in common.

On-manifold preintegration (Forster et al. 2017, "On-manifold preintegration for real-time visual-inertial
odometry"), rotations only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.geometry.rotations import vectors_from_rotations
from overfly.types import IntArray

OUTLIER = 4.0  # standard deviations from which on one counts linearly
N_FAULTS = 12  # of a gyroscope: its bias (3,), and what its rates are to be multiplied with (3, 3), less one
FAULT_SIGMAS = np.array([0.05] * 3 + [0.02] * 9)  # rad/s; scale and misalignment of a small one's axes


@dataclass(frozen=True, slots=True, eq=False)
class Turns:
    """Measured rotations i_from_j, c of them: i (c,) and j (c,) of the poses, rotations (c, 3, 3); by_faults
    (c, 3, 12): faults f of the gyroscope turned them on the right by by_faults f; seconds (c,) they took;
    density: of the gyroscope's noise, rad/s/sqrt(Hz), infinite as long as it is not known.
    """

    i: IntArray
    j: IntArray
    rotations: FloatArray
    by_faults: FloatArray
    seconds: FloatArray
    density: float

    @property
    def sigma(self) -> FloatArray:
        """(c,) standard deviations, radians."""
        return np.asarray(self.density * np.sqrt(self.seconds))

    def __len__(self) -> int:
        return len(self.i)

    def pairs(self) -> IntArray:
        """(c,) keys low * 2^32 + high of both poses, as those of points_kernels."""
        return (np.minimum(self.i, self.j) << 32) | np.maximum(self.i, self.j)

    def errors(self, rotations: FloatArray, faults: FloatArray) -> FloatArray:
        """(c, 3) radians by which poses, rotations (n, 3, 3) world_from_cam, turned more."""
        i_from_j = np.einsum("cji,cjk->cik", rotations[self.i], rotations[self.j])
        turn = np.einsum("cji,cjk->cik", self.rotations, i_from_j)
        return np.asarray(vectors_from_rotations(turn) + self.by_faults @ faults)

    def cost(self, rotations: FloatArray, faults: FloatArray) -> float:
        """Of poses, rotations (n, 3, 3) world_from_cam, and faults (12,)."""
        length = np.linalg.norm(self.errors(rotations, faults), axis=1) / self.sigma
        return float(np.sum(np.where(length > OUTLIER, OUTLIER * (2.0 * length - OUTLIER), length**2)))

    def add_to(
        self, rotations: FloatArray, faults: FloatArray, pair: IntArray,
        diagonal: FloatArray, off_diagonal: FloatArray, gradient: FloatArray,
        border: FloatArray, corner: FloatArray, corner_gradient: FloatArray,
    ) -> None:  # fmt: skip
        """Add to the normal equations; pair (c,): which off-diagonal block, lower pose first, takes each;
        border (n, 6, 12), corner (12, 12) and corner_gradient (12,): those of the faults."""
        error = self.errors(rotations, faults)
        length = np.linalg.norm(error, axis=1) / self.sigma
        weight = np.minimum(1.0, OUTLIER / np.maximum(length, 1e-9)) / self.sigma**2
        weights = weight[:, None, None]
        i_from_j = np.einsum("cji,cjk->cik", rotations[self.i], rotations[self.j])  # x_j = -j_from_i x_i
        pull, by_faults = weight[:, None] * error, weights * self.by_faults
        np.add.at(diagonal[:, 3:, 3:], self.i, weights * np.eye(3))
        np.add.at(diagonal[:, 3:, 3:], self.j, weights * np.eye(3))
        np.add.at(gradient[:, 3:], self.i, -np.einsum("cij,cj->ci", i_from_j, pull))
        np.add.at(gradient[:, 3:], self.j, pull)
        np.add.at(border[:, 3:], self.i, -i_from_j @ by_faults)
        np.add.at(border[:, 3:], self.j, by_faults)
        corner += np.einsum("cji,cjk->ik", self.by_faults, by_faults)
        corner_gradient += np.einsum("cji,cj->i", self.by_faults, pull)
        low_first = (self.i < self.j)[:, None, None]
        mixed = -weights * i_from_j
        np.add.at(off_diagonal[:, 3:, 3:], pair, np.where(low_first, mixed, mixed.transpose(0, 2, 1)))
