"""What drawing the mosaic while flying costs the mapping loop: frames per second with and without, in turn.

    python benchmarks/growing_mosaic_cost.py FLIGHT [--frames 600] [--rounds 5] [--fps 0]

Frames are read beforehand and mapped as fast as they can be, or --fps a second. Told are medians over
pairs of runs, without and with, one after the other.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from overfly.pipeline.growing import MOSAIC_NAME, growing_mosaic
from overfly.pipeline.recording import record_flight
from overfly.sensors import Flight, open_flight
from overfly.slam import Slam
from overfly.threads import limit_blas_threads
from overfly.types import Frame


def paced(frames: list[Frame], fps: float) -> Iterator[Frame]:
    begin = time.perf_counter()
    for number, frame in enumerate(frames):
        if fps > 0.0:
            time.sleep(max(0.0, begin + number / fps - time.perf_counter()))
        yield frame


def drawing_seconds() -> float:
    """CPU seconds of the thread that draws."""
    drawing = [thread for thread in threading.enumerate() if thread.name == "overfly-mosaic"]
    return sum(time.clock_gettime(time.pthread_getcpuclockid(thread.ident or 0)) for thread in drawing)


def measure(
    frames: list[Frame], flight: Flight, fps: float, folder: str | None
) -> tuple[float, float, float]:
    """Seconds by the clock and CPU seconds of the loop, CPU seconds of the drawing."""
    slam = Slam(flight.rig, None, flight.scale_landmark, flight.attitude_at, lambda: flight.imu)
    readings = []

    def read(count: int, _result: object) -> None:
        if count in (1, len(frames)):
            readings.append((time.perf_counter(), time.thread_time(), drawing_seconds()))

    slam.finish = lambda: None  # type: ignore[method-assign]  # the loop alone
    with growing_mosaic(Path(folder) / MOSAIC_NAME if folder else None, slam) as drawer:
        record_flight(paced(frames, fps), slam, read, viewer=drawer)
    clock, loop, drawing = (after - before for before, after in zip(*readings, strict=True))
    return clock, loop, drawing


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("flight", type=Path)
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--fps", type=float, default=0.0)
    options = parser.parse_args()
    flight = open_flight(options.flight)
    read = (flight.read_frame(index) for index in range(min(options.frames, len(flight))))
    frames = [frame for frame in read if frame is not None]
    pairs: list[tuple[tuple[float, float, float], ...]] = []
    with tempfile.TemporaryDirectory() as folder:
        measure(frames[:60], flight, 0.0, folder)  # compiles
        for number in range(options.rounds):
            order = (None, folder) if number % 2 else (folder, None)
            first, second = (measure(frames, flight, options.fps, where) for where in order)
            pairs.append((first, second) if number % 2 else (second, first))
    clock, loop = (statistics.median(drawn[k] / without[k] - 1.0 for without, drawn in pairs) for k in (0, 1))
    drawing = statistics.median(drawn[2] for _, drawn in pairs)
    seconds = statistics.median(without[0] for without, _ in pairs)
    print(f"{len(frames)} frames in {seconds:.2f} s by the clock; with the mosaic {100 * clock:+.1f} %,"
          f" CPU of the loop {100 * loop:+.1f} %; CPU of the drawing {drawing:.2f} s")  # fmt: skip


if __name__ == "__main__":
    limit_blas_threads()
    main()
