"""overfly export: a finished map in the format of another program. run() is the list of what happens."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from overfly.errors import OverflyError, UsageError
from overfly.geometry.poses import FloatArray
from overfly.graph.files import write_graph
from overfly.mapstore import Map
from overfly.pieces import main_piece
from overfly.pipeline.keeping import MAP_NAME
from overfly.pipeline.results import elevation_of_points
from overfly.products.elevation import ElevationGrid, read_elevation
from overfly.products.exports.colmap import write_colmap
from overfly.products.exports.content import GroundPoints, NodeImage, Reconstruction
from overfly.products.exports.geographic import write_geojson, write_gpx, write_kml
from overfly.products.exports.occupancy import write_occupancy
from overfly.products.exports.point_clouds import write_las, write_ply
from overfly.products.exports.trajectories import write_euroc, write_kitti
from overfly.products.georeference import GeoReference
from overfly.products.pictures import map_picture
from overfly.sensors import open_flight
from overfly.trajectory import Trajectory, write_tum
from overfly.types import BoolArray, IntArray, UInt8Array


class Format(StrEnum):
    """What a map can be written as."""

    TUM = "tum"
    KITTI = "kitti"
    EUROC = "euroc"
    G2O = "g2o"
    COLMAP = "colmap"
    GEOJSON = "geojson"
    KML = "kml"
    GPX = "gpx"
    PLY = "ply"
    LAS = "las"
    OCCUPANCY = "occupancy"


@dataclass(frozen=True, slots=True)
class ExportRequest:
    """Which map (a map file, or the folder that map left) as what, and where.

    flight: number of the flight whose trajectory is meant, None for all; obstacle_m: for occupancy, how far
    something stands out of the ground to be in the way.
    """

    source: Path
    to: Format
    out: Path
    flight: int | None = None
    obstacle_m: float = 0.3


Writer = Callable[[ExportRequest, Map], dict[str, Any]]


def run(request: ExportRequest) -> dict[str, Any]:
    """Write the file; returns what it holds, in numbers. Raises OverflyError in one line."""
    known = open_map(request.source)
    counts = WRITERS[request.to](request, known)
    return {"format": str(request.to), "output": str(request.out), **counts}


def open_map(source: Path) -> Map:
    """source: a map file or the folder that holds it."""
    return Map.open(source / MAP_NAME if source.is_dir() else source)


def placed_nodes(known: Map) -> BoolArray:
    """(n,) whether a node belongs to the main piece; where the others are against it is not known."""
    located = [frame.node for frame in known.frames if frame.node is not None]
    return main_piece(known.visual.graph, np.array(located, np.int64))


def trajectory_of(known: Map, flight: int | None = None) -> Trajectory:
    """world_from_cam of every located frame as the graph has it, of one flight or of all in the order of
    time.

    Raises UsageError for a flight that is not in the map, or flights whose times overlap.
    """
    if flight is not None and not 0 <= flight < len(known.flights):
        raise UsageError(f"--flight {flight}: the map holds flights 0 to {len(known.flights) - 1}")
    is_placed = known.main_piece()
    is_placed = placed_nodes(known)
    rows = [
        (frame.t_ns, known.visual.graph.pose(frame.node) @ frame.node_from_cam)
        for frame in known.frames
        if frame.node is not None
        and frame.node_from_cam is not None
        and is_placed[frame.node]
        and (flight is None or frame.flight == flight)
    ]
    if not rows:
        raise UsageError(f"{known.path}: no located frame, so there is no trajectory to export")
    rows.sort(key=lambda row: row[0])
    t_ns = np.array([t for t, _ in rows], np.int64)
    if (np.diff(t_ns) == 0).any():
        raise UsageError(f"{known.path}: flights were recorded at the same times; choose one with --flight")
    return Trajectory.from_poses(t_ns, [pose for _, pose in rows])


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """The map's ground points: each track once, where the nodes that saw it place it together.

    point (n_tracks,): row in ``points`` of a track, -1 where no depth is known.
    """

    points: GroundPoints
    point: IntArray


def tracks_of(known: Map, least_views: int) -> Tracks:
    """Tracks seen from least_views nodes or more; mean of the nodes' points, weighted by their variances."""
    visual = known.visual
    nodes = [node for node, placed in zip(visual.nodes, placed_nodes(known), strict=True) if placed]
    has = [node.has_point for node in nodes]
    track = np.concatenate([np.zeros(0, np.int64), *(n.tracks[k] for n, k in zip(nodes, has, strict=True))])
    world = [visual.points_in_world(n)[k] for n, k in zip(nodes, has, strict=True)]
    points = np.concatenate([np.zeros((0, 3)), *world])
    sigma = np.concatenate([np.zeros(0), *(n.depth_sigma_m[k] for n, k in zip(nodes, has, strict=True))])
    weight = 1.0 / np.maximum(sigma, 1e-4) ** 2
    size = visual.n_tracks
    views = np.bincount(np.concatenate([np.zeros(0, np.int64), *(n.tracks for n in nodes)]), minlength=size)
    total = np.bincount(track, weight, size)
    chosen = np.flatnonzero((views >= least_views) & (total > 0))
    sums = np.stack([np.bincount(track, weight * points[:, axis], size) for axis in range(3)], axis=1)
    positions = sums[chosen] / total[chosen, None]
    # views of one point share their errors: the best of them, not their sum, tells how well it is known
    best = np.full(size, np.inf)
    np.minimum.at(best, track, sigma)
    row = np.full(size, -1)
    row[chosen] = np.arange(len(chosen))
    return Tracks(GroundPoints(positions, best[chosen], colours_of(known, positions)), row)


def colours_of(known: Map, positions: FloatArray) -> UInt8Array | None:
    """(n, 3) colours of points from the mosaic beside the map; None where there is no mosaic."""
    mosaic = None if known.path is None else known.path.with_name("mosaic.tif")
    if mosaic is None or not mosaic.exists():
        return None
    picture = map_picture(mosaic, known.georeference, longest_px=8000)
    px = np.floor(picture.pixels_from_world(positions[:, :2])).astype(np.int64)
    rows, columns = picture.rgba.shape[:2]
    x, y = np.clip(px[:, 0], 0, columns - 1), np.clip(px[:, 1], 0, rows - 1)
    return np.ascontiguousarray(picture.rgba[y, x, :3])


def reconstruction_of(known: Map) -> Reconstruction:
    """Nodes as images, ground points seen from several nodes as 3D points."""
    tracks = tracks_of(known, least_views=2)
    names = node_names(known)
    images = []
    for node, placed in zip(known.visual.nodes, placed_nodes(known), strict=True):
        if not placed:
            continue
        flight = known.node_flights[node.index]
        camera = known.flights[flight].rig.cam0.camera
        point = np.full(len(node.tracks), -1)
        _, first = np.unique(node.tracks, return_index=True)  # an image sees a point once
        point[first] = tracks.point[node.tracks[first]]
        px = camera.pixels_from_rays(node.rays)
        images.append(NodeImage(names[node.index], flight, known.visual.graph.pose(node.index), px, point))
    cameras = tuple(flight.rig.cam0.camera for flight in known.flights)
    return Reconstruction(cameras, tuple(images), tracks.points)


def node_names(known: Map) -> list[str]:
    """File names of the nodes' pictures, from the recorded flight where it still is; else their times."""
    names = [f"{node.t_ns}.png" for node in known.visual.nodes]
    for entry in known.flights:
        mine = [node for node in known.visual.nodes if known.node_flights[node.index] == entry.number]
        try:
            flight = open_flight(Path(entry.source))
        except (OverflyError, OSError):
            continue  # the recording is elsewhere now
        index = {int(t): number for number, t in enumerate(flight.t_ns)}
        for node in mine:
            frame = flight.read_frame(index[node.t_ns]) if node.t_ns in index else None
            if frame is not None:
                names[node.index] = frame.name
    return names


def elevation_of(known: Map) -> ElevationGrid:
    """The elevation beside the map, else that of the map's points. Raises UsageError where there is none."""
    beside = None if known.path is None else known.path.with_name("elevation.tif")
    if beside is not None and beside.exists():
        return read_elevation(beside, known.georeference)
    grid = elevation_of_points(*known.visual.all_points(known.main_piece()))
    if grid is None:
        raise UsageError(f"{known.path}: no height of the ground is known, so nothing can stand out of it")
    return grid


def _on_earth(request: ExportRequest, known: Map) -> GeoReference:
    if known.georeference is None:
        raise UsageError(
            f"{known.path} does not know where it lies on Earth, which {request.to} needs: "
            "map a flight with GPS, or choose tum, euroc or ply"
        )
    return known.georeference


def _tum(request: ExportRequest, known: Map) -> dict[str, Any]:
    trajectory = trajectory_of(known, request.flight)
    write_tum(request.out, trajectory)
    return {"poses": len(trajectory)}


def _kitti(request: ExportRequest, known: Map) -> dict[str, Any]:
    trajectory = trajectory_of(known, request.flight)
    write_kitti(request.out, trajectory)
    return {"poses": len(trajectory)}


def _euroc(request: ExportRequest, known: Map) -> dict[str, Any]:
    trajectory = trajectory_of(known, request.flight)
    flights = known.flights if request.flight is None else [known.flights[request.flight]]
    mountings = [entry.rig.cam0.body_from_cam for entry in flights]
    if any(not np.allclose(mounting.matrix(), mountings[0].matrix()) for mounting in mountings):
        raise UsageError(f"{known.path}: flights had their cameras mounted differently; choose with --flight")
    write_euroc(request.out, trajectory, mountings[0])
    return {"poses": len(trajectory)}


def _g2o(request: ExportRequest, known: Map) -> dict[str, Any]:
    write_graph(request.out, known.visual.graph)
    return {"nodes": len(known), "constraints": known.visual.graph.n_constraints}


def _colmap(request: ExportRequest, known: Map) -> dict[str, Any]:
    model = reconstruction_of(known)
    write_colmap(request.out, model)
    return {"images": len(model.images), "points": len(model.points)}


def _track(
    write: Callable[[Path, str, Trajectory, GeoReference], None],
) -> Writer:
    def writer(request: ExportRequest, known: Map) -> dict[str, Any]:
        reference = _on_earth(request, known)
        trajectory = trajectory_of(known, request.flight)
        name = Path(known.flights[request.flight or 0].source).name
        write(request.out, name, trajectory, reference)
        return {"poses": len(trajectory), "crs": reference.crs}

    return writer


def _ply(request: ExportRequest, known: Map) -> dict[str, Any]:
    points = tracks_of(known, least_views=1).points
    write_ply(request.out, points)
    return {"points": len(points)}


def _las(request: ExportRequest, known: Map) -> dict[str, Any]:
    points = tracks_of(known, least_views=1).points
    write_las(request.out, points, known.georeference)
    return {"points": len(points), "crs": known.georeference.crs if known.georeference else None}


def _occupancy(request: ExportRequest, known: Map) -> dict[str, Any]:
    path = request.out if request.out.suffix in (".yaml", ".yml") else request.out.with_suffix(".yaml")
    grid = elevation_of(known)
    write_occupancy(path, grid, request.obstacle_m)
    rows, columns = grid.heights.shape
    return {"output": str(path), "columns": columns, "rows": rows, "cell_m": grid.cell_m}


WRITERS: dict[Format, Writer] = {
    Format.TUM: _tum,
    Format.KITTI: _kitti,
    Format.EUROC: _euroc,
    Format.G2O: _g2o,
    Format.COLMAP: _colmap,
    Format.GEOJSON: _track(write_geojson),
    Format.KML: _track(write_kml),
    Format.GPX: _track(write_gpx),
    Format.PLY: _ply,
    Format.LAS: _las,
    Format.OCCUPANCY: _occupancy,
}
