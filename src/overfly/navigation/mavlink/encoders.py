"""Vehicle states as the messages that ArduPilot and PX4 accept. The rules and their sources:
docs/autopilots.md.

What both share: ODOMETRY in a local frame with z down and the body's forward-right-down; the quaternion w
first, from body to local; the covariances' upper triangles row by row; what is not known is NaN.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from overfly.geometry.aerospace import FRD_FROM_FLU
from overfly.geometry.poses import FloatArray, euler_from_rotation, quaternion_from_rotation
from overfly.navigation.mavlink.dialect import Autopilot, messages
from overfly.navigation.mavlink.placement import Placement
from overfly.navigation.mavlink.state import VehicleState

UNKNOWN = math.nan
_UPPER = np.triu_indices(6)
_GPS_EPOCH_S = 315_964_800  # 6 January 1980, in seconds of Unix time
_WEEK_S = 7 * 86_400
_FIX_3D = 3


def encode_odometry(state: VehicleState, placement: Placement, autopilot: Autopilot) -> Any:
    """ODOMETRY for this autopilot (pymavlink's message)."""
    local_from_body = placement.local_from_world() @ state.world_from_body.rotation @ FRD_FROM_FLU
    x, y, z, w = quaternion_from_rotation(local_from_body)
    covariance = pose_covariance(state, placement)
    frame = messages.MAV_FRAME_LOCAL_FRD
    if autopilot is Autopilot.ARDUPILOT:
        covariance = _for_ardupilot(covariance)
    elif placement.is_north_aligned:
        frame = messages.MAV_FRAME_LOCAL_NED
    place = placement.local(state.world_from_body.translation)
    velocity, velocity_covariance = _body_velocity(state, placement)
    return messages.MAVLink_odometry_message(
        time_usec=state.t_ns // 1000,
        frame_id=frame,
        child_frame_id=messages.MAV_FRAME_BODY_FRD,
        x=place[0], y=place[1], z=place[2],
        q=[w, x, y, z],
        vx=velocity[0], vy=velocity[1], vz=velocity[2],
        rollspeed=UNKNOWN, pitchspeed=UNKNOWN, yawspeed=UNKNOWN,
        pose_covariance=covariance[_UPPER].tolist(),
        velocity_covariance=velocity_covariance[_UPPER].tolist(),
        reset_counter=state.reset_counter,
        estimator_type=messages.MAV_ESTIMATOR_TYPE_VISION,
        quality=state.quality,
    )  # fmt: skip


def pose_covariance(state: VehicleState, placement: Placement) -> FloatArray:
    """(6, 6) of x, y, z in the local frame and roll, pitch, yaw of the body in it (m, rad)."""
    local_from_flu = placement.local_from_world() @ state.world_from_body.rotation
    roll, pitch, _ = euler_from_rotation(local_from_flu @ FRD_FROM_FLU)
    transform = np.zeros((6, 6))
    transform[:3, :3] = placement.scale * local_from_flu
    transform[3:, 3:] = _euler_rates(roll, pitch) @ FRD_FROM_FLU
    return np.asarray(transform @ state.covariance @ transform.T)


def _euler_rates(roll_rad: float, pitch_rad: float) -> FloatArray:
    """(3, 3): a small turn in body axes -> changes of roll, pitch and yaw of R = Rz Ry Rx."""
    cos_pitch = max(math.cos(pitch_rad), 1e-3)  # a body on end has no roll and yaw of its own
    sin_roll, cos_roll = math.sin(roll_rad), math.cos(roll_rad)
    tan_pitch = math.sin(pitch_rad) / cos_pitch
    return np.array(
        [
            [1.0, sin_roll * tan_pitch, cos_roll * tan_pitch],
            [0.0, cos_roll, -sin_roll],
            [0.0, sin_roll / cos_pitch, cos_roll / cos_pitch],
        ]
    )


def _for_ardupilot(covariance: FloatArray) -> FloatArray:
    """Diagonal (6, 6) from which ArduPilot makes one error, never smaller than the largest deviation.

    It takes the cube root of the sum of the squares of the three entries as an error in metres (or radians).
    An entry of sqrt(s^3 / 3) gives s; the variance itself is larger where s is large, and then stands, so
    that a reader that takes the entries for variances is not misled either.
    """
    entries = np.zeros((6, 6))
    for axes in (slice(0, 3), slice(3, 6)):
        variance = np.diag(covariance)[axes]
        largest = math.sqrt(float(variance.max()))
        entries[axes, axes] = np.diag(np.maximum(variance, math.sqrt(largest**3 / 3.0)))
    return entries


def _body_velocity(state: VehicleState, placement: Placement) -> tuple[FloatArray, FloatArray]:
    """Velocity (3,) in body forward-right-down, and the covariance (6, 6) of it and the
    unknown turn rates.
    """
    covariance = np.full((6, 6), UNKNOWN)
    if state.velocity_m_s is None or state.velocity_covariance is None:
        return np.full(3, UNKNOWN), covariance
    frd_from_world = placement.scale * FRD_FROM_FLU @ state.world_from_body.rotation.T
    covariance[:3, :3] = frd_from_world @ state.velocity_covariance @ frd_from_world.T
    return frd_from_world @ state.velocity_m_s, covariance


def encode_global_position(
    state: VehicleState, placement: Placement, autopilot: Autopilot, now_ns: int, unix_s: float
) -> Any | None:
    """GPS_INPUT for ArduPilot, GLOBAL_POSITION_SENSOR for PX4; None for a map without latitude and longitude.

    now_ns: when it is sent, on the clock of the state; unix_s: the same instant in seconds since 1970.
    """
    geodetic = placement.geodetic(state.world_from_body.translation)
    if geodetic is None:
        return None
    deviations = np.sqrt(np.diag(pose_covariance(state, placement))[:3])
    horizontal, vertical = float(deviations[:2].max()), float(deviations[2])
    if autopilot is Autopilot.PX4:
        return messages.MAVLink_global_position_sensor_message(
            target_system=0,
            target_component=0,
            id=1,
            time_usec=now_ns // 1000,
            processing_time=max(0, now_ns - state.t_ns) // 1000,
            source=messages.GLOBAL_POSITION_SRC_VISION,
            flags=0,
            lat=round(geodetic[0] * 1e7),
            lon=round(geodetic[1] * 1e7),
            alt_ellipsoid=UNKNOWN,
            alt=geodetic[2],
            eph=horizontal,
            epv=vertical,
        )
    return _gps_input(state, placement, geodetic, (horizontal, vertical), unix_s)


def _gps_input(
    state: VehicleState,
    placement: Placement,
    geodetic: FloatArray,
    deviations_m: tuple[float, float],
    unix_s: float,
) -> Any:
    ignored = messages.GPS_INPUT_IGNORE_FLAG_HDOP | messages.GPS_INPUT_IGNORE_FLAG_VDOP
    velocity, speed_accuracy = np.zeros(3), 0.0
    if state.velocity_m_s is None or state.velocity_covariance is None:
        ignored |= (
            messages.GPS_INPUT_IGNORE_FLAG_VEL_HORIZ
            | messages.GPS_INPUT_IGNORE_FLAG_VEL_VERT
            | messages.GPS_INPUT_IGNORE_FLAG_SPEED_ACCURACY
        )
    else:
        velocity = placement.local(state.velocity_m_s)
        speed_accuracy = math.sqrt(float(np.diag(state.velocity_covariance).max()))
    week, since_s = divmod(unix_s - _GPS_EPOCH_S, _WEEK_S)  # leap seconds: nothing here needs them
    return messages.MAVLink_gps_input_message(
        time_usec=state.t_ns // 1000,
        gps_id=0,
        ignore_flags=ignored,
        time_week_ms=int(since_s * 1000),
        time_week=int(week),
        fix_type=1 if state.is_guess else _FIX_3D,
        lat=round(geodetic[0] * 1e7),
        lon=round(geodetic[1] * 1e7),
        alt=geodetic[2],
        hdop=1.0,
        vdop=1.0,
        vn=velocity[0],
        ve=velocity[1],
        vd=velocity[2],
        speed_accuracy=speed_accuracy,
        horiz_accuracy=deviations_m[0],
        vert_accuracy=deviations_m[1],
        satellites_visible=10,
        yaw=_yaw_centidegrees(state, placement),
    )


def _yaw_centidegrees(state: VehicleState, placement: Placement) -> int:
    """Heading clockwise from north, 1 to 36000: 0 stands for none."""
    rotation = placement.local_from_world() @ state.world_from_body.rotation @ FRD_FROM_FLU
    return round(math.degrees(euler_from_rotation(rotation)[2]) * 100.0) % 36_000 or 36_000
