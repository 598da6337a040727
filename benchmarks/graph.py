"""Pose graphs: chi2, CPU time, iterations, on public graphs and lawn-mower flights; batch, online, false.

    python benchmarks/graph.py FOLDER_WITH_G2O_FILES [batch|tree|online|false|scaling ...]

Prints Markdown tables; ``scaling`` also writes docs/graph_scaling.svg.
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from overfly.graph.batch import Method, optimise_batch
from overfly.graph.files import read_graph
from overfly.graph.linearise import chi2, constraint_chi2
from overfly.graph.online import OnlineOptimiser, OnlineSettings
from overfly.graph.pose_graph import PoseGraph, State
from overfly.graph.synthetic import (
    LawnMower,
    Recording,
    fly_lawn_mower,
    replay,
    trajectory_error_m,
    with_false_loops,
)
from overfly.graph.tree_online import OnlineTree
from overfly.types import Constraint, ConstraintKind

# Best known chi2, and TORO's C++ after 100 iterations: ratio to it, milliseconds an iteration.
BEST = {
    "sphere2500": (727.15, "3.7", "19-23"),
    "parking-garage": (1.2387, "18-26", "5-10"),
    "torus3D": (14575.0, "1.4-1.6", "18-24"),
    "sphere_bignoise_vertex3": (743860.0, "1.15-1.35", "27-50"),
    "cubicle": (2346.0, "diverges", "23"),
    "intel": (45.00, "1.1-1.3", ".5-.7"),
    "city10000": (512.0, "2.2", "14"),
    "manhattan": (3549.0, "300-1100", "2.3"),
}
ONLINE = ("intel", "manhattan", "parking-garage", "sphere2500")


def load(folder: Path, name: str) -> PoseGraph:
    return read_graph(folder / f"{name}.g2o.gz")


def lawn_graph(nodes: int) -> PoseGraph:
    for graph, constraint in replay(fly_lawn_mower(LawnMower(nodes), 1)):
        graph.add_constraint(constraint)
    return graph


def batch(folder: Path) -> None:
    print("| graph | best known | ours | iterations | CPU s |\n|---|---|---|---|---|")
    optimise_batch(load(folder, "intel"))
    optimise_batch(load(folder, "parking-garage"))
    for name, (best, *_) in BEST.items():
        reports = [optimise_batch(load(folder, name)) for _ in range(3)]
        seconds = np.median([report.cpu_s for report in reports])
        print(
            f"| {name} | {best:.6g} | {reports[0].chi2_after:.6g} | {reports[0].iterations} | {seconds:.3f} |"
        )


def tree(folder: Path) -> None:
    print("| graph | ours / best | ms an iteration | TORO / best | TORO ms |\n|---|---|---|---|---|")
    optimise_batch(load(folder, "intel"), Method.TREE, max_iterations=2)
    for name, (best, toro, toro_ms) in BEST.items():
        report = optimise_batch(load(folder, name), Method.TREE)
        print(f"| {name} | {report.chi2_after / best:.3g} | {10 * report.cpu_s:.1f} | {toro} | {toro_ms} |")


def recorded(graph: PoseGraph) -> Recording:
    """The constraints of a graph in the order in which its nodes came; the truth is its optimum."""
    best = graph.copy()
    optimise_batch(best)
    newest = np.maximum(graph.i, graph.j)
    constraints, seen = [], 0
    for number in np.lexsort((-np.minimum(graph.i, graph.j), newest)):
        c = graph.constraint(int(number))
        kind = ConstraintKind.ODOMETRY if newest[number] > seen else ConstraintKind.REVISIT
        seen = max(seen, int(newest[number]))
        constraints.append(Constraint(c.i, c.j, c.i_from_j, c.information, kind))
    return Recording([best.pose(n) for n in range(len(best))], constraints, np.zeros(len(constraints), bool))


def flights(folder: Path) -> Iterator[tuple[str, Recording, bool]]:
    for name in ONLINE:
        graph = load(folder, name)
        yield name, recorded(graph), graph.planar
    for nodes in (1000, 10_000):
        yield f"lawn {nodes}", fly_lawn_mower(LawnMower(nodes), 1), False


def fly(recording: Recording, planar: bool, settings: OnlineSettings) -> tuple[OnlineOptimiser, list[float]]:
    """The optimiser after the flight, and the CPU seconds of every constraint."""
    optimiser, seconds = None, []
    for graph, constraint in replay(recording, planar):
        optimiser = optimiser or OnlineOptimiser(graph, settings)
        began = time.process_time()
        optimiser.add(constraint)
        seconds.append(time.process_time() - began)
    assert optimiser is not None
    return optimiser, seconds


def online(folder: Path) -> None:
    print("| graph | method | total s | median ms | largest ms | chi2 / batch |")
    print("|---|---|---|---|---|---|")
    fly(fly_lawn_mower(LawnMower(100), 1), False, OnlineSettings(gate_sigma=None))
    for name, recording, planar in flights(folder):
        optimiser, seconds = fly(recording, planar, OnlineSettings(gate_sigma=None))
        best = optimiser.graph.copy()
        ratio = chi2(optimiser.graph) / optimise_batch(best).chi2_after
        steps = f"{1e3 * np.median(seconds):.2f} | {1e3 * max(seconds):.1f}"
        print(f"| {name} | sparse | {sum(seconds):.3f} | {steps} | {ratio:.4f} |")
        began = time.process_time()
        graph = fly_tree(recording, planar)
        total = time.process_time() - began
        print(f"| {name} | tree | {total:.2f} | | | {chi2(graph) / chi2(best):.3g} |")


def fly_tree(recording: Recording, planar: bool) -> PoseGraph:
    tree_of: OnlineTree | None = None
    for graph, constraint in replay(recording, planar):
        if tree_of is None:
            tree_of = OnlineTree(graph)
            tree_of.attach(-1)
        while len(tree_of) < len(graph):
            tree_of.attach(min(constraint.i, constraint.j))
        number = graph.add_constraint(constraint)
        tree_of.add(number)
        if constraint_chi2(graph, np.array([number]))[0] > 1.0:
            tree_of.resolve(number, 1)
    return graph


def false(folder: Path) -> None:
    print(
        "| graph | false | before finish m | after m | false in before | after | true out before | after "
        "| flight s | largest ms | finish s |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    fly(with_false_loops(fly_lawn_mower(LawnMower(100), 1), 0.1, 7), False, OnlineSettings())  # compile first
    flown = [(f"lawn {n}", fly_lawn_mower(LawnMower(n), 1)) for n in (1000, 10_000)]
    flown += [(name, recorded(load(folder, name))) for name in ("parking-garage", "sphere2500")]
    for name, recording in flown:
        for rate in (0.0, 0.01, 0.1, 0.5):
            spoilt = with_false_loops(recording, rate, 7)
            optimiser, steps = fly(spoilt, False, OnlineSettings())
            before = found(optimiser.graph, spoilt)
            began = time.process_time()
            optimiser.finish()
            seconds = time.process_time() - began
            after = found(optimiser.graph, spoilt)
            pairs = " | ".join(f"{a} | {b}" for a, b in zip(before, after, strict=True))
            times = f"{sum(steps):.1f} | {1e3 * max(steps):.0f} | {seconds:.1f}"
            print(f"| {name} | {rate:.0%} | {pairs} | {times} |", flush=True)


def found(graph: PoseGraph, spoilt: Recording) -> tuple[str, str, int]:
    """Error in metres, false loops believed of all false ones, true loops not believed."""
    kept = graph.states == State.ACTIVE
    error = f"{trajectory_error_m(graph, spoilt.truth):.4f}"
    false = f"{(kept & spoilt.false).sum()}/{spoilt.false.sum()}"
    return error, false, int((~kept & ~spoilt.false).sum())


def scaling(_folder: Path) -> None:
    print("| nodes | CPU s | peak memory MB | chi2 |\n|---|---|---|---|")
    rows = []
    optimise_batch(lawn_graph(100))  # compile first
    for nodes in (1000, 3000, 10_000, 30_000, 100_000):
        graph = lawn_graph(nodes)
        report = optimise_batch(graph)
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        rows.append((nodes, report.cpu_s, memory))
        print(f"| {nodes} | {report.cpu_s:.2f} | {memory:.0f} | {report.chi2_after:.0f} |", flush=True)
    Path("docs/graph_scaling.svg").write_text(drawing(rows), encoding="utf-8")


def drawing(rows: list[tuple[int, float, float]]) -> str:
    """Time and memory against n on logarithmic axes, as SVG."""
    n, seconds, memory = (np.log10(np.array(column, dtype=float)) for column in zip(*rows, strict=True))

    def line(values: np.ndarray, colour: str) -> str:
        x = 60 + 480 * (n - n[0]) / (n[-1] - n[0])
        y = 250 - 220 * (values - values.min()) / (values.max() - values.min())
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
        labels = "".join(
            f'<text x="{a:.0f}" y="{b - 6:.0f}" fill="{colour}">{10**v:.3g}</text>'
            for a, b, v in zip(x, y, values, strict=True)
        )
        return f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2"/>{labels}'

    nodes = "".join(
        f'<text x="{60 + 480 * (v - n[0]) / (n[-1] - n[0]):.0f}" y="270">{10**v:.0f}</text>' for v in n
    )
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 620 300" '
        'font-family="sans-serif" font-size="11">'
        '<rect width="620" height="300" fill="white"/>'
        f"{line(seconds, '#1f77b4')}{line(memory, '#d62728')}{nodes}"
        '<text x="60" y="15" fill="#1f77b4">CPU seconds of a batch optimisation</text>'
        '<text x="320" y="15" fill="#d62728">peak memory, MB</text><text x="280" y="290">nodes</text></svg>\n'
    )


PARTS = {"batch": batch, "tree": tree, "online": online, "false": false, "scaling": scaling}

if __name__ == "__main__":
    for part in sys.argv[2:] or PARTS:
        print(f"\n## {part}\n")
        PARTS[part](Path(sys.argv[1]))
