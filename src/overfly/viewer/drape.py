"""Pictures of nodes laid on the ground: where each shows ground that none before it showed.

A piece hangs on its node and moves with it when the map is optimised. Ground that was seen before gets no
second picture, so hovering and revisits add nothing; beyond a number of pieces the oldest go.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.types import BoolArray, IntArray, UInt8Array
from overfly.viewer.glb import grid_faces, textured_mesh

COLUMNS, ROWS = 13, 10  # vertices of the mesh over a picture
MARGIN = 0.04  # of the picture, along its border: the worst of the lens, and where seams would show
TEXTURE_PX = 256  # width of the pictures as they are shown
LEAST_NEW = 0.35  # a picture whose share of new ground is smaller adds nothing to see
CELLS_ACROSS = 22  # cells of the raster that remembers what was seen, per width of the first picture
STEEPEST_TAN = 3.0  # ground seen at a flatter angle than this is not drawn
MOST_PIECES = 1000
LAYERS, LAYER_SHARE = 16, 2e-4  # pieces overlap a little: neighbours differ by this share of the height

_corner = np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS)[:-1, :-1].reshape(-1, 1)
CELL_CORNERS = _corner + np.array([0, 1, COLUMNS, COLUMNS + 1])  # vertices of each cell of the mesh
# Middles of the quarters of a cell, from its corners.
QUARTERS = np.array([[9, 3, 3, 1], [3, 9, 1, 3], [3, 1, 9, 3], [1, 3, 3, 9]]) / 16.0
CELL_FACES = grid_faces(ROWS, COLUMNS).reshape(-1, 2, 3)


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """Part of a picture on the ground, as binary glTF in the frame of its node's camera.

    lift_m: how much it is raised so that overlapping pieces do not flicker.
    """

    node: int
    mesh: bytes
    lift_m: float


@dataclass(slots=True, eq=False)
class Drape:
    """Decides what of each picture is laid down, for one camera."""

    camera: Camera
    pieces: list[int] = field(default_factory=list)  # nodes that have one, oldest first
    _cell_m: float = 0.0
    _seen: dict[int, int] = field(default_factory=dict)  # cell of the ground -> node that shows it
    _grid_px: FloatArray = field(init=False)
    _grid_rays: FloatArray = field(init=False)
    _ray_lengths_2: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        low = MARGIN * np.array([self.camera.width, self.camera.height])
        high = np.array([self.camera.width, self.camera.height]) - 1.0 - low
        columns, rows = np.linspace(low[0], high[0], COLUMNS), np.linspace(low[1], high[1], ROWS)
        self._grid_px = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        rays = self.camera.rays_from_pixels(self._grid_px)
        self._grid_rays = np.column_stack([rays, np.ones(len(rays))])
        self._ray_lengths_2 = (self._grid_rays**2).sum(axis=1)

    def add(self, node: int, picture: UInt8Array, world_from_cam: Pose, ground_m: float) -> Piece | None:
        """The new part of a picture, or None. picture: of any size, best reduced; ground_m: height of the
        level ground that it shows, world.
        """
        height_m = float(world_from_cam.translation[2]) - ground_m
        if height_m <= 0.0:
            return None
        points, usable = self._on_ground(world_from_cam, height_m)
        drawn = _whole_cells(usable)
        if len(drawn) == 0:
            return None
        if self._cell_m == 0.0:
            width = np.ptp(points[usable, 0]), np.ptp(points[usable, 1])
            self._cell_m = max(float(max(width)) / CELLS_ACROSS, 1e-6)
        corners = world_from_cam.transform(points)[CELL_CORNERS[drawn], :2] / self._cell_m
        x, y = np.floor(QUARTERS @ corners).astype(np.int64).transpose(2, 0, 1)
        ground = (x << 32) + y  # (k, 4) one number for each cell
        unseen = np.array([cell not in self._seen for cell in ground.ravel().tolist()]).reshape(-1, 4)
        if unseen.mean() < LEAST_NEW and self.pieces:
            return None
        self._seen.update(dict.fromkeys(ground[unseen].tolist(), node))
        new = _and_beside(drawn, np.asarray(unseen.any(axis=1)))
        self.pieces.append(node)
        faces = CELL_FACES[drawn[new]].reshape(-1, 3)
        places = (self._grid_px + 0.5) / [self.camera.width, self.camera.height]
        lift_m = LAYER_SHARE * height_m * (len(self.pieces) % LAYERS)
        return Piece(node, textured_mesh(points, places, faces, picture), lift_m)

    def outgrown(self) -> list[int]:
        """Nodes whose pieces have to go; the ground they showed may be shown again."""
        gone, self.pieces = self.pieces[:-MOST_PIECES], self.pieces[-MOST_PIECES:]
        if gone:
            dropped = set(gone)
            self._seen = {cell: node for cell, node in self._seen.items() if node not in dropped}
        return gone

    def rescale(self, factor: float) -> None:
        """All lengths of the map were multiplied."""
        self._cell_m *= factor

    def _on_ground(self, world_from_cam: Pose, height_m: float) -> tuple[FloatArray, BoolArray]:
        """Where the mesh's rays meet level ground height_m below: (n, 3) in the camera's frame; (n,) bool."""
        down = -(self._grid_rays @ world_from_cam.rotation[2])
        # not for rays that are not known: comparing those is False
        usable = (down > 0.0) & (self._ray_lengths_2 < (1.0 + STEEPEST_TAN**2) * down**2)
        depth = height_m / np.where(usable, down, 1.0)
        return np.where(usable[:, None], self._grid_rays * depth[:, None], 0.0), usable


def _and_beside(drawn: IntArray, unseen: BoolArray) -> BoolArray:
    """(k,) which of the drawn cells of the mesh are unseen or beside one that is, so that no gaps stay."""
    grid = np.zeros((ROWS - 1) * (COLUMNS - 1), np.uint8)
    grid[drawn[unseen]] = 1
    wider = cv2.dilate(grid.reshape(ROWS - 1, COLUMNS - 1), np.ones((3, 3), np.uint8))
    return np.asarray(wider.ravel()[drawn] > 0)


def _whole_cells(usable: BoolArray) -> IntArray:
    """(k,) cells of the mesh, numbered row by row, whose corners are all usable."""
    return np.flatnonzero(usable[CELL_CORNERS].all(axis=1))


def reduced(picture: UInt8Array) -> UInt8Array:
    """Small enough to be one of a thousand."""
    height, width = picture.shape[:2]
    if width <= 1.5 * TEXTURE_PX:
        return picture
    size = (TEXTURE_PX, max(1, round(height * TEXTURE_PX / width)))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
