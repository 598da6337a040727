"""What hours over the same small place cost: nodes, size of the map file and memory against time.

python benchmarks/hover.py FOLDER [--hours 3] [--rate 2] [--seed 1]

The paper's hold (a blimp pushed away every 45 s) goes on for hours; frames are rendered as they are needed,
and the map file is kept as ``overfly map`` keeps it. Writes hover.json and hover.svg.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

import numpy as np
from memory import resident_mb

from overfly.mapstore import MapWriter
from overfly.mapstore.live import flight_entry
from overfly.pipeline.keeping import MapKeeper
from overfly.products.charts import Drawing, add_frame, add_line, axes_around, write_chart
from overfly.simulation import SimulatedFlight
from overfly.simulation.plants import hold_position
from overfly.simulation.scenario import declared
from overfly.simulation.vehicles import BLIMP
from overfly.slam import Slam

SAMPLES = 60  # points of the plot


def hover(folder: Path, hours: float, rate_hz: float, seed: int) -> list[dict[str, float]]:
    """One row per sample: hours, nodes, constraints, file_mb, memory_mb, located so far."""
    base = declared("hold").build(seed)
    path = hold_position(
        BLIMP, (2.5, 0.0, 1.9), duration_s=3600.0 * hours, push_every_s=45.0, push_m=2.8, seed=seed
    )
    flight = SimulatedFlight(dataclasses.replace(base, path=path, rate_hz=rate_hz), seed)
    slam = Slam(flight.rig)
    file = folder / "map.overfly"
    keeper = MapKeeper(MapWriter.begin(file, flight_entry(slam, "hover")), slam)
    rows = []
    every = max(len(flight) // SAMPLES, 1)
    for index in range(len(flight)):
        frame = flight.frame(index)
        keeper.observe(frame, slam.process(frame))
        if index % every == every - 1:
            rows.append(
                {
                    "hours": index / rate_hz / 3600.0,
                    "nodes": len(slam.map),
                    "constraints": slam.map.graph.n_constraints,
                    "file_mb": file.stat().st_size / 1e6,
                    "memory_mb": resident_mb(),
                    "located": len(slam.records) / (index + 1),
                }
            )
            print(rows[-1], flush=True)
    keeper.save(complete=True)
    keeper.writer.close()
    print(f"closed: {file.stat().st_size / 1e6:.1f} MB")
    return rows


def draw(path: Path, rows: list[dict[str, float]]) -> None:
    """Nodes, megabytes of the file and of the process, one above the other, against hours."""
    shown = (("nodes", "nodes"), ("file_mb", "map file, MB"), ("memory_mb", "process, MB"))
    drawing = Drawing(640, 200 * len(shown), "what hours over one place cost")
    for place, (key, label) in enumerate(shown):
        points = np.array([[row["hours"], row[key]] for row in rows])
        low = np.vstack([points, [[0.0, 0.0]]])
        axes = axes_around(70, 200 * place + 15, 550, 140, low)
        add_frame(drawing, axes, "hours", label)
        add_line(drawing, axes, points, "path")
    write_chart(path, drawing)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--hours", type=float, default=3.0)
    parser.add_argument("--rate", type=float, default=2.0)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    rows = hover(given.folder, given.hours, given.rate, given.seed)
    draw(given.folder / "hover.svg", rows)
    (given.folder / "hover.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
