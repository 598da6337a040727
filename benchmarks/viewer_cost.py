"""What the live view costs the mapping loop: the same flight with and without, by turns, in CPU seconds.

    python benchmarks/viewer_cost.py FLIGHT [--frames 300] [--rounds 3] [--browser /usr/bin/chromium]

CPU seconds are those of this process, all its threads; the browser has its own. Drawings come by the clock,
so on a machine that is busy otherwise there are more of them per frame: what one drawing costs, times the
drawings of a second, is the share of a core that the view takes at most.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from overfly.pipeline.recording import record_flight
from overfly.sensors import open_flight
from overfly.slam import Slam
from overfly.types import Frame
from overfly.viewer.live import PERIOD_S, LiveViewer
from overfly.viewer.server import open_page


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


def measure(frames: list[Frame], flight_path: Path, browser: str | None, watched: bool) -> tuple[float, int]:
    """CPU seconds of mapping the frames, and how often was drawn."""
    flight = open_flight(flight_path)
    slam = Slam(flight.rig)
    drawings: list[object] = []
    if not watched:
        began = time.process_time()
        record_flight(frames, slam, lambda _count, _result: None)
        return time.process_time() - began, 0
    live = LiveViewer(open_page("Overfly", port=0), flight.rig.cam0.camera, slam.map, slam)
    live.on_tick.append(drawings.append)
    with visitor(live.page.url, browser):
        began = time.process_time()
        record_flight(frames, slam, lambda _count, _result: None, viewer=live)
        spent = time.process_time() - began
    live.close()
    return spent, len(drawings)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("flight", type=Path)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--browser")
    options = parser.parse_args()
    flight = open_flight(options.flight)
    read = (flight.read_frame(index) for index in range(min(options.frames, len(flight))))
    frames = [frame for frame in read if frame is not None]
    measure(frames[:60], options.flight, None, watched=False)  # compiles
    plain, watched, per_drawing = [], [], []
    for _ in range(options.rounds):
        plain.append(measure(frames, options.flight, None, watched=False)[0])
        spent, drawings = measure(frames, options.flight, options.browser, watched=True)
        watched.append(spent)
        per_drawing.append((spent - plain[-1]) / max(drawings, 1))
    mine, theirs, one = (statistics.median(values) for values in (watched, plain, per_drawing))
    print(
        f"{len(frames)} frames: {theirs:.2f} s without, {mine:.2f} s with: {100 * (mine / theirs - 1):+.1f} %"
    )
    share = f"{100 * one / PERIOD_S:.1f} % of a core"
    print(f"{1e3 * one:.1f} ms a drawing, at most {1 / PERIOD_S:.1f} a second: {share}")


if __name__ == "__main__":
    main()
