"""What a run over a flight leaves in memory: the map, where each frame was, what was lost and
why, the time.
"""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Any, Protocol

import numpy as np

from overfly.frame_records import FrameRecord
from overfly.frame_result import FrameResult
from overfly.geometry.poses import Pose
from overfly.mapstore import FrameLog
from overfly.mapstore.progress import frame_entry
from overfly.pipeline.keeping import MapKeeper
from overfly.pipeline.node_pictures import KeptPictures
from overfly.pipeline.prefetch import read_ahead
from overfly.revisit.outcome import RevisitStatus
from overfly.slam import Slam
from overfly.threads import is_compiled, one_opencv_thread
from overfly.trajectory import Trajectory
from overfly.types import Frame, GeoPosition, Reason
from overfly.viewer.interface import NullViewer, Viewer

Progress = Callable[[int, FrameResult], None]


class Interruptible(Protocol):
    """Work that Ctrl-C marks, to be ended at the next good moment."""

    interrupted: bool


@dataclass(slots=True, eq=False)
class Recording:
    """One flight as Slam saw it. frames: what became of each, in the order of time; pictures: of nodes."""

    slam: Slam
    frames: FrameLog = field(default_factory=FrameLog)
    positions: dict[int, GeoPosition] = field(default_factory=dict)  # by time in nanoseconds
    wall_s: float = 0.0
    compiled_first: bool = False  # a first start, whose times hold a minute of that
    interrupted: bool = False
    keeper: MapKeeper | None = None  # of the map file, where one is kept while flying
    pictures: KeptPictures = field(init=False)

    def __post_init__(self) -> None:
        self.pictures = KeptPictures(self.slam.config.mosaic.max_width_px)

    def observe(self, frame: Frame, result: FrameResult) -> None:
        """A frame was processed. Raises OutputError when a map that is kept cannot be saved."""
        if result.node is not None:
            self.pictures.keep(frame, self.slam.source_rig)
        if frame.position is not None:
            self.positions[frame.t_ns] = frame.position
        if self.keeper is not None:
            self.keeper.observe(frame, result)
        else:
            record = self.slam.records[-1] if result.pose is not None else None
            self.frames.append(frame_entry(0, frame, result, record))

    @property
    def n_located(self) -> int:
        return len(self.slam.placed())

    def lost_by_reason(self) -> dict[str, int]:
        """How many frames were lost, by reason; those in a piece of map that nothing ties to the main one
        count as lost."""
        reasons = Counter(str(frame.reason) for frame in self.frames if frame.node is None)
        reasons[str(Reason.OTHER_PIECE)] = len(self.slam.records) - self.n_located
        return {reason: count for reason, count in reasons.items() if count > 0}

    def revisits(self) -> dict[str, Any]:
        """How often a place was sought again and found, and why not when it was not."""
        sought = [frame.revisit for frame in self.frames if frame.revisit is not None]
        tried = [revisit for revisit in sought if revisit.status is not RevisitStatus.NONE_NEAR]
        confirmed = sum(len(revisit.confirmed) for revisit in tried)
        reasons = Counter(str(revisit.reason) for revisit in tried if revisit.reason is not None)
        reasons[str(Reason.INCONSISTENT)] -= confirmed  # these waited, and were believed later
        return {
            "tried": len(tried),
            "accepted": sum(revisit.status is RevisitStatus.ACCEPTED for revisit in tried) + confirmed,
            "constraints": sum(revisit.constraint is not None for revisit in tried) + confirmed,
            "rejected": {reason: count for reason, count in sorted(reasons.items()) if count > 0},
        }

    def trajectory(self) -> Trajectory:
        """world_from_cam of every located frame as the graph has it now."""
        return self._trajectory(self.slam.pose_of)

    def online(self) -> Trajectory:
        """world_from_cam of every located frame as it was known when it had just been processed; without
        those that were placed only later."""
        records = self.slam.placed()
        usual = Counter(record.piece for record in records).most_common(1)
        known = [record for record in records if record.piece == usual[0][0]]
        return Trajectory.from_poses([one.t_ns for one in known], [one.online for one in known])

    def odometry(self) -> Trajectory:
        """world_from_cam of every located frame by visual odometry alone."""
        nodes = self.slam.map.odometry_poses()
        return self._trajectory(lambda record: nodes[record.node] @ record.node_from_cam)

    def stage_seconds(self) -> dict[str, dict[str, float]]:
        """Per stage, over the frames in which it ran: p50, p95 and max, in seconds."""
        return stage_seconds(frame.seconds for frame in self.frames)

    def _trajectory(self, pose_of: Callable[[FrameRecord], Pose]) -> Trajectory:
        records = self.slam.placed()
        return Trajectory.from_poses(
            [record.t_ns for record in records], [pose_of(record) for record in records]
        )


def stage_seconds(of_frames: Iterable[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Of each stage, over the frames in which it ran: p50, p95 and max, in seconds."""
    stages: dict[str, list[float]] = {}
    for of_frame in of_frames:
        for stage, seconds in of_frame.items():
            stages.setdefault(stage, []).append(seconds)
    return {
        stage: {
            "p50": float(np.percentile(seconds, 50)),
            "p95": float(np.percentile(seconds, 95)),
            "max": float(max(seconds)),
        }
        for stage, seconds in stages.items()
    }


def record_flight(
    frames: Iterable[Frame],
    slam: Slam,
    progress: Progress,
    keeper: MapKeeper | None = None,
    viewer: Viewer | None = None,
) -> Recording:
    """Feed all frames to slam. An interrupt (Ctrl-C) ends after the current frame; what was found is kept.

    keeper: of the map file; what it remembers of a run that was broken off comes first.
    viewer: is shown every frame.
    """
    recording = Recording(slam, keeper=keeper)
    viewer = viewer or NullViewer()
    if keeper is not None:
        recording.frames = keeper.entries
    before_s = sum(sum(frame.seconds.values()) for frame in recording.frames)
    recording.positions |= {
        frame.t_ns: frame.position for frame in recording.frames if frame.position is not None
    }
    recording.compiled_first = not is_compiled()
    begin = time.perf_counter()
    ahead = closing(read_ahead(frames, slam.observe))
    with one_opencv_thread(), interrupt_deferred(recording), ahead as views:
        while not recording.interrupted:
            try:
                view = next(views, None)
                if view is None:
                    break
                frame, result = view.frame, slam.process(view)
                recording.observe(frame, result)
                progress(len(recording.frames), result)
                viewer.show_frame(frame, result)
            except KeyboardInterrupt:
                recording.interrupted = True
    slam.finish()
    recording.wall_s = before_s + time.perf_counter() - begin
    return recording


@contextmanager
def interrupt_deferred(recording: Interruptible) -> Iterator[None]:
    """Ctrl-C marks the recording, so that no frame is left half in the map; a second one acts at once."""

    def mark(number: int, stack: FrameType | None) -> None:
        if recording.interrupted:
            signal.default_int_handler(number, stack)
        recording.interrupted = True

    if threading.current_thread() is not threading.main_thread():
        yield  # signals come to the main thread only
        return
    previous = signal.signal(signal.SIGINT, mark)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous or signal.SIG_DFL)


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far; NaN on systems that do not tell."""
    try:
        import resource
    except ImportError:
        return float("nan")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024.0**2 if sys.platform == "darwin" else 1024.0)
