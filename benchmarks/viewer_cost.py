"""What the live view costs the mapping loop: CPU seconds of the threads and calls that are there for it.

    python benchmarks/viewer_cost.py FLIGHT [--rounds 3] [--browser /usr/bin/chromium] [--busy 7]

Counted are the drawing thread, the web server's thread and the calls within the loop; the browser has its
own. Drawings come by the clock: on a machine that is busy otherwise there are more of them per frame, so the
share of a core that all this takes is given beside the share of the loop. With --busy N (seconds by the clock
for each that the loop computes, as the last line tells) the clock of the drawings is slowed down as much,
which gives what an idle machine would pay.
"""

from __future__ import annotations

import argparse
import statistics
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from overfly.frame_result import FrameResult
from overfly.localizer import Fix
from overfly.pipeline.recording import record_flight
from overfly.sensors import open_flight
from overfly.slam import Slam
from overfly.types import Frame
from overfly.viewer import live as live_view
from overfly.viewer.live import LiveViewer
from overfly.viewer.server import open_page

FIRST, SETTLED_S = 20, 2.0  # frames and seconds until the page is set up, which costs 0.1 s once


class Timed:
    """A viewer, and the CPU seconds that the loop spends in calling it."""

    def __init__(self, live: LiveViewer) -> None:
        self.live, self.seconds = live, 0.0

    def show_frame(self, frame: Frame, result: FrameResult | Fix) -> None:
        began = time.thread_time()
        self.live.show_frame(frame, result)
        self.seconds += time.thread_time() - began

    def close(self) -> None:
        self.live.close()


def seconds_of_other_threads() -> float:
    """CPU seconds of all threads of Python but this one and the one that reads ahead."""
    others = [
        thread
        for thread in threading.enumerate()
        if thread is not threading.current_thread() and not thread.name.startswith("overfly")
    ]
    return sum(time.clock_gettime(time.pthread_getcpuclockid(thread.ident or 0)) for thread in others)


@contextmanager
def visitor(url: str, browser: str | None) -> Iterator[None]:
    """A browser with the page open, if there is one."""
    if browser is None:
        yield
        return
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        switches = [
            "--no-sandbox",
            "--use-gl=angle",
            "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader",
        ]
        chromium = playwright.chromium.launch(executable_path=browser, args=switches)
        page = chromium.new_page(viewport={"width": 400, "height": 300})
        page.goto(url)
        page.wait_for_timeout(4000)
        yield
        chromium.close()


def measure(frames: list[Frame], flight_path: Path, browser: str | None) -> tuple[float, float, float]:
    """CPU seconds of the loop without its viewer, of the viewer, and seconds by the clock."""
    rig = open_flight(flight_path).rig
    slam = Slam(rig)
    live = LiveViewer(open_page("Overfly", port=0), rig.cam0.camera, slam.map, slam)
    viewer = Timed(live)
    readings: list[np.ndarray] = []

    def read(count: int, _result: object) -> None:
        if count == FIRST:
            time.sleep(SETTLED_S)
        if count in (FIRST, len(frames)):
            loop = time.thread_time() - viewer.seconds
            view = seconds_of_other_threads() + viewer.seconds
            readings.append(np.array([loop, view, time.perf_counter()]))

    with visitor(live.page.url, browser):
        record_flight(frames, slam, read, viewer=viewer)
    live.close()
    loop, view, clock = readings[1] - readings[0]
    return float(loop), float(view), float(clock)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("flight", type=Path)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--browser")
    parser.add_argument("--busy", type=float, default=1.0)
    options = parser.parse_args()
    live_view.PERIOD_S *= options.busy
    live_view.GRAPH_PERIOD_S *= options.busy
    live_view.SHARE /= options.busy
    flight = open_flight(options.flight)
    read = (flight.read_frame(index) for index in range(min(options.frames, len(flight))))
    frames = [frame for frame in read if frame is not None]
    measure(frames[:60], options.flight, None)  # compiles
    rounds = [measure(frames, options.flight, options.browser) for _ in range(options.rounds)]
    loop, viewer, clock = (statistics.median(column) for column in zip(*rounds, strict=True))
    print(
        f"{len(frames)} frames in {clock:.1f} s by the clock; CPU seconds: loop {loop:.2f}, view {viewer:.2f}"
    )
    print(f"{100 * viewer / loop:.1f} % of the loop, {100 * viewer / clock:.1f} % of a core")
    print(f"{clock / loop:.1f} s by the clock for each that the loop computes")


if __name__ == "__main__":
    main()
