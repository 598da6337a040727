"""How far a trajectory is from the truth: absolute and relative error, scale, coverage.

Absolute trajectory error (ATE) and relative pose error (RPE) as in Sturm et al., "A Benchmark for the
Evaluation of RGB-D SLAM Systems" (IROS 2012); alignment by Umeyama, "Least-squares estimation of
transformation parameters between two point patterns" (PAMI 1991); percent of path as in Geiger et al.
(CVPR 2012). docs/evaluation.md says what each figure means.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from overfly.errors import GraphFileError
from overfly.geometry.poses import FloatArray, rotation_z
from overfly.trajectory import NS_PER_S, Trajectory
from overfly.types import IntArray

PAIR_LENGTHS_M = (1.0, 5.0, 10.0, 50.0, 100.0, 500.0, 1000.0)
PAIR_TOLERANCE = 0.1  # of the length: pairs of frames that far apart still count as that length
LEAST_PAIRS = 3  # fewer do not determine a rotation


class Align(StrEnum):
    """What is taken out of the estimate before it is compared."""

    NONE = "none"
    YAW = "yaw"  # translation and rotation about z: what a levelled vehicle cannot know
    SE3 = "se3"  # translation and rotation
    SIM3 = "sim3"  # translation, rotation and scale


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """x_b = scale * rotation @ x_a + translation; rotation (3, 3), translation (3,) metres of frame b."""

    scale: float
    rotation: FloatArray
    translation: FloatArray

    def transform(self, points: FloatArray) -> FloatArray:
        """points: (..., 3) in frame a -> the same in frame b."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)


@dataclass(frozen=True, slots=True)
class Statistics:
    """Of a set of errors, in the unit of the field that holds it."""

    rmse: float
    mean: float
    median: float
    p95: float
    max: float

    @staticmethod
    def of(errors: FloatArray) -> Statistics:
        """errors: (n,), n >= 1, not negative."""
        return Statistics(
            float(np.sqrt(np.mean(errors**2))),
            float(np.mean(errors)),
            float(np.median(errors)),
            float(np.percentile(errors, 95.0)),
            float(np.max(errors)),
        )


@dataclass(frozen=True, slots=True)
class RelativeError:
    """Error of the motion between frames that lie ``length_m`` of true path apart (None: between neighbours).

    translation_percent and rotation_deg_per_m are means over the pairs, each divided by its own true path;
    None between neighbours, where a hovering vehicle would divide by nothing.
    """

    length_m: float | None
    n_pairs: int
    translation_m: Statistics
    rotation_rad: Statistics
    translation_percent: float | None
    rotation_deg_per_m: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """An estimate against the truth, over the frames that both have.

    scale_error: scale of the estimate over the true one, minus 1 (None when the path is too small to tell).
    coverage: fraction of the truth's frames that the estimate has. final_error_m: how far the estimate
    ends from the truth when both start in the same pose; final_error_percent: the same in percent of the
    true path between these two frames, path_m. estimate: the aligned poses; truth: as many true ones;
    errors_m (n, 3): estimate minus truth, world axes.
    """

    align: Align
    n_frames: int
    n_truth: int
    coverage: float
    path_m: float
    ate_m: Statistics
    ate_horizontal_m: Statistics
    ate_vertical_m: Statistics
    rotation_rad: Statistics
    scale_error: float | None
    final_error_m: float
    final_error_percent: float | None
    relative: tuple[RelativeError, ...]
    truth_from_estimate: Similarity
    estimate: Trajectory
    truth: Trajectory
    errors_m: FloatArray


def evaluate(
    estimate: Trajectory, truth: Trajectory, align: Align = Align.SE3, tolerance_s: float = 0.01
) -> Evaluation:
    """Compare two trajectories of the same body (camera or vehicle) and the same clock.

    tolerance_s: frames whose times differ by no more are the same frame. Raises GraphFileError when fewer
    than three are.
    """
    in_estimate, in_truth = associate(estimate.t_ns, truth.t_ns, tolerance_s)
    if len(in_truth) < LEAST_PAIRS:
        raise GraphFileError(
            f"estimate and truth share {len(in_truth)} frames within {tolerance_s:g} s, "
            f"at least {LEAST_PAIRS} are needed; are their times of the same clock?"
        )
    matched_truth = truth.at(in_truth)
    matched = estimate.at(in_estimate)
    similarity = alignment(matched.positions, matched_truth.positions, align)
    aligned = apply_similarity(similarity, matched)
    errors = aligned.positions - matched_truth.positions
    turns = Rotation.from_quat(aligned.quaternions_xyzw).inv() * Rotation.from_quat(
        matched_truth.quaternions_xyzw
    )
    path = truth.path_m()[in_truth]
    length_m = float(path[-1] - path[0])
    final_m = float(_relative_errors(aligned, matched_truth, np.array([0]), np.array([len(path) - 1]))[0][0])
    return Evaluation(
        align=align,
        n_frames=len(in_truth),
        n_truth=len(truth),
        coverage=len(in_truth) / len(truth),
        path_m=length_m,
        ate_m=Statistics.of(np.linalg.norm(errors, axis=1)),
        ate_horizontal_m=Statistics.of(np.linalg.norm(errors[:, :2], axis=1)),
        ate_vertical_m=Statistics.of(np.abs(errors[:, 2])),
        rotation_rad=Statistics.of(np.asarray(turns.magnitude())),
        scale_error=_scale_error(matched.positions, matched_truth.positions),
        final_error_m=final_m,
        final_error_percent=100.0 * final_m / length_m if length_m > 0 else None,
        relative=_relative(aligned, matched_truth),
        truth_from_estimate=similarity,
        estimate=aligned,
        truth=matched_truth,
        errors_m=errors,
    )


def associate(
    first_ns: NDArray[np.int64], second_ns: NDArray[np.int64], tolerance_s: float
) -> tuple[IntArray, IntArray]:
    """Rows of the times that belong together: each the other's nearest and at most ``tolerance_s`` apart."""
    if len(first_ns) == 0 or len(second_ns) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    second_of_first = _nearest(first_ns, second_ns)
    first_of_second = _nearest(second_ns, first_ns)
    rows = np.arange(len(first_ns))
    mutual = first_of_second[second_of_first] == rows
    near = np.abs(second_ns[second_of_first] - first_ns) <= round(tolerance_s * NS_PER_S)
    rows = rows[mutual & near]
    return rows, second_of_first[rows]


def alignment(points_a: FloatArray, points_b: FloatArray, align: Align) -> Similarity:
    """The transform of this kind that brings points_a (n, 3) nearest to points_b (n, 3), in least squares.

    On a straight line the rotation about the line is free; one of the best is returned. Raises
    GraphFileError when the scale is wanted and points_a do not move.
    """
    if align is Align.NONE:
        return Similarity(1.0, np.eye(3), np.zeros(3))
    mean_a, mean_b = points_a.mean(axis=0), points_b.mean(axis=0)
    a, b = points_a - mean_a, points_b - mean_b
    scale = 1.0
    if align is Align.YAW:
        sine = float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))
        cosine = float(np.sum(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]))
        rotation = rotation_z(math.atan2(sine, cosine))
    else:
        u, singular, vt = np.linalg.svd(b.T @ a)
        signs = np.array([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)])  # a rotation, not a mirror
        signs[2] = 1.0 if signs[2] > 0 else -1.0
        rotation = (u * signs) @ vt
        if align is Align.SIM3:
            spread = float(np.sum(a**2))
            if spread < 1e-12 * len(a):
                raise GraphFileError(
                    "the estimate does not move, so its scale cannot be aligned; use se3 or yaw"
                )
            scale = float(singular @ signs) / spread
    return Similarity(scale, rotation, mean_b - scale * rotation @ mean_a)


def apply_similarity(similarity: Similarity, trajectory: Trajectory) -> Trajectory:
    """The trajectory in the other frame; orientations turn, distances scale."""
    turned = Rotation.from_matrix(similarity.rotation) * Rotation.from_quat(trajectory.quaternions_xyzw)
    return Trajectory(trajectory.t_ns, similarity.transform(trajectory.positions), turned.as_quat())


def horizontal_rms_against_gps(
    trajectory: Trajectory, gps_t_ns: NDArray[np.int64], gps_enu_m: FloatArray, largest_gap_s: float = 2.0
) -> float:
    """RMS horizontal distance (m) of a trajectory from GPS after the best scale, heading and translation.

    gps_enu_m: (m, 3) local east, north, up; interpolated to the frames, but not across gaps above
    ``largest_gap_s``. Heights are left out: those of small receivers err by tens of metres. Raises
    GraphFileError when fewer than three frames have GPS.
    """
    after = np.clip(np.searchsorted(gps_t_ns, trajectory.t_ns), 1, max(1, len(gps_t_ns) - 1))
    if len(gps_t_ns) < 2:
        raise GraphFileError("fewer than two GPS positions to compare with")
    before = after - 1
    fraction = (trajectory.t_ns - gps_t_ns[before]) / (gps_t_ns[after] - gps_t_ns[before])
    short = gps_t_ns[after] - gps_t_ns[before] <= largest_gap_s * NS_PER_S
    exact = (trajectory.t_ns == gps_t_ns[before]) | (trajectory.t_ns == gps_t_ns[after])
    used = (fraction >= 0) & (fraction <= 1) & (short | exact)
    if np.count_nonzero(used) < LEAST_PAIRS:
        raise GraphFileError(
            "fewer than three frames have a GPS position; are their times of the same clock?"
        )
    east_north = gps_enu_m[before, :2] + fraction[:, None] * (gps_enu_m[after, :2] - gps_enu_m[before, :2])
    # In complex numbers a similarity of the plane is one multiplication.
    a = trajectory.positions[used, 0] + 1j * trajectory.positions[used, 1]
    b = east_north[used, 0] + 1j * east_north[used, 1]
    a, b = a - a.mean(), b - b.mean()
    spread = float(np.vdot(a, a).real)
    turn_and_scale = np.vdot(a, b) / spread if spread > 0 else 0.0
    return float(np.sqrt(np.mean(np.abs(turn_and_scale * a - b) ** 2)))


def _nearest(wanted_ns: NDArray[np.int64], sorted_ns: NDArray[np.int64]) -> IntArray:
    """For each wanted time the row of the nearest in ``sorted_ns``."""
    after = np.clip(np.searchsorted(sorted_ns, wanted_ns), 1, max(1, len(sorted_ns) - 1))
    after = np.minimum(after, len(sorted_ns) - 1)
    before = np.maximum(after - 1, 0)
    take_before = wanted_ns - sorted_ns[before] <= sorted_ns[after] - wanted_ns
    return np.where(take_before, before, after)


def _scale_error(estimate: FloatArray, truth: FloatArray) -> float | None:
    """Scale of the estimate minus 1; None when either hardly moves or the paths have nothing in common."""
    spread = np.sqrt(np.mean(np.var(estimate, axis=0))), np.sqrt(np.mean(np.var(truth, axis=0)))
    if min(spread) < 1e-6:
        return None
    scale = alignment(estimate, truth, Align.SIM3).scale
    return 1.0 / scale - 1.0 if scale > 1e-6 else None


def _relative(estimate: Trajectory, truth: Trajectory) -> tuple[RelativeError, ...]:
    """Relative errors over one frame and over the lengths of PAIR_LENGTHS_M that fit the path."""
    path = truth.path_m()
    frames = np.arange(len(truth) - 1)
    found = [_relative_error(estimate, truth, frames, frames + 1, None)]
    for length_m in PAIR_LENGTHS_M:
        first, second = pairs_along_path(path, length_m)
        if len(first):
            found.append(_relative_error(estimate, truth, first, second, length_m))
    return tuple(found)


def pairs_along_path(path_m: FloatArray, length_m: float) -> tuple[IntArray, IntArray]:
    """Rows of path_m (n,) in pairs: to each the one nearest to ``length_m`` on, if within PAIR_TOLERANCE."""
    wanted = path_m + length_m
    after = np.clip(np.searchsorted(path_m, wanted), 0, len(path_m) - 1)
    before = np.searchsorted(path_m, path_m[np.maximum(after - 1, 0)])  # the first, where it hovered
    second = np.where(np.abs(path_m[before] - wanted) <= np.abs(path_m[after] - wanted), before, after)
    first = np.arange(len(path_m))
    fits = np.abs(path_m[second] - wanted) <= PAIR_TOLERANCE * length_m
    return first[fits], second[fits]


def _relative_error(
    estimate: Trajectory, truth: Trajectory, first: IntArray, second: IntArray, length_m: float | None
) -> RelativeError:
    translation_m, rotation_rad = _relative_errors(estimate, truth, first, second)
    path = truth.path_m()
    percent = per_m = None
    if length_m is not None:
        lengths = path[second] - path[first]
        percent = float(100.0 * np.mean(translation_m / lengths))
        per_m = float(np.mean(np.degrees(rotation_rad) / lengths))
    return RelativeError(
        length_m, len(first), Statistics.of(translation_m), Statistics.of(rotation_rad), percent, per_m
    )


def _relative_errors(
    estimate: Trajectory, truth: Trajectory, first: IntArray, second: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Length (m) and angle (rad) of (true motion)^-1 (estimated motion) between each two frames."""
    true_turn, true_step = _motion(truth, first, second)
    turn, step = _motion(estimate, first, second)
    return np.linalg.norm(step - true_step, axis=1), np.asarray((true_turn.inv() * turn).magnitude())


def _motion(trajectory: Trajectory, first: IntArray, second: IntArray) -> tuple[Rotation, FloatArray]:
    """Pose of ``second`` in the frame of ``first``, for each pair."""
    start = Rotation.from_quat(trajectory.quaternions_xyzw[first]).inv()
    step = start.apply(trajectory.positions[second] - trajectory.positions[first])
    return start * Rotation.from_quat(trajectory.quaternions_xyzw[second]), np.asarray(step)
