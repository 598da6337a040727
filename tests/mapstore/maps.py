"""Small maps with everything in them that a file can hold, and what it means that two are the same."""

from __future__ import annotations

import math

import numpy as np
import pytest

from overfly.config import Config
from overfly.geometry.cameras import Camera, Distortion
from overfly.geometry.poses import FloatArray, Pose
from overfly.mapstore import FlightEntry, FrameEntry, Map
from overfly.revisit.outcome import Revisit, RevisitStatus
from overfly.types import (
    Constraint,
    ConstraintKind,
    Features,
    GeoPosition,
    MountedCamera,
    Reason,
    Rig,
)
from overfly.vision.refine import HeightPrior, TiltPrior
from overfly.visual_map import Node, VisualMap

CAMERA = Camera(320, 240, 288.0, 287.5, 161.4, 116.6, coefficients=(-0.12, 0.05, 0.0006, -0.0004))
FISHEYE = Camera(640, 480, 250.0, 250.0, 320.0, 240.0, Distortion.EQUIDISTANT, (0.01, 0.0, 0.0, 0.0))
BODY_FROM_CAM = Pose(np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]]), np.array([0.05, 0.0, -0.03]))
RIG = Rig(
    (MountedCamera("cam0", CAMERA, BODY_FROM_CAM), MountedCamera("cam1", FISHEYE, BODY_FROM_CAM)),
    "given",
    0.05,
)
FRAME_NS = 100_000_000


def random_pose(generator: np.random.Generator) -> Pose:
    return Pose.exp(generator.normal(size=6))


def information(generator: np.random.Generator) -> FloatArray:
    half = generator.normal(size=(6, 6))
    return half @ half.T + np.eye(6)


def make_node(
    generator: np.random.Generator, visual_map: VisualMap, count: int, binary: bool, constraint: int
) -> Node:
    index = len(visual_map)
    descriptors = (
        generator.integers(0, 256, (count, 32), dtype=np.uint8)
        if binary
        else generator.normal(size=(count, 64)).astype(np.float32)
    )
    points = generator.normal(size=(count, 3))
    points[::5] = np.nan
    single = [generator.normal(size=count).astype(np.float32) for _ in range(3)]
    return Node(
        index=index,
        frame_index=2 * index,
        t_ns=2 * index * FRAME_NS,
        features=Features(generator.normal(size=(count, 2)).astype(np.float32), descriptors, *single),
        rays=generator.normal(size=(count, 2)),
        points_in_cam=points,
        depth_sigma_m=generator.random(count),
        inverse_depth=np.where(generator.random(count) < 0.5, np.nan, generator.random(count)),
        ray_sigma=generator.random(count),
        tracks=visual_map.new_tracks(count),
        anchor=generator.integers(0, index + 1, count),
        anchor_row=generator.integers(0, max(count, 1), count),
        tilt=TiltPrior(random_pose(generator).rotation, 0.01),
        height=HeightPrior(2.0, 0.05) if index % 2 else None,
        parent=index - 1,
        constraint=constraint,
        n_continued=3 * index,
    )


def grow(generator: np.random.Generator, visual_map: VisualMap, count: int = 12, binary: bool = True) -> Node:
    """Append a node at a random pose, tied to the one before."""
    graph = visual_map.graph
    index = len(visual_map)
    node = make_node(generator, visual_map, count, binary, graph.n_constraints if index else -1)
    visual_map.add_node(node, random_pose(generator))
    if index:
        tie = Constraint(index - 1, index, random_pose(generator), information(generator))
        graph.add_constraint(tie)
    return node


def frame_of(visual_map: VisualMap, number: int, generator: np.random.Generator) -> FrameEntry:
    """Every third is lost; the others hang on the newest node there was."""
    if number % 3 == 2:
        return FrameEntry(0, number * FRAME_NS, number, reason=Reason.FEW_MATCHES, detail="3 matches")
    node = min(number // 2, len(visual_map) - 1)
    return FrameEntry(
        0,
        number * FRAME_NS,
        number,
        node,
        number % 2 == 0,
        random_pose(generator),
        random_pose(generator),
        n_matches=50,
        n_inliers=40,
        rms_px=0.4,
        position=GeoPosition(47.998, 7.842, 280.0, 1.5, math.inf) if number % 2 else None,
        seconds={"tracking": 0.004} | ({"node": 0.01} if number % 2 else {}),
        piece=number // 5,
        revisit=Revisit(RevisitStatus.ACCEPTED, 3, 1, confirmed=((0, 2),)) if number % 6 == 0 else None,
    )


def make_flight() -> FlightEntry:
    start = {"height_m": 3.1, "level_from_cam": np.eye(3).tolist(), "source": "range"}
    progress = {"start": start, "relief": 0.02, "scale": None}
    return FlightEntry(0, "flight", "2026-01-01T00:00:00+00:00", "overfly 0.1.0", RIG, Config(), progress)


def make_map(seed: int = 0, n_nodes: int = 5, count: int = 12, binary: bool = True) -> Map:
    generator = np.random.default_rng(seed)
    visual_map = VisualMap()
    for _ in range(n_nodes):
        grow(generator, visual_map, count, binary)
    if n_nodes > 2:
        revisit = Constraint(
            0, n_nodes - 1, random_pose(generator), information(generator), ConstraintKind.REVISIT
        )
        number = visual_map.graph.add_constraint(revisit)
        visual_map.graph.states[number] = 1
    frames = [frame_of(visual_map, number, generator) for number in range(2 * n_nodes)]
    return Map(visual_map, [make_flight()], [0] * n_nodes, frames)


def assert_same(a: Map, b: Map) -> None:
    """Equal to the last bit; frames to that of single precision, their seconds to half of that."""
    assert len(a) == len(b)
    assert a.visual.n_tracks == b.visual.n_tracks
    for name in (
        "positions", "quaternions", "i", "j", "measured_positions", "measured_quaternions", "information",
        "kinds", "states",
    ):  # fmt: skip
        np.testing.assert_array_equal(getattr(a.visual.graph, name), getattr(b.visual.graph, name), name)
    for one, other in zip(a.visual.nodes, b.visual.nodes, strict=True):
        assert_same_node(one, other)
    for frame, twin in zip(a.frames, b.frames, strict=True):
        assert_same_frame(frame, twin)
    for flight, twin in zip(a.flights, b.flights, strict=True):
        assert flight.config == twin.config
        assert repr(flight.rig) == repr(twin.rig)
        assert (flight.source, flight.created, flight.progress) == (twin.source, twin.created, twin.progress)
    assert a.node_flights == b.node_flights
    assert a.georeference == b.georeference


def assert_same_frame(one: FrameEntry, other: FrameEntry) -> None:
    for name in (
        "flight", "t_ns", "frame_index", "node", "made_node", "reason", "detail", "n_matches", "n_inliers",
        "piece", "position", "revisit",
    ):  # fmt: skip
        assert getattr(one, name) == getattr(other, name), name
    np.testing.assert_allclose(one.rms_px, other.rms_px, rtol=1e-7)
    assert one.seconds == pytest.approx(other.seconds, rel=1e-3)
    for name in ("node_from_cam", "online"):
        mine, theirs = getattr(one, name), getattr(other, name)
        assert (mine is None) == (theirs is None)
        if mine is not None:
            np.testing.assert_allclose(mine.matrix(), theirs.matrix(), atol=1e-6)


def assert_same_node(one: Node, other: Node) -> None:
    for name in ("index", "frame_index", "t_ns", "parent", "constraint", "n_continued", "height"):
        assert getattr(one, name) == getattr(other, name)
    np.testing.assert_array_equal(one.tilt.level_from_cam, other.tilt.level_from_cam)
    assert one.tilt.sigma_rad == other.tilt.sigma_rad
    for name in (
        "rays", "points_in_cam", "depth_sigma_m", "inverse_depth", "ray_sigma", "tracks", "anchor",
        "anchor_row",
    ):  # fmt: skip
        mine, theirs = getattr(one, name), getattr(other, name)
        np.testing.assert_array_equal(mine, theirs, name)
        assert mine.dtype == theirs.dtype
    for name in ("px", "descriptors", "size_px", "angle_rad", "response"):
        mine, theirs = getattr(one.features, name), getattr(other.features, name)
        np.testing.assert_array_equal(mine, theirs, name)
        assert mine.dtype == theirs.dtype
