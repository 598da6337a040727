"""A map whose nodes see the same points exactly: what every export of it must say is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from overfly.config import Config
from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose, rotation_from_euler
from overfly.mapstore import FlightEntry, FrameEntry, Map
from overfly.mapstore.writer import write_whole
from overfly.products.georeference import GeoReference
from overfly.types import Constraint, Features, MountedCamera, Rig
from overfly.vision.refine import TiltPrior
from overfly.visual_map import Node, VisualMap

CAMERA = Camera(640, 480, 520.0, 521.0, 330.0, 236.0, coefficients=(-0.05, 0.01, 0.0004, -0.0003))
BODY_FROM_CAM = Pose(np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]]), np.array([0.05, 0.02, -0.03]))
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])
START_NS = 1_700_000_000_123_456_789
REFERENCE = GeoReference("EPSG:32635", 1.01, 0.4, (470_000.0, 6_700_000.0, 25.0))
N_POINTS = 150


def ground_points(seed: int = 0) -> FloatArray:
    """(N_POINTS, 3) metres: the points of the map, by their track."""
    generator = np.random.default_rng(seed)
    xy = generator.uniform([-1.0, -2.0], [7.0, 2.0], (N_POINTS, 2))
    return np.column_stack([xy, generator.normal(0, 0.2, N_POINTS)])


def node_poses(count: int = 6, seed: int = 1) -> list[Pose]:
    """world_from_cam along a line at about 4 m, tilted a little."""
    generator = np.random.default_rng(seed)
    return [
        Pose(
            rotation_from_euler(*generator.normal(0, 0.05, 3)) @ LOOKING_DOWN,
            np.array([x, 0.1 * x, 4.0 + 0.1 * generator.normal()]),
        )
        for x in np.arange(count, dtype=float)
    ]


def seen_by(pose: Pose, points: FloatArray, number: int, camera: Camera = CAMERA) -> Node:
    """The node that stands here, with every point that falls into its picture."""
    in_cam = pose.inverse().transform(points)
    px = camera.project(in_cam)
    track = np.flatnonzero(((px > 5) & (px < [camera.width - 6, camera.height - 6])).all(axis=1))
    n = len(track)
    single = np.ones(n, np.float32)
    return Node(
        index=number,
        frame_index=2 * number,
        t_ns=START_NS + 200_000_000 * number,
        features=Features(px[track].astype(np.float32), np.zeros((n, 32), np.uint8), single, single, single),
        rays=camera.rays_from_pixels(px[track]),
        points_in_cam=in_cam[track],
        depth_sigma_m=np.full(n, 0.02),
        inverse_depth=np.full(n, np.nan),
        ray_sigma=np.full(n, 1e-3),
        tracks=track,
        anchor=np.full(n, number),
        anchor_row=np.arange(n),
        tilt=TiltPrior(np.eye(3), 0.01),
        height=None,
        parent=number - 1,
        constraint=number - 1,
    )


def make_map(reference: GeoReference | None = REFERENCE) -> Map:
    """Six nodes and, hanging on each, its own frame and one a tenth of a second later, 0.3 m on."""
    points = ground_points()
    visual_map = VisualMap()
    visual_map.new_tracks(N_POINTS)
    frames = []
    step = Pose(np.eye(3), np.array([0.3, 0.0, 0.0]))
    poses = node_poses()
    for number, pose in enumerate(poses):
        node = seen_by(pose, points, number)
        visual_map.add_node(node, pose)
        if number:
            tie = poses[number - 1].inverse() @ pose
            visual_map.graph.add_constraint(Constraint(number - 1, number, tie, np.eye(6)))
        for shift, t_ns in ((Pose.identity(), node.t_ns), (step, node.t_ns + 100_000_000)):
            frames.append(FrameEntry(0, t_ns, len(frames), number, node_from_cam=shift, online=pose @ shift))
    rig = Rig((MountedCamera("cam0", CAMERA, BODY_FROM_CAM),))
    start = {"height_m": 4.0, "level_from_cam": np.eye(3).tolist(), "source": "range"}
    progress = {"start": start, "relief": 0.02, "scale": None}
    entry = FlightEntry(0, "somewhere/lawn", "2026-01-01T00:00:00+00:00", "overfly", rig, Config(), progress)
    return Map(visual_map, [entry], [0] * len(visual_map), frames, reference)


def write_map(folder: Path, reference: GeoReference | None = REFERENCE) -> Map:
    """The map as map.overfly in the folder."""
    known = make_map(reference)
    write_whole(folder / "map.overfly", known)
    known.path = folder / "map.overfly"
    return known


def world_poses(known: Map) -> list[Pose]:
    """world_from_cam of all frames."""
    return [
        known.visual.graph.pose(frame.node) @ frame.node_from_cam
        for frame in known.frames
        if frame.node is not None and frame.node_from_cam is not None
    ]
