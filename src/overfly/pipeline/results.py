"""The files of a finished run: graph, rasters, metrics."""

from __future__ import annotations

import json
import math
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import overfly
from overfly.adjustment_report import AdjustmentReport
from overfly.attitude_clock import ClockLag
from overfly.config import Config
from overfly.errors import OutputError
from overfly.files import atomic_path
from overfly.geometry.poses import FloatArray
from overfly.graph.files import write_graph
from overfly.pipeline.georeferencing import Georeferenced
from overfly.pipeline.node_pictures import NodePictures
from overfly.pipeline.recording import Recording, peak_memory_mb
from overfly.pipeline.surface import SurfaceView, dense_elevation
from overfly.products.elevation import ElevationGrid, elevation_from_points, write_elevation
from overfly.products.mosaic import Mosaic, write_mosaic
from overfly.products.views import MappedImage
from overfly.self_calibration import RefinedCamera
from overfly.sensors import Flight
from overfly.types import NotFound
from overfly.vision.dense import DepthRange

LIBRARIES = ("numpy", "scipy", "numba", "opencv-contrib-python-headless", "rasterio", "pyproj")
POINTS_PER_CELL = 4  # of the elevation map, on average


def prepare_folder(out: Path) -> None:
    """Make the folder of results and see that files can be written in it, before any work is done."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise OutputError(f"cannot write into {out}: {error.strerror or error}") from error


def write_text(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, tree: dict[str, Any]) -> None:
    write_text(path, json.dumps(tree, indent=2, allow_nan=False) + "\n")


def write_graph_file(path: Path, recording: Recording) -> None:
    """graph.g2o: nodes and constraints, odometry first."""
    with atomic_path(path) as temporary:
        write_graph(temporary, recording.slam.map.graph)


def write_elevation_map(
    path: Path, pictures: NodePictures, recording: Recording, placed: Georeferenced | None
) -> ElevationGrid | None:
    """elevation.tif: from the nodes' pictures, matched densely; where that finds nothing, from the points
    that the map measured; nothing where those were only assumed to lie on flat ground.
    """
    slam = recording.slam
    grid = dense_elevation(surface_views(pictures, recording), pictures.rig)
    if grid is None and slam.measures_depth:
        grid = elevation_of_points(*slam.map.all_points(slam.main_piece()))
    if grid is not None:
        write_elevation(path, grid, placed.reference if placed else None)
    return grid


def surface_views(pictures: NodePictures, recording: Recording) -> list[SurfaceView]:
    """The nodes of the main piece whose depth is known, with their pictures to be read again."""
    visual = recording.slam.map
    report = recording.slam.adjustment
    pose_sigma_m = np.zeros(len(visual)) if report is None else report.ground_sigma_m
    return [
        SurfaceView(
            visual.graph.pose(node.index),
            DepthRange.of(node.points_in_cam[node.has_point, 2]),
            pictures.loader(node.frame_index),
            float(pose_sigma_m[node.index]),
            node.points_in_cam[node.has_point],
            node.depth_sigma_m[node.has_point],
        )
        for node, is_placed in zip(visual.nodes, recording.slam.main_piece(), strict=True)
        if is_placed and node.has_point.any()
    ]


def elevation_of_points(points: FloatArray, sigmas_m: FloatArray) -> ElevationGrid | None:
    """Heights from scattered points (n, 3), world, with standard deviations (n,); None for hardly any."""
    if len(points) < POINTS_PER_CELL:
        return None
    cell = _cell_size(points)
    return elevation_from_points(points, sigmas_m, cell, largest_hole_m=6 * cell)


def _cell_size(points: FloatArray) -> float:
    """A round cell size in metres that holds a few points where there are points at all."""
    low, high = np.percentile(points[:, :2], [2, 98], axis=0)
    coarse = max(float((high - low).max()) / 100.0, 1e-3)
    cells = np.unique(np.floor(points[:, :2] / coarse).astype(np.int64), axis=0)
    wanted = math.sqrt(len(cells) * coarse**2 / (len(points) / POINTS_PER_CELL))
    return float(f"{wanted:.1g}")


def write_mosaic_map(
    path: Path,
    pictures: NodePictures,
    recording: Recording,
    ground: ElevationGrid | None,
    placed: Georeferenced | None,
) -> Mosaic:
    """mosaic.tif from the pictures of the nodes."""
    slam = recording.slam
    nodes = {node.frame_index for node in slam.map.nodes}
    images = [
        MappedImage(
            str(record.frame_index),
            pictures.first_loader(record.frame_index),
            pictures.rig.cam0.camera,
            slam.pose_of(record),
        )
        for record in slam.placed()
        if record.frame_index in nodes
    ]
    return write_mosaic(
        path, images, ground or ElevationGrid.flat(0.0), reference=placed.reference if placed else None
    )


def camera_yaml(refined: RefinedCamera) -> str:
    """The refined calibration in the form of EuRoC's sensor.yaml, for --camera."""
    camera = refined.camera
    tree = {
        "camera_model": "pinhole",
        "resolution": [camera.width, camera.height],
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "distortion_model": str(camera.distortion),
        "distortion_coefficients": list(camera.coefficients),
    }
    return yaml.safe_dump(tree, sort_keys=False)


def _camera_tree(refined: RefinedCamera | None) -> dict[str, Any] | None:
    """What metrics.json says of a refined camera: pixels of the source's pictures."""
    if refined is None:
        return None
    camera = refined.camera
    return {
        "focal_px": camera.focal_px,
        "focal_sigma_px": refined.focal_sigma_px,
        "centre_px": [camera.cx, camera.cy],
        "centre_sigma_px": list(refined.centre_sigma_px),
        "distortion": list(camera.coefficients),
        "radial_sigma": list(refined.radial_sigma),
    }


def _adjustment_tree(report: AdjustmentReport | None) -> dict[str, Any] | None:
    """What metrics.json says of the adjustment of the whole map."""
    if report is None:
        return None
    sigma_px = [finite_or_none(value) for value in report.sigma_px]
    return {
        "nodes": report.nodes,
        "points": report.points,
        "observations": report.observations,
        "joined_pairs": report.joined_pairs,
        "rms_px": report.rms_px,
        "range_offset_m": None if report.range_offset is None else report.range_offset.offset_m,
        "sigma_px": dict(zip(("followed", "described", "joined"), sigma_px, strict=True)),
        "attitude_bias_rad": list(report.tilt_bias_rad),
        "odometry_variance": report.odometry_variance,
        "gyro_noise_density": finite_or_none(report.gyro_density),
    }


def _lag_tree(lag: ClockLag | NotFound | None) -> dict[str, Any] | None:
    """What metrics.json says of the attitude sensor's clock; None where it was not found out."""
    if not isinstance(lag, ClockLag):
        return None
    return {"lag_s": lag.lag_s, "sigma_s": lag.sigma_s, "corrected": lag.is_significant}


def collect_metrics(
    flight: Flight,
    recording: Recording,
    config: Config,
    placed: Georeferenced | None,
    mosaic: Mosaic | None,
    warnings: list[str],
) -> dict[str, Any]:
    """What metrics.json holds."""
    slam = recording.slam
    n_frames = len(recording.frames)
    start = slam.start
    return {
        "source": str(flight.path),
        "frames": n_frames,
        "located": recording.n_located,
        "lost_by_reason": recording.lost_by_reason(),
        "nodes": len(slam.map),
        "pieces": len(np.unique(slam.map.pieces())),
        "constraints": slam.map.graph.n_constraints,
        "revisits": recording.revisits(),
        "scale_source": start.source if start else "none",
        "start_height_m": start.height_m if start else None,
        "gps_horizontal_rms_m": placed.horizontal_rms_m if placed else None,
        "gps_place_sigma_m": placed.place_sigma_m if placed else None,
        "crs": placed.reference.crs if placed else None,
        "adjustment": _adjustment_tree(slam.adjustment),
        "attitude_lag": _lag_tree(slam.attitude_lag),
        "refined_camera": _camera_tree(slam.refined_camera),
        "mosaic_gsd_m": mosaic.gsd_m if mosaic else None,
        "reprojection_rms_px": _rms([frame.rms_px for frame in recording.frames]),
        "seconds_per_stage": recording.stage_seconds(),
        "wall_seconds": recording.wall_s,
        "compiled_first": recording.compiled_first,
        "frames_per_second": n_frames / recording.wall_s if recording.wall_s > 0 else None,
        "peak_memory_mb": finite_or_none(peak_memory_mb()),
        "interrupted": recording.interrupted,
        "warnings": warnings,
        "problems": [f"{problem.where}: {problem.what}" for problem in flight.problems],
        "versions": {"overfly": overfly.__version__, "python": platform.python_version()}
        | {name: version(name) for name in LIBRARIES},
        "config_hash": config.hash(),
    }


def _rms(values: list[float]) -> float | None:
    known = [value for value in values if math.isfinite(value)]
    return math.sqrt(sum(value * value for value in known) / len(known)) if known else None


def finite_or_none(value: float) -> float | None:
    """JSON knows no NaN."""
    return value if math.isfinite(value) else None
