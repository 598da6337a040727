"""Keeping the metre while flying: the map's lengths against what the other sensors measure.

One camera over flat ground knows no metre of its own. A map that began with an assumed height, or with a
range reading that was an outlier, is rescaled as soon as enough measurements agree on another scale. Where
there is neither range nor GPS, a climb does: what a barometer rises by against what the map does.
"""

from __future__ import annotations

import math

import numpy as np

from overfly.geometry.geodesy import GeoOrigin, enu_from_geodetic
from overfly.geometry.poses import FloatArray, Pose
from overfly.geometry.similarity import align_about_vertical
from overfly.range_offset import FEWEST_READINGS, fit_line
from overfly.start import range_height
from overfly.types import AltitudeKind, BoolArray, Frame, GeoPosition, Rig

WITHOUT_OWN_METRE = ("none", "given", "altitude")  # starts that GPS is better than
FIRST_CHECK = 5  # measurements; then again each time their number has doubled
LAST_RANGE_CHECK = 40  # by then the range sensor holds the height anyway
LEAST_CHANGE = 0.01
SIGNIFICANT = 4.0  # standard deviations
CLIMBING = ("none", "altitude")  # starts that a climb may be better than
LARGEST_CLIMB_SIGMA = 0.1  # of the metre that a climb gives
ANY_OFFSET_M = 1e4  # of a barometer: it counts from wherever it was switched on


def size_ratio(before: FloatArray, after: FloatArray, members: BoolArray) -> float:
    """How much larger a map was before it was adjusted: positions (n, 3) of its nodes, of which only members
    (n,) count.
    """
    same = align_about_vertical(after[members], before[members], np.full(int(members.sum()), 1e-3))
    return 1.0 if same is None else same.scale


class ScaleKeeper:
    """Collects measurements and says when all lengths should be multiplied, and by what."""

    def __init__(self, source: str) -> None:
        self.source = source
        self._log_ratios: list[float] = []
        self._positions: list[tuple[float, ...]] = []
        self._climb: list[tuple[float, float, float]] = []  # height in the map; above start, with deviation
        self._next_check = FIRST_CHECK

    def observe(self, frame: Frame, rig: Rig, level_from_cam: FloatArray, world_from_cam: Pose) -> None:
        """A located frame; level_from_cam (3, 3): its tilt by the sensors."""
        height, z_m = range_height(frame, rig, level_from_cam, 0.0), float(world_from_cam.translation[2])
        if height is not None and z_m > 0 and len(self._log_ratios) < LAST_RANGE_CHECK:
            self._log_ratios.append(math.log(height.z_m / z_m))
        altitude = frame.altitude
        if self.source in CLIMBING and altitude is not None and altitude.kind is AltitudeKind.ABOVE_START:
            self.observe_climb(z_m, altitude.value_m, altitude.sigma_m)
        if self.source != "range" and frame.position is not None:
            self.observe_position(frame.position, world_from_cam @ rig.cam0.body_from_cam.inverse())

    def observe_climb(self, z_m: float, above_start_m: float, sigma_m: float) -> None:
        """How high the camera is in the map, and what a barometer says with its deviation."""
        if z_m > 0:
            self._climb.append((z_m, above_start_m, sigma_m))

    def observe_position(self, position: GeoPosition, world_from_body: Pose) -> None:
        """Where GPS had the body."""
        if not self._positions:
            self._next_check = FIRST_CHECK
        geodetic = (position.latitude_deg, position.longitude_deg, position.altitude_m)
        self._positions.append(
            (*world_from_body.translation, *geodetic, max(position.sigma_horizontal_m, 0.01))
        )

    def due_factor(self) -> float | None:
        """What all lengths should be multiplied with now; None while there is no reason to. source is then
        what said so: the range sensor, whenever it begins to measure, else GPS, else a barometer.
        """
        if self.source != "range" and len(self._log_ratios) >= FIRST_CHECK:
            self.source, self._next_check = "range", 2 * len(self._log_ratios)
            return self._multiplied(self._from_range()[0])
        if self.source != "range" and not self._positions:
            return self._due_by_climb()
        count = len(self._log_ratios if self.source == "range" else self._positions)
        if count < self._next_check:
            return None
        self._next_check = 2 * count
        factor, sigma = self._from_range() if self.source == "range" else self._from_positions()
        change = abs(math.log(factor))
        if change < LEAST_CHANGE or change < SIGNIFICANT * sigma:
            return None
        if self.source in WITHOUT_OWN_METRE:
            self.source = "gps"
        return self._multiplied(factor)

    def _due_by_climb(self) -> float | None:
        """The same by a barometer, as soon as the climb tells the metre better than the start did."""
        count = len(self._climb)
        if count < max(self._next_check, FEWEST_READINGS):
            return None
        self._next_check = 2 * count
        factor, sigma = self._from_climb()
        _, first_m, first_sigma_m = self._climb[0]
        known = first_sigma_m / first_m if self.source == "altitude" and first_m > 0 else math.inf
        if sigma > min(LARGEST_CLIMB_SIGMA, known) or abs(math.log(factor)) < max(LEAST_CHANGE, sigma):
            return None
        self.source = "altitude"
        return self._multiplied(factor)

    def _multiplied(self, factor: float) -> float:
        """What was collected, by the new metre; the factor again."""
        self._log_ratios = [ratio - math.log(factor) for ratio in self._log_ratios]
        self._positions = [(*(factor * value for value in row[:3]), *row[3:]) for row in self._positions]
        self._climb = [(factor * z_m, read_m, sigma_m) for z_m, read_m, sigma_m in self._climb]
        return factor

    def _from_range(self) -> tuple[float, float]:
        """Median ratio of measured to mapped height, and its relative standard deviation."""
        middle = float(np.median(self._log_ratios))
        scatter = 1.4826 * float(np.median(np.abs(np.array(self._log_ratios) - middle)))
        return math.exp(middle), max(1.25 * scatter / math.sqrt(len(self._log_ratios)), 0.005)

    def _from_positions(self) -> tuple[float, float]:
        """Scale of the similarity to the GPS positions, and its relative standard deviation."""
        table = np.array(self._positions)
        origin = GeoOrigin(*(float(value) for value in table[0, 3:6]))
        aligned = align_about_vertical(table[:, :3], enu_from_geodetic(table[:, 3:6], origin), table[:, 6])
        if aligned is None:
            return 1.0, math.inf
        spread = aligned.scale * float(np.linalg.norm(np.std(table[:, :2], axis=0))) * math.sqrt(len(table))
        noise = max(aligned.horizontal_rms_m, float(np.median(table[:, 6])))
        return aligned.scale, noise / spread

    def _from_climb(self) -> tuple[float, float]:
        """Metres that a barometer rose by for each of the map, and the relative standard deviation.

        Its slow drift looks like a climb, so all of the climb is known no better than one reading.
        """
        height, above_start, sigma = np.array(self._climb).T
        (metre, _), covariance = fit_line(above_start, sigma, height, ANY_OFFSET_M)
        if metre <= 0:
            return 1.0, math.inf
        climbed = metre * max(float(np.ptp(np.quantile(height, [0.05, 0.95]))), 1e-6)
        return float(metre), math.hypot(
            math.sqrt(covariance[0, 0]) / metre, float(np.median(sigma)) / climbed
        )
