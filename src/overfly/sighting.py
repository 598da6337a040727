"""What a new node saw: followed points under their old identity, and fresh features between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from overfly.geometry.poses import FloatArray
from overfly.types import Features, IntArray
from overfly.vision.observation import Observation
from overfly.vision.odometry import Located
from overfly.visual_map import VisualMap

SAME_PX = 2.0  # a fresh feature this near to a followed point, in a picture 320 wide, is that point
# Points that were put where the whole picture agrees err together: each counts so little that all of them
# count as one.
FILLED_SIGMA = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """Features of a new node, n of them.

    rays (n, 2) undistorted image coordinates, and ray_sigma (n,) their standard deviation; tracks (n,)
    identity of the ground point; anchor (n,) node that saw it first and anchor_row (n,) its feature there, -1
    where that is the new node itself; world (n, 3) metres and depth_sigma_m (n,) of points that are known
    already, NaN of new ones.
    """

    features: Features
    rays: FloatArray
    ray_sigma: FloatArray
    tracks: IntArray
    anchor: IntArray
    anchor_row: IntArray
    world: FloatArray
    depth_sigma_m: FloatArray


def first_sighting(view: Observation, visual_map: VisualMap, ray_sigma: float) -> Sighting:
    """Everything is new."""
    return _all_new(visual_map, view.features, view.rays, np.full(len(view.features), ray_sigma))


def _all_new(visual_map: VisualMap, features: Features, rays: FloatArray, ray_sigma: FloatArray) -> Sighting:
    count = len(features)
    return Sighting(
        features,
        rays,
        ray_sigma,
        visual_map.new_tracks(count),
        np.full(count, -1, np.int64),
        np.full(count, -1, np.int64),
        np.full((count, 3), np.nan),
        np.full(count, np.nan),
    )


def matched_sighting(
    view: Observation, located: Located, visual_map: VisualMap, ray_sigma: float
) -> Sighting:
    """The frame's own features; those matched with nodes carry on their tracks, the oldest node's last so
    that it wins.
    """
    sighting = first_sighting(view, visual_map, ray_sigma)
    correspondences = located.matches.correspondences
    for index in located.nodes():
        rows = located.inliers_of(index)
        frame_rows, map_rows = correspondences.frame_index[rows], correspondences.map_index[rows]
        _carry_on(sighting, visual_map, np.full(len(rows), index), map_rows, frame_rows)
    return sighting


def followed_sighting(
    view: Observation, located: Located, visual_map: VisualMap, ray_sigma: float, count: int
) -> Sighting:
    """Followed points that agree first, in the order of the inliers; then fresh features where there are
    none, up to count in all.

    A followed point takes the description of a fresh feature at the same place, else of the feature it was
    before.
    ray_sigma: standard deviation of a fresh feature's ray; that of a followed point is not larger.
    """
    assert located.px is not None
    inliers = located.estimate.inliers
    px = located.px[inliers]
    of_node = located.matches.node[inliers]
    of_row = located.matches.correspondences.map_index[inliers]
    old = _gather(visual_map, of_node, of_row)
    fresh = view.features
    descriptors, size, angle, response = (
        old.descriptors.copy(), old.size_px.copy(), old.angle_rad.copy(), old.response.copy()
    )  # fmt: skip
    free = np.zeros(len(fresh), np.bool_)
    if len(fresh):
        reach = SAME_PX * view.gray.shape[1] / 320.0
        distance, found = cKDTree(fresh.px).query(px, distance_upper_bound=reach)
        same, nearest = np.isfinite(distance), np.asarray(found)
        descriptors[same] = fresh.descriptors[nearest[same]]
        size[same], angle[same] = fresh.size_px[nearest[same]], fresh.angle_rad[nearest[same]]
        response[same] = fresh.response[nearest[same]]
        away, _ = cKDTree(px).query(fresh.px, distance_upper_bound=reach)
        free = ~np.isfinite(away)
    keep = np.flatnonzero(free)[: max(0, count - len(px))]
    features = Features(
        np.concatenate([px, fresh.px[keep]]).astype(np.float32),
        np.concatenate([descriptors, fresh.descriptors[keep]]) if len(fresh) else descriptors,
        np.concatenate([size, fresh.size_px[keep]]),
        np.concatenate([angle, fresh.angle_rad[keep]]),
        np.concatenate([response, fresh.response[keep]]),
    )
    assert located.sigma_px is not None
    followed_sigma = np.minimum(located.sigma_px[inliers] / view.rig.cam0.camera.focal_px, ray_sigma)
    if located.filled is not None:
        followed_sigma[located.filled[inliers]] = FILLED_SIGMA * ray_sigma
    sighting = _all_new(
        visual_map,
        features,
        view.rig.cam0.camera.rays_from_pixels(features.px),
        np.concatenate([followed_sigma, np.full(len(keep), ray_sigma)]),
    )
    _carry_on(sighting, visual_map, of_node, of_row, np.arange(len(px)))
    return sighting


def _carry_on(
    sighting: Sighting, visual_map: VisualMap, of_node: IntArray, of_row: IntArray, rows: IntArray
) -> None:
    """Give rows of the sighting the identity, the anchor and the place of the features (of_node, of_row)."""
    for index in np.unique(of_node):
        node = visual_map.nodes[int(index)]
        mine = of_node == index
        there = of_row[mine]
        sighting.tracks[rows[mine]] = node.tracks[there]
        sighting.anchor[rows[mine]] = node.anchor[there]
        sighting.anchor_row[rows[mine]] = node.anchor_row[there]
        sighting.world[rows[mine]] = visual_map.points_in_world(node)[there]
        sighting.depth_sigma_m[rows[mine]] = node.depth_sigma_m[there]


def _gather(visual_map: VisualMap, of_node: IntArray, of_row: IntArray) -> Features:
    """The features (of_node, of_row) as one set."""
    first = visual_map.nodes[int(of_node[0])].features
    count = len(of_node)
    gathered = Features(
        np.empty((count, 2), np.float32),
        np.empty((count, first.descriptors.shape[1]), first.descriptors.dtype),
        np.empty(count, np.float32),
        np.empty(count, np.float32),
        np.empty(count, np.float32),
    )
    for index in np.unique(of_node):
        mine = of_node == index
        source = visual_map.nodes[int(index)].features
        for name in ("px", "descriptors", "size_px", "angle_rad", "response"):
            getattr(gathered, name)[mine] = getattr(source, name)[of_row[mine]]
    return gathered
