"""overfly map: from a source to a folder of results. run() is the list of what happens."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from overfly.config import Config
from overfly.errors import SourceError, UsageError
from overfly.evaluation import Evaluation
from overfly.mapstore import Map
from overfly.pipeline.georeferencing import Georeferenced, georeference
from overfly.pipeline.growing import MOSAIC_NAME, growing_mosaic
from overfly.pipeline.keeping import MAP_NAME, keeping_map, write_map
from overfly.pipeline.landmarks import locate_landmarks, write_landmarks
from overfly.pipeline.node_pictures import NodePictures
from overfly.pipeline.page import write_page
from overfly.pipeline.recording import Progress, Recording, record_flight
from overfly.pipeline.results import (
    camera_yaml,
    collect_metrics,
    prepare_folder,
    write_elevation_map,
    write_graph_file,
    write_json,
    write_mosaic_map,
    write_text,
)
from overfly.pipeline.warnings import warnings_of
from overfly.pipeline.watching import Announce, watching
from overfly.products.exports.geographic import write_geojson
from overfly.sensors import Flight, ReadOptions, open_flight
from overfly.slam import Slam
from overfly.timing import Stopwatch
from overfly.trajectory import write_tum
from overfly.types import NotFound
from overfly.viewer.interface import Viewers


@dataclass(frozen=True, slots=True)
class MapRequest:
    """What to map, with which settings, and where to leave the results."""

    source: Path
    out: Path
    config: Config = field(default_factory=Config)
    reading: ReadOptions = field(default_factory=ReadOptions)
    command: str = ""  # as typed, for the report
    resume: bool = False  # carry on with the map in ``out``, if there is one
    into: Path | None = None  # a map of the same ground, which the flight is to continue
    watch: Announce | None = None  # show the run on a page, whose address this is told
    growing_mosaic: bool | None = None  # draw the mosaic while flying; None: where the source is live


@dataclass(frozen=True, slots=True, eq=False)
class MapOutcome:
    """metrics: what metrics.json holds. interrupted: the run was ended early, by Ctrl-C."""

    metrics: dict[str, Any]
    interrupted: bool


def run(request: MapRequest, progress: Progress) -> MapOutcome:
    """Map a recorded flight and write everything the contract names. Raises OverflyError in one line each."""
    older = Map.open(request.into) if request.into else None
    flight = open_flight(request.source, request.reading)
    if request.config.adjustment.refine_camera and flight.rig.is_stereo:
        raise UsageError(
            "--refine-camera finds the calibration of one camera: map with --mono, or without it"
        )
    prepare_folder(request.out)
    slam = Slam(flight.rig, request.config, flight.scale_landmark, flight.attitude_at, lambda: flight.imu)
    with keeping_map(request.out, flight, slam, request.resume) as keeper:
        growing = growing_mosaic(request.out / MOSAIC_NAME if request.growing_mosaic else None, slam)
        with watching(request.watch, flight.rig, slam) as viewer, growing as drawer:
            watchers = Viewers((viewer, drawer))
            recording = record_flight(keeper.rest_of(flight), slam, progress, keeper, watchers)
        check_located(flight, recording)
        joined = None if older is None else keeper.join(older)
        notes = [of_joined_map(request)] if isinstance(joined, Map) else []
        outcome = save(flight, recording, request, notes=notes)
        if isinstance(joined, Map):
            keeper.replace_by(joined)
        elif isinstance(joined, NotFound):
            raise SourceError(
                f"{flight.path}: not placed in {request.into}: {joined.detail}; its own map is kept"
            )
        return outcome


def of_joined_map(request: MapRequest) -> str:
    return (
        "map.overfly holds both flights; the trajectory, the mosaic and the elevation are those of this one, "
        f"in the world of {request.into}."
    )


def fly(flight: Flight, config: Config, progress: Progress) -> Recording:
    """Run SLAM over a flight. Raises SourceError when not one frame could be located."""
    slam = Slam(flight.rig, config, flight.scale_landmark, flight.attitude_at, lambda: flight.imu)
    recording = record_flight(flight, slam, progress)
    check_located(flight, recording)
    return recording


def check_located(flight: Flight, recording: Recording) -> None:
    """Raises SourceError when not one frame could be located."""
    if not recording.frames:
        raise SourceError(f"{flight.path}: no frame could be read")
    if recording.n_located == 0:
        why = ", ".join(f"{reason} ({count} frames)" for reason, count in recording.lost_by_reason().items())
        raise SourceError(f"{flight.path}: no frame could be located: {why}")


def save(
    flight: Flight,
    recording: Recording,
    request: MapRequest,
    evaluate_run: Callable[[Recording], Evaluation] | None = None,
    notes: Sequence[str] = (),
) -> MapOutcome:
    """Write the results of a run into its folder.

    evaluate_run: compares the finished run with a truth that the caller has; the report then shows it.
    notes: what the user is told beside the warnings.
    """
    out = request.out
    placed = georeference(recording)
    _save_map(out / MAP_NAME, flight, recording, placed)
    write_tum(out / "trajectory.tum", recording.trajectory())
    write_tum(out / "online.tum", recording.online())
    write_tum(out / "odometry.tum", recording.odometry())
    write_graph_file(out / "graph.g2o", recording)
    if placed is not None:
        name = flight.path.resolve().name
        write_geojson(out / "track.geojson", name, recording.trajectory(), placed.reference)
    landmarks = locate_landmarks(flight.landmark_clicks, recording)
    if flight.landmark_clicks:
        write_landmarks(out / "landmarks.json", landmarks)
    pictures = NodePictures(flight, recording.pictures, recording.slam.source_rig)
    watch = Stopwatch()
    with watch.stage("elevation"):
        ground = write_elevation_map(out / "elevation.tif", pictures, recording, placed)
    with watch.stage("mosaic"):
        mosaic = write_mosaic_map(out / MOSAIC_NAME, pictures, recording, ground, placed)
    write_text(out / "config.yaml", request.config.to_yaml())
    if recording.slam.refined_camera is not None:
        write_text(out / "camera.yaml", camera_yaml(recording.slam.refined_camera))
    warnings = [*warnings_of(flight, recording), *notes]
    metrics = collect_metrics(flight, recording, request.config, placed, mosaic, warnings)
    metrics["seconds_of_products"] = watch.seconds
    write_json(out / "metrics.json", metrics)
    write_page(
        out / "report.html", flight, recording, request.config, request.command, placed, mosaic, ground,
        landmarks, metrics, evaluate_run(recording) if evaluate_run else None,
    )  # fmt: skip
    return MapOutcome(metrics, recording.interrupted)


def _save_map(path: Path, flight: Flight, recording: Recording, placed: Georeferenced | None) -> None:
    """The map as it is in the end."""
    reference = placed.reference if placed else None
    if recording.keeper is None:
        write_map(path, flight, recording.slam, recording.frames, reference)
    else:
        recording.keeper.save(complete=not recording.interrupted, georeference=reference)
