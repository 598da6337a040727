"""The visual map: the pose graph, and for each node what was seen there (paper, section IV: "as a map, we
directly use the graph structure of the optimizer; additionally, we store for each node the observed features
as well as their 3D positions relative to the node")."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.pose_graph import KINDS, PoseGraph
from overfly.pieces import find_pieces
from overfly.types import BoolArray, ConstraintKind, Features, IntArray
from overfly.vision.alignment import MOST_REFERENCES, Pyramid
from overfly.vision.refine import HeightPrior, TiltPrior
from overfly.vision.tracking import Anchor, TrackedPoints

PICTURED_NODES = MOST_REFERENCES  # last used nodes whose pictures points are followed from
BRIDGE = KINDS.index(ConstraintKind.BRIDGE)
PICTURE_BYTES = 64_000_000  # of pictures that are kept, for when the camera comes back to their nodes


@dataclass(slots=True, eq=False)
class Node:
    """One camera pose of the graph and what was seen from it, n features.

    rays (n, 2) undistorted image coordinates; points_in_cam (n, 3) metres, NaN where no depth is known;
    depth_sigma_m (n,); inverse_depth (n,) 1/m as a second camera measured it, NaN where none did;
    ray_sigma (n,) standard deviation of the rays, per coordinate;
    tracks (n,) identity of the ground point: features of different nodes with the same track saw the same
    point; anchor (n,) node that saw it first and anchor_row (n,) its feature there;
    tilt and height: what the other sensors said; parent: node that odometry located this one against, -1 for
    none;
    pyramid: the picture, while the node is new enough to be tracked from; constraint: number of the
    constraint to the parent.
    """

    index: int
    frame_index: int
    t_ns: int
    features: Features
    rays: FloatArray
    points_in_cam: FloatArray
    depth_sigma_m: FloatArray
    inverse_depth: FloatArray
    ray_sigma: FloatArray
    tracks: IntArray
    anchor: IntArray
    anchor_row: IntArray
    tilt: TiltPrior
    height: HeightPrior | None
    parent: int
    pyramid: Pyramid | None = None
    constraint: int = -1
    n_continued: int = 0  # most features that one later frame found again; tells how many are left

    @property
    def has_point(self) -> BoolArray:
        return np.isfinite(self.points_in_cam[:, 2])


@dataclass(slots=True, eq=False)
class VisualMap:
    """The graph and its nodes. Points are kept relative to their node, so they follow when the graph is
    optimised.
    """

    graph: PoseGraph = field(default_factory=PoseGraph)
    nodes: list[Node] = field(default_factory=list)
    n_tracks: int = 0
    n_rescaled: int = 0
    recent: list[int] = field(default_factory=list)  # nodes by when odometry last used them, latest last
    _followed: tuple[tuple[object, ...], tuple[TrackedPoints, dict[int, Anchor]]] | None = None
    _pieces: tuple[tuple[int, ...], IntArray] | None = None

    def __len__(self) -> int:
        return len(self.nodes)

    def add_node(self, node: Node, world_from_cam: Pose) -> None:
        """Append a node at this pose; its index must be the next one."""
        number = self.graph.add_node(world_from_cam)
        if number != node.index:
            raise ValueError(f"node {node.index} would become node {number} of the graph")
        self.nodes.append(node)
        self.use(number)

    def use(self, index: int) -> None:
        """Odometry goes on from this node; those that it has not used for longest lose their picture."""
        if index in self.recent:
            self.recent.remove(index)
        self.recent.append(index)
        pyramid = self.nodes[index].pyramid
        if pyramid is not None:
            most = max(PICTURED_NODES, PICTURE_BYTES // sum(level.nbytes for level in pyramid))
            for old in self.recent[:-most]:
                self.nodes[old].pyramid = None
            del self.recent[:-most]

    def go_on_from(self, index: int) -> None:
        """Odometry goes on from a node of old, maybe in another piece of the map."""
        piece = self.pieces()
        if self.recent and piece[self.recent[-1]] != piece[index]:
            self.forget_recent()
        self.use(index)

    def forget_recent(self) -> None:
        """Odometry goes on elsewhere and compares with none of the nodes that it used."""
        for index in self.recent:
            self.nodes[index].pyramid = None
        self.recent.clear()

    def is_bridged(self, node: Node) -> bool:
        """Whether only a bridge over a gap ties the node to those before: it shares no points with them."""
        return node.constraint >= 0 and int(self.graph.kinds[node.constraint]) == BRIDGE

    def after_gap(self, index: int) -> int:
        """The first node after the last gap that was bridged before this node or by it; 0 where none was."""
        bridged = self.graph.j[self.graph.kinds == BRIDGE]
        return int(bridged[bridged <= index].max(initial=0))

    def new_tracks(self, count: int) -> IntArray:
        """Identities (count,) of ground points not seen before."""
        self.n_tracks += count
        return np.arange(self.n_tracks - count, self.n_tracks, dtype=np.int64)

    def points_in_world(self, node: Node) -> FloatArray:
        """(n, 3) metres, NaN where no depth is known."""
        return self.graph.pose(node.index).transform(node.points_in_cam)

    def spread_in_world(self, node: Node) -> FloatArray:
        """(n, 3) metres: one standard deviation of each point's depth, along the ray from its node."""
        along = node.points_in_cam * (node.depth_sigma_m / node.points_in_cam[:, 2])[:, None]
        return np.asarray(along @ self.graph.pose(node.index).rotation.T)

    def followable(self, count: int) -> tuple[TrackedPoints, dict[int, Anchor]]:
        """Points of the last count nodes that odometry used, and the nodes whose pictures are at hand.
        Between two changes of the map they are gathered once.
        """
        pictured = [node for node in self.pictured() if node.pyramid is not None]
        indices = [node.index for node in pictured]
        poses = self.graph.positions[indices].tobytes(), self.graph.quaternions[indices].tobytes()
        # Points and tracks of these nodes change only when a node is added, or all of them by a new scale.
        state = (len(self), self.n_rescaled, self.n_tracks, count, *indices, *poses)
        if self._followed is None or self._followed[0] != state:
            anchors = {
                node.index: Anchor(node.pyramid, self.graph.pose(node.index))
                for node in pictured
                if node.pyramid is not None
            }
            nodes = [node for node in self.previous(count) if node.index in anchors]
            self._followed = state, (self.points_to_follow(nodes, anchors), anchors)
        return self._followed[1]

    def points_to_follow(self, nodes: Sequence[Node], retained: Collection[int]) -> TrackedPoints:
        """Points of these nodes, newest first, each once; an anchor whose picture is not retained gives way
        to the node itself.
        """
        world = np.concatenate([self.points_in_world(node) for node in nodes])
        spread = np.concatenate([self.spread_in_world(node) for node in nodes])
        index = np.concatenate([np.full(len(node.features), node.index) for node in nodes])
        row = np.concatenate([np.arange(len(node.features)) for node in nodes])
        anchor = np.concatenate([node.anchor for node in nodes])
        anchor_row = np.concatenate([node.anchor_row for node in nodes])
        tracks = np.concatenate([node.tracks for node in nodes])
        known = np.flatnonzero(np.isfinite(world[:, 2]))
        _, first = np.unique(tracks[known], return_index=True)
        chosen = known[np.sort(first)]
        anchor, anchor_row = anchor[chosen], anchor_row[chosen]
        for old in np.unique(anchor):
            if int(old) not in retained:
                gone = anchor == old
                anchor[gone], anchor_row[gone] = index[chosen][gone], row[chosen][gone]
        anchor_px = np.empty((len(chosen), 2))
        for node_index in np.unique(anchor):
            mine = anchor == node_index
            anchor_px[mine] = self.nodes[int(node_index)].features.px[anchor_row[mine]]
        return TrackedPoints(world[chosen], spread[chosen], anchor, anchor_px, index[chosen], row[chosen])

    def all_points(self, wanted: BoolArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Every point with a known depth: (n, 3) metres, world, and the standard deviation of
        its depth (n,). wanted (nodes,): of which nodes, None for all.
        """
        nodes = [node for node in self.nodes if wanted is None or wanted[node.index]]
        points = [self.points_in_world(node)[node.has_point] for node in nodes]
        sigmas = [node.depth_sigma_m[node.has_point] for node in nodes]
        return np.concatenate([np.zeros((0, 3)), *points]), np.concatenate([np.zeros(0), *sigmas])

    def rescale(self, factor: float, heights_are_measured: bool = False) -> None:
        """Multiply all lengths of the map. Heights that a range sensor measured are in metres already and
        stay; those that only hold the scale of the map do not.
        """
        self._scale(np.ones(len(self), np.bool_), factor, heights_are_measured)

    def lay(self, is_moved: BoolArray, factor: float, new_from_old: Pose, heights_are_measured: bool) -> None:
        """Put a piece of the map (nodes,) elsewhere: first its lengths are multiplied, then it is moved."""
        self._scale(is_moved, factor, heights_are_measured)
        for index in np.flatnonzero(is_moved).tolist():
            self.graph.set_pose(index, new_from_old @ self.graph.pose(index))

    def _scale(self, is_scaled: BoolArray, factor: float, heights_are_measured: bool) -> None:
        self.n_rescaled += 1
        graph = self.graph
        within = is_scaled[graph.i] & is_scaled[graph.j]
        graph.positions[is_scaled] *= factor
        graph.measured_positions[within] *= factor
        graph.information[within, :3, :] /= factor
        graph.information[within, :, :3] /= factor
        for node in [self.nodes[index] for index in np.flatnonzero(is_scaled)]:
            node.points_in_cam = node.points_in_cam * factor
            node.depth_sigma_m = node.depth_sigma_m * factor
            node.inverse_depth = node.inverse_depth / factor
            if node.height is not None and not heights_are_measured:
                node.height = HeightPrior(node.height.z_m * factor, node.height.sigma_m * factor)

    def odometry_poses(self) -> list[Pose]:
        """world_from_cam of every node by odometry alone: along the constraints to the parents, without loop
        closures.
        """
        poses: list[Pose] = []
        for node in self.nodes:
            if node.parent < 0:
                poses.append(self.graph.pose(node.index))
            else:
                poses.append(poses[node.parent] @ self.graph.constraint(node.constraint).i_from_j)
        return poses

    def pieces(self) -> IntArray:
        """(n,) the piece that each node belongs to, named by the oldest node of the piece; 0 for all while
        the camera was never lost for long.
        """
        state = (len(self), self.graph.n_constraints, len(self.graph.active))
        if self._pieces is None or self._pieces[0] != state:
            self._pieces = state, find_pieces(self.graph)
        return self._pieces[1]

    def pictured(self) -> Sequence[Node]:
        """The last nodes that odometry used, whose pictures are at hand, latest last."""
        return [self.nodes[index] for index in self.recent[-PICTURED_NODES:]]

    def previous(self, count: int) -> Sequence[Node]:
        """The last nodes that odometry used, latest first."""
        return [self.nodes[index] for index in self.recent[: -count - 1 : -1]]

    def newest(self, count: int) -> list[Node]:
        """The newest nodes, of those the ones in the piece of the last, oldest first."""
        piece, nodes = self.pieces(), self.nodes[-count:]
        return [node for node in nodes if piece[node.index] == piece[-1]]

    def left_behind(self, count: int) -> Sequence[Node]:
        """Nodes with a picture that are not among the last count that odometry used."""
        kept = [self.nodes[index] for index in self.recent[:-count]]
        return [node for node in kept if node.pyramid is not None]
