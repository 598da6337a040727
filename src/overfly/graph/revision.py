"""What loops to believe, asked of the whole graph: chosen from dead reckoning, if they fit better so, then
each tested against all the others. In steps, so that it can go on beside a flight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from overfly.graph.batch import Report, Start, optimise_in_steps
from overfly.graph.covariance import exact_covariance
from overfly.graph.gate import Gate
from overfly.graph.linearise import Freedom, chi2
from overfly.graph.pose_graph import PoseGraph, State
from overfly.graph.reckoning import believe_what_fits, loops, misfit
from overfly.graph.robust import Robust
from overfly.graph.snooping import FEW_LOOPS, best_within, contradicted
from overfly.graph.steps import Steps

FINAL_ROUNDS = 20
CLEARLY_LESS = 0.5


@dataclass(frozen=True)
class Revised:
    """The last optimisation, and the squared distance from all the others within which the believed loops
    lie.
    """

    report: Report
    bound: float


def revise(graph: PoseGraph, gate: Gate | None, robust: Robust, freedom: Freedom) -> Steps[Revised]:
    """Optimise to the end, in place; see whether loops fit better that were chosen from dead reckoning alone;
    and test every accepted loop once more against all the others. gate: None believes every loop.
    """
    if gate is not None and len(loops(graph)) >= FEW_LOOPS:
        other = graph.copy()
        yield from believe_what_fits(other, gate, robust, freedom)
        is_wrong = contradicts_itself(graph, chi2(graph), gate) and not contradicts_itself(
            other, chi2(other), gate
        )
        if is_wrong or misfit(other) < CLEARLY_LESS * misfit(graph):
            graph.positions[:], graph.quaternions[:] = other.positions, other.quaternions
            graph.states[:] = other.states
    return (yield from _optimise_and_vote(graph, gate, robust, freedom))


def _optimise_and_vote(
    graph: PoseGraph, gate: Gate | None, robust: Robust, freedom: Freedom
) -> Steps[Revised]:
    """Set aside what the others contradict, then take back what fits the estimate that it had no part in, in
    turn, until nothing changes.
    """
    report = yield from optimise_in_steps(graph, robust, freedom, Start.EACH)
    bound = np.inf if gate is None else gate.stated
    for _ in range(FINAL_ROUNDS if gate is not None else 0):
        covariance = exact_covariance(graph, freedom, robust)
        yield
        if gate is None or covariance is None:
            break
        relative = yield from covariance.along_constraints()
        out, bound = contradicted(graph, gate, relative)
        yield
        if len(out):
            graph.states[out] = State.REJECTED
            report = yield from optimise_in_steps(graph, robust, freedom, Start.EACH)
            covariance = exact_covariance(graph, freedom, robust)
            yield
            if covariance is not None:
                yield from covariance.along_constraints()
        # where noise is stated far too large, nearly anything fits in a weak place
        most_gain = report.cost_after if gate.overstates(bound) else np.inf
        back = np.empty(0, np.int64)
        if covariance is not None:
            back = yield from best_within(graph, bound, out, covariance, most_gain)
        graph.states[back] = State.ACTIVE
        if len(back):
            report = yield from optimise_in_steps(graph, robust, freedom, Start.EACH)
        if len(out) == len(back) == 0:
            break
    return Revised(report, bound)


def contradicts_itself(graph: PoseGraph, cost: float, gate: Gate) -> bool:
    """Whether the believed loops cost more together than the gate allows each of them, or there are few."""
    believed = int((graph.states[loops(graph)] == State.ACTIVE).sum())
    return believed < FEW_LOOPS or cost > gate.stated * believed
