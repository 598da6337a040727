"""How far the second camera of a stereo rig has turned from where its calibration has it.

A knock turns a camera by tenths of a degree, and depth with it: half a degree towards the other camera is two
pixels of disparity. Two of the three angles show as rows that do not agree: for a point seen at (x, y, 1) in
the rectified pictures, a small turn (a, b, c) about their axes moves its row by

    f * (-(1 + y^2) a + x y b + x c)

The angle b about the vertical axis of the picture, the one that spoils depth, shows only in the corners,
where errors of the lens's calibration of a twentieth of a pixel look the same. It is believed as far as the
others say that the rig was knocked: all three are then as large by chance. A rig whose rows agree is left as
it is.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from overfly.geometry.poses import FloatArray, Pose
from overfly.types import BoolArray, Rig

LENS_SIGMA_RAD = 2e-3  # of the angle b, by errors of the lens's calibration
ROW_SIGMA_PX = 0.3  # of the alignment of two pictures
POINTS_OF_A_PAIR = 5.0  # that a pair of pictures counts as: blur moves all of its points alike
LARGEST_ROW_ERROR_PX = 1.5  # after rectification; more is a wrong match
FIRST_ROW_ERROR_PX = 6.0  # the same, before anything is known of the rig
LEAST_KNOCK_RAD = 1e-3  # of the turn: less is calibration as good as can be had
LEAST_CHANGE_RAD = 3e-4  # of a known turn that is worth rectifying anew for
CERTAIN = 20.0  # squared distance of a and c from zero, in sigmas, from which the rig was knocked
ROUNDS = 8


@dataclass(slots=True, eq=False)
class RigBend:
    """Learns the turn from the rows of matched points, one pair of pictures after another.

    turn_rad (3,): of the second camera about its own axes, as it is allowed for now.
    """

    turn_rad: FloatArray = field(default_factory=lambda: np.zeros(3))
    n_pairs: int = 0
    _information: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    _evidence: FloatArray = field(default_factory=lambda: np.zeros(3))

    def fits(self, row_error_px: FloatArray) -> BoolArray:
        """(n,) whether rows agree as far as they must for a match to be believed."""
        limit = LARGEST_ROW_ERROR_PX if self.n_pairs else FIRST_ROW_ERROR_PX
        return np.abs(row_error_px) < limit

    def learn(
        self, xy: FloatArray, row_error_px: FloatArray, focal_px: float, rectified_from_cam: FloatArray
    ) -> bool:
        """Take in the points of one pair: xy (n, 2) in the rectified second picture in units of the focal
        length, by how many pixels (n,) they lie below the first's. True when turn_rad has changed and the
        pictures are to be rectified anew.
        """
        if len(xy) < POINTS_OF_A_PAIR:
            return False
        x, y = xy.T
        by_turn = focal_px * np.column_stack([-(1.0 + y * y), x * y, x]) @ rectified_from_cam
        total = row_error_px + by_turn @ self.turn_rad
        turn, share = self.turn_rad, POINTS_OF_A_PAIR / len(total)
        for _ in range(ROUNDS):
            weight = share / (ROW_SIGMA_PX**2 + (total - by_turn @ turn) ** 2)
            information = self._information + (by_turn * weight[:, None]).T @ by_turn
            evidence = self._evidence + (by_turn * weight[:, None]).T @ total
            turn = np.asarray(np.linalg.solve(information + np.eye(3), evidence))  # never singular
        turn = _believed(information, evidence, rectified_from_cam)
        self._information, self._evidence = information, evidence
        self.n_pairs += 1
        is_due = self.n_pairs & (self.n_pairs - 1) == 0  # after 1, 2, 4, 8 ... pairs
        if not is_due or np.linalg.norm(turn - self.turn_rad) < LEAST_CHANGE_RAD:
            return False
        self.turn_rad = turn
        return True


def _believed(information: FloatArray, evidence: FloatArray, rectified_from_cam: FloatArray) -> FloatArray:
    """(3,) the turn by weighted least squares; about the picture's vertical axis as much of it as the two
    others make likely.
    """
    rectified = rectified_from_cam @ information @ rectified_from_cam.T + np.eye(3)
    turn = np.linalg.solve(rectified, rectified_from_cam @ evidence)
    covariance = np.linalg.inv(rectified)
    a_and_c = turn[::2]
    knock = 0.5 * float(a_and_c @ a_and_c)
    if a_and_c @ np.linalg.solve(covariance[::2, ::2], a_and_c) < CERTAIN or knock < LEAST_KNOCK_RAD**2:
        return np.zeros(3)
    believed = turn[1] * knock / (knock + covariance[1, 1] + LENS_SIGMA_RAD**2)
    turn += covariance[:, 1] / covariance[1, 1] * (believed - turn[1])  # a and c as they go with that b
    return np.asarray(rectified_from_cam.T @ turn)


def bent_rig(rig: Rig, turn_rad: FloatArray) -> Rig:
    """The stereo rig whose second camera has turned so about its own axes."""
    turned = Pose.exp(np.concatenate([np.zeros(3), turn_rad]))
    second = rig.cameras[1]
    mounted = replace(second, body_from_cam=second.body_from_cam @ turned.inverse())
    return replace(rig, cameras=(rig.cameras[0], mounted, *rig.cameras[2:]))
