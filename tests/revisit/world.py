"""Ground of points with descriptors, and a map of it made by a camera whose odometry drifts: exact truth,
no pictures."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from overfly.config import Config
from overfly.geometry.cameras import Camera
from overfly.geometry.levelling import NADIR_BODY_FROM_CAM, level_from_cam
from overfly.geometry.poses import FloatArray, Pose, rotation_from_euler
from overfly.graph.online import OnlineOptimiser
from overfly.revisit.places import Places
from overfly.revisit.verification import Query, Verifier
from overfly.types import Attitude, Constraint, ConstraintKind, Features, MountedCamera, Rig
from overfly.vision.features import create_extractor
from overfly.vision.odometry import information_of_constraint
from overfly.vision.refine import TiltPrior
from overfly.vision.registration import create_registrar
from overfly.visual_map import Node, VisualMap

CAMERA = Camera(320, 240, 250.0, 250.0, 160.0, 120.0)
ATTITUDE = Attitude(0.0, 0.0, 0.005)
TILT = TiltPrior(level_from_cam(ATTITUDE, NADIR_BODY_FROM_CAM), ATTITUDE.sigma_rad)
HEIGHT_M = 2.0
POINTS_PER_M2 = 60
BYTES = 32
PX_SIGMA = 0.3
FLIPPED_SHARE = 0.06  # of the bits of a descriptor, from view to view


def pose_at(x: float, y: float, yaw: float = 0.0, z: float = HEIGHT_M) -> Pose:
    """world_from_cam of a level camera."""
    return Pose(rotation_from_euler(0.0, 0.0, yaw) @ NADIR_BODY_FROM_CAM, np.array([x, y, z]))


@dataclass
class Ground:
    """Points (n, 3) and their descriptors; period_m: the ground repeats itself along x, but for a share of
    the points, which are alike nowhere."""

    seed: int
    size_m: tuple[float, float]
    period_m: float | None = None
    unlike_share: float = 0.0
    points: FloatArray = field(init=False)
    descriptors: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.generator = np.random.default_rng(self.seed)
        width = self.period_m or self.size_m[0]
        count = int(POINTS_PER_M2 * width * self.size_m[1])
        corner = self.generator.uniform([0, -self.size_m[1] / 2], [width, self.size_m[1] / 2], (count, 2))
        descriptors = self.generator.integers(0, 256, (count, BYTES), dtype=np.uint8)
        copies = int(np.ceil(self.size_m[0] / width))
        xy = np.concatenate([corner + np.array([k * width, 0.0]) for k in range(copies)])
        self.points = np.column_stack([xy, np.zeros(len(xy))])
        self.descriptors = np.tile(descriptors, (copies, 1))
        other = np.random.default_rng([self.seed, 1])
        unlike = other.random(len(xy)) < self.unlike_share
        self.descriptors[unlike] = other.integers(0, 256, (unlike.sum(), BYTES), dtype=np.uint8)

    def observe(self, pose: Pose) -> tuple[Query, FloatArray]:
        """What a camera sees, noisy, and where its features truly are in its frame (n, 3)."""
        in_cam = pose.inverse().transform(self.points)
        px = CAMERA.project(in_cam)
        seen = np.flatnonzero(((px > 0) & (px < [CAMERA.width - 1, CAMERA.height - 1])).all(axis=1))
        seen = self.generator.permutation(seen)
        noisy = (px[seen] + self.generator.normal(scale=PX_SIGMA, size=(len(seen), 2))).astype(np.float32)
        flips = np.packbits(self.generator.random((len(seen), 8 * BYTES)) < FLIPPED_SHARE, axis=1)
        zero = np.zeros(len(seen), np.float32)
        features = Features(noisy, self.descriptors[seen] ^ flips, zero, zero, zero)
        return Query(features, CAMERA.rays_from_pixels(noisy), ATTITUDE, TILT), in_cam[seen]


class Flight:
    """A map that grows along true poses, with odometry whose error is known."""

    def __init__(self, ground: Ground, config: Config | None = None) -> None:
        config = config or Config()
        self.ground = ground
        self.map = VisualMap()
        self.optimiser = OnlineOptimiser(self.map.graph)
        rig = Rig((MountedCamera("cam0", CAMERA, Pose(NADIR_BODY_FROM_CAM, np.zeros(3))),))
        extractor = create_extractor("hessian-teblid", 400)
        registrar = create_registrar(rig, config, extractor.max_distance)
        self.places = Places(
            self.map, self.optimiser, Verifier(CAMERA, extractor, registrar, config.revisit), config.revisit
        )
        self.truth: list[Pose] = []

    def add(
        self,
        true_pose: Pose,
        drift: FloatArray | None = None,
        sigma: float = 0.01,
        kind: ConstraintKind = ConstraintKind.ODOMETRY,
    ) -> Query:
        """The next node: odometry, or dead reckoning, sees its true motion times exp(drift), with sigma
        (metres, radians / 2) as its noise."""
        index = len(self.map)
        query, in_cam = self.ground.observe(true_pose)
        pose = true_pose
        if self.truth:
            step = self.truth[-1].inverse() @ true_pose @ Pose.exp(np.zeros(6) if drift is None else drift)
            pose = self.map.graph.pose(index - 1) @ step
        n = len(in_cam)
        none = np.full(n, np.nan)
        node = Node(
            index=index,
            frame_index=index,
            t_ns=index * 10**8,
            features=query.features,
            rays=query.rays,
            points_in_cam=in_cam,
            depth_sigma_m=np.full(n, 0.003),
            inverse_depth=none,
            ray_sigma=np.full(n, 0.001),
            tracks=self.map.new_tracks(n),
            anchor=np.full(n, index),
            anchor_row=np.arange(n),
            tilt=TILT,
            height=None,
            parent=index - 1,
        )
        self.map.add_node(node, pose)
        if self.truth:
            covariance = np.diag([sigma**2] * 3 + [(0.5 * sigma) ** 2] * 3)
            added = self.optimiser.add(
                Constraint(index - 1, index, step, information_of_constraint(covariance), kind)
            )
            node.constraint = added.constraint
        self.truth.append(true_pose)
        return query

    def error_m(self, node: int) -> float:
        """Horizontal distance of a node from the truth; the first one is exact."""
        return float(np.linalg.norm((self.map.graph.positions[node] - self.truth[node].translation)[:2]))
