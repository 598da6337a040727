"""Pieces of a map that no place ties together, laid where GPS says that they are.

The camera was lost, and over other ground a new piece began. Where both have positions, each is fitted to
these about the vertical, and the smaller one is laid beside the main one in the world that the map has.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from overfly.geometry.geodesy import GeoOrigin, enu_from_geodetic
from overfly.geometry.poses import FloatArray, Pose, rotation_z
from overfly.geometry.similarity import align_about_vertical
from overfly.pipeline.recording import Recording
from overfly.scale import WITHOUT_OWN_METRE
from overfly.slam import Slam
from overfly.types import Constraint, ConstraintKind, GeoPosition
from overfly.vision.odometry import information_of_constraint

CORRELATION_S = 20.0  # errors of GPS positions within so many seconds count as one
LARGEST_TURN_SIGMA_RAD = 0.05  # of a piece's heading, and of its scale: one that is known worse stays apart


@dataclass(frozen=True, slots=True)
class _Fit:
    """enu = scale * Rz(turn_rad) world + shift_m, with standard deviations."""

    scale: float
    turn_rad: float
    shift_m: FloatArray
    turn_sigma_rad: float
    place_sigma_m: tuple[float, float]  # horizontal, vertical


def join_pieces_by_position(recording: Recording) -> int:
    """Lay every piece that has positions enough beside the main one; returns how many became part of it."""
    slam = recording.slam
    pieces = slam.map.pieces()
    if not recording.positions or len(np.unique(pieces)) < 2:
        return 0
    first = next(iter(recording.positions.values()))
    origin = GeoOrigin(first.latitude_deg, first.longitude_deg, first.altitude_m)
    has_metre = slam.start is not None and slam.start.source not in (*WITHOUT_OWN_METRE, "gps")
    is_main = slam.main_piece()
    main = _fit(recording, is_main, origin, has_metre)
    if main is None:
        return 0
    oldest = int(np.flatnonzero(is_main)[0])
    joined = 0
    for name in np.unique(pieces[~is_main]):
        is_piece = pieces == name
        fit = _fit(recording, is_piece, origin, has_metre)
        if fit is None:
            continue
        turn = rotation_z(fit.turn_rad - main.turn_rad)
        shift = rotation_z(-main.turn_rad) @ (fit.shift_m - main.shift_m) / main.scale
        tie = _tie_covariance(main, fit)
        slam.lay_piece(is_piece, fit.scale / main.scale, Pose(turn, shift))
        _tie(slam, oldest, int(name), tie)
        joined += 1
    return joined


def _fit(recording: Recording, is_piece: np.ndarray, origin: GeoOrigin, has_metre: bool) -> _Fit | None:
    """None where positions do not tell the piece's heading."""
    cam_from_body = recording.slam.rig.cam0.body_from_cam.inverse()
    world, t_s, known = [], [], []
    for record in recording.slam.records:
        position = recording.positions.get(record.t_ns)
        if is_piece[record.node] and position is not None and math.isfinite(position.sigma_vertical_m):
            world.append((recording.slam.pose_of(record) @ cam_from_body).translation)
            t_s.append(1e-9 * record.t_ns)
            known.append(position)
    if len(known) < 3:
        return None
    body, enu = np.array(world), _enu(known, origin)
    sigma = np.array([max(position.sigma_horizontal_m, 0.01) for position in known])
    fit = align_about_vertical(body, enu, sigma)
    if fit is None:
        return None
    horizontal = max(float(np.median(sigma)), fit.horizontal_rms_m)
    vertical = max(float(np.median([position.sigma_vertical_m for position in known])), 0.01)
    independent = min(max((t_s[-1] - t_s[0]) / CORRELATION_S, 2.0), float(len(known)))
    extent = float(np.linalg.norm(np.std(enu[:, :2], axis=0)))
    turn_sigma = horizontal / (extent * math.sqrt(independent))
    if turn_sigma > LARGEST_TURN_SIGMA_RAD:
        return None
    scale, shift = fit.scale, fit.translation_m
    if has_metre:  # stereo, a range sensor or an object of known size knows it better
        scale, shift = 1.0, np.median(enu - body @ rotation_z(fit.rotation_rad).T, axis=0)
    place_sigma = horizontal / math.sqrt(independent), vertical / math.sqrt(independent)
    return _Fit(scale, fit.rotation_rad, shift, turn_sigma, place_sigma)


def _enu(positions: list[GeoPosition], origin: GeoOrigin) -> FloatArray:
    return enu_from_geodetic(
        np.array([(one.latitude_deg, one.longitude_deg, one.altitude_m) for one in positions]), origin
    )


def _tie_covariance(main: _Fit, fit: _Fit) -> FloatArray:
    """(6, 6) of the piece's place and heading against the main one, in level axes of the world."""
    place, height = (math.hypot(a, b) for a, b in zip(main.place_sigma_m, fit.place_sigma_m, strict=True))
    turn = math.hypot(main.turn_sigma_rad, fit.turn_sigma_rad)
    level = LARGEST_TURN_SIGMA_RAD  # of roll and pitch, which the attitude sensor holds, if there is one
    place, height = place / main.scale, height / main.scale
    return np.diag(np.square([place, place, height, level, level, turn]))


def _tie(slam: Slam, main: int, piece: int, covariance: FloatArray) -> None:
    """One constraint from the oldest node of the main piece to that of the other makes both one."""
    graph = slam.map.graph
    main_from_piece = graph.pose(main).inverse() @ graph.pose(piece)
    turned = np.zeros((6, 6))
    turned[:3, :3] = turned[3:, 3:] = graph.pose(piece).rotation.T
    information = information_of_constraint(turned @ covariance @ turned.T)
    graph.add_constraint(Constraint(main, piece, main_from_piece, information, ConstraintKind.POSITIONS))
