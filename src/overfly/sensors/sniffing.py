"""Which reader a path is for."""

from __future__ import annotations

from pathlib import Path

from overfly.errors import SourceError
from overfly.sensors.euroc import find_mav0, open_euroc
from overfly.sensors.flight import Flight, ReadOptions
from overfly.sensors.photographs import find_pictures, open_photographs

READ_TODAY = "an EuRoC folder (the one that holds mav0) and a folder of photographs are read today"


def open_flight(path: str | Path, options: ReadOptions | None = None) -> Flight:
    """Open a recorded flight, whatever it was recorded as.

    path: a folder in the EuRoC layout (the one that holds mav0, or mav0 itself), or a folder of photographs.
    Raises SourceError (CalibrationError for the camera) with one line that names the file and what to do.
    """
    path = Path(path)
    options = options or ReadOptions()
    if not path.exists():
        raise SourceError(f"{path}: no such file or folder")
    if not path.is_dir():
        raise SourceError(f"{path}: not something that can be read; {READ_TODAY}")
    if find_mav0(path) is not None:
        return open_euroc(path, options)
    if find_pictures(path) is not None:
        return open_photographs(path, options)
    raise SourceError(f"{path}: holds neither mav0/cam0 nor pictures; {READ_TODAY}")
