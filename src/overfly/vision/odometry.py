"""Visual odometry: the current picture against the previous n nodes (paper, section IV).

The features of all n nodes are matched with the current ones, pooled, and one pose is found for all of them;
each node that keeps enough inliers then gives a constraint of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from overfly.geometry.poses import FloatArray, Pose
from overfly.types import (
    BoolArray,
    Constraint,
    Correspondences,
    Features,
    Float32Array,
    IntArray,
    NotFound,
    PoseEstimate,
    Reason,
)
from overfly.vision.features import Extractor
from overfly.vision.matching import match_guided, match_mutual
from overfly.vision.observation import Observation
from overfly.vision.refine import HeightPrior, TiltPrior
from overfly.vision.registration import Registrar

GUIDED_RADIUS = 0.15  # of the picture's width: how far from its prediction a feature is looked for first


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """A node to match with: its features, their points in the world (n, 3), NaN where unknown, and how far
    these may lie off (n, 3).
    """

    node: int
    features: Features
    points: FloatArray
    spread: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PooledMatches:
    """Correspondences with several nodes, sorted by descriptor distance; node (m,) the node
    each comes from.
    """

    correspondences: Correspondences
    node: IntArray


def match_references(
    observation: Observation,
    references: Sequence[Reference],
    extractor: Extractor,
    predicted: Pose | None,
) -> PooledMatches:
    """Match the current features with those of the nodes; near where predicted (world_from_cam) puts them, if
    given.
    """
    camera = observation.rig.cam0.camera
    found: list[tuple[np.ndarray, ...]] = []
    for reference in references:
        usable = np.flatnonzero(np.isfinite(reference.points[:, 2]))
        descriptors = reference.features.descriptors[usable]
        if predicted is None:
            a, b, distance = match_mutual(
                descriptors, observation.features.descriptors, extractor.metric, extractor.max_distance
            )
        else:
            a, b, distance = match_guided(
                descriptors,
                observation.features.descriptors,
                extractor.metric,
                extractor.max_distance,
                camera.project(predicted.inverse().transform(reference.points[usable])),
                observation.features.px,
                GUIDED_RADIUS * camera.width,
            )
        node = np.full(len(a), reference.node, np.int64)
        points, spread = reference.points[usable[a]], reference.spread[usable[a]]
        found.append((points, observation.rays[b], distance, usable[a], b, node, spread))
    points, rays, distance, map_index, frame_index, node, spread = (
        np.concatenate(column) for column in zip(*found, strict=True)
    )
    order = np.argsort(distance, kind="stable")
    order = order[np.isfinite(rays[order, 0])]
    return PooledMatches(
        Correspondences(
            points[order], rays[order], distance[order], map_index[order], frame_index[order], spread[order]
        ),
        node[order],
    )


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """A pose found against nodes, with the matches it rests on.

    px: (m, 2) where followed points are in the picture; None when features of the frame were matched instead.
    filled: (m,) points that were not found themselves, but put where all of the picture agrees.
    sigma_px: (m,) how exactly each followed point was found by its patch, NaN where it was not.
    """

    estimate: PoseEstimate
    matches: PooledMatches
    px: Float32Array | None = None
    filled: BoolArray | None = None
    sigma_px: FloatArray | None = None

    @property
    def pose(self) -> Pose:
        """world_from_cam."""
        return self.estimate.world_from_cam

    @property
    def main_node(self) -> int:
        """The node with most inliers, the newest of equals."""
        nodes = self.matches.node[self.estimate.inliers]
        first = int(nodes.min())
        counts = np.bincount(nodes - first)
        return first + len(counts) - 1 - int(np.argmax(counts[::-1]))

    def nodes(self) -> list[int]:
        """Nodes with inliers, newest first."""
        return [int(node) for node in np.unique(self.matches.node[self.estimate.inliers])[::-1]]

    def inliers_of(self, node: int) -> IntArray:
        """Rows of the correspondences that are inliers and come from this node."""
        inliers = self.estimate.inliers
        return np.asarray(inliers[self.matches.node[inliers] == node])


def locate_against(
    observation: Observation,
    references: Sequence[Reference],
    extractor: Extractor,
    registrar: Registrar,
    predicted: Pose | None,
    height_range_m: tuple[float, float],
    height: HeightPrior | None,
) -> Located | NotFound:
    """The current pose from the features of some nodes: first near the prediction, then anywhere."""
    if len(observation.features) < registrar.config.registration.min_inliers:
        return NotFound(Reason.FEW_FEATURES, f"{len(observation.features)} features")
    outcome: NotFound | None = None
    for guess in (predicted, None) if predicted is not None else (None,):
        matches = match_references(observation, references, extractor, guess)
        estimate = registrar.register(
            matches.correspondences, observation.frame.attitude, height_range_m, height
        )
        if isinstance(estimate, PoseEstimate):
            return Located(estimate, matches)
        outcome = estimate
    return outcome or NotFound(Reason.FEW_MATCHES)


MIN_CONSTRAINT_INLIERS = 8


def constraints_to_nodes(
    located: Located,
    poses: dict[int, Pose],
    new_node: int,
    registrar: Registrar,
    tilt: TiltPrior,
    localisation_px: float,
) -> list[Constraint]:
    """One constraint per node with enough inliers, from a refinement on that node's inliers alone.

    poses: world_from_cam of the nodes, in which the correspondences' points are.
    """
    constraints = []
    for node in located.nodes():
        rows = located.inliers_of(node)
        if len(rows) < MIN_CONSTRAINT_INLIERS and node != located.main_node:
            continue
        estimate = registrar.refine(
            located.pose,
            subset(located.matches.correspondences, rows),
            tilt,
            None,
            located.estimate.score,
            localisation_px,
        )
        if isinstance(estimate, NotFound):
            if node != located.main_node:
                continue
            estimate = located.estimate
        node_from_new = poses[node].inverse() @ estimate.world_from_cam
        constraints.append(
            Constraint(node, new_node, node_from_new, information_of_constraint(estimate.covariance))
        )
    return constraints


def information_of_constraint(covariance: FloatArray) -> FloatArray:
    """Information (6, 6) of (translation, vector part of the quaternion) from a covariance of (translation,
    rotation).

    The vector part of a small rotation's quaternion is half the rotation vector.
    """
    scale = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])
    return np.asarray(np.linalg.inv(covariance) * np.outer(scale, scale))


def subset(correspondences: Correspondences, rows: IntArray) -> Correspondences:
    """Some rows of the correspondences, in their order."""
    return Correspondences(
        correspondences.points[rows],
        correspondences.rays[rows],
        correspondences.distance[rows],
        correspondences.map_index[rows],
        correspondences.frame_index[rows],
        None if correspondences.spread is None else correspondences.spread[rows],
    )
