"""A finished map in the browser: the mosaic on the elevation, path, nodes and constraints, and a time slider
that plays the flight back.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import viser

from overfly.geometry.poses import FloatArray, Pose
from overfly.mapstore import Map
from overfly.types import IntArray, UInt8Array
from overfly.viewer.ground import Surface
from overfly.viewer.known_ground import draw_ground, terrain_of
from overfly.viewer.measuring import GroundClicks, Measurement, describe
from overfly.viewer.scene import PATH_AHEAD, GraphState, MapScene
from overfly.viewer.server import LOCAL_HOST, WebPage, open_page

TICK_S = 0.1  # of playback
SPEEDS = ("1x", "2x", "5x", "20x")
SHOWN_WIDTH_PX = 320
FOOTPRINT = 0.6  # of the flying height: how far beside its camera a picture reaches, for most lenses

Pictures = Callable[[int], UInt8Array | None]  # frame index -> its picture


@dataclass(frozen=True, slots=True, eq=False)
class FlownPath:
    """Located frames in the order of time: t_s (n,) seconds since the first; positions (n, 3); poses;
    frame_index (n,); n_nodes (n,) nodes of the map that existed then.
    """

    t_s: FloatArray
    positions: FloatArray
    poses: list[Pose]
    frame_index: IntArray
    n_nodes: IntArray

    @staticmethod
    def of(known: Map) -> FlownPath:
        """The last flight of a map."""
        flight = known.flights[-1].number
        frames = [frame for frame in known.frames if frame.flight == flight and frame.node is not None]
        poses = [
            known.visual.graph.pose(frame.node) @ frame.node_from_cam
            for frame in frames
            if frame.node is not None and frame.node_from_cam is not None
        ]
        t_ns = np.array([frame.t_ns for frame in frames], np.int64)
        node_t = [
            node.t_ns if number == flight else 0
            for node, number in zip(known.visual.nodes, known.node_flights, strict=True)
        ]
        return FlownPath(
            1e-9 * (t_ns - t_ns[:1]).astype(np.float64),
            np.array([pose.translation for pose in poses]).reshape(-1, 3),
            poses,
            np.array([frame.frame_index for frame in frames], np.int64),
            np.searchsorted(np.maximum.accumulate(np.array(node_t, np.int64)), t_ns, side="right"),
        )

    def row_at(self, t_s: float) -> int:
        """The last frame at or before this time."""
        return max(0, int(np.searchsorted(self.t_s, t_s + 1e-6, side="right")) - 1)


class FinishedView:
    """Serves one finished map until it is closed."""

    def __init__(self, page: WebPage, known: Map, folder: Path, pictures: Pictures | None = None) -> None:
        """folder: where mosaic.tif and elevation.tif are, if they are. Raises SourceError when one of them
        cannot be read.
        """
        self.page = page
        self._pictures = pictures
        self._graph = GraphState.of(known.visual.graph)
        self.path = FlownPath.of(known)
        self.terrain = terrain_of(known, folder)
        server = page.server
        places = np.concatenate([self._graph.positions, self.path.positions])
        low, high = places.min(axis=0), places.max(axis=0)
        ground_m = float(np.median(self.terrain.height_at(places[:, 0], places[:, 1])))
        unit_m = max(float(np.median(places[:, 2])) - ground_m, 1e-3)
        self._draw = MapScene(server, known.rig.cam0.camera, unit_m)
        low[2] = ground_m
        beside = FOOTPRINT * unit_m * np.array([1.0, 1.0, 0.0])
        self._draw.look_from_above(server, low - beside, high + beside)
        draw_ground(server, known, folder, self.terrain, unit_m)
        self._draw.show_path(self.path.positions, "/path/ahead", PATH_AHEAD)
        self._playing = False
        self._closed = threading.Event()
        self._shown_row = -1
        self._lock = threading.Lock()
        self._controls(server, known)
        GroundClicks(server, lambda: self.surface, 0.02 * unit_m, self._measured)
        self._georeference = known.georeference
        self.show_time(float(self.path.t_s[-1]) if len(self.path.t_s) else 0.0)
        self._player = threading.Thread(target=self._play, name="playback", daemon=True)
        self._player.start()

    @property
    def surface(self) -> Surface:
        return self.terrain.surface

    def vehicle_position(self) -> FloatArray:
        """(3,) metres, world: where the vehicle is drawn."""
        return self._draw.vehicle_position()

    def show_time(self, t_s: float) -> None:
        """The map and the vehicle as they stood t_s seconds after the first frame."""
        if len(self.path.t_s) == 0:
            if self._shown_row < 0:
                self._shown_row = 0
                self._draw.show_graph(self._graph)
            return
        with self._lock:
            row = self.path.row_at(t_s)
            if row == self._shown_row:
                return
            self._shown_row = row
            self._draw.show_vehicle(self.path.poses[row])
            self._draw.show_path(self.path.positions[: row + 1])
            self._draw.show_graph(self._graph.up_to(int(self.path.n_nodes[row])))
            self._numbers.content = self._describe(row)
            picture = self._pictures(int(self.path.frame_index[row])) if self._pictures else None
            if picture is not None and self._picture is not None:
                self._picture.image = shown_picture(picture)

    def wait(self) -> None:
        """Until the view is closed, or Ctrl-C."""
        self._closed.wait()

    def close(self) -> None:
        self._closed.set()
        self._player.join(timeout=2.0)
        self.page.close()

    def _controls(self, server: viser.ViserServer, known: Map) -> None:
        gui = server.gui
        end_s = float(self.path.t_s[-1]) if len(self.path.t_s) else 0.0
        with gui.add_folder("Playback"):
            end_s = max(math.ceil(10.0 * end_s) / 10.0, 0.1)
            self.slider = gui.add_slider("Time (s)", 0.0, end_s, 0.1, end_s)
            self._button = gui.add_button("Play")
            self._speed = gui.add_dropdown("Speed", SPEEDS, initial_value="2x")
        self._picture = gui.add_image(np.zeros((8, 8, 3), np.uint8)) if self._pictures else None
        self._numbers = gui.add_markdown("")
        with gui.add_folder("Measure"):
            self._measure = gui.add_markdown("Click on the ground: coordinates; click again: distance.")
        with gui.add_folder("Show", expand_by_default=False):
            self._draw.add_switches(server.gui)
        gui.add_markdown(f"{len(known)} nodes, scale from {known.scale_source}")
        self._button.on_click(lambda _event: self._toggle())

    def _toggle(self) -> None:
        self._playing = not self._playing
        self._button.label = "Pause" if self._playing else "Play"
        if self._playing and self.slider.value >= self.slider.max - 1e-6:
            set_value(self.slider, 0.0)

    def _play(self) -> None:
        """Follow the slider, however fast it is drawn, and move it while playing."""
        while not self._closed.wait(TICK_S):
            if self._playing:
                step = TICK_S * float(self._speed.value.removesuffix("x"))
                set_value(self.slider, min(self.slider.value + step, self.slider.max))
                if self.slider.value >= self.slider.max - 1e-6:
                    self._toggle()
            self.show_time(self.slider.value)

    def _describe(self, row: int) -> str:
        x, y, z = self.path.positions[row]
        graph = self._graph.up_to(int(self.path.n_nodes[row]))
        return (
            f"**{self.path.t_s[row]:.1f} s**, frame {int(self.path.frame_index[row])}\n\n"
            f"x {x:.2f} m, y {y:.2f} m, z {z:.2f} m\n\n"
            f"{len(graph.positions)} nodes, {graph.n_revisits} revisits"
        )

    def _measured(self, measurement: Measurement) -> None:
        self._measure.content = describe(measurement, self._georeference)


def set_value(handle: viser.GuiInputHandle[Any], value: Any) -> None:
    """Type checkers take the property for read-only."""
    setattr(handle, "value", value)  # noqa: B010


def shown_picture(picture: UInt8Array) -> UInt8Array:
    """(h, w, 3), small enough to be sent often."""
    every = max(1, picture.shape[1] // SHOWN_WIDTH_PX)
    small = picture[::every, ::every]
    return np.ascontiguousarray(small if small.ndim == 3 else np.repeat(small[..., None], 3, axis=2))


def view_map(known: Map, folder: Path, port: int | None, pictures: Pictures | None = None) -> FinishedView:
    """Serve a finished map on this machine's own address. Raises OutputError, SourceError."""
    page = open_page("Overfly", LOCAL_HOST, port)
    try:
        return FinishedView(page, known, folder, pictures)
    except BaseException:
        page.close()
        raise
