"""report.html of a finished run: gathers what the page shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import overfly
from overfly.attitude_clock import ClockLag
from overfly.config import Config
from overfly.evaluation import Evaluation
from overfly.geometry.poses import FloatArray
from overfly.pipeline.georeferencing import Georeferenced
from overfly.pipeline.landmarks import Landmark
from overfly.pipeline.recording import Recording
from overfly.products.elevation import ElevationGrid
from overfly.products.mosaic import Mosaic
from overfly.products.perspective import perspective_view
from overfly.products.pictures import elevation_picture, map_picture
from overfly.products.report import (
    ElevationPicture,
    Figure,
    LandmarkRow,
    ReportData,
    RevisitCounts,
    SensorUse,
    StageTiming,
    write_report,
)
from overfly.sensors import Flight, Quantity
from overfly.slam import Slam
from overfly.types import IntArray, Problem

ELLIPSES = 15  # of uncertainty, along the path
SCALE_WORDS = {
    "stereo": "the baseline of the stereo cameras",
    "range": "the range sensor",
    "landmark": "the object of known size in the first frame",
    "gps": "GPS",
    "altitude": "the height above start of the first frame",
    "given": "the height that was given for the first frame",
    "none": "nothing: lengths are in heights of the first frame",
}


def write_page(
    path: Path,
    flight: Flight,
    recording: Recording,
    config: Config,
    command: str,
    placed: Georeferenced | None,
    mosaic: Mosaic | None,
    ground: ElevationGrid | None,
    landmarks: list[Landmark],
    metrics: dict[str, Any],
    evaluation: Evaluation | None = None,
) -> None:
    """Write the page. evaluation: only where the caller, not the map, knows the truth."""
    frames = recording.frames
    picture = map_picture(mosaic.path, placed.reference if placed else None) if mosaic else None
    relief = perspective_view(picture, ground) if picture is not None and ground is not None else None
    write_report(
        path,
        ReportData(
            title=f"Map of {flight.path.resolve().name}",
            subtitle=f"{flight.kind}, {len(frames)} frames, {len(flight.rig.cameras)} "
            f"camera{'s' if flight.rig.is_stereo else ''} of {flight.rig.cam0.camera.width} x "
            f"{flight.rig.cam0.camera.height} px",
            numbers=_numbers(recording, metrics),
            trajectory=recording.trajectory(),
            odometry=recording.odometry(),
            constraints_ns=constraint_times(recording),
            frame_ns=np.array([frame.t_ns for frame in frames], np.int64),
            located=np.array([frame.node is not None for frame in frames]),
            scale_source=SCALE_WORDS.get(metrics["scale_source"], metrics["scale_source"]),
            command=command,
            version=overfly.__version__,
            lost_reasons=tuple(recording.lost_by_reason().items()),
            warnings=(*metrics["warnings"], *_in_groups(flight.problems)),
            mosaic=picture,
            elevation=_elevation(ground),
            evaluation=evaluation,
            stages=tuple(
                StageTiming(name, *(1e3 * stage[key] for key in ("p50", "p95", "max")))
                for name, stage in metrics["seconds_per_stage"].items()
            ),
            sensors=_sensors(flight, config, metrics["scale_source"], recording.slam),
            landmarks=tuple(
                LandmarkRow(
                    landmark.name,
                    (
                        float(landmark.position_m[0]),
                        float(landmark.position_m[1]),
                        float(landmark.position_m[2]),
                    ),
                    float(np.linalg.norm(landmark.sigma_m)),
                )
                for landmark in landmarks
            ),
            settings=config.to_yaml(),
            ellipses=uncertainty_ellipses(recording),
            revisits=_revisit_counts(metrics["revisits"]),
            perspective=relief,
            products_s=tuple(metrics.get("seconds_of_products", {}).items()),
        ),
    )


def _in_groups(problems: Sequence[Problem]) -> list[str]:
    """A line for each kind of problem: a row of bad files is not a page of warnings."""
    files: dict[str, list[str]] = {}
    for problem in problems:
        files.setdefault(problem.what, []).append(problem.where)
    return [
        f"{where[0]}{f' and {len(where) - 1} more' if len(where) > 1 else ''}: {what}"
        for what, where in files.items()
    ]


def constraint_times(recording: Recording) -> IntArray:
    """(m, 2) times of the frames that each constraint joins."""
    slam = recording.slam
    node_ns = np.array([node.t_ns for node in slam.map.nodes], np.int64)
    graph = slam.map.graph
    return np.column_stack([node_ns[graph.i], node_ns[graph.j]])


def uncertainty_ellipses(recording: Recording) -> tuple[FloatArray, ...]:
    """Outlines (k, 2), metres, of where some nodes are within three standard deviations in the shape of the
    adjusted map, which as a whole may be moved and turned; none where that is not known."""
    report, graph = recording.slam.adjustment, recording.slam.map.graph
    if report is None:
        return ()
    placed = np.flatnonzero(recording.slam.main_piece()[report.shape.nodes])
    if len(placed) == 0:
        return ()
    chosen = placed[np.unique(np.linspace(0, len(placed) - 1, ELLIPSES).round().astype(np.int64))]
    angle = np.linspace(0.0, 2.0 * np.pi, 33)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    outlines = []
    for place in chosen.tolist():
        pose = graph.pose(int(report.shape.nodes[place]))
        horizontal = (pose.rotation @ report.shape.cameras[place] @ pose.rotation.T)[:2, :2]
        values, axes = np.linalg.eigh(horizontal)
        radii = 3.0 * np.sqrt(np.maximum(values, 0.0))
        outlines.append(pose.translation[:2] + ((axes * radii) @ circle).T)
    return tuple(outlines)


def _revisit_counts(revisits: dict[str, Any]) -> RevisitCounts:
    return RevisitCounts(revisits["tried"], revisits["accepted"], tuple(revisits["rejected"].items()))


def _numbers(recording: Recording, metrics: dict[str, Any]) -> tuple[Figure, ...]:
    share = 100.0 * metrics["located"] / metrics["frames"]
    path_m = float(recording.trajectory().path_m()[-1])
    unit = "heights" if metrics["scale_source"] == "none" else "m"
    numbers = [
        Figure("frames located", f"{share:.1f} %", f"{metrics['located']} of {metrics['frames']}"),
        Figure("path", f"{path_m:.1f} {unit}"),
        Figure("nodes", str(metrics["nodes"]), f"{metrics['constraints']} constraints"),
        Figure(
            "speed",
            f"{metrics['frames_per_second']:.0f} frames/s",
            "compiling included" if metrics["compiled_first"] else "",
        ),
    ]
    if metrics["reprojection_rms_px"] is not None:
        numbers.append(Figure("reprojection", f"{metrics['reprojection_rms_px']:.2f} px", "RMS"))
    if metrics["gps_horizontal_rms_m"] is not None:
        whole = f"horizontal RMS; the whole to {metrics['gps_place_sigma_m']:.2g} m"
        numbers.append(Figure("against GPS", f"{metrics['gps_horizontal_rms_m']:.2f} m", whole))
    return tuple(numbers)


def _elevation(ground: ElevationGrid | None) -> ElevationPicture | None:
    if ground is None:
        return None
    return ElevationPicture(elevation_picture(ground), *ground.shown_range_m())


def _sensors(flight: Flight, config: Config, scale_source: str, slam: Slam) -> tuple[SensorUse, ...]:
    """What became of each sensor beside the cameras."""
    uses, lag = [], slam.attitude_lag
    gyro_density = math.inf if slam.adjustment is None else slam.adjustment.gyro_density
    for sensor in flight.sensors:
        used, how = False, "not used"
        if sensor.quantity is Quantity.ATTITUDE:
            used = config.attitude.use != "none"
            how = f"roll and pitch as {config.attitude.use}" if used else "switched off"
            how += f", {lag}" if used and isinstance(lag, ClockLag) else ""
        elif sensor.quantity is Quantity.IMU:
            used = math.isfinite(gyro_density)
            how = f"turns between nodes, to {gyro_density:.2g} rad/s/√Hz" if used else "not used"
        elif sensor.quantity is Quantity.RANGE:
            used, how = not flight.rig.is_stereo, "height" if not flight.rig.is_stereo else "stereo is better"
        elif sensor.quantity is Quantity.POSITION:
            used, how = True, "place on Earth" + (" and scale" if scale_source == "gps" else "")
        elif sensor.quantity is Quantity.HEIGHT:
            used = scale_source == "altitude"
            how = "scale" if used else "first height only"
        uses.append(
            SensorUse(sensor.name, used, f"{sensor.quantity}, {how}; {sensor.rate_hz:.3g} Hz, {sensor.sigma}")
        )
    return tuple(uses)
