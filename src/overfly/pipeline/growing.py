"""mosaic.tif while the flight goes on: a thread of its own draws it from what the loop leaves there.

The loop leaves pictures of new nodes and, every few seconds, a copy of where all nodes stand. Nothing here
holds it up, changes the map, or ends a run when it fails. What the thread computes it pays for by resting
19 times as long, so that a machine with two cores has them nearly whole for the mapping.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from overfly.errors import OverflyError
from overfly.frame_result import FrameResult
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray
from overfly.localizer import Fix
from overfly.pipeline.node_pictures import reduced
from overfly.products.growing_mosaic import POINTS, GrowingMosaic, NodePicture, Placement
from overfly.products.picture_spool import PictureSpool
from overfly.slam import Slam
from overfly.types import BoolArray, Frame, IntArray, UInt8Array
from overfly.viewer.interface import NullViewer, Viewer
from overfly.vision.observation import working_rig
from overfly.visual_map import Node, VisualMap

MOSAIC_NAME = "mosaic.tif"
FIRST_S, LOOK_EVERY_S, SAVE_EVERY_S = 1.0, 2.5, 5.0  # the first copy of the map, the others; the file
SHARE = 0.05  # of a core, that the thread takes at most
LONGEST_REST_S = 5.0  # also after a first start, which compiles for a minute
WIDTH_PX = 1000  # of the pictures: wider ones would want more than that share
MOST_WAITING_BYTES = 200 * 2**20  # of pictures; what comes beyond is not drawn
YOUNG_NODES = 10  # whose points may still become better

log = logging.getLogger("overfly.mosaic")


@dataclass(frozen=True, slots=True, eq=False)
class _Snapshot:
    """The map between two frames, n nodes; scale: its metre by that of its beginning."""

    positions: FloatArray
    quaternions: FloatArray
    pieces: IntArray
    first_node: int
    points: FloatArray
    scale: float

    def __len__(self) -> int:
        return len(self.positions)

    def placement(self) -> Placement:
        rotations = Rotation.from_quat(self.quaternions).as_matrix()
        return Placement(
            self.positions / self.scale,
            rotations,
            self._in_main_piece(),
            self.first_node,
            self.points / self.scale,
        )

    def _in_main_piece(self) -> BoolArray:
        names, counts = np.unique(self.pieces, return_counts=True)
        return np.asarray(self.pieces == names[np.argmax(counts)])


@contextmanager
def growing_mosaic(path: Path | None, slam: Slam) -> Iterator[Viewer]:
    """The drawer of a run's mosaic, which is shown every frame; nobody when path is None."""
    if path is None:
        yield NullViewer()
        return
    with closing(MosaicDrawer(path, slam)) as drawer:
        yield drawer


class MosaicDrawer:
    """A viewer that leaves what it sees in a file."""

    def __init__(self, path: Path, slam: Slam) -> None:
        self._path, self._slam = path, slam
        width_px = min(WIDTH_PX, slam.config.mosaic.max_width_px)
        self._camera: Camera = working_rig(slam.source_rig, width_px).cam0.camera
        self._waiting: deque[tuple[int, UInt8Array]] = deque()
        self._bytes_in, self._bytes_out = 0, 0  # each is written by one thread only
        self._latest: deque[_Snapshot] = deque(maxlen=1)
        self._taken = (0, 1)  # nodes and pieces of the snapshot that the drawing thread took last
        self._first_height_m: float | None = None
        self._due_s = time.monotonic() + FIRST_S
        self._scale = 1.0
        self._save_due_s = 0.0
        self._has_warned = False
        self._wake, self._closed = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="overfly-mosaic", daemon=True)
        self._thread.start()

    # -- in the thread of the loop

    def show_frame(self, frame: Frame, result: FrameResult | Fix) -> None:
        """A frame was processed; a copy of the map is made every few seconds."""
        if not self._thread.is_alive():
            return
        if isinstance(result, FrameResult) and result.node is not None:
            picture = frame.images[0]
            if self._n_waiting_bytes + picture.nbytes <= MOST_WAITING_BYTES:
                self._bytes_in += picture.nbytes
                self._waiting.append((result.node, picture))
        now = time.monotonic()
        if len(self._slam.map) and (now >= self._due_s or self._n_waiting_bytes > MOST_WAITING_BYTES // 2):
            self._due_s = now + LOOK_EVERY_S
            self._latest.append(self._snapshot())
            self._wake.set()

    def close(self) -> None:
        """Leave the file as it is; afterwards nobody writes it here."""
        self._closed.set()
        self._wake.set()
        self._thread.join()

    @property
    def _n_waiting_bytes(self) -> int:
        return self._bytes_in - self._bytes_out

    def _snapshot(self) -> _Snapshot:
        visual, start = self._slam.map, self._slam.start
        if self._first_height_m is None and start is not None:
            self._first_height_m = start.height_m
        scale = start.height_m / self._first_height_m if start is not None and self._first_height_m else 1.0
        pieces = visual.pieces()
        n_pieces = len(np.unique(pieces))
        # a piece that was laid elsewhere may have been given another size
        n_taken, n_pieces_taken = self._taken
        first = max(0, n_taken - YOUNG_NODES) if n_pieces == n_pieces_taken else 0
        return _Snapshot(
            visual.graph.positions.copy(), visual.graph.quaternions.copy(), pieces.copy(), first,
            _points_of(visual, first), scale,
        )  # fmt: skip

    # -- in the drawing thread

    def _run(self) -> None:
        try:
            with closing(PictureSpool(self._path.parent)) as spool:
                mosaic = GrowingMosaic(self._camera, spool)
                while not self._closed.is_set():
                    began = time.thread_time()
                    if self._step(mosaic):
                        rest_s = (time.thread_time() - began) * (1.0 / SHARE - 1.0)
                        self._closed.wait(min(rest_s, LONGEST_REST_S))
                    else:
                        self._wake.wait(LOOK_EVERY_S)
                        self._wake.clear()
        except OverflyError as error:
            log.warning("%s is not drawn any further while flying: %s", self._path, error)
        except Exception:  # a picture that cannot be drawn must not end a flight
            log.exception("%s is not drawn any further while flying", self._path)

    def _step(self, mosaic: GrowingMosaic) -> bool:
        """The next thing there is to do; False when there is nothing."""
        if self._latest:
            latest = self._latest.popleft()
            self._scale, self._taken = latest.scale, (len(latest), len(np.unique(latest.pieces)))
            mosaic.lay(latest.placement(), self._pictures_before(len(latest)))
            return True
        if mosaic.has_changed and time.monotonic() >= self._save_due_s:
            self._save(mosaic)
            return True
        return mosaic.draw_next()

    def _pictures_before(self, n_nodes: int) -> Iterator[NodePicture]:
        while self._waiting and self._waiting[0][0] < n_nodes:
            node, picture = self._waiting.popleft()
            self._bytes_out += picture.nbytes
            yield NodePicture(node, reduced(picture, self._camera))

    def _save(self, mosaic: GrowingMosaic) -> None:
        try:
            mosaic.save(self._path, self._scale)
        except OverflyError as error:  # there may be room again later
            if not self._has_warned:
                log.warning("no mosaic while flying for now: %s", error)
            self._has_warned = True
        self._save_due_s = time.monotonic() + SAVE_EVERY_S


def _points_of(visual: VisualMap, first: int) -> FloatArray:
    """(m, POINTS, 4) of the nodes from the first on, NaN beyond what they have."""
    points = np.full((len(visual) - first, POINTS, 4), np.nan)
    for row, node in enumerate(visual.nodes[first:]):
        few = _few(node)
        points[row, : len(few)] = few
    return points


def _few(node: Node) -> FloatArray:
    """(k, 4) some of a node's points and the standard deviations of their depths, metres."""
    known = np.flatnonzero(node.has_point)
    known = known[:: max(1, -(-len(known) // POINTS))]
    return np.column_stack([node.points_in_cam[known], node.depth_sigma_m[known]])
