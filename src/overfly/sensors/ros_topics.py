"""Which topics of a bag are used, and what the sensors among them say."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from overfly.errors import SourceError
from overfly.geometry.aerospace import euler_from_quaternion
from overfly.geometry.poses import Pose
from overfly.sensors.default_sigmas import GPS_ALTITUDE_SIGMA_M, POSITION_SIGMA_M
from overfly.sensors.flight import Problems, ReadOptions
from overfly.sensors.interpolation import TimeSeries
from overfly.sensors.ros_cameras import baseline_m
from overfly.sensors.tables import longest_increasing
from overfly.sensors.telemetry import Telemetry, ordered, range_values
from overfly.types import ImuRecord

IMAGES = frozenset({"sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"})
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_OTHERS = ("sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Range")
_ULTRASOUND = 0  # Range.radiation_type
_TRANSFORMS = "tf2_msgs/msg/TFMessage"
_NOT_PICTURES = ("depth", "disparity", "mask", "theora")
_SIDES = (("left", "right"), ("cam0", "cam1"), ("infra1", "infra2"), ("camera0", "camera1"))

Decoded = Callable[[str], Iterator[tuple[int, Any]]]  # (recorded at, message) of a topic


@dataclass(frozen=True, slots=True)
class Topics:
    """Names; images and their camera_infos in the order of the cameras, None where there is none."""

    images: tuple[str, ...]
    camera_infos: tuple[str | None, ...]
    imu: str | None
    position: str | None
    range: str | None
    transforms: str | None = None


def choose_topics(path: Path, reader: Any, options: ReadOptions, problems: Problems) -> Topics:
    """The topics of a bag that make a flight: of each kind the one with the most messages.

    Raises SourceError when there are no pictures, or not those that the options ask for.
    """
    counts: dict[str, dict[str, int]] = {}
    for one in reader.connections:
        kind = counts.setdefault(one.msgtype, {})
        kind[one.topic] = kind.get(one.topic, 0) + int(one.msgcount)
    infos = counts.get(_CAMERA_INFO, {})
    images = {
        topic: count
        for kind in IMAGES
        for topic, count in counts.get(kind, {}).items()
        if count and not any(word in topic.lower() for word in _NOT_PICTURES)
    }
    is_only_one = len(images) == 1 and len(infos) == 1  # then they belong together, whatever their names
    if options.topic is not None:
        if options.topic not in images:
            known = ", ".join(sorted(images)) or "none"
            raise SourceError(f"{path}: no pictures in topic {options.topic}; topics with pictures: {known}")
        images = {options.topic: images[options.topic]}
    if not images:
        kinds = ", ".join(sorted(counts)) or "no message at all"
        raise SourceError(f"{path}: no pictures in this bag, only {kinds}")
    best = sorted(images, key=lambda topic: (_info_of(topic, infos) is None, -images[topic], topic))
    first = best[0]
    second = _other_side(first, images) if options.stereo is not False and options.topic is None else None
    if second is not None and not _knows_baseline(reader, _info_of(second, infos), options):
        second = None
    if options.stereo and second is None:
        raise SourceError(
            f"{path}: stereo was asked for, but no second camera with a known place; leave --stereo away"
        )
    chosen = (first,) if second is None else (first, second)
    left_over = sorted(set(images) - set(chosen))
    if left_over:
        problems.report(path.name, f"pictures of {', '.join(left_over)} are not used (--topic chooses)")
    if is_only_one:
        camera_infos: tuple[str | None, ...] = (next(iter(infos)),)
    else:
        camera_infos = tuple(_info_of(topic, infos) for topic in chosen)
    imu, position, distance = (_most(counts.get(kind, {})) for kind in _OTHERS)
    static = [topic for topic in counts.get(_TRANSFORMS, {}) if topic.endswith("tf_static")]
    return Topics(chosen, camera_infos, imu, position, distance, min(static, default=None))


def stamp_of(raw: bytes, is_ros2: bool) -> int | None:
    """Nanoseconds of the header that a message begins with, without decoding the rest; None for damage."""
    try:
        if is_ros2:
            order = "<" if raw[1] & 1 else ">"
            seconds, nanoseconds = struct.unpack_from(f"{order}iI", raw, 4)
        else:
            _, seconds, nanoseconds = struct.unpack_from("<III", raw)
    except (struct.error, IndexError):
        return None
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def read_telemetry(decoded: Decoded, topics: Topics, name: str) -> Telemetry:
    """Attitude, range and position of the chosen topics, on the clock of the headers."""
    used = [topic for topic in (topics.imu, topics.range, topics.position) if topic]
    return Telemetry(
        name=" ".join(used) or name,
        attitude=None if topics.imu is None else _attitude(decoded, topics.imu),
        range=None if topics.range is None else _range(decoded, topics.range),
        position=None if topics.position is None else _position(decoded, topics.position),
        range_half_angle_rad=0.0 if topics.range is None else _half_angle_rad(decoded, topics.range),
    )


def mount_by_transforms(decoded: Decoded, topics: Topics) -> Pose | None:
    """body_from_cam by the static transforms; the body is the IMU's frame, without an IMU base_link.

    None when the bag has no such transforms, or none that join the two frames.
    """
    static = topics.transforms
    if static is None:
        return None
    frames = [
        next((message.header.frame_id for _, message in decoded(topic)), "") if topic else "base_link"
        for topic in (topics.imu, topics.camera_infos[0] or topics.images[0])
    ]
    parent_from: dict[str, tuple[str, Pose]] = {}
    for _, message in decoded(static):
        for one in message.transforms:
            turn, shift = one.transform.rotation, one.transform.translation
            quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
            if np.linalg.norm(quaternion) > 0.5:
                pose = Pose.from_quaternion(quaternion, np.array(_xyz(shift)))
                parent_from[one.child_frame_id.lstrip("/")] = (one.header.frame_id.lstrip("/"), pose)
    if frames[0] == frames[1]:  # one name for all: nobody thought of frames
        return None
    body, camera = (_to_root(frame.lstrip("/"), parent_from) for frame in frames)
    return body[1].inverse() @ camera[1] if body[0] == camera[0] else None


def _to_root(frame: str, parent_from: dict[str, tuple[str, Pose]]) -> tuple[str, Pose]:
    """The root of a frame's tree, and root_from_frame."""
    pose, seen = Pose.identity(), {frame}
    while frame in parent_from and parent_from[frame][0] not in seen:  # a circle ends, too
        frame, step = parent_from[frame]
        seen.add(frame)
        pose = step @ pose
    return frame, pose


def read_imu(decoded: Decoded, topic: str) -> ImuRecord | None:
    """Angular rate and specific force, taken to be in the body's axes."""
    every = (
        (_time(message, logged), *_xyz(message.angular_velocity), *_xyz(message.linear_acceleration))
        for logged, message in decoded(topic)
    )
    rows = [row for row in every if np.isfinite(row).all()]
    if not rows:
        return None
    t_ns = np.array([row[0] for row in rows], dtype=np.int64)
    keep = longest_increasing(t_ns)
    values = np.array([row[1:] for row in rows])[keep]
    return ImuRecord(t_ns[keep], values[:, :3], values[:, 3:])


def _attitude(decoded: Decoded, topic: str) -> TimeSeries | None:
    """The orientation of an IMU that has one."""
    times, quaternions = [], []
    for logged, message in decoded(topic):
        q = message.orientation
        if message.orientation_covariance[0] != -1 and abs(q.x) + abs(q.y) + abs(q.z) + abs(q.w) > 0.5:
            times.append(_time(message, logged))
            quaternions.append((q.w, q.x, q.y, q.z))
    if not times:
        return None
    angles = np.unwrap(euler_from_quaternion(np.array(quaternions)), axis=0)
    return ordered(np.array(times, dtype=np.int64), angles)


def _range(decoded: Decoded, topic: str) -> TimeSeries | None:
    rows = [
        (_time(message, logged), message.range)
        for logged, message in decoded(topic)
        if message.min_range <= message.range <= message.max_range
    ]
    if not rows:
        return None
    distance = np.array([row[1] for row in rows], dtype=np.float64)
    return ordered(np.array([row[0] for row in rows], dtype=np.int64), range_values(distance))


def _half_angle_rad(decoded: Decoded, topic: str) -> float:
    """Of a sonar's cone, in which the nearest echo counts; 0 of anything else."""
    first = next((message for _, message in decoded(topic)), None)
    if first is None or first.radiation_type != _ULTRASOUND or not 0.0 < first.field_of_view < math.pi:
        return 0.0
    return 0.5 * float(first.field_of_view)


def _position(decoded: Decoded, topic: str) -> TimeSeries | None:
    rows = []
    for logged, message in decoded(topic):
        if message.status.status < 0 or not np.isfinite([message.latitude, message.longitude]).all():
            continue
        horizontal, vertical = POSITION_SIGMA_M, GPS_ALTITUDE_SIGMA_M
        if message.position_covariance_type > 0:
            east, north, up = (float(message.position_covariance[k]) for k in (0, 4, 8))
            horizontal = (0.5 * (east + north)) ** 0.5 or horizontal
            vertical = up**0.5 or vertical
        altitude, vertical = (message.altitude, vertical) if np.isfinite(message.altitude) else (0.0, np.inf)
        place = (message.latitude, message.longitude, altitude, horizontal, vertical)
        rows.append((_time(message, logged), *place))
    if not rows:
        return None
    values = np.array([row[1:] for row in rows], dtype=np.float64)
    values[:, 1] = np.unwrap(values[:, 1], period=360.0)
    return ordered(np.array([row[0] for row in rows], dtype=np.int64), values)


def _time(message: Any, logged_ns: int) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec) or logged_ns


def _xyz(vector: Any) -> tuple[float, float, float]:
    return float(vector.x), float(vector.y), float(vector.z)


def _most(topics: dict[str, int]) -> str | None:
    return min(topics, key=lambda topic: (-topics[topic], topic), default=None)


def _info_of(topic: str, infos: dict[str, int]) -> str | None:
    """The camera_info beside a topic of pictures, whose last parts are names of what was done to them."""
    parts = topic.split("/")
    for length in range(len(parts) - 1, 0, -1):
        candidate = "/".join([*parts[:length], "camera_info"])
        if candidate in infos:
            return candidate
    return None


def _other_side(topic: str, images: dict[str, int]) -> str | None:
    """The same topic of the second camera of a pair; None when this is none, or itself the second."""
    for first, second in _SIDES:
        if first in topic:
            other = topic.replace(first, second)
            return other if other in images else None
    return None


def _knows_baseline(reader: Any, info: str | None, options: ReadOptions) -> bool:
    if options.camera_file is not None:
        return True
    connections = [one for one in reader.connections if one.topic == info]
    for connection, _, raw in reader.messages(connections) if connections else ():
        return abs(baseline_m(reader.deserialize(raw, connection.msgtype))) > 1e-4
    return False
