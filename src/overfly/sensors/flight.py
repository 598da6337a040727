"""What every reader hands out: a flight, which is a sequence of frames with the rig that recorded them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from pathlib import Path

from overfly.types import Attitude, Frame, ImuRecord, IntArray, LandmarkClick, Problem, Rig, ScaleLandmark


class SourceKind(StrEnum):
    """What a flight was read from."""

    EUROC = "EuRoC folder"
    PHOTOGRAPHS = "folder of photographs"
    VIDEO = "video"
    ROS_BAG = "ROS bag"
    LIVE = "live camera"


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """How to read a flight.

    camera_file: calibration that replaces what the source says of its cameras. stereo: True insists on two
    cameras, False reads the first only, None takes what is there. start_s, stop_s: seconds from the first
    frame. every: read each n-th frame. max_time_gap_s: samples further apart than this are never interpolated
    between; a sensor that is usually faster is held to 2.5 of its own periods. time_offset_s: how much later
    than its telemetry a video begins, None when that was not said. topic: of a bag's pictures, None for the
    likeliest.
    """

    camera_file: Path | None = None
    stereo: bool | None = None
    start_s: float | None = None
    stop_s: float | None = None
    every: int = 1
    max_time_gap_s: float = 2.0
    time_offset_s: float | None = None
    topic: str | None = None


class Quantity(StrEnum):
    """What a sensor beside the cameras measures."""

    ATTITUDE = "attitude"
    RANGE = "range to the ground"
    HEIGHT = "height above start"
    POSITION = "GPS position"
    IMU = "angular rate and specific force"


@dataclass(frozen=True, slots=True)
class SensorSummary:
    """One sensor beside the cameras.

    rate_hz: from the median time between samples, 0 for fewer than two. sigma: standard deviations in words,
    with where they come from. frames: how many of the flight's frames get a value from it.
    """

    name: str
    quantity: Quantity
    samples: int
    rate_hz: float
    sigma: str
    frames: int


class Problems(list[Problem]):
    """Bad files and rows, each named once however often the flight is read."""

    def report(self, where: str, what: str) -> None:
        problem = Problem(where, what)
        if problem not in self:
            self.append(problem)


@dataclass(eq=False)
class Flight:
    """A recorded flight: iterate it, as often as you like, for :class:`overfly.types.Frame`.

    ``len()`` counts the frames the source lists; pictures that turn out unreadable are passed over while
    iterating and named in ``problems``, so fewer frames may come. t_ns: (len,) stamps of the listed frames.
    read_frame: frame of an index, or None when it was passed over; read_imu: inertial samples, or None.
    attitude_at: what the attitude sensor says at any times (n,) of its clock; None without a record of it.
    """

    path: Path
    kind: SourceKind
    rig: Rig
    t_ns: IntArray
    read_frame: Callable[[int], Frame | None]
    problems: Problems
    sensors: Sequence[SensorSummary] = ()
    scale_landmark: ScaleLandmark | None = None
    landmark_clicks: Sequence[LandmarkClick] = ()
    read_imu: Callable[[], ImuRecord | None] = field(default=lambda: None, repr=False)
    attitude_at: Callable[[IntArray], Sequence[Attitude | None]] | None = field(default=None, repr=False)

    def __len__(self) -> int:
        return len(self.t_ns)

    def __iter__(self) -> Iterator[Frame]:
        for index in range(len(self)):
            frame = self.read_frame(index)
            if frame is not None:
                yield frame

    @cached_property
    def imu(self) -> ImuRecord | None:
        """Inertial samples in the body frame, read when first asked for; None when there are none."""
        return self.read_imu()
