"""What each ingredient brings: a flight mapped with one of them switched off at a time.

python benchmarks/ablation.py FLIGHT [FLIGHT ...]

FLIGHT: a simulated flight with truth/groundtruth_cam0.tum. Printed: frames in the results, ATE after SE3 and
after Sim3 alignment, metres, and seconds of CPU of mapping and finishing. The first run of a fresh
installation compiles, so its seconds do not count.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

from overfly.config import load_config
from overfly.evaluation import Align, evaluate
from overfly.pipeline.georeferencing import georeference
from overfly.pipeline.mapping import fly
from overfly.pipeline.recording import Recording
from overfly.sensors import ReadOptions, open_flight
from overfly.trajectory import read_tum

NO_GYROSCOPE = "no gyroscope"
SWITCHED_OFF = (
    (),
    ("adjustment.enabled=false",),
    ("window.nodes=0",),
    ("tracking.enabled=false",),
    ("attitude.use=fixed",),
    ("revisit.enabled=false",),
    ("nodes.displacement=0.3",),
    (NO_GYROSCOPE,),
)


def mapped(folder: Path, settings: list[str]) -> Recording:
    """A flight mapped to the end, georeferenced where it has positions."""
    flight = open_flight(folder, ReadOptions())
    if NO_GYROSCOPE in settings:
        flight, settings = replace(flight, read_imu=lambda: None), []
    recording = fly(flight, load_config(None, settings), lambda _count, _result: None)
    if recording.positions:
        georeference(recording)
    return recording


def main() -> None:
    for folder in map(Path, sys.argv[1:]):
        truth = read_tum(folder / "truth" / "groundtruth_cam0.tum")
        for settings in SWITCHED_OFF:
            began = time.process_time()
            recording = mapped(folder, list(settings))
            seconds = time.process_time() - began
            found = recording.trajectory()
            rigid, similar = (evaluate(found, truth, align).ate_m.rmse for align in (Align.SE3, Align.SIM3))
            print(
                f"{folder.name:12s} {' '.join(settings) or 'nothing':28s} "
                f"{len(found)}/{len(recording.frames)} "
                f"{rigid:.4f} ({similar:.4f}) m {seconds:.1f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
