"""How a gyroscope says that the camera turned between two moments, and how exact it is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.geometry.rotations import rotations_from_vectors, vectors_from_rotations
from overfly.graph.points_turns import FAULT_SIGMAS, N_FAULTS, OUTLIER, Turns
from overfly.types import BoolArray, ImuRecord, IntArray, MountedCamera

GAP_S = 0.25  # silence over which nobody knows how it turned
FEWEST_TURNS = 20  # that tell how exact it is
LAGS = (1, 2, 4, 8)  # turns that are put together for that
MEDIAN_SIZE = 0.6745  # of a normal deviate
SPREAD_OF_MEDIAN = 1.166  # of a deviation by n of them, as a share, times the root of n
FITS = 5  # with weights anew each time
LEAST_DENSITY = 3e-5  # rad/s/sqrt(Hz)


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredTurns:
    """Between moments, c pairs of them: rotations (c, 3, 3) earlier_from_later of the camera; by_faults
    (c, 3, 12) as Turns have it; seconds (c,); is_known (c,): the gyroscope was heard all the time.
    """

    rotations: FloatArray
    by_faults: FloatArray
    seconds: FloatArray
    is_known: BoolArray


class Gyroscope:
    """Angular rates of a whole flight, put together so that any two moments can be asked for."""

    def __init__(self, t_ns: IntArray, rates: FloatArray) -> None:
        """t_ns (n,) increasing, rates (n, 3) rad/s in the camera's axes; two or more."""
        self.t_ns = t_ns
        dt = np.diff(t_ns) * 1e-9
        self._rates = 0.5 * (rates[1:] + rates[:-1])
        turns = self._rates * dt[:, None]
        self._turned = _products(rotations_from_vectors(turns))
        halfway = self._turned[:-1] @ rotations_from_vectors(0.5 * turns)
        self._by_bias = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(halfway * dt[:, None, None], axis=0)])
        self._gaps = np.append(0, np.cumsum(dt > GAP_S))

    def between(self, earlier_ns: IntArray, later_ns: IntArray) -> MeasuredTurns:
        """Turns between moments (c,) and (c,)."""
        first, first_by_bias = self._at(earlier_ns)
        last, last_by_bias = self._at(later_ns)
        inside = (earlier_ns >= self.t_ns[0]) & (later_ns <= self.t_ns[-1]) & (later_ns > earlier_ns)
        before = np.clip(np.searchsorted(self.t_ns, earlier_ns, side="right") - 1, 0, None)
        after = np.clip(np.searchsorted(self.t_ns, later_ns), None, len(self.t_ns) - 1)
        turn = first.transpose(0, 2, 1) @ last
        vector = vectors_from_rotations(turn)
        back = rotations_from_vectors(-0.5 * vector)  # as if it turned evenly: faults of scale are small
        by_matrix = back[:, :, :, None] * vector[:, None, None, :]
        by_bias = last.transpose(0, 2, 1) @ (last_by_bias - first_by_bias)
        return MeasuredTurns(
            turn,
            np.concatenate([by_bias, -by_matrix.reshape(-1, 3, 9)], axis=2),
            np.asarray((later_ns - earlier_ns) * 1e-9, np.float64),
            inside & (self._gaps[before] == self._gaps[after]),
        )

    def _at(self, t_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """start_from_then (c, 3, 3), and its sum over time until then."""
        k = np.clip(np.searchsorted(self.t_ns, t_ns, side="right") - 1, 0, len(self._rates) - 1)
        on_s = np.clip((t_ns - self.t_ns[k]) * 1e-9, 0.0, None)
        turned = self._turned[k] @ rotations_from_vectors(self._rates[k] * on_s[:, None])
        return turned, self._by_bias[k] + self._turned[k] * on_s[:, None, None]


def gyroscope_of(record: ImuRecord | None, mounted: MountedCamera) -> Gyroscope | None:
    """The gyroscope of a record in the body's axes, for the camera; None where nothing was recorded."""
    if record is None or len(record.t_ns) < 2:
        return None
    return Gyroscope(record.t_ns, record.gyro @ mounted.body_from_cam.rotation)


def turns_between(gyroscope: Gyroscope, t_ns: IntArray, part: IntArray, density: float) -> Turns | None:
    """Turns between poses, taken at t_ns (n,), that follow each other in time and lie in the same part (n,)
    of the map, as far as the gyroscope was heard; density: of its noise, rad/s/sqrt(Hz). None where there are
    none.
    """
    order = np.argsort(t_ns, kind="stable")
    i, j = order[:-1], order[1:]
    measured = gyroscope.between(t_ns[i], t_ns[j])
    known = np.flatnonzero(measured.is_known & (part[i] == part[j]))
    if len(known) == 0:
        return None
    return Turns(
        i[known], j[known], measured.rotations[known], measured.by_faults[known], measured.seconds[known],
        density,
    )  # fmt: skip


def noise_density(turns: Turns, rotations: FloatArray) -> float:
    """Of the gyroscope, at most, rad/s/sqrt(Hz), by poses, rotations (n, 3, 3) world_from_cam, which know
    nothing of it. Infinite where too few tell.

    The poses err, too, but not about all axes alike, and what a single pose is off by cancels where turns are
    put together: the axis, and the number of turns, at which both leave least is nearest to the gyroscope's
    own.
    """
    if len(turns) < FEWEST_TURNS:
        return math.inf
    left = turns.errors(rotations, _faults(turns, rotations))
    left = np.einsum("cij,cj->ci", rotations[turns.j], left)  # in the world's axes
    found = [math.inf]
    for lag in LAGS:
        n = len(left) // lag
        if n >= FEWEST_TURNS:
            together = left[: n * lag].reshape(n, lag, 3).sum(axis=1)
            sigma = np.sqrt(turns.seconds[: n * lag].reshape(n, lag).sum(axis=1))
            least = float(_deviations(together / sigma[:, None]).min())
            found.append(least * (1.0 + SPREAD_OF_MEDIAN / math.sqrt(n)))  # the least of many is one too low
    return max(min(found), LEAST_DENSITY)


def _faults(turns: Turns, rotations: FloatArray) -> FloatArray:
    """(12,) of the gyroscope as such poses have them; robust, and with the deviation that is left."""
    faults, by, expected = np.zeros(N_FAULTS), turns.by_faults, np.diag(FAULT_SIGMAS**-2.0)
    one = np.sqrt(turns.seconds)
    for _ in range(FITS):
        left = turns.errors(rotations, faults)
        sigma = one * max(float(_deviations(left / one[:, None]).mean()), LEAST_DENSITY)
        length = np.linalg.norm(left, axis=1) / sigma
        weight = np.minimum(1.0, OUTLIER / np.maximum(length, 1e-9)) / sigma**2
        information = np.einsum("cji,c,cjk->ik", by, weight, by) + expected
        pull = np.einsum("cji,c,cj->i", by, weight, left) + expected @ faults
        faults = faults - np.linalg.solve(information, pull)
    return faults


def _deviations(left: FloatArray) -> FloatArray:
    """(3,) of residuals (c, 3), by their medians."""
    return np.asarray(np.median(np.abs(left), axis=0) / MEDIAN_SIZE)


def _products(steps: FloatArray) -> FloatArray:
    """(n + 1, 3, 3) products of none, one, two .. of the rotations (n, 3, 3), by doubling."""
    product = np.concatenate([np.eye(3)[None], steps])
    reach = 1
    while reach < len(product):
        product[reach:] = product[:-reach] @ product[reach:]
        reach *= 2
    return product
