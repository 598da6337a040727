"""The map while it grows, in the browser.

The loop over frames leaves snapshots, the newest wins; a thread of its own draws them a few times a second.
Nothing here holds the loop up, changes the map, or ends a run when it fails.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import viser

from overfly.frame_result import FrameResult
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.localizer import Fix
from overfly.mapstore import Map
from overfly.slam import Slam
from overfly.types import Frame
from overfly.viewer.allowance import Allowance, cpu_seconds
from overfly.viewer.drape import Drape
from overfly.viewer.ground import Surface
from overfly.viewer.known_ground import draw_ground, terrain_of
from overfly.viewer.measuring import GroundClicks, Measurement, describe
from overfly.viewer.moment import Moment, NewNode, new_node, reason_of, region_of, sigma_of
from overfly.viewer.panel import annotated, badge, length, table
from overfly.viewer.scene import GraphState, MapScene, wxyz
from overfly.viewer.server import WebPage
from overfly.visual_map import VisualMap

PERIOD_S, GRAPH_PERIOD_S = 0.25, 0.75  # vehicle, picture, new ground; nodes, constraints, visitors' cameras
SHARE, SAVED_S = 0.02, 0.01  # of a core, that drawing may take, the server included; for a burst
MOST_WAITING = 64  # new nodes between two drawings; what is more is not drawn
MOST_MOVED = 100  # pieces of ground that follow the map per drawing
FOLLOWED_SHARE = 0.1  # of the flying height: cameras of visitors move in steps no smaller
ARRIVAL = np.array([0.0, -2.5, 3.5])  # flying heights: from where a visitor first sees the vehicle
MOST_PATH_PLACES = 1000  # of the vehicle, where there are no nodes to draw the path through
MOVED_SHARE = 2e-3  # of the flying height: a smaller shift cannot be seen

log = logging.getLogger("overfly.viewer")


@dataclass(slots=True, eq=False)
class _Piece:
    handle: viser.GlbHandle
    lift_m: float
    scale: float
    position: FloatArray
    quaternion: FloatArray


class LiveViewer:
    """Shows a Slam at work, or frames being found in a map that does not change."""

    def __init__(
        self,
        page: WebPage,
        camera: Camera,
        visual_map: VisualMap,
        slam: Slam | None = None,
        known: Map | None = None,
        *,
        measures: bool = True,
        follows: bool = True,
    ) -> None:
        """camera: that of the frames, as recorded. slam: when the map grows; known: if there was one before.

        measures: clicks measure; follows: visitors' cameras go with the vehicle, until they do not want that.
        """
        self._known, self._measures = known, measures
        self.page = page
        self.on_tick: list[Callable[[Moment], None]] = []  # more to draw, in the drawing thread
        self.tells_state = True  # whether the vehicle is located, above the numbers
        self.on_place: Callable[[Measurement], None] = self._measured  # a click on the ground
        self.surface: Surface | None = None
        self._camera = camera
        self._map = visual_map
        self._slam = slam
        self._drape = Drape(camera)
        self._pieces: dict[int, _Piece] = {}
        self._places: list[FloatArray] = []  # of the ground below nodes
        self._draw: MapScene | None = None
        self._path: list[FloatArray] = []
        self._n_frames = 0
        self._due_s = self._graph_due_s = 0.0
        self._first_height_m: float | None = None
        self._scale = 1.0
        self._n_revisits = 0
        self._told: tuple[bool, str] | None = None
        self._rates: deque[tuple[float, int]] = deque(maxlen=14)
        self._waiting: deque[NewNode] = deque(maxlen=MOST_WAITING)
        self._latest: Moment | None = None
        self._wake, self._closed = threading.Event(), threading.Event()
        self._rested = True  # whether the drawing thread may spend more
        self._allowance = Allowance(SHARE, SAVED_S, lambda: cpu_seconds(page.threads))
        self._controls(page.server.gui, follows)
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    # -- in the thread of the loop

    def show_frame(self, frame: Frame, result: FrameResult | Fix) -> None:
        """A frame was processed; a few microseconds, or a fraction of a millisecond when a drawing is due."""
        if not self._thread.is_alive():
            return
        self._n_frames += 1
        if self._slam is not None and isinstance(result, FrameResult) and result.node is not None:
            self._waiting.append(new_node(frame, result.node, self._slam, self._map_scale(self._slam)))
        now = time.perf_counter()
        if now >= self._due_s and self._rested:
            self._due_s = now + PERIOD_S
            graph_due = now >= self._graph_due_s
            if graph_due:
                self._graph_due_s = now + GRAPH_PERIOD_S
            self._latest = self._moment(frame, result, graph_due)
            self._wake.set()

    def close(self) -> None:
        """Draw what is left and end the page."""
        self._closed.set()
        self._wake.set()
        self._thread.join(timeout=5.0)
        self.page.close()

    def _map_scale(self, slam: Slam) -> float:
        if slam.start is None:
            return 1.0
        if self._first_height_m is None:
            self._first_height_m = slam.start.height_m
        return slam.start.height_m / self._first_height_m

    def _moment(self, frame: Frame, result: FrameResult | Fix, graph_due: bool) -> Moment:
        slam, visual_map = self._slam, self._map
        points = np.zeros((0, 3))
        if result.pose is not None and len(visual_map):
            points = visual_map.points_in_world(visual_map.nodes[self._nearest_node(result.pose)])
        return Moment(
            frame.t_ns, frame.images[0], result.pose, reason_of(result), sigma_of(result.covariance),
            result.n_inliers, points,
            region_of(slam) if slam is not None and graph_due else None,
            GraphState.of(visual_map.graph) if graph_due else None,
            self._n_frames, len(visual_map), 1.0 if slam is None else self._map_scale(slam),
        )  # fmt: skip

    def _nearest_node(self, pose: Pose) -> int:
        """The node above the place nearest to the camera's."""
        away = self._map.graph.positions[:, :2] - pose.translation[:2]
        return int(np.argmin((away * away).sum(axis=1)))

    # -- in the drawing thread

    def _run(self) -> None:
        while not self._closed.is_set():
            self._wake.wait()
            self._wake.clear()
            moment = self._latest
            if moment is None:
                continue
            try:
                with self.page.server.atomic():
                    self._show(moment)
            except Exception:  # a page that cannot be drawn must not end a flight
                log.exception("the live view failed and is no longer updated")
                return
            self._rest()

    def _rest(self) -> None:
        """Until what was drawn is paid for; setting the page up is free. The newest frame is drawn then."""
        wait_s = 0.0 if self._draw is None else self._allowance.wait_s()
        if wait_s > 0.0:
            self._rested = False
            self._closed.wait(wait_s)
            self._rested = True

    def _show(self, moment: Moment) -> None:
        if moment.pose is not None:
            self._begin(moment)
            self._path.append(moment.pose.translation)
            self._path = self._path[-MOST_PATH_PLACES:]
        if self._draw is None:
            return
        self._draw.show_vehicle(moment.pose)
        self._lay_ground()
        if moment.graph is not None:
            self._show_graph(moment.graph, moment)
        if moment.pose is not None:
            self._draw.show_path(np.array(self._path), "/path/newest")
        if self.page.server.get_clients():  # nobody looks: nothing to encode
            self._picture.image = annotated(moment, self._camera)
        state = (moment.pose is None, moment.reason)
        if moment.graph is not None or state != self._told:  # numbers that change faster cannot be read
            self._told = state
            self._numbers.content = self._describe(moment)
            self._follow(moment)  # asks each visitor where it looks
        for draw_more in self.on_tick:
            draw_more(moment)

    def _begin(self, moment: Moment) -> None:
        """The first pose tells how large things should be."""
        if self._draw is not None or moment.pose is None:
            return
        place = moment.pose.translation
        z = moment.points[np.isfinite(moment.points[:, 2]), 2]
        ground_m = float(np.median(z)) if len(z) else 0.0
        unit_m = max(float(place[2]) - ground_m, 1e-3)
        server = self.page.server
        self._draw = MapScene(server, self._camera, unit_m)
        GroundClicks(server, lambda: self.surface, 0.02 * unit_m, self._placed, self._measures)
        if self._known is not None:
            folder = None if self._known.path is None else self._known.path.parent
            terrain = terrain_of(self._known, folder)
            self.surface = terrain.surface
            draw_ground(server, self._known, folder, terrain, unit_m)
        with self._show_folder:
            self._draw.add_switches(server.gui)
        places = place[None] if self._known is None else self._known.visual.graph.positions
        low, high = places.min(axis=0) - 1.5 * unit_m, places.max(axis=0) + 1.5 * unit_m
        low[2] = ground_m
        self._draw.look_from_above(server, low, high)
        if self._slam is None:
            self._draw.show_graph(GraphState.of(self._map.graph))

    @property
    def unit_m(self) -> float | None:
        """The flying height at the beginning, by which sizes are chosen; None before the first pose."""
        return None if self._draw is None else self._draw.unit_m

    @property
    def ground_m(self) -> float:
        """Height of the newest ground, world."""
        return float(self._places[-1][2]) if self._places else 0.0

    def _lay_ground(self) -> None:
        """Pieces of ground for the nodes that came since the last drawing."""
        laid = False
        while self._waiting:
            node = self._waiting.popleft()
            if node.scale != self._scale:
                self._drape.rescale(node.scale / self._scale)
                self._places = [place * (node.scale / self._scale) for place in self._places]
                self._scale = node.scale
            piece = self._drape.add(node.index, node.picture, node.world_from_cam, node.ground_m)
            if piece is None:
                continue
            pose = node.world_from_cam
            place = raised(pose.translation, piece.lift_m)
            handle = self.page.server.scene.add_glb(
                f"/ground/{node.index}", piece.mesh, position=place, wxyz=wxyz(pose.quaternion()),
                cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
            self._pieces[node.index] = _Piece(
                handle, piece.lift_m, node.scale, pose.translation, pose.quaternion()
            )
            self._places.append(np.array([place[0], place[1], node.ground_m]))
            laid = True
        for gone in self._drape.outgrown():
            self._pieces.pop(gone).handle.remove()
        if laid and self._known is None:
            self.surface = Surface.below_nodes(np.array(self._places))

    def _show_graph(self, graph: GraphState, moment: Moment) -> None:
        assert self._draw is not None
        if self._slam is not None:
            self._draw.show_graph(graph)
            self._draw.show_path(graph.positions)
            # Between nodes the vehicle's own places are shown.
            self._path = [graph.positions[-1], *self._path[-1:]]
        if moment.pose is not None:
            centre = np.array([*moment.pose.translation[:2], self.ground_m + 0.01 * self._draw.unit_m])
            self._draw.show_region(centre, moment.region)
        self._move_pieces(graph, moment.scale)

    def _move_pieces(self, graph: GraphState, scale: float) -> None:
        """Let the ground follow the optimised map, what moved most first."""
        nodes = np.array([node for node in self._pieces if node < len(graph.positions)], np.int64)
        if len(nodes) == 0:
            return
        assert self._draw is not None
        drawn = np.array([self._pieces[node].position for node in nodes.tolist()])
        turned = np.array([self._pieces[node].quaternion for node in nodes.tolist()])
        shift = np.linalg.norm(graph.positions[nodes] - drawn, axis=1)
        shift += self._draw.unit_m * np.abs(graph.quaternions[nodes] - turned).max(axis=1)
        order = np.argsort(-shift)[:MOST_MOVED]
        for node in nodes[order[shift[order] > MOVED_SHARE * self._draw.unit_m]].tolist():
            piece = self._pieces[node]
            piece.position, piece.quaternion = graph.positions[node], graph.quaternions[node]
            piece.handle.position = raised(piece.position, piece.lift_m)
            piece.handle.wxyz = wxyz(piece.quaternion)
            piece.handle.scale = scale / piece.scale

    def _controls(self, gui: viser.GuiApi, follows: bool) -> None:
        self.top = gui.add_folder(None)  # for what others have to say first
        self._numbers = gui.add_html(badge("waiting for the first frame", "#777"))
        self._picture = gui.add_image(np.zeros((8, 8, 3), np.uint8))
        self._follow_box = gui.add_checkbox("Follow the vehicle", initial_value=follows)
        with gui.add_folder("Measure", expand_by_default=False, visible=self._measures):
            self._measure = gui.add_markdown("Click on the ground: coordinates; click again: distance.")
        self._show_folder = gui.add_folder("Show", expand_by_default=False)
        self._visitors: set[int] = set()

    def _placed(self, found: Measurement) -> None:
        self.on_place(found)

    def _measured(self, measurement: Measurement) -> None:
        self._measure.content = describe(measurement)

    def _follow(self, moment: Moment) -> None:
        """Turn visitors' cameras to the vehicle: once on arrival, then as long as they want to follow."""
        if moment.pose is None or self._draw is None:
            return
        target = np.array([*moment.pose.translation[:2], self.ground_m])
        for number, client in self.page.server.get_clients().items():
            if number not in self._visitors:
                self._visitors.add(number)
                client.camera.position = target + self._draw.unit_m * ARRIVAL
                client.camera.look_at = target
            elif self._follow_box.value:
                step = target - client.camera.look_at
                if np.linalg.norm(step) > FOLLOWED_SHARE * self._draw.unit_m:
                    client.camera.position = client.camera.position + step  # what is looked at moves along

    def _describe(self, moment: Moment) -> str:
        self._rates.append((time.perf_counter(), moment.n_frames))
        (before_s, before), (now_s, now) = self._rates[0], self._rates[-1]
        rate = (now - before) / (now_s - before_s) if now_s > before_s else math.nan
        state = (
            badge(f"located &plusmn; {length(moment.sigma_m)}", "#1b8a4b")
            if moment.pose is not None
            else badge(f"lost: {moment.reason}", "#c62828")
        )
        rows = [("frames", f"{moment.n_frames} ({rate:.0f} per second)"), ("nodes", str(moment.n_nodes))]
        if moment.graph is not None:
            self._n_revisits = moment.graph.n_revisits
        rows += [("revisits", str(self._n_revisits)), ("inliers", str(moment.n_inliers))]
        if moment.pose is not None:
            x, y, z = moment.pose.translation
            rows.append(("position", f"{x:.2f}, {y:.2f}, {z:.2f} m"))
        return (state if self.tells_state else "") + table(rows)


def raised(place: FloatArray, lift_m: float) -> FloatArray:
    """(3,) metres, world."""
    return np.asarray(place + np.array([0.0, 0.0, lift_m]))
