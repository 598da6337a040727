"""Which loops to believe, asked once more without what the flight made of them: from dead reckoning alone.

An estimate that wrong loops have bent agrees with nothing; from it the right ones look wrong too. Where the
stated noise is so large that any loop passes a gate, that is how a flight ends. Dead reckoning knows no
loops: those that fit it best are believed, the graph optimised, and so on until the choice stays the same.
Where dead reckoning drifts further than loops can tell, the flight's own estimate is the better one; which of
the two it is, shows in how well a quarter of all loops fit.
"""

from __future__ import annotations

import numpy as np

from overfly.graph.batch import Start, optimise_in_steps
from overfly.graph.gate import Gate
from overfly.graph.linearise import Freedom, constraint_chi2
from overfly.graph.pose_graph import KINDS, PoseGraph, State
from overfly.graph.robust import Robust
from overfly.graph.steps import Steps
from overfly.types import ConstraintKind, IntArray

MOST_ROUNDS = 15
REVISIT = KINDS.index(ConstraintKind.REVISIT)


def loops(graph: PoseGraph) -> IntArray:
    """Numbers of the revisits, but those that placed a node when it was new."""
    newest = np.maximum(graph.i, graph.j)
    placed = np.zeros(graph.n_constraints, np.bool_)
    placed[np.unique(newest, return_index=True)[1]] = True
    return np.flatnonzero((graph.kinds == REVISIT) & ~placed)


def misfit(graph: PoseGraph) -> float:
    """Lower quartile of the loops' chi2, those not believed included: up to three quarters may be wrong."""
    return float(np.quantile(constraint_chi2(graph, loops(graph)), 0.25))


def believe_what_fits(graph: PoseGraph, gate: Gate, robust: Robust, freedom: Freedom) -> Steps[None]:
    """Start from dead reckoning, then choose loops and optimise in turn, in place."""
    numbers = loops(graph)
    graph.states[numbers] = State.REJECTED
    place_by_ties(graph, 0)
    for _ in range(MOST_ROUNDS):
        distances = constraint_chi2(graph, numbers)
        states = np.where(distances > gate.bound_for(distances), State.REJECTED, State.ACTIVE)
        if np.array_equal(states, graph.states[numbers]):
            return
        graph.states[numbers] = states
        yield from optimise_in_steps(graph, robust, freedom, Start.GIVEN)


def place_by_ties(graph: PoseGraph, begin: int) -> None:
    """Place every node from number ``begin`` on by the first constraint that ties it to an older one."""
    newest = np.maximum(graph.i, graph.j)
    nodes, first = np.unique(newest, return_index=True)
    later = nodes >= begin
    for node, number in zip(nodes[later], first[later], strict=True):
        tie = graph.constraint(int(number))
        if tie.j == node:
            graph.set_pose(tie.j, graph.pose(tie.i) @ tie.i_from_j)
        else:
            graph.set_pose(tie.i, graph.pose(tie.j) @ tie.i_from_j.inverse())
