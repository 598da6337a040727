"""Where the map lies on Earth: a similarity from the world to the positions that GPS gave, found after the
flight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pyproj import Transformer

from overfly.adjustment import Positions
from overfly.geometry.geodesy import GeoOrigin, enu_from_geodetic, utm_crs, utm_epsg
from overfly.geometry.poses import FloatArray, rotation_z
from overfly.geometry.similarity import align_about_vertical
from overfly.graph.batch import Start, optimise_batch
from overfly.pipeline.joining_pieces import join_pieces_by_position
from overfly.pipeline.recording import Recording
from overfly.products.georeference import GeoReference
from overfly.scale import WITHOUT_OWN_METRE
from overfly.slam import Slam
from overfly.types import IntArray

# Errors of GPS positions change slowly: those of so many seconds count as one.
CORRELATION_S = 20.0
FLAT_SHARE = 0.03  # of its height over flat ground, which a camera without measured depth keeps to
ANCHOR_ROUNDS = 4  # heading, accuracy of the receiver and optimisation depend on each other
ADJUSTMENT_ROUNDS = 2  # the same, of a map that is stiff


@dataclass(frozen=True, slots=True, eq=False)
class Georeferenced:
    """The map on Earth: similarity to its UTM zone, how well it fits, and the origin in degrees for other
    formats.
    """

    reference: GeoReference
    horizontal_rms_m: float
    residuals_m: FloatArray  # (n, 3) east, north, up of the camera positions against GPS


def georeference(recording: Recording) -> Georeferenced | None:
    """Fit the map to its GPS positions, if it has any; give it their metre when it has no better one of its
    own.
    """
    fitted = _positions(recording)
    if fitted is None:
        return None
    body, geodetic, sigma = fitted
    origin = GeoOrigin(*(float(value) for value in geodetic[0]))
    local = align_about_vertical(body, enu_from_geodetic(geodetic, origin), sigma)
    if local is None:
        return None
    start = recording.slam.start
    if start is not None and start.source in (*WITHOUT_OWN_METRE, "gps"):
        recording.slam.rescale(local.scale, "gps")
    join_pieces_by_position(recording)
    anchor_to_positions(recording)
    fitted = _positions(recording)
    if fitted is None:
        return None
    body, geodetic, sigma = fitted
    crs = utm_crs(origin.latitude_deg, origin.longitude_deg)
    transformer = Transformer.from_crs(4326, crs, always_xy=True)
    east, north = transformer.transform(geodetic[:, 1], geodetic[:, 0])
    projected = align_about_vertical(body, np.column_stack([east, north, geodetic[:, 2]]), sigma)
    if projected is None:
        return None
    epsg = utm_epsg(origin.latitude_deg, origin.longitude_deg)
    x, y, z = (float(value) for value in projected.translation_m)
    return Georeferenced(
        GeoReference(f"EPSG:{epsg}", projected.scale, projected.rotation_rad, (x, y, z)),
        projected.horizontal_rms_m,
        projected.residuals_m,
    )


def _positions(recording: Recording) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """World positions of the body (n, 3), geodetic positions (n, 3) and horizontal sigmas (n,) of frames that
    have both.
    """
    body_from_cam = recording.slam.rig.cam0.body_from_cam
    rows = []
    for record in recording.slam.placed():
        position = recording.positions.get(record.t_ns)
        if position is not None:
            body = recording.slam.pose_of(record) @ body_from_cam.inverse()
            geodetic = (position.latitude_deg, position.longitude_deg, position.altitude_m)
            rows.append((*body.translation, *geodetic, max(position.sigma_horizontal_m, 0.01)))
    if not rows:
        return None
    table = np.array(rows)
    return table[:, :3], table[:, 3:6], table[:, 6]


def anchor_to_positions(recording: Recording) -> None:
    """Let GPS hold the nodes where the map alone is soft: the whole map is adjusted with their positions, or,
    where that is switched off, the graph is optimised with them as absolute constraints.

    The world keeps its own origin and heading; GPS is turned into it by the similarity that fits best.
    """
    slam = recording.slam
    known = _node_positions(recording)
    if known is None:
        return
    nodes, enu, sigma, alike = known
    heights = slam.map.graph.positions[:, 2].copy()
    for _ in range(ANCHOR_ROUNDS if not slam.config.adjustment.enabled else ADJUSTMENT_ROUNDS):
        positions = _wanted(slam, nodes, enu, sigma, alike)
        if positions is None:
            return
        if slam.adjust(positions) is None:
            _anchor_graph(slam, positions, heights)


def _node_positions(recording: Recording) -> tuple[IntArray, FloatArray, FloatArray, float] | None:
    """Nodes (k,) with a position, east, north, up (k, 3), sigmas (k, 2) horizontal and vertical, and the
    factor on these that makes up for errors that change slowly; None for fewer than three.
    """
    nodes, geodetic, sigmas = [], [], []
    is_placed = recording.slam.main_piece()
    for node in recording.slam.map.nodes:
        position = recording.positions.get(node.t_ns)
        if position is not None and is_placed[node.index] and np.isfinite(position.sigma_vertical_m):
            nodes.append(node.index)
            geodetic.append((position.latitude_deg, position.longitude_deg, position.altitude_m))
            sigmas.append((position.sigma_horizontal_m, position.sigma_vertical_m))
    if len(nodes) < 3:
        return None
    stamps_s = np.array([recording.slam.map.nodes[node].t_ns for node in nodes]) * 1e-9
    alike = math.sqrt(max(1.0, CORRELATION_S / max(float(np.median(np.diff(stamps_s))), 1e-3)))
    enu = enu_from_geodetic(np.array(geodetic), GeoOrigin(*geodetic[0]))
    return np.array(nodes), enu, np.maximum(np.array(sigmas), 0.01), alike


def _wanted(
    slam: Slam, nodes: IntArray, enu: FloatArray, sigma: FloatArray, alike: float
) -> Positions | None:
    """Where GPS would have the cameras of the nodes, in the world as it is now."""
    cam_from_body = slam.rig.cam0.body_from_cam.inverse()
    poses = [slam.map.graph.pose(int(node)) for node in nodes]
    body = np.array([(pose @ cam_from_body).translation for pose in poses])
    fit = align_about_vertical(body, enu, sigma[:, 0])
    if fit is None:
        return None
    lever = np.array([pose.rotation @ cam_from_body.translation for pose in poses])
    wanted = (enu - fit.translation_m) @ rotation_z(fit.rotation_rad) - lever
    horizontal = _deviations(np.linalg.norm(fit.residuals_m[:, :2], axis=1), sigma[:, 0]) * alike
    vertical = _deviations(np.abs(fit.residuals_m[:, 2]), sigma[:, 1]) * alike
    give_metre = slam.start is not None and slam.start.source in (*WITHOUT_OWN_METRE, "gps")
    return Positions(nodes, wanted, np.column_stack([horizontal, horizontal, vertical]), give_metre)


def _anchor_graph(slam: Slam, positions: Positions, heights: FloatArray) -> None:
    """One optimisation of the graph with positions, and where depth is not measured with the heights (n,)
    over flat ground that the map had.
    """
    graph = slam.map.graph
    anchored = graph.copy()
    for number, place, sigma in zip(positions.node, positions.position, positions.sigma, strict=True):
        anchored.add_prior_position(int(number), place, np.diag(sigma) ** 2)
    if not slam.measures_depth:
        for number, height in enumerate(heights):
            anchored.add_prior_height(number, float(height), FLAT_SHARE * abs(float(height)))
    optimise_batch(anchored, start=Start.GIVEN)
    graph.positions[:] = anchored.positions
    graph.quaternions[:] = anchored.quaternions


def _deviations(residual: FloatArray, sigma: FloatArray) -> FloatArray:
    """Standard deviations that the residuals (n,), metres, make believable.

    A receiver that is worse than it says shows in the residuals that the stiff graph leaves; one position
    that the others contradict counts as little as its own residual says.
    """
    typical = np.maximum(sigma, float(np.median(residual)))
    return np.asarray(typical * np.maximum(1.0, residual / (3.0 * typical)))
