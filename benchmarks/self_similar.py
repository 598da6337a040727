"""Whether ground that repeats itself fools the search for places.

python benchmarks/self_similar.py [--seeds 10] [--materials tiles wood paving] [--black-s 3]

The simulated loop over a tiled floor, and the same over boards and over slabs: revisits that were entered,
those of them that are false (the relative pose is wrong by more than three standard deviations and 5 cm),
frames located, and the error of the trajectory. With --black-s no picture shows anything for so long in the
middle, and a second piece of the map begins, which may or may not be joined to the first.
"""

from __future__ import annotations

import argparse
import dataclasses

import numpy as np

from overfly.evaluation import Align, evaluate
from overfly.graph.covariance import tangent_covariance
from overfly.graph.pose_graph import KINDS
from overfly.simulation import SimulatedFlight, paving, strewn
from overfly.simulation.ground import Ground, Layer
from overfly.simulation.scenario import declared
from overfly.slam import Slam
from overfly.trajectory import Trajectory
from overfly.types import ConstraintKind

REVISIT = KINDS.index(ConstraintKind.REVISIT)
FLOORS = {"tiles": paving.tiled_floor(0.30), "wood": paving.wood_floor(), "paving": paving.slabs()}


def flight_over(floor: str, seed: int, black_s: float = 0.0) -> SimulatedFlight:
    scenario = declared("self-similar").build(seed)
    if black_s > 0.0:
        begin = 0.5 * (scenario.path.duration_s - black_s)
        trouble = dataclasses.replace(scenario.trouble, black_s=((begin, begin + black_s),))
        scenario = dataclasses.replace(scenario, trouble=trouble)
    ground = Ground((Layer(FLOORS[floor], None, (strewn.SPOTS,)),), (), seed)
    return SimulatedFlight(dataclasses.replace(scenario, ground=ground), seed)


def false_revisits(slam: Slam, flight: SimulatedFlight) -> tuple[int, int]:
    """Revisits that were entered, and how many of them are false."""
    graph, truth = slam.map.graph, flight.truth
    entered = [int(k) for k in graph.active if graph.kinds[k] == REVISIT]
    false = 0
    for number in entered:
        constraint = graph.constraint(number)
        i, j = (slam.map.nodes[node].frame_index for node in (constraint.i, constraint.j))
        i_from_j = truth[i].inverse() @ truth[j]
        wrong = i_from_j.translation - constraint.i_from_j.translation
        covariance = tangent_covariance(constraint.information, False)[:3, :3]
        sigma = np.sqrt(np.linalg.eigvalsh(covariance)[-1])
        false += bool(np.linalg.norm(wrong) > 3.0 * sigma + 0.05)
    return len(entered), false


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--materials", nargs="*", choices=sorted(FLOORS), default=sorted(FLOORS))
    parser.add_argument("--black-s", type=float, default=0.0)
    given = parser.parse_args()
    print("| floor | seed | located | pieces | revisits | false | ATE, m | largest error, m |")
    print("|---|---|---|---|---|---|---|---|")
    for floor in given.materials:
        for seed in range(1, given.seeds + 1):
            flight = flight_over(floor, seed, given.black_s)
            slam = Slam(flight.rig)
            for frame in flight:
                slam.process(frame)
            entered, false = false_revisits(slam, flight)
            slam.finish()
            placed = slam.placed()
            estimate = Trajectory.from_poses(
                [record.t_ns for record in placed], [slam.pose_of(record) for record in placed]
            )
            truth = Trajectory.from_poses(flight.stamps_ns, flight.truth)
            found = evaluate(estimate, truth, Align.SE3)
            n_pieces = len(np.unique(slam.map.pieces()))
            print(
                f"| {floor} | {seed} | {len(placed)} of {len(flight)} | {n_pieces} "
                f"| {entered} | {false} "
                f"| {found.ate_m.rmse:.3f} | {found.ate_m.max:.3f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
