"""Options that several commands share, so that they read and behave alike."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Source = Annotated[Path, typer.Argument(help="EuRoC folder, photographs, video, ROS bag or MCAP file.")]
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")]
Assignments = Annotated[
    list[str] | None, typer.Option("--set", help="One setting: section.field=value. Repeatable.")
]
CameraFile = Annotated[
    Path | None, typer.Option(help="Calibration: Kalibr, OpenCV, ROS camera_info, COLMAP or EuRoC.")
]
Stereo = Annotated[
    bool | None, typer.Option("--stereo/--mono", help="Insist on two cameras, or use the first alone.")
]
AttitudeUse = Annotated[str | None, typer.Option(help="Use of the attitude sensor: prior, fixed, none.")]
StartS = Annotated[float | None, typer.Option("--from", help="Seconds after the first frame.")]
StopS = Annotated[float | None, typer.Option("--to", help="Seconds after the first frame.")]
Watched = Annotated[bool, typer.Option("--viewer", help="Show the run in the browser, on 127.0.0.1.")]
Every = Annotated[int, typer.Option(help="Use each n-th frame.")]
TimeOffset = Annotated[
    float | None,
    typer.Option("--time-offset", help="Seconds by which a video begins later than its telemetry."),
]
Topic = Annotated[str | None, typer.Option(help="Topic of a bag's pictures; the likeliest if left away.")]
