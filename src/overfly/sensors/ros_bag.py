"""ROS 1 and ROS 2 bags and MCAP files, without ROS. Topics are chosen by their types.

Frames as REP 103 and REP 145 have them: x forward, y left, z up, and the IMU's orientation against
east-north-up.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from overfly.errors import CalibrationError, SourceError
from overfly.geometry.cameras import Camera
from overfly.sensors.calibration_files import fit_to_images, nadir_mount, read_camera_file
from overfly.sensors.flight import Flight, Problems, ReadOptions, SourceKind
from overfly.sensors.imu_attitude import attitude_of_imu
from overfly.sensors.photographs import DEFAULT_FOCAL_WIDTHS
from overfly.sensors.ros_cameras import camera_of, right_from_left
from overfly.sensors.ros_images import decode_image
from overfly.sensors.ros_topics import (
    IMAGES,
    Topics,
    choose_topics,
    mount_by_transforms,
    read_imu,
    read_telemetry,
    stamp_of,
)
from overfly.sensors.selection import select_frames
from overfly.sensors.tables import longest_increasing
from overfly.sensors.telemetry import values_at
from overfly.types import Frame, IntArray, MountedCamera, Rig, UInt8Array

_SUFFIXES = frozenset({".bag", ".mcap", ".db3"})
_STEPS_AHEAD = 50  # a picture that follows within so many is reached by reading on


def is_bag(path: Path) -> bool:
    """A bag file, or the folder of a ROS 2 bag."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() and not (path / "mav0").exists()
    return path.suffix.lower() in _SUFFIXES


@dataclass(slots=True, eq=False)
class _Pictures:
    """The pictures of one topic. logged_ns: when they were recorded, by which they are found; t_ns: when they
    were taken.
    """

    topic: str
    t_ns: IntArray
    logged_ns: IntArray


class _Bag:
    """An open bag; pictures by number, quick in order. Closed when nobody holds it any more."""

    def __init__(self, path: Path) -> None:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        self.path = path
        try:
            self.reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self.reader.open()
        except Exception as error:  # damage shows as any error of struct, sqlite or yaml
            words = str(error).splitlines()[0][:100] if str(error) else type(error).__name__
            raise SourceError(
                f"{path}: not readable as a ROS bag ({words}); try 'rosbag reindex' or record it again"
            ) from error
        self._lock = threading.Lock()  # frames are read ahead in a thread of their own
        self._ahead: dict[str, Generator[tuple[int, bytes, str], None, None]] = {}
        self._passed: dict[str, int] = {}  # the number of the picture that was read last
        weakref.finalize(self, _close, self._ahead, self.reader.stack)

    def messages(
        self, topic: str, start_ns: int | None = None
    ) -> Generator[tuple[int, bytes, str], None, None]:
        """(recorded at, bytes, type) of a topic's messages."""
        connections = [one for one in self.reader.connections if one.topic == topic]
        for connection, logged_ns, raw in self.reader.messages(connections, start=start_ns):
            yield logged_ns, raw, connection.msgtype

    def decoded(self, topic: str) -> Iterator[tuple[int, Any]]:
        """(recorded at, message) of a topic; what cannot be understood is passed over."""
        for logged_ns, raw, kind in self.messages(topic):
            try:
                yield logged_ns, self.reader.deserialize(raw, kind)
            except Exception:  # damage shows as any error of struct or numpy
                continue

    def picture(self, pictures: _Pictures, number: int) -> UInt8Array | str:
        """One picture, or what is wrong with it."""
        with self._lock:
            return self._picture(pictures, number)

    def _picture(self, pictures: _Pictures, number: int) -> UInt8Array | str:
        topic, wanted_ns = pictures.topic, int(pictures.logged_ns[number])
        passed = self._passed.get(topic)
        if passed is None or not passed < number <= passed + _STEPS_AHEAD:
            self._ahead[topic] = self.messages(topic, wanted_ns)
        self._passed[topic] = number
        for logged_ns, raw, kind in self._ahead[topic]:
            stamp_ns = stamp_of(raw, self.reader.is2)
            is_another = stamp_ns not in (None, 0, int(pictures.t_ns[number]))
            if logged_ns < wanted_ns or is_another:
                continue
            try:
                return decode_image(self.reader.deserialize(raw, kind))
            except Exception:  # damage shows as any error of struct or numpy
                return "damaged message"
        return "the message is not where it was"


def _close(ahead: dict[str, Generator[Any, None, None]], files: Any) -> None:
    """The readings first: a database does not close under one."""
    for reading in ahead.values():
        reading.close()
    with suppress(Exception):  # nobody is left to be told
        files.close()


def open_ros_bag(path: Path, options: ReadOptions) -> Flight:
    """path: a .bag, .mcap or .db3 file, or the folder of a ROS 2 bag.

    Raises SourceError when it cannot be read or has no pictures, CalibrationError for a camera that cannot
    be.
    """
    problems = Problems()
    bag = _Bag(path)
    topics = choose_topics(path, bag.reader, options, problems)
    pictures = [_index(bag, topic, problems) for topic in topics.images]
    numbers = _pair(path, pictures)
    t_ns = pictures[0].t_ns[numbers[:, 0]]
    chosen = select_frames(path, t_ns, options)
    numbers, t_ns = numbers[chosen], t_ns[chosen]
    rig = _make_rig(bag, topics, pictures, numbers, options)
    imu = cache(lambda: None if topics.imu is None else read_imu(bag.decoded, topics.imu))
    telemetry, gap_s = read_telemetry(bag.decoded, topics, path.name), options.max_time_gap_s
    tilts = None
    if telemetry.attitude is None and topics.imu is not None and (record := imu()) is not None:
        tilts = attitude_of_imu(record, topics.imu, t_ns, gap_s, problems)
    values = values_at(telemetry, t_ns, gap_s, tilts)

    def read_frame(n: int) -> Frame | None:
        images = []
        for one, number, mounted in zip(pictures, numbers[n], rig.cameras, strict=True):
            image = bag.picture(one, int(number))
            if not isinstance(image, str) and image.shape[1::-1] != (
                mounted.camera.width,
                mounted.camera.height,
            ):
                image = f"{image.shape[1]}x{image.shape[0]} pixels where the first has another size"
            if isinstance(image, str):
                problems.report(f"{one.topic}, picture {number}", f"{image}; passed over")
                return None
            images.append(image)
        at_n = values.attitudes[n], values.altitudes[n], values.positions[n]
        return Frame(n, int(t_ns[n]), f"{pictures[0].topic} {numbers[n, 0]}", tuple(images), *at_n)

    return Flight(
        path, SourceKind.ROS_BAG, rig, t_ns, read_frame, problems, values.summaries,
        read_imu=imu, attitude_at=values.attitude_at,
    )  # fmt: skip


def _index(bag: _Bag, topic: str, problems: Problems) -> _Pictures:
    """When the pictures were taken: by their headers, by the time of recording where those say nothing."""
    rows = [(logged_ns, stamp_of(raw, bag.reader.is2) or 0) for logged_ns, raw, _ in bag.messages(topic)]
    table = np.array(rows, dtype=np.int64).reshape(-1, 2)
    if not len(table):
        raise SourceError(f"{bag.path}: no picture in topic {topic}")
    stamped = table[:, 1] if bool(np.all(table[:, 1] > 0)) else table[:, 0]
    if stamped is not table[:, 1] and not np.array_equal(stamped, table[:, 1]):
        problems.report(topic, "pictures without a time; that of recording was taken")
    keep = longest_increasing(stamped)
    if len(keep) < len(stamped):
        problems.report(topic, f"{len(stamped) - len(keep)} pictures out of order in time; passed over")
    return _Pictures(topic, stamped[keep], table[keep, 0])


def _pair(path: Path, pictures: Sequence[_Pictures]) -> IntArray:
    """(n, cameras) numbers of pictures of one instant: less than half a frame's period apart."""
    left = pictures[0].t_ns
    if len(pictures) == 1:
        return np.arange(len(left), dtype=np.int64)[:, None]
    right = pictures[1].t_ns
    period_ns = float(np.median(np.diff(left))) if len(left) > 1 else 1e9
    after = np.clip(np.searchsorted(right, left), 1, max(len(right) - 1, 1))
    before_is_nearer = left - right[after - 1] <= right[np.minimum(after, len(right) - 1)] - left
    nearest = np.minimum(np.where(before_is_nearer, after - 1, after), len(right) - 1)
    together = np.flatnonzero(np.abs(right[nearest] - left) < 0.5 * period_ns)
    if not len(together):
        raise SourceError(f"{path}: no two pictures of the cameras belong together; use --mono")
    return np.column_stack([together, nearest[together]]).astype(np.int64)


def _make_rig(
    bag: _Bag, topics: Topics, pictures: Sequence[_Pictures], numbers: IntArray, options: ReadOptions
) -> Rig:
    """Cameras by --camera, else by the bag's own CameraInfo, else a guess."""
    sizes = [_first_size(bag, one, numbers[:, k]) for k, one in enumerate(pictures)]
    mount = mount_by_transforms(bag.decoded, topics) or nadir_mount()
    if options.camera_file is not None:
        given = read_camera_file(options.camera_file, sizes[0])
        if len(given) < len(sizes):
            raise CalibrationError(f"{options.camera_file}: calibrates one camera of two; use --mono")
        mounted: list[MountedCamera] = []
        for k, (calibrated, size) in enumerate(zip(given, sizes, strict=False)):
            if k > 0 and calibrated.cam_from_previous is not None:
                mount = mounted[0].body_from_cam @ calibrated.cam_from_previous.inverse()
            elif calibrated.body_from_cam is not None:
                mount = calibrated.body_from_cam
            elif k > 0:
                raise CalibrationError(f"{options.camera_file}: says not where the second camera is")
            camera = fit_to_images(options.camera_file, calibrated.camera, size)
            mounted.append(MountedCamera(pictures[k].topic, camera, mount))
        return Rig(tuple(mounted), "given")
    infos = [_first(bag, topic) for topic in topics.camera_infos]
    cameras: list[Camera | None] = []
    for one, size, info in zip(pictures, sizes, infos, strict=True):
        where = Path(f"{bag.path} {one.topic}")
        cameras.append(None if info is None else camera_of(where, info, size, one.topic))
    if cameras[0] is None:
        focal_px = DEFAULT_FOCAL_WIDTHS * max(sizes[0])
        centre = 0.5 * (sizes[0][0] - 1), 0.5 * (sizes[0][1] - 1)
        guess = Camera(*sizes[0], focal_px, focal_px, *centre)
        return Rig((MountedCamera(pictures[0].topic, guess, mount),), "default")
    first = MountedCamera(pictures[0].topic, cameras[0], mount)
    if len(cameras) == 1 or cameras[1] is None:
        return Rig((first,), "given")
    step = right_from_left(infos[0], infos[1], pictures[0].topic)
    return Rig((first, MountedCamera(pictures[1].topic, cameras[1], mount @ step.inverse())), "given")


def _first(bag: _Bag, topic: str | None) -> Any | None:
    return None if topic is None else next((message for _, message in bag.decoded(topic)), None)


def _first_size(bag: _Bag, pictures: _Pictures, numbers: IntArray) -> tuple[int, int]:
    why = "none"
    for number in numbers[:20]:
        image = bag.picture(pictures, int(number))
        if not isinstance(image, str):
            return image.shape[1], image.shape[0]
        why = image
    kinds = ", ".join(sorted(IMAGES))
    raise SourceError(f"{bag.path}: no picture of {pictures.topic} can be read ({why}); known are {kinds}")
