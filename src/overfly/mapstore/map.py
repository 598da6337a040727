"""A map in memory as a file holds it: what ``overfly.Map`` is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from overfly.config import Config
from overfly.mapstore import reader
from overfly.mapstore.content import FlightEntry, FrameEntry
from overfly.mapstore.database import connect_to_read, making_sense
from overfly.pieces import main_piece
from overfly.products.georeference import GeoReference
from overfly.types import BoolArray, Rig
from overfly.visual_map import VisualMap


@dataclass(slots=True, eq=False)
class Map:
    """A visual map, where it comes from, and the frames of its flights.

    flights: at least one; node_flights: for each node the number of its flight; frames: those of all
    flights, by flight and time; georeference: where the map lies on Earth, if that is known.
    """

    visual: VisualMap
    flights: list[FlightEntry]
    node_flights: list[int] = field(default_factory=list)
    frames: Sequence[FrameEntry] = field(default_factory=list)
    georeference: GeoReference | None = None
    path: Path | None = None

    @staticmethod
    def open(path: str | Path) -> Map:
        """Read a map file, which stays as it is. Raises MapFileError in one line for anything but a sound
        map."""
        path = Path(path)
        connection = connect_to_read(path)
        try:
            facts = reader.read_facts(connection, path)
            flights = reader.read_flights(connection, path)
            with making_sense(path, "its facts"):
                visual_map, node_flights = reader.read_visual_map(
                    connection, path, int(facts["tracks"]), len(flights)
                )
                frames = reader.read_frames(connection, path, len(flights), len(visual_map))
                counts = [len(visual_map), visual_map.graph.n_constraints, len(frames)]
                if list(facts["counts"]) != counts:
                    raise ValueError(
                        f"nodes, constraints, frames: {facts['counts']} were written, {counts} found"
                    )
                reference = _georeference(facts.get("georeference"))
        finally:
            connection.close()
        return Map(visual_map, flights, node_flights, frames, reference, path)

    @property
    def config(self) -> Config:
        """Settings that the map was made with, those of its first flight."""
        return self.flights[0].config

    @property
    def rig(self) -> Rig:
        """Cameras of the first flight, as they recorded."""
        return self.flights[0].rig

    @property
    def scale_source(self) -> str:
        """Where the metre of the map comes from."""
        start = self.flights[0].progress.get("start")
        return str(start["source"]) if start else "none"

    def main_piece(self) -> BoolArray:
        """(n,) whether a node belongs to the piece of the map in which most frames were located. Where
        others lie against it is reckoned only."""
        located = [frame.node for frame in self.frames if frame.node is not None]
        return main_piece(self.visual.graph, np.array(located, np.int64))

    def __len__(self) -> int:
        """Nodes."""
        return len(self.visual)

    @property
    def n_features(self) -> int:
        return sum(len(node.features) for node in self.visual.nodes)


def _georeference(tree: dict[str, Any] | None) -> GeoReference | None:
    if tree is None:
        return None
    x, y, z = (float(value) for value in tree["translation_m"])
    return GeoReference(str(tree["crs"]), float(tree["scale"]), float(tree["rotation_rad"]), (x, y, z))
