"""Which of the recorded frames to read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from overfly.errors import SourceError, UsageError
from overfly.sensors.flight import ReadOptions
from overfly.types import IntArray


def select_frames(path: Path, t_ns: IntArray, options: ReadOptions) -> IntArray:
    """Indices of the frames that the options ask for; t_ns (n,) increasing.

    Raises UsageError for options that cannot mean anything, SourceError when nothing is left.
    """
    if options.every < 1:
        raise UsageError(f"every {options.every}: give 1 or more")
    start_s = 0.0 if options.start_s is None else options.start_s
    stop_s = np.inf if options.stop_s is None else options.stop_s
    if start_s >= stop_s:
        raise UsageError(f"from {start_s:g} s to {stop_s:g} s: the end must come after the start")
    since_first_s = (t_ns - t_ns[0]) * 1e-9
    chosen = np.flatnonzero((since_first_s >= start_s) & (since_first_s <= stop_s))[:: options.every]
    if len(chosen) == 0:
        raise SourceError(
            f"{path}: no frame between {start_s:g} and {stop_s:g} s; it lasts {since_first_s[-1]:.1f} s"
        )
    return chosen
