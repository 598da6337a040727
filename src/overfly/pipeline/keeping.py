"""The map file of a run: grows with the flight, outlives the run, and lets it carry on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from zlib import crc32

import numpy as np

from overfly.config import Config
from overfly.errors import MapFileError, OutputError, OverflyError, UsageError
from overfly.frame_records import FrameRecord
from overfly.frame_result import FrameResult
from overfly.mapstore import FlightEntry, FrameEntry, FrameLog, Map, MapWriter
from overfly.mapstore.blobs import rig_to_json
from overfly.mapstore.joining import join
from overfly.mapstore.live import flight_entry, save_map
from overfly.mapstore.progress import frame_entry, progress_of, restore
from overfly.mapstore.writer import write_whole
from overfly.products.georeference import GeoReference
from overfly.sensors import Flight
from overfly.slam import Slam
from overfly.types import Frame, NotFound
from overfly.vision.alignment import build_pyramid
from overfly.vision.observation import working_image

MAP_NAME = "map.overfly"
SET_ASIDE = "map.previous.overfly"  # the map of an earlier run, until the new one is complete
PARTS = ("", "-wal", "-shm", "-journal")  # a map that was killed has its newest part beside it


@dataclass(slots=True, eq=False)
class MapKeeper:
    """Takes every frame of a run and saves the map every half second of flight.

    entries: all frames so far, with those that were processed before the run was broken off.
    """

    writer: MapWriter
    slam: Slam
    entries: FrameLog = field(default_factory=FrameLog)
    first_picture: int | None = None  # its checksum, by which a flight is known again
    _records: Sequence[FrameRecord] | None = None

    def observe(self, frame: Frame, result: FrameResult) -> None:
        """A frame was processed. Raises OutputError when the map cannot be saved."""
        record = self.slam.records[-1] if result.pose is not None else None
        if self.first_picture is None:
            self.first_picture = crc32(frame.images[0].tobytes())
        self.entries.append(frame_entry(self.writer.flight.number, frame, result, record))
        if self.writer.is_due(frame.t_ns):
            self.save()

    def save(self, *, complete: bool = False, georeference: GeoReference | None = None) -> None:
        """Write what the file does not have yet. Raises OutputError."""
        self._follow_rescaling()
        if self.slam.refined_camera is not None:
            self.writer.flight = replace(self.writer.flight, rig=self.slam.source_rig)
        progress = progress_of(self.slam) | {"first_picture": self.first_picture}
        self.writer.save(self.slam.map, self.entries, progress, complete=complete, georeference=georeference)

    def rest_of(self, flight: Flight) -> Iterator[Frame]:
        """Frames of the flight that were not processed yet."""
        first = np.searchsorted(flight.t_ns, self.entries[-1].t_ns, side="right") if self.entries else 0
        for index in range(int(first), len(flight)):
            frame = flight.read_frame(index)
            if frame is not None:
                yield frame

    def join(self, older: Map) -> Map | NotFound:
        """The older map with this flight, or why they do not belong together. Raises UsageError when they
        are joined."""
        if self.writer.flight.number > 0:
            raise UsageError(f"{self.writer.path} is joined with an older map already")
        self._follow_rescaling()
        return join(older, self.slam, self.writer.flight, self.entries)

    def replace_by(self, joined: Map) -> None:
        """From now on the file holds this map. Raises OutputError."""
        self.writer.close()
        write_whole(self.writer.path, joined)

    def _follow_rescaling(self) -> None:
        """Rescaling renews all records: frames hang by other lengths then."""
        if self._records is not None and self._records is not self.slam.records:
            self.entries.rehang(self.slam.records)
        self._records = self.slam.records


def start_map(path: Path, flight: Flight, slam: Slam) -> MapKeeper:
    """A new map file for a flight that begins. Raises OutputError."""
    return MapKeeper(MapWriter.begin(path, flight_entry(slam, source_of(flight))), slam)


def continue_map(path: Path, flight: Flight, slam: Slam) -> MapKeeper:
    """The map of a run that was broken off, put into a Slam that has not seen a frame.

    Raises MapFileError, or UsageError when the flight, its reading or the settings are not those of that run.
    """
    known = Map.open(path)
    entry = known.flights[-1]
    _check_same_run(path, entry, known.frames, flight, slam.config)
    try:
        restore(slam, known, entry.number)
    except (ValueError, KeyError, TypeError) as error:
        raise MapFileError(f"{path}: its progress makes no sense: {error}") from error
    _bring_back_pictures(path, flight, slam)
    keeper = MapKeeper(MapWriter.carry_on(path, known), slam, FrameLog.of(known.frames))
    keeper.first_picture = entry.progress.get("first_picture")
    keeper._records = slam.records
    return keeper


def write_map(
    path: Path,
    flight: Flight,
    slam: Slam,
    frames: FrameLog,
    place: GeoReference | None,
) -> None:
    """The map of a run that kept none while it flew, whole or not at all. Raises OutputError."""
    frames.rehang(slam.records)
    save_map(path, slam, source_of(flight), frames, place)


def source_of(flight: Flight) -> str:
    return str(flight.path.resolve())


def _check_same_run(
    path: Path, entry: FlightEntry, frames: Sequence[FrameEntry], flight: Flight, config: Config
) -> None:
    if entry.config.hash() != config.hash():
        raise UsageError(f"{path} was made with other settings: --resume needs the same")
    if rig_to_json(entry.rig) != rig_to_json(flight.rig):
        raise UsageError(f"{path} was made with another calibration: --resume needs the same")
    stamps = set(flight.t_ns.tolist())
    index = frames[0].frame_index if len(frames) else len(flight)
    first = flight.read_frame(index) if index < len(flight) else None
    picture = None if first is None else crc32(first.images[0].tobytes())
    if picture != entry.progress.get("first_picture") or any(frame.t_ns not in stamps for frame in frames):
        raise UsageError(f"{path} was made from other frames than {flight.path} has: --resume needs the same")


def _bring_back_pictures(path: Path, flight: Flight, slam: Slam) -> None:
    """The newest nodes are tracked from their pictures, which are not in the file."""
    for node in slam.map.pictured():
        frame = flight.read_frame(node.frame_index)
        if frame is None or frame.t_ns != node.t_ns:
            raise UsageError(f"{path}: frame {node.frame_index} of {flight.path} is not the one it was")
        node.pyramid = build_pyramid(working_image(frame.images[0], slam.rig.cam0.camera))


@contextmanager
def keeping_map(folder: Path, flight: Flight, slam: Slam, resume: bool) -> Iterator[MapKeeper]:
    """The map of a run, in its folder. resume: carry on with the one that is there, if there is one.

    Otherwise one that is there stays under another name until the new one is complete, and comes back if
    the new one never held anything. When the block fails, what was mapped until then is in the file.
    """
    path, aside = folder / MAP_NAME, folder / SET_ASIDE
    resume = resume and path.exists()
    had_one = not resume and path.exists()
    if had_one:
        _move(path, aside)
    keeper = None
    try:
        keeper = continue_map(path, flight, slam) if resume else start_map(path, flight, slam)
        yield keeper
    except BaseException:
        if keeper is not None:
            with suppress(OverflyError):  # the reason for ending is what counts, and may be the same
                keeper.writer.close()
        if not resume and not slam.records:
            _remove(path)
            if had_one:
                _move(aside, path)
        raise
    keeper.writer.close()
    _remove(aside)


def _move(old: Path, new: Path) -> None:
    _remove(new)
    try:
        for part in PARTS[::-1]:
            if (there := old.with_name(old.name + part)).exists():
                there.replace(new.with_name(new.name + part))
    except OSError as error:
        raise OutputError(f"cannot move {old} to {new}: {error.strerror or error}") from error


def _remove(path: Path) -> None:
    try:
        for part in PARTS:
            path.with_name(path.name + part).unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"cannot remove {path}: {error.strerror or error}") from error
