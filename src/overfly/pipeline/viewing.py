"""overfly view: a map file or a folder of results becomes a page."""

from __future__ import annotations

from pathlib import Path

from overfly.errors import OverflyError, UsageError
from overfly.mapstore import Map
from overfly.pipeline.keeping import MAP_NAME
from overfly.sensors import Flight, open_flight
from overfly.types import UInt8Array
from overfly.viewer.finished import FinishedView, Pictures, view_map


def open_view(source: Path, port: int | None) -> FinishedView:
    """Serve it on this machine's own address, until it is closed. Raises OverflyError in one line each."""
    path = source / MAP_NAME if source.is_dir() else source
    if not path.exists():
        where = f"{source} holds no {MAP_NAME}" if source.is_dir() else f"there is no {source}"
        raise UsageError(f"{where}: name a map file or the folder that overfly map wrote")
    known = Map.open(path)
    if len(known) == 0:
        raise UsageError(f"{path} holds no node: there is nothing to show")
    return view_map(known, path.parent, port, _pictures_of(known))


def _pictures_of(known: Map) -> Pictures | None:
    """The flight's own pictures, if they are still where they were; stamps tell whether they are the same."""
    entry = known.flights[-1]
    try:
        flight = open_flight(Path(entry.source))
    except (OverflyError, OSError):
        return None
    stamps = {frame.frame_index: frame.t_ns for frame in known.frames if frame.flight == entry.number}
    if not all(_stamp(flight, index) == t_ns for index, t_ns in stamps.items()):
        return None

    def picture(index: int) -> UInt8Array | None:
        frame = flight.read_frame(index)
        return None if frame is None else frame.images[0]

    return picture


def _stamp(flight: Flight, index: int) -> int | None:
    return int(flight.t_ns[index]) if index < len(flight) else None
