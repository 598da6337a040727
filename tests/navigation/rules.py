"""What ArduPilot and PX4 do with a message before their filters see it, written from their sources.

docs/autopilots.md names file and function of each rule. Only what decides about acceptance is here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from overfly.navigation.mavlink.dialect import messages

LOCAL_NED, LOCAL_FRD, BODY_FRD = 1, 20, 12  # MAV_FRAME
VISION = 2  # MAV_ESTIMATOR_TYPE


def over_the_wire(message: Any) -> Any:
    """The message as the other end of a link has it: single precision and all."""
    sender = messages.MAVLink(None, srcSystem=1, srcComponent=197)
    receiver = messages.MAVLink(None)
    (received,) = receiver.parse_buffer(message.pack(sender))
    return received


@dataclass(frozen=True)
class Accepted:
    """What reaches a filter: NED or FRD metres and radians; None where the message says nothing usable."""

    time_s: float
    position: np.ndarray
    position_sigma: np.ndarray
    yaw_rad: float
    yaw_sigma_rad: float
    tilt: tuple[float, float]  # roll, pitch
    velocity: np.ndarray | None
    is_reset: bool
    frame: str = "FRD"


def euler(q: Any) -> tuple[float, float, float]:
    """Roll, pitch, yaw of a quaternion w x y z from body to local."""
    w, x, y, z = q
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )


def turned(q: Any, v: np.ndarray) -> np.ndarray:
    w, u = q[0], np.array(q[1:])
    return v + 2 * w * np.cross(u, v) + 2 * np.cross(u, np.cross(u, v))


@dataclass
class ArduPilot:
    """GCS_MAVLINK::handle_odometry, AP_VisualOdom_MAV, NavEKF3_core::writeExtNavData / writeExtNavVelData."""

    pos_noise: float = 0.2  # VISO_POS_M_NSE
    yaw_noise: float = 0.2  # VISO_YAW_M_NSE
    quality_min: int = 0  # VISO_QUAL_MIN
    last_position_s: float = -math.inf
    last_velocity_s: float = -math.inf
    last_counter: int | None = None
    last_message_s: float = -math.inf
    refused: list[str] = field(default_factory=list)

    def take(self, m: Any) -> Accepted | None:
        if m.frame_id != LOCAL_FRD or m.child_frame_id != BODY_FRD:
            self.refused.append("frame")
            return None
        time_s = m.time_usec * 1e-6
        self.last_message_s = time_s
        position_error = angle_error = 0.0
        if not math.isnan(m.pose_covariance[0]):
            position_error = float(np.cbrt(sum(m.pose_covariance[k] ** 2 for k in (0, 6, 11))))
            angle_error = float(np.cbrt(sum(m.pose_covariance[k] ** 2 for k in (15, 18, 20))))
        position_error = min(max(position_error, self.pos_noise), 100.0)
        angle_error = min(max(angle_error, self.yaw_noise), 1.5)
        if m.quality < self.quality_min:
            self.refused.append("quality")
            return None
        position = np.array([m.x, m.y, m.z])
        if np.isnan(position).any() or math.isnan(position_error):
            self.refused.append("not a number")
            return None
        if time_s - self.last_position_s < 0.020:
            self.refused.append("too fast")
            return None
        self.last_position_s = time_s
        is_reset = self.last_counter is not None and m.reset_counter != self.last_counter
        self.last_counter = m.reset_counter
        velocity = turned(m.q, np.array([m.vx, m.vy, m.vz]))
        use_velocity = not np.isnan(velocity).any() and time_s - self.last_velocity_s >= 0.020
        if use_velocity:
            self.last_velocity_s = time_s
        roll, pitch, yaw = euler(m.q)
        return Accepted(
            time_s,
            position,
            np.full(3, position_error),
            yaw,
            max(angle_error, math.radians(5.0)),
            (roll, pitch),
            velocity if use_velocity else None,
            is_reset,
        )


@dataclass
class Px4:
    """MavlinkReceiver::handle_message_odometry, EKF2::UpdateExtVisionSample,
    Ekf::controlExternalVisionFusion.
    """

    position_noise: float = 0.1  # EKF2_EVP_NOISE
    angle_noise: float = 0.1  # EKF2_EVA_NOISE
    quality_min: int = 0  # EKF2_EV_QMIN
    min_interval_s: float = 0.010
    previous_s: float = -math.inf  # the last sample of sufficient quality
    newest_s: float = -math.inf
    last_counter: int | None = None
    is_fusing: bool = False
    refused: list[str] = field(default_factory=list)

    def take(self, m: Any) -> Accepted | None:  # noqa: PLR0911  one return per rule
        if m.estimator_type not in (0, 1, VISION, 3):
            self.refused.append("estimator")
            return None
        position = np.array([m.x, m.y, m.z])
        if m.frame_id not in (LOCAL_NED, LOCAL_FRD) or not np.isfinite(position).all():
            self.refused.append("position")
            return None
        norm = math.sqrt(sum(value * value for value in m.q))
        if abs(1.0 - norm) > 1e-5:
            self.refused.append("quaternion")
            return None
        time_s = m.time_usec * 1e-6
        if time_s < self.newest_s + self.min_interval_s:
            self.refused.append("too fast")
            return None
        self.newest_s = time_s
        is_reset = self.last_counter is not None and m.reset_counter != self.last_counter
        sufficient = self.quality_min <= 0 or m.quality >= self.quality_min
        starts = sufficient and time_s - self.previous_s < 0.200
        if self.is_fusing and time_s - self.previous_s > 0.400:
            self.is_fusing = False
        if sufficient:
            self.previous_s, self.last_counter = time_s, m.reset_counter
        self.is_fusing = self.is_fusing or starts
        if not sufficient:
            self.refused.append("quality")
            return None
        if not self.is_fusing:
            return None
        variance = [m.pose_covariance[k] for k in (0, 6, 11)]
        sigma = np.full(3, self.position_noise)
        if np.isfinite(variance).all():
            sigma = np.maximum(sigma, np.sqrt(variance))
        yaw_sigma = self.angle_noise
        if np.isfinite(m.pose_covariance[20]):
            yaw_sigma = max(yaw_sigma, math.sqrt(m.pose_covariance[20]))
        velocity = np.array([m.vx, m.vy, m.vz])
        roll, pitch, yaw = euler(m.q)
        return Accepted(
            time_s,
            position,
            sigma,
            yaw,
            yaw_sigma,
            (roll, pitch),
            turned(m.q, velocity) if np.isfinite(velocity).all() and m.child_frame_id == BODY_FRD else None,
            is_reset,
            "NED" if m.frame_id == LOCAL_NED else "FRD",
        )
