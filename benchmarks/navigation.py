"""Go to random places of a map, and hold one against pushes: python benchmarks/navigation.py [--seeds 5] ...

For each seed a world, a survey of it, and 20 places drawn anywhere in what the survey has mapped, visited in
wind; then the paper's 18 minutes over one place (section V-C), pushed away 24 times, over a map that begins
with the first picture. Prints one row a flight.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from overfly.mapstore import Map
from overfly.pipeline.flying import FlyOutcome, FlyRequest, run

FROM_A_NODE = 0.25  # of the height: a place is in the mapped area when a node lies so near


def random_places(known: Map, count: int, seed: int) -> tuple[tuple[float, float], ...]:
    """Places (x, y) anywhere in the mapped area, evenly."""
    nodes = known.visual.graph.positions
    height = float(np.median(nodes[:, 2]))
    low, high = nodes[:, :2].min(axis=0), nodes[:, :2].max(axis=0)
    generator = np.random.default_rng([seed, 7])
    places: list[tuple[float, float]] = []
    while len(places) < count:
        x, y = generator.uniform(low, high)
        if np.linalg.norm(nodes[:, :2] - [x, y], axis=1).min() < FROM_A_NODE * height:
            places.append((float(x), float(y)))
    return tuple(places)


def go_to(scenario: str, seed: int, count: int, wind_m_s: float, folder: Path) -> FlyOutcome:
    """A survey, then the places."""
    map_file = folder / f"{scenario}-{seed}.overfly"
    run(FlyRequest(map_file, scenario, folder / f"{scenario}-{seed}-survey", minutes=0.05, seed=seed))
    places = random_places(Map.open(map_file), count, seed)
    return run(
        FlyRequest(map_file, scenario, folder / f"{scenario}-{seed}", places, None, wind_m_s, seed=seed)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", default="blimp")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--places", type=int, default=20)
    parser.add_argument("--wind", type=float, default=0.2)
    parser.add_argument("--hold-minutes", type=float, default=18.0, help="0: no holding")
    parser.add_argument("--pushes", type=int, default=24)
    parser.add_argument("--out", type=Path, help="keep the reports here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.out or Path(temporary)
        for seed in range(options.first_seed, options.first_seed + options.seeds):
            numbers = go_to(options.scenario, seed, options.places, options.wind, folder).numbers
            errors = np.array(numbers["arrival_errors_m"])
            print(
                f"go to, {options.scenario} seed {seed}: {numbers['arrived']} of {options.places} places, "
                f"on arrival {np.median(errors):.3f} m (median), {errors.max():.3f} m (largest); longest "
                f"lost {numbers['longest_lost_s']:.1f} s; {numbers['images']} pictures, {speed(numbers)}",
                flush=True,
            )
        if options.hold_minutes:
            request = FlyRequest(
                folder / "hold.overfly", options.scenario, folder / "hold", (), options.hold_minutes, 0.1,
                options.pushes, survey_m=(0.0, 0.0), seed=options.first_seed,
            )  # fmt: skip
            numbers = run(request).numbers
            print(
                f"hold, {options.scenario}: {numbers['images']} pictures, {numbers['pushes']} pushes up to "
                f"{numbers['max_error_m']:.1f} m, came back {numbers['returned']} times; settled "
                f"{numbers['rms_error_m']:.3f} m RMS; longest lost {numbers['longest_lost_s']:.1f} s; "
                f"{numbers['map_nodes']} nodes, {speed(numbers)}"
            )


def speed(numbers: dict[str, float]) -> str:
    """Real-time factors as words."""
    wall, cpu = numbers["realtime_factor"], numbers["realtime_factor_cpu"]
    return f"{wall:.1f} times real time ({cpu:.1f} by processor time)"


if __name__ == "__main__":
    main()
