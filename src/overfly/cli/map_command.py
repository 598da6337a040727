"""overfly map: build a map from a recorded flight."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from overfly.cli.console import FrameProgress, announce_page, exit_interrupted
from overfly.cli.options import (
    Assignments,
    AttitudeUse,
    CameraFile,
    Every,
    Out,
    StartS,
    Stereo,
    StopS,
    TimeOffset,
    Topic,
    Watched,
)
from overfly.errors import UsageError

if TYPE_CHECKING:
    from overfly.config import Config
    from overfly.pipeline.live_mapping import LiveSource

ATTITUDES = ("prior", "fixed", "none")


def command(
    source: Annotated[
        Path | None, typer.Argument(help="EuRoC folder, photographs, video, ROS bag, MCAP file, or camera:0.")
    ] = None,
    *,
    out: Out,
    config: Annotated[Path | None, typer.Option("--config", help="Settings, YAML.")] = None,
    assignments: Assignments = None,
    camera: CameraFile = None,
    stereo: Stereo = None,
    attitude: AttitudeUse = None,
    height_m: Annotated[float | None, typer.Option("--height-m", help="Height of the first frame.")] = None,
    start_s: StartS = None,
    stop_s: StopS = None,
    every: Every = 1,
    time_offset_s: TimeOffset = None,
    topic: Topic = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Carry on with a run that was broken off, where it stopped.")
    ] = False,
    into: Annotated[
        Path | None, typer.Option("--into", help="A map that this flight continues; both become one in OUT.")
    ] = None,
    refine_camera: Annotated[
        bool | None,
        typer.Option(
            "--refine-camera/--no-refine-camera",
            help="Find focal length, centre and distortion from the flight; done where only EXIF tells them.",
        ),
    ] = None,
    viewer: Watched = False,
    mosaic_while_flying: Annotated[
        bool | None,
        typer.Option(
            "--mosaic-while-flying/--no-mosaic-while-flying",
            help="Draw mosaic.tif all along, not only in the end; live sources do, if not told otherwise.",
        ),
    ] = None,
    mavlink: Annotated[
        str | None, typer.Option("--mavlink", help="Live: attitude and range of this autopilot.")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="Live: as --camera F, where --camera names the source.")
    ] = None,
    camera_delay_ms: Annotated[
        float, typer.Option("--camera-delay-ms", help="Live: from exposure to arrival.")
    ] = 0.0,
    json_output: Annotated[
        bool, typer.Option("--json", help="Print the metrics as one JSON object.")
    ] = False,
) -> int:
    """Build a map from a recorded or live flight: trajectory, graph, mosaic, elevation, report."""
    live = live_source(source, camera, mavlink, camera_delay_ms)
    if live is not None:
        if resume or into is not None or stereo or (live.camera == str(camera) and source is not None):
            raise UsageError("a live camera: --resume, --into and --stereo are for recorded flights")
        camera = calibration or (None if live.camera == str(camera) else camera)
    elif calibration is not None or camera_delay_ms:
        raise UsageError("--calibration and --camera-delay-ms are for live cameras")
    refined = [] if refine_camera is None else [f"adjustment.refine_camera={str(refine_camera).lower()}"]
    settings = settings_of(config, [*(assignments or []), *refined], attitude, height_m)
    from overfly.pipeline.mapping import MapRequest, run
    from overfly.sensors import ReadOptions

    reading = ReadOptions(camera, stereo, start_s, stop_s, every, time_offset_s=time_offset_s, topic=topic)
    watch = announce_page if viewer else None
    typed = shlex.join(["overfly", *sys.argv[1:]])
    request = MapRequest(
        source or Path(str(camera)), out, settings, reading, typed, resume, into, watch, mosaic_while_flying
    )
    with FrameProgress() as progress:
        if live is None:
            outcome = run(request, progress)
        else:
            from overfly.pipeline import live_mapping

            outcome = live_mapping.run(live, request, progress)
    if json_output:
        print(json.dumps(outcome.metrics))
    else:
        print(summary(outcome.metrics, out))
    return exit_interrupted() if outcome.interrupted else 0


def live_source(
    source: Path | None, camera: Path | None, mavlink: str | None, camera_delay_ms: float
) -> LiveSource | None:
    """The camera that runs now, named as SOURCE or by --camera; None for a recorded flight.

    Raises UsageError when nothing names a source.
    """
    from overfly.sensors.live_camera import is_live

    named = source if source is not None else camera
    if named is None or (source is None and not is_live(str(named))):
        raise UsageError("give a SOURCE: a folder or file of a flight, or camera:0")
    if not is_live(str(named)):
        if mavlink is not None:
            raise UsageError("--mavlink is for live cameras: give camera:0 as SOURCE")
        return None
    from overfly.pipeline.live_mapping import LiveSource

    return LiveSource(str(named), mavlink, 1e-3 * camera_delay_ms)


def settings_of(
    config: Path | None, assignments: list[str] | None, attitude: str | None, height_m: float | None
) -> Config:
    """Configuration file, then --set, then the options that have a name of their own."""
    if attitude is not None and attitude not in ATTITUDES:
        raise UsageError(f"--attitude {attitude}: choose one of {', '.join(ATTITUDES)}")
    from overfly.config import load_config

    named = [f"attitude.use={attitude}"] if attitude else []
    if height_m is not None:
        named.append(f"height.given_m={height_m!r}")
    return load_config(config, [*(assignments or []), *named])


def summary(metrics: dict[str, Any], out: Path) -> str:
    """A few lines for a person."""
    compiling = ", compiling included" if metrics["compiled_first"] else ""
    lines = [
        f"{metrics['located']} of {metrics['frames']} frames located, "
        f"{metrics['nodes']} nodes, {metrics['constraints']} constraints, "
        f"{metrics['frames_per_second']:.1f} frames/s{compiling}, "
        f"scale from {metrics['scale_source']}"
    ]
    if metrics["gps_horizontal_rms_m"] is not None:
        lines.append(f"horizontal RMS against GPS: {metrics['gps_horizontal_rms_m']:.2f} m")
    lines += [f"note: {warning}" for warning in metrics["warnings"]]
    lines.append(f"results in {out}: open {out / 'report.html'}")
    return "\n".join(lines)
