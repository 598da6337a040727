"""What a frame, a search for places and the memory cost as a flight gets long, and how true its map stays.

python benchmarks/long_flight.py FOLDER [--scenario long-haul] [--frames 10800] [--seed 1]

Frames are rendered one by one as they are needed. Times are processor time of Slam.process alone. Writes
long_flight.json, and long_flight.svg with the cost per frame, per search, and the memory of the process.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from memory import resident_mb

from overfly.evaluation import Align, evaluate
from overfly.geometry.poses import FloatArray, Pose
from overfly.graph.pose_graph import KINDS
from overfly.pipeline.georeferencing import georeference
from overfly.pipeline.recording import Recording
from overfly.products.charts import Drawing, add_frame, add_line, axes_around, write_chart
from overfly.revisit.outcome import RevisitStatus
from overfly.simulation import SimulatedFlight
from overfly.simulation.scenario import declared
from overfly.slam import Slam
from overfly.threads import one_opencv_thread
from overfly.trajectory import Trajectory
from overfly.types import ConstraintKind

SHARE = 1000  # frames of the first and of the last part that are compared
WARM_UP = 100  # frames before the first part: kernels are loaded in them
BLOCK = 100  # frames that a point of the plot is the mean of
MEMORY_EVERY = 50
FALSE_SIGMAS, FALSE_SHARE = (
    3.0,
    0.005,
)  # a revisit further off than these sigmas + share of the height is false
AWAY = 10  # nodes newer than that are odometry's


@dataclass(slots=True, eq=False)
class Costs:
    """Per frame: seconds of processor time, in all and for the search for places (NaN where there was none),
    nodes so far. memory_mb (k, 2): frame and resident memory of the process. recognised: nodes at which an
    older place was seen again, whether that gave a constraint or not.
    """

    frame_s: list[float] = field(default_factory=list)
    search_s: list[float] = field(default_factory=list)
    nodes: list[int] = field(default_factory=list)
    memory_mb: list[tuple[int, float]] = field(default_factory=list)
    recognised: set[int] = field(default_factory=set)


def fly(flight: SimulatedFlight) -> tuple[Slam, Recording, Costs]:
    slam, costs = Slam(flight.rig), Costs()
    recording = Recording(slam)
    for index in range(len(flight)):
        frame = flight.frame(index)
        begin = time.process_time()
        result = slam.process(frame)
        costs.frame_s.append(time.process_time() - begin)
        # Stages are timed by the clock: of the processor time the search has the same share.
        share = result.timings_s.get("revisit", np.nan) / sum(result.timings_s.values())
        costs.search_s.append(costs.frame_s[-1] * share)
        costs.nodes.append(len(slam.map))
        revisit = result.revisit
        if result.node is not None and revisit is not None and revisit.status is RevisitStatus.ACCEPTED:
            costs.recognised.add(result.node)
        recording.observe(frame, result)
        if index % MEMORY_EVERY == 0:
            costs.memory_mb.append((index, resident_mb()))
        if index % SHARE == SHARE - 1:
            recent = costs.frame_s[-SHARE:]
            print(f"{index + 1} frames, {len(slam.map)} nodes, {1e3 * np.mean(recent):.2f} ms", flush=True)
    slam.finish()
    georeference(recording)
    return slam, recording, costs


def places_seen(truth: list[Pose]) -> FloatArray:
    """(n, 2) where each optical axis meets the plane z = 0."""
    along = np.array([pose.rotation[:, 2] for pose in truth])
    at = np.array([pose.translation for pose in truth])
    return np.asarray((at - along * (at[:, 2:] / along[:, 2:]))[:, :2])


def judge_revisits(recording: Recording, recognised: set[int], flight: SimulatedFlight) -> dict[str, Any]:
    """Revisits against the truth: how many there were to be found, how many were, and how many of these gave
    a constraint, since the map did not know as much already; how many are false."""
    slam = recording.slam
    truth = flight.truth
    nodes = [truth[node.frame_index] for node in slam.map.nodes]
    camera = slam.rig.cam0.camera
    seen = places_seen(nodes)
    heights = np.array([pose.translation[2] for pose in nodes])
    half_view = 0.25 * min(camera.width, camera.height) / camera.focal_px * heights
    possible = [
        int(n)
        for n in range(AWAY + 1, len(nodes))
        if (np.linalg.norm(seen[: n - AWAY] - seen[n], axis=1) < half_view[n]).any()
    ]
    graph = slam.map.graph
    revisits = np.flatnonzero(graph.kinds == KINDS.index(ConstraintKind.REVISIT))
    false = 0
    for k in revisits:
        i, j = int(graph.i[k]), int(graph.j[k])
        off = graph.measured_positions[k] - (nodes[i].inverse() @ nodes[j]).translation
        sigma = np.sqrt(np.trace(np.linalg.inv(graph.information[k])[:3, :3]))
        false += bool(np.linalg.norm(off) > FALSE_SIGMAS * sigma + FALSE_SHARE * heights[j])
    tied = {int(graph.j[k]) for k in revisits}
    found = tied | recognised
    return {
        "nodes_that_see_an_older_place": len(possible),
        "of_these_found": len(found & set(possible)),
        "of_these_tied": len(tied & set(possible)),
        "revisit_constraints": len(revisits),
        "false": false,
    }


def errors_m(recording: Recording, flight: SimulatedFlight) -> dict[str, Any]:
    truth = Trajectory.from_poses(flight.stamps_ns.tolist(), list(flight.truth))
    runs = {
        "odometry": recording.odometry(),
        "optimised": recording.trajectory(),
        "online": recording.online(),
    }
    evaluated = {name: evaluate(run, truth, Align.SE3) for name, run in runs.items()}
    free = evaluate(recording.trajectory(), truth, Align.SIM3)
    return {
        "ate_m": {name: result.ate_m.rmse for name, result in evaluated.items()},
        "optimised_sim3_m": free.ate_m.rmse,
        "scale_error": evaluated["optimised"].scale_error,
        "path_m": evaluated["optimised"].path_m,
    }


def map_bytes(slam: Slam) -> int:
    """Of everything that nodes keep, without the pictures of the newest."""
    total = 0
    for node in slam.map.nodes:
        for name in node.__slots__:
            value = getattr(node, name)
            if isinstance(value, np.ndarray):
                total += value.nbytes
        features = node.features
        total += sum(getattr(features, one.name).nbytes for one in dataclasses.fields(features))
    return total


def summary(slam: Slam, recording: Recording, costs: Costs, flight: SimulatedFlight) -> dict[str, Any]:
    frame_ms, search_ms = 1e3 * np.array(costs.frame_s), 1e3 * np.array(costs.search_s)
    nodes = np.array(costs.nodes)
    share = min(SHARE, len(frame_ms) // 4)
    by_size = []
    edges = np.linspace(0, nodes[-1], 7).astype(int)
    for low, high in pairwise(edges):
        some = search_ms[(nodes > low) & (nodes <= high) & np.isfinite(search_ms)]
        if len(some):
            by_size.append([int(high), float(np.median(some)), float(np.percentile(some, 95))])
    begun = min(WARM_UP, share)
    parts = {"first": frame_ms[begun : begun + share], "last": frame_ms[-share:]}
    return {
        "frames": len(frame_ms),
        "located": recording.n_located,
        "nodes": len(slam.map),
        "share": share,
        **{
            name: {
                "mean_ms": float(part.mean()),
                "p50_ms": float(np.median(part)),
                "p95_ms": float(np.percentile(part, 95)),
            }
            for name, part in parts.items()
        },
        "search_ms_by_nodes_p50_p95": by_size,
        "memory_mb_first_last": [
            costs.memory_mb[min(2, len(costs.memory_mb) - 1)][1],
            costs.memory_mb[-1][1],
        ],
        "map_bytes_per_node": map_bytes(slam) / len(slam.map),
        "revisits": recording.revisits() | judge_revisits(recording, costs.recognised, flight),
        **errors_m(recording, flight),
    }


def draw(costs: Costs, path: Path) -> None:
    frame_ms, search_ms = 1e3 * np.array(costs.frame_s), 1e3 * np.array(costs.search_s)
    count = len(frame_ms) // BLOCK
    blocks = frame_ms[: count * BLOCK].reshape(count, BLOCK)
    middle = (np.arange(count) + 0.5) * BLOCK
    nodes, sought = np.array(costs.nodes), np.isfinite(search_ms)
    curves = [
        ("frame", "processor time per frame, ms", middle, blocks.mean(axis=1), "path"),
        (
            "nodes in the map",
            "search for places, ms",
            nodes[sought],
            search_ms[sought],
            "good",
        ),
        ("frame", "memory of the process, MB", *np.array(costs.memory_mb).T, "truth"),
    ]
    drawing = Drawing(760, 3 * 190, "Cost per frame, per search and memory over a long flight")
    for place, (x_label, y_label, x, y, tone) in enumerate(curves):
        points = np.column_stack([x, y])
        axes = axes_around(60, 20 + 190 * place, 680, 125, np.vstack([points, [0.0, 0.0]]))
        add_frame(drawing, axes, x_label, y_label)
        add_line(drawing, axes, points, tone)
    write_chart(path, drawing)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenario", default="long-haul")
    parser.add_argument("--frames", type=int)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    flight = SimulatedFlight(
        declared(arguments.scenario).build(arguments.seed), arguments.seed, arguments.frames
    )
    with one_opencv_thread():
        slam, recording, costs = fly(flight)
    draw(costs, arguments.folder / "long_flight.svg")
    report = summary(slam, recording, costs, flight)
    (arguments.folder / "long_flight.json").write_text(json.dumps(report, indent=1) + "\n")
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
