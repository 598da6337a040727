"""What is drawn: ground, nodes, constraints, path, vehicle, its three-sigma region. Live views and playback
share it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import viser

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.pose_graph import KINDS, PoseGraph, State
from overfly.types import BoolArray, ConstraintKind, IntArray

PATH, PATH_AHEAD = (255, 196, 0), (120, 110, 80)
NODE = (235, 235, 235)
ODOMETRY, REVISIT, REJECTED = (150, 150, 150), (0, 230, 118), (255, 61, 0)
VEHICLE, LOST, REGION = (64, 156, 255), (255, 61, 0), (213, 120, 255)
LAYERS = ("ground", "path", "nodes", "constraints")
MOST_PATH_POINTS = 2000
PANEL_SHARE = 0.15  # of the map's size, that it is moved out from under the panel on the right
MOST_LINES = 8000
ELLIPSE_POINTS = 48
REGION_SIGMAS = 3.0
ARRIVAL = np.array([0.0, -math.sin(0.54), math.cos(0.54)])  # of a visitor's camera, from what it looks at
FIELD_RAD = math.radians(50.0)  # from the lower edge of the page to the upper one
LEAST_ASPECT = 1.2  # of pages, width by height


@dataclass(frozen=True, slots=True, eq=False)
class GraphState:
    """A pose graph as it was at one moment, n nodes, m constraints; a copy that nobody changes.

    positions (n, 3) metres, world; quaternions (n, 4) xyzw of world_from_node; i, j (m,); is_revisit,
    is_active (m,).
    """

    positions: FloatArray
    quaternions: FloatArray
    i: IntArray
    j: IntArray
    is_revisit: BoolArray
    is_active: BoolArray

    @staticmethod
    def of(graph: PoseGraph) -> GraphState:
        return GraphState(
            graph.positions.copy(),
            graph.quaternions.copy(),
            graph.i.copy(),
            graph.j.copy(),
            graph.kinds == KINDS.index(ConstraintKind.REVISIT),
            graph.states == State.ACTIVE,
        )

    @property
    def n_revisits(self) -> int:
        """Revisits that the map believes."""
        return int(np.count_nonzero(self.is_revisit & self.is_active))

    def up_to(self, n_nodes: int) -> GraphState:
        """The first nodes and what joins them."""
        kept = (self.i < n_nodes) & (self.j < n_nodes)
        return GraphState(
            self.positions[:n_nodes], self.quaternions[:n_nodes], self.i[kept], self.j[kept],
            self.is_revisit[kept], self.is_active[kept],
        )  # fmt: skip


class MapScene:
    """Draws into one viser scene. unit_m: a length of the map by which sizes are chosen, such as the flying
    height.
    """

    def __init__(self, server: viser.ViserServer, camera: Camera, unit_m: float) -> None:
        self.scene = server.scene
        self.unit_m = unit_m
        self._drawn: dict[str, viser.LineSegmentsHandle] = {}
        self._nodes: viser.PointCloudHandle | None = None
        self.scene.configure_default_lights(enabled=True, cast_shadow=False)
        self._layers = {name: self.scene.add_frame(f"/{name}", show_axes=False) for name in LAYERS}
        self._frustum = self.scene.add_camera_frustum(
            "/vehicle", 2.0 * math.atan(0.5 * camera.height / camera.fy),
            camera.width / camera.height * camera.fy / camera.fx,
            scale=0.3 * unit_m, thickness=2.5, thickness_units="screen", color=VEHICLE, visible=False,
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        self._body = self.scene.add_icosphere(
            "/vehicle/body", 0.02 * unit_m, color=VEHICLE, cast_shadow=False, receive_shadow=False
        )

    def add_switches(self, gui: viser.GuiApi) -> None:
        """Boxes that show and hide parts of the scene."""
        for name, layer in self._layers.items():
            self._add_switch(gui.add_checkbox(name.capitalize(), initial_value=True), layer)

    def _add_switch(self, box: viser.GuiInputHandle[bool], layer: viser.FrameHandle) -> None:
        box.on_update(lambda _event: setattr(layer, "visible", box.value))

    def look_from_above(self, server: viser.ViserServer, low: FloatArray, high: FloatArray) -> None:
        """Where a visitor's camera begins: south of the box low (3,) to high (3,); it sees all of it."""
        half = np.maximum(0.5 * (high - low), [0.5 * self.unit_m, 0.5 * self.unit_m, 0.0])
        size = 2.0 * float(np.linalg.norm(half))
        target = 0.5 * (low + high) + np.array([PANEL_SHARE * size, 0.0, 0.0])
        corners = half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        corners -= [PANEL_SHARE * size, 0.0, 0.0]
        up = np.array([0.0, ARRIVAL[2], -ARRIVAL[1]])
        # each corner is as far from the middle of the picture as its distance from the camera allows
        across = np.maximum(np.abs(corners[:, 0]) / LEAST_ASPECT, np.abs(corners @ up))
        away = float((across / math.tan(0.5 * FIELD_RAD) + corners @ ARRIVAL).max())
        place = target + away * ARRIVAL
        server.initial_camera.look_at = (float(target[0]), float(target[1]), float(target[2]))
        server.initial_camera.position = (float(place[0]), float(place[1]), float(place[2]))
        server.initial_camera.fov = FIELD_RAD
        server.initial_camera.near = 0.02 * self.unit_m
        server.initial_camera.far = max(60.0 * size, 3000.0 * self.unit_m)

    def show_vehicle(self, world_from_cam: Pose | None) -> None:
        """None: lost; it stays where it was last seen, in another colour."""
        colour = LOST if world_from_cam is None else VEHICLE
        if tuple(self._frustum.color) != colour:
            self._frustum.color = colour
            self._body.color = colour
        if world_from_cam is not None:
            self._frustum.position = world_from_cam.translation
            self._frustum.wxyz = wxyz(world_from_cam.quaternion())
            if not self._frustum.visible:
                self._frustum.visible = True

    def vehicle_position(self) -> FloatArray:
        """(3,) metres, world: where it is drawn."""
        return np.asarray(self._frustum.position, np.float64)

    def show_path(
        self, positions: FloatArray, name: str = "/path/flown", colour: tuple[int, int, int] = PATH
    ) -> None:
        """positions (n, 3), in the order of time."""
        if len(positions) < 2:
            self._hide(name)
            return
        thin = positions[:: max(1, math.ceil(len(positions) / MOST_PATH_POINTS))]
        if thin[-1] is not positions[-1]:
            thin = np.concatenate([thin, positions[-1:]])
        self._lines(name, np.stack([thin[:-1], thin[1:]], axis=1), colour, 3.0)

    def show_graph(self, graph: GraphState) -> None:
        """Nodes as points; odometry gray, revisits green, those that the map does not believe red."""
        places = graph.positions.astype(np.float32)
        if self._nodes is None:
            self._nodes = self.scene.add_point_cloud(
                "/nodes/all", places, NODE, point_size=0.014 * self.unit_m, point_shape="circle",
                precision="float32", point_shading="flat",
            )  # fmt: skip
        else:
            self._nodes.points = places
        odometry = ~graph.is_revisit
        for name, chosen, colour, width in (
            ("/constraints/odometry", odometry, ODOMETRY, 1.0),
            ("/constraints/revisits", graph.is_revisit & graph.is_active, REVISIT, 2.0),
            ("/constraints/rejected", graph.is_revisit & ~graph.is_active, REJECTED, 1.0),
        ):
            rows = np.flatnonzero(chosen)[-MOST_LINES:]
            ends = np.stack([graph.positions[graph.i[rows]], graph.positions[graph.j[rows]]], axis=1)
            self._lines(name, ends, colour, width)

    def show_region(self, centre: FloatArray, covariance: FloatArray | None) -> None:
        """Where the vehicle may be: the three-sigma ellipse about centre (3,), from covariance (2, 2) m^2 in
        the plane; None hides it.
        """
        if covariance is None:
            self._hide("/region")
            return
        outline = np.column_stack([ellipse(covariance), np.zeros(ELLIPSE_POINTS)]) + centre
        ends = np.stack([outline, np.roll(outline, -1, axis=0)], axis=1)
        self._lines("/region", ends, REGION, 2.5)

    def _lines(self, name: str, ends: FloatArray, colour: tuple[int, int, int], width: float) -> None:
        """ends (k, 2, 3). A line that is there already is changed: a new one costs several times as much."""
        if len(ends) == 0:
            self._hide(name)
            return
        drawn = self._drawn.get(name)
        if drawn is None:
            self._drawn[name] = self.scene.add_line_segments(
                name, ends.astype(np.float32), colour, thickness=width, thickness_units="screen"
            )
            return
        drawn.points = ends.astype(np.float32)
        if not drawn.visible:
            drawn.visible = True

    def _hide(self, name: str) -> None:
        if name in self._drawn:
            self._drawn[name].visible = False


def wxyz(quaternion_xyzw: FloatArray) -> FloatArray:
    """The order that viser wants."""
    return np.asarray(np.roll(quaternion_xyzw, 1))


def ellipse(covariance: FloatArray) -> FloatArray:
    """(ELLIPSE_POINTS, 2) outline of REGION_SIGMAS standard deviations of covariance (2, 2) about zero."""
    variances, axes = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2.0 * math.pi, ELLIPSE_POINTS, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(REGION_SIGMAS * (circle * np.sqrt(np.maximum(variances, 0.0))) @ axes.T)


def horizontal_covariance(covariance: FloatArray, rotation: FloatArray) -> FloatArray:
    """(2, 2) of the place in the world's plane, from covariance (6, 6) of world_from_cam @ Pose.exp(x)."""
    return np.asarray((rotation @ covariance[:3, :3] @ rotation.T)[:2, :2])
