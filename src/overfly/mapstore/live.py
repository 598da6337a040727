"""What ``overfly.Slam`` is: the heart, with a map that can be saved by ``slam.map.save("map.overfly")``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import overfly
import overfly.slam
from overfly.files import atomic_path
from overfly.mapstore.content import FlightEntry, FrameEntry
from overfly.mapstore.progress import progress_of
from overfly.mapstore.writer import MapWriter
from overfly.products.georeference import GeoReference
from overfly.visual_map import VisualMap


def flight_entry(slam: overfly.slam.Slam, source: str) -> FlightEntry:
    """The flight that a slam has flown or is about to. source: where its frames come from, in words."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return FlightEntry(
        0, source, now, f"overfly {overfly.__version__}", slam.source_rig, slam.config, progress_of(slam)
    )


def save_map(
    path: Path,
    slam: overfly.slam.Slam,
    source: str,
    frames: Sequence[FrameEntry],
    georeference: GeoReference | None = None,
) -> None:
    """Write the map of a slam, whole or not at all. Raises OutputError."""
    with atomic_path(path) as temporary:
        temporary.unlink(missing_ok=True)
        writer = MapWriter.begin(temporary, flight_entry(slam, source))
        writer.save(slam.map, frames, progress_of(slam), complete=True, georeference=georeference)
        writer.close()


@dataclass(slots=True, eq=False)
class LiveMap(VisualMap):
    """The map that a slam is making."""

    slam: overfly.slam.Slam | None = None

    def save(self, path: str | Path) -> None:
        """Write a map file, whole or not at all. Raises OutputError."""
        assert self.slam is not None
        frames = [
            FrameEntry(
                0, record.t_ns, record.frame_index, record.node,
                node_from_cam=record.node_from_cam, online=record.online,
            )
            for record in self.slam.records
        ]  # fmt: skip
        save_map(Path(path), self.slam, "frames from Python", frames)


class Slam(overfly.slam.Slam):
    """Simultaneous localisation and mapping for one rig. Feed it frames in the order of time."""

    @property
    def map(self) -> LiveMap:
        """The map so far."""
        return self._live_map

    @map.setter  # noqa: A003
    def map(self, empty: VisualMap) -> None:
        """The heart begins with an empty map; this is it, with a way to a file."""
        self._live_map = LiveMap(graph=empty.graph, nodes=empty.nodes, n_tracks=empty.n_tracks, slam=self)
