"""Short gaps in the chain of located frames: a dark moment, a few spoilt pictures, ground that shows next to
nothing.

When the pictures after the gap register with each other, the camera's speed is known on both sides of it, and
where it must have got to is known better than that it was lost: odometry goes on, tied across the gap by a
constraint whose deviation grows with the time that nobody saw.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from overfly.geometry.levelling import split_yaw, world_from_cam_rotation
from overfly.geometry.poses import FloatArray, Pose, rotation_z
from overfly.pieces import CLIMB_SHARE_PER_S, Reckoned
from overfly.types import IntArray, NotFound
from overfly.vision.depth import RELIEF_SHARE
from overfly.vision.features import Extractor
from overfly.vision.motion import ACCELERATION, LONGEST_GAP_S, NS_PER_S, SPEED_SIGMA
from overfly.vision.observation import Observation
from overfly.vision.odometry import Reference, locate_against
from overfly.vision.refine import HeightPrior
from overfly.vision.registration import Registrar

SPEED_SPAN_S = 0.3  # before the last located frame, over which its speed is taken
MOST_OPEN = 0.25  # flying heights, one standard deviation: what is known less well is not tied
FEWEST_INLIERS = 20  # of two pictures that show the same ground
LEAST_INLIER_SHARE = 0.3
TURN_SIGMA = 0.03  # rad/s: of a rate of turn as two pictures tell it
TURN_CHANGE = 0.6  # rad/s^2: how fast a vehicle changes it
GATE_SIGMAS = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """Where the camera is, world_from_cam at t_ns, and how it moved at motion_ns, shortly before: velocity
    (3,) m/s in the world and turn about the vertical in rad/s."""

    t_ns: int
    pose: Pose
    motion_ns: int
    velocity_m_s: FloatArray
    turn_rad_s: float


def course_between(earlier_ns: int, earlier: Pose, now_ns: int, now: Pose) -> Course:
    """The course of a camera that was at one pose and is at another."""
    seconds = (now_ns - earlier_ns) / NS_PER_S
    return Course(
        now_ns,
        now,
        (earlier_ns + now_ns) // 2,
        (now.translation - earlier.translation) / seconds,
        _turn(now.rotation @ earlier.rotation.T) / seconds,
    )


def course_of(stamps_ns: IntArray, poses: Callable[[int], Pose]) -> Course | None:
    """The course of the last of some located frames, at stamps (n,), whose world_from_cam is given by their
    number; None where no other is near it."""
    if len(stamps_ns) < 2:
        return None
    before = int(np.argmin(np.abs(stamps_ns[:-1] - (stamps_ns[-1] - SPEED_SPAN_S * NS_PER_S))))
    if stamps_ns[-1] - stamps_ns[before] > LONGEST_GAP_S * NS_PER_S:
        return None
    last = len(stamps_ns) - 1
    return course_between(int(stamps_ns[before]), poses(before), int(stamps_ns[last]), poses(last))


@dataclass(frozen=True, slots=True, eq=False)
class _Sight:
    """A picture that was not found in the map, and where it was taken if the camera kept its course."""

    view: Observation
    pose: Pose


class Bridge:
    """Watches frames that are not found, and says where the camera is as soon as two of them agree."""

    def __init__(
        self,
        extractor: Extractor,
        registrar: Registrar,
        reference_of: Callable[[Observation, Pose], Reference],
    ) -> None:
        """reference_of: what a picture shows, as something to register with, if taken from a pose."""
        self._extractor = extractor
        self._registrar = registrar
        self._reference_of = reference_of
        self._last: _Sight | None = None

    def found(self) -> None:
        """The camera is in the map."""
        self._last = None

    def span(self, view: Observation, before: Course, height: HeightPrior | None) -> Reckoned | None:
        """Where the camera is after the gap, against where it was last; None while that is not known.

        height: by the range sensor.
        """
        gap_s = (view.frame.t_ns - before.t_ns) / NS_PER_S
        last, self._last = self._last, None
        if unseen_share(gap_s) > MOST_OPEN:
            return None
        self._last = _Sight(view, self._kept_on(view, before, gap_s, height))
        now = None if last is None else self._registered(last, self._last, height)
        if last is None or now is None:
            return None
        after = course_between(last.view.frame.t_ns, last.pose, view.frame.t_ns, now)
        z = float(now.translation[2])
        changed = float(np.linalg.norm((after.velocity_m_s - before.velocity_m_s)[:2]))
        if changed > GATE_SIGMAS * z * (ACCELERATION * gap_s + SPEED_SIGMA):
            return None
        # What moved evenly faster or slower had, on the way, the speed of the middle of the gap.
        middle_ns = (before.t_ns + after.t_ns) // 2
        share = (middle_ns - before.motion_ns) / (after.motion_ns - before.motion_ns)
        turn = before.turn_rad_s + share * (after.turn_rad_s - before.turn_rad_s)
        excess = gap_s * turn - _turn(now.rotation @ before.pose.rotation.T)
        faster = rotation_z(excess) @ after.velocity_m_s - before.velocity_m_s
        velocity = before.velocity_m_s + share * faster
        place = before.pose.translation + gap_s * velocity
        pose = Pose(rotation_z(excess) @ now.rotation, np.array([*place[:2], z]))
        return Reckoned(pose, _covariance(pose, gap_s, view, height))

    def _kept_on(self, view: Observation, before: Course, gap_s: float, height: HeightPrior | None) -> Pose:
        """world_from_cam if the camera kept its course; its tilt by the sensor, or as it was."""
        place = before.pose.translation + gap_s * before.velocity_m_s * [1.0, 1.0, 0.0]
        if height is not None:
            place[2] = height.z_m
        rotation = rotation_z(before.turn_rad_s * gap_s) @ before.pose.rotation
        if self._registrar.knows_tilt(view.frame.attitude):
            yaw, _ = split_yaw(rotation, self._registrar.body_from_cam)
            rotation = world_from_cam_rotation(yaw, view.tilt.level_from_cam)
        return Pose(rotation, place)

    def _registered(self, last: _Sight, now: _Sight, height: HeightPrior | None) -> Pose | None:
        """world_from_cam of this picture if the last one was taken where it is supposed; None where both do
        not show the same."""
        reference = self._reference_of(last.view, last.pose)
        z = float(last.pose.translation[2])
        change = self._registrar.config.registration.height_change
        found = locate_against(
            now.view,
            [reference],
            self._extractor,
            self._registrar,
            now.pose,
            (z / change, z * change),
            height,
        )
        if isinstance(found, NotFound):
            return None
        count = len(found.estimate.inliers)
        enough = max(FEWEST_INLIERS, LEAST_INLIER_SHARE * len(found.matches.correspondences))
        return found.pose if count >= enough else None


def unseen_share(gap_s: float) -> float:
    """By how much, in flying heights and one standard deviation, a camera is off the way that its speed
    before and after a gap says: a quarter of what the speed before alone would leave."""
    return math.hypot(0.125 * ACCELERATION * gap_s**2, SPEED_SIGMA * gap_s)


def _covariance(pose: Pose, gap_s: float, view: Observation, height: HeightPrior | None) -> FloatArray:
    """(6, 6) of (translation, rotation), on the right."""
    z = float(pose.translation[2])
    z_sigma = CLIMB_SHARE_PER_S * gap_s * z
    if height is not None:  # above what is below now: ground, or something that stands on it
        z_sigma = math.hypot(height.sigma_m, RELIEF_SHARE * z)
    yaw_sigma = math.hypot(0.125 * TURN_CHANGE * gap_s**2, TURN_SIGMA * gap_s)
    shift = np.diag([(unseen_share(gap_s) * z) ** 2] * 2 + [z_sigma**2])
    turn = np.diag([view.tilt.sigma_rad**2] * 2 + [yaw_sigma**2])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = pose.rotation.T @ shift @ pose.rotation
    covariance[3:, 3:] = pose.rotation.T @ turn @ pose.rotation
    return covariance


def _turn(rotation: FloatArray) -> float:
    """The part of a rotation (3, 3) that is about the vertical, rad."""
    return math.atan2(rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1])
