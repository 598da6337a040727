"""How fast the simulator is, on one core: python benchmarks/simulation_speed.py

Prints frames per CPU second at 320x240, over ground that is painted already (median: what revisiting costs)
and over new ground (mean, painting included), and the largest memory.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import dataclasses
import resource
import time

import numpy as np

from overfly.simulation import SimulatedFlight
from overfly.simulation.scenario import Scenario, declared

SIZE = (320, 240)


def seconds_per_frame(scenario: Scenario, exposure_s: float, frames: range) -> tuple[float, float, float]:
    """CPU seconds per frame, median: first time over the ground, second time; and sub-exposures per frame."""
    first = scenario.cameras[0]
    setup = dataclasses.replace(first, camera=first.camera.scaled(*SIZE), exposure_s=exposure_s)
    flight = SimulatedFlight(dataclasses.replace(scenario, cameras=(setup,)), 1)
    eye = flight._eyes[0]
    counts = [eye.subexposures(scenario.path, float(flight._times[k])) for k in frames]
    times = []
    flight.render(0, store=False)
    for _ in range(2):
        spent = []
        for index in frames:
            start = time.process_time()
            flight.render(index, store=False)
            spent.append(time.process_time() - start)
        times.append(spent)
    return float(np.mean(times[0])), float(np.median(times[1])), float(np.mean(counts))


def main() -> None:
    print(f"{'scenario':12} {'exposure':>9} {'images':>7} {'frames/s':>9} {'new ground':>11}")
    for name in ("corridor", "blimp", "outdoor", "demo", "long-haul"):
        scenario = declared(name).build(1)
        for exposure in (0.0, 0.010):
            fresh, again, count = seconds_per_frame(scenario, exposure, range(20, 60))
            print(f"{name:12} {1e3 * exposure:6.0f} ms {count:7.1f} {1 / again:9.1f} {1 / fresh:9.1f}/s")
    print(f"largest memory so far: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")


if __name__ == "__main__":
    main()
