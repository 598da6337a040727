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
from overfly.pipeline.position_accuracy import CORRELATION_S, accuracy_shown
from overfly.pipeline.recording import Recording
from overfly.products.georeference import GeoReference
from overfly.scale import WITHOUT_OWN_METRE
from overfly.sensors.default_sigmas import GPS_ALTITUDE_SIGMA_M, POSITION_SIGMA_M, state_no_accuracy
from overfly.slam import Slam
from overfly.types import IntArray

FLAT_SHARE = 0.03  # of its height over flat ground, which a camera without measured depth keeps to
ANCHOR_ROUNDS = 4  # heading, accuracy of the receiver and optimisation depend on each other
ADJUSTMENT_ROUNDS = 2  # the same, of a map that is stiff


@dataclass(frozen=True, slots=True, eq=False)
class Georeferenced:
    """The map on Earth: similarity to its UTM zone, and how well it fits.

    place_sigma_m: deviation of the whole map's place, which residuals do not show: what the fixes of one
    flight err in common is as large as the receiver says, or as is usual, and as they differ at least.
    """

    reference: GeoReference
    horizontal_rms_m: float
    place_sigma_m: float
    residuals_m: FloatArray  # (n, 3) east, north, up of the camera positions against GPS


@dataclass(frozen=True, slots=True, eq=False)
class _Fixes:
    """Of every located frame with a position: the node (k,) that it hangs by, where the map has that node's
    camera and the frame's body, (k, 3); geodetic (k, 3) position and sigma (k, 2) horizontal and vertical,
    metres.
    """

    node: IntArray
    t_ns: IntArray
    camera: FloatArray
    body: FloatArray
    geodetic: FloatArray
    sigma: FloatArray


def georeference(recording: Recording) -> Georeferenced | None:
    """Fit the map to its GPS positions, if it has any; give it their metre when it has no better one of its
    own.
    """
    fixes = _fixes(recording)
    if fixes is None:
        return None
    origin = GeoOrigin(*(float(value) for value in fixes.geodetic[0]))
    local = align_about_vertical(fixes.body, enu_from_geodetic(fixes.geodetic, origin), fixes.sigma[:, 0])
    if local is None:
        return None
    if _gives_metre(recording.slam):
        recording.slam.rescale(local.scale, "gps")
    join_pieces_by_position(recording)
    anchor_to_positions(recording)
    fixes = _fixes(recording)
    if fixes is None:
        return None
    crs = utm_crs(origin.latitude_deg, origin.longitude_deg)
    transformer = Transformer.from_crs(4326, crs, always_xy=True)
    east, north = transformer.transform(fixes.geodetic[:, 1], fixes.geodetic[:, 0])
    projected = align_about_vertical(
        fixes.body, np.column_stack([east, north, fixes.geodetic[:, 2]]), fixes.sigma[:, 0]
    )
    if projected is None:
        return None
    epsg = utm_epsg(origin.latitude_deg, origin.longitude_deg)
    x, y, z = (float(value) for value in projected.translation_m)
    return Georeferenced(
        GeoReference(f"EPSG:{epsg}", projected.scale, projected.rotation_rad, (x, y, z)),
        projected.horizontal_rms_m,
        max(float(np.median(fixes.sigma[:, 0])), projected.horizontal_rms_m / math.sqrt(2.0)),
        projected.residuals_m,
    )


def anchor_to_positions(recording: Recording) -> None:
    """Let GPS hold the map where it alone is soft: the whole map is adjusted with the positions of all its
    frames, or, where that is switched off, the graph is optimised with them as absolute constraints.

    The world keeps its own origin and heading; GPS is turned into it by the similarity that fits best.
    """
    slam = recording.slam
    heights = slam.map.graph.positions[:, 2].copy()
    for _ in range(ANCHOR_ROUNDS if not slam.config.adjustment.enabled else ADJUSTMENT_ROUNDS):
        fixes = _fixes(recording)
        positions = None if fixes is None else _wanted(slam, fixes)
        if positions is None:
            return
        if slam.adjust(positions) is None:
            _anchor_graph(slam, positions, heights)


def _gives_metre(slam: Slam) -> bool:
    return slam.start is not None and slam.start.source in (*WITHOUT_OWN_METRE, "gps")


def _fixes(recording: Recording) -> _Fixes | None:
    """As the map is now; None where there are none."""
    slam = recording.slam
    records = [record for record in slam.placed() if record.t_ns in recording.positions]
    if not records:
        return None
    cam_from_body = slam.rig.cam0.body_from_cam.inverse()
    positions = [recording.positions[record.t_ns] for record in records]
    node = np.array([record.node for record in records])
    return _Fixes(
        node,
        np.array([record.t_ns for record in records]),
        slam.map.graph.positions[node],
        np.array([(slam.pose_of(record) @ cam_from_body).translation for record in records]),
        np.array([(one.latitude_deg, one.longitude_deg, one.altitude_m) for one in positions]),
        np.maximum([(one.sigma_horizontal_m, one.sigma_vertical_m) for one in positions], 0.01),
    )


def _wanted(slam: Slam, fixes: _Fixes) -> Positions | None:
    """Where GPS would have the cameras of the nodes, in the world as it is now: the mean of what the frames
    that hang by a node say.

    Errors that change slowly make deviations larger, so that a node counts as much however often its time
    was measured.
    """
    known = np.isfinite(fixes.sigma[:, 1])
    node, sigma = fixes.node[known], fixes.sigma[known]
    if len(np.unique(node)) < 3:
        return None
    enu = enu_from_geodetic(fixes.geodetic[known], GeoOrigin(*fixes.geodetic[known][0]))
    fit = align_about_vertical(fixes.body[known], enu, sigma[:, 0])
    if fit is None:
        return None
    apart_s = 1e-9 * float(np.median(np.diff(fixes.t_ns[known])))
    alike = math.sqrt(max(1.0, CORRELATION_S / max(apart_s, 1e-3)))
    wanted = (enu - fit.translation_m) @ rotation_z(fit.rotation_rad) - (fixes.body - fixes.camera)[known]
    horizontal, vertical = alike * _deviations(fit.residuals_m, sigma, fixes.body[known], fixes.t_ns[known])
    weight = np.column_stack([horizontal, horizontal, vertical]) ** -2.0
    nodes, which = np.unique(node, return_inverse=True)
    total, places = np.zeros((len(nodes), 3)), np.zeros((len(nodes), 3))
    np.add.at(total, which, weight)
    np.add.at(places, which, weight * wanted)
    return Positions(nodes, places / total, total**-0.5, _gives_metre(slam))


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


def _deviations(residual: FloatArray, sigma: FloatArray, body: FloatArray, t_ns: IntArray) -> FloatArray:
    """(2, n) horizontal and vertical standard deviations that residuals (n, 3), metres, make believable.

    A receiver that is worse than it says, sigma (n, 2), shows in the residuals that the stiff graph leaves;
    one that says nothing may be better than the default as well. One position that the others contradict
    counts as little as its own residual says.
    """
    silent = state_no_accuracy(sigma)
    found = []
    for axes, stated, usual_m in (
        (slice(0, 2), sigma[:, 0], POSITION_SIGMA_M),
        (slice(2, 3), sigma[:, 1], GPS_ALTITUDE_SIGMA_M),
    ):
        length = np.linalg.norm(residual[:, axes], axis=1)
        typical = np.maximum(stated, float(np.median(length)))
        if np.count_nonzero(silent) >= 3:
            typical[silent] = accuracy_shown(residual[silent, axes], body[silent], t_ns[silent], usual_m)
        found.append(typical * np.maximum(1.0, length / (3.0 * typical)))
    return np.array(found)
