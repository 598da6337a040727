"""Loops revised while a flight goes on: a copy of the graph is worked on, a step with every constraint, and
the result carried over to what the graph has become.
"""

from __future__ import annotations

import numpy as np

from overfly.graph.consistency import Corroboration
from overfly.graph.gate import Gate
from overfly.graph.linearise import Freedom, constraint_chi2
from overfly.graph.pose_graph import PoseGraph, State
from overfly.graph.reckoning import loops, place_by_ties
from overfly.graph.revision import Revised, contradicts_itself, revise
from overfly.graph.robust import Robust
from overfly.graph.snooping import FEW_LOOPS
from overfly.graph.steps import Steps
from overfly.types import IntArray

GROWN = 1.5  # so many times as many loops, until they are revised again
MOST_STEPS = 1000  # of one revision: where it takes longer, it is not going to tell
NEAR_NODES = 10  # apart lie the ends of loops that confirm each other, at most


class RevisionInFlight:
    """Begins when loops have grown in number and do not look like their stated noise; goes on by
    :meth:`advance`.
    """

    def __init__(self, graph: PoseGraph, gate: Gate, robust: Robust, freedom: Freedom) -> None:
        self._graph, self._gate = graph, gate
        self._robust, self._freedom = robust, freedom
        self._cycles = Gate(gate.sigma, gate.degrees, 0)
        self._agreement = Corroboration(graph, NEAR_NODES, self._cycles)
        self._asked: set[int] = set()
        self.confirmed_late: list[int] = []  # loops that waited, to be judged again
        self._n_loops = 0
        self._begin_at = 2 * FEW_LOOPS
        self._copy: PoseGraph | None = None  # None: nothing is being revised
        self._steps: Steps[Revised]
        self._n_steps = 0

    def count(self) -> None:
        """A loop has come."""
        self._n_loops += 1

    def believes(self, number: int, distance: float, settled_cost: float) -> bool:
        """Whether a loop at this squared distance is believed: inside the gate, and, where noise turned out
        to be stated too large, confirmed by another if it alone would bend all the others.
        """
        if not self._gate.is_narrowed or not self._gate.keeps(distance):
            return self._gate.keeps(distance)
        gain = float(constraint_chi2(self._graph, np.array([number]))[0]) - distance
        if gain <= settled_cost or number in self._agreement.confirmed:
            return True
        if number in self._asked:
            return False
        self._asked.add(number)
        confirmed = self._agreement.add(number)
        self.confirmed_late += [loop for loop in confirmed if loop != number]
        return number in confirmed

    def advance(self, settled_cost: float, is_stuck: bool) -> Revised | None:
        """One step of the work, if there is any; the result when it was the last. settled_cost: chi2 of the
        graph; is_stuck: it cannot be settled further.
        """
        if self._n_loops >= self._begin_at:
            self._begin_at = int(GROWN * self._n_loops)
            wrong = is_stuck or contradicts_itself(self._graph, settled_cost, self._gate)
            if wrong or self._gate.is_overstated:
                self._copy, self._n_steps = self._graph.copy(), 0
                self._steps = revise(self._copy, self._gate, self._robust, self._freedom)
                return None
        if self._copy is None:
            return None
        self._n_steps += 1
        try:
            next(self._steps)
        except StopIteration as stop:
            revised: Revised = stop.value
            self._gate.narrow(revised.bound)
            self._cycles.narrow(revised.bound)
            return revised
        if self._n_steps >= MOST_STEPS:
            self._copy = None
        return None

    def take_over(self) -> tuple[IntArray, IntArray]:
        """Carry over which loops are believed and where they put the nodes; newer nodes follow those they
        hang on. Returns the loops whose state changed, and the newer ones, set aside, to be judged anew; both
        are empty, and nothing is changed, where the graph believes the same loops already.
        """
        graph, copy = self._graph, self._copy
        self._copy = None
        assert copy is not None
        n, m = len(copy), copy.n_constraints
        changed = np.flatnonzero(graph.states[:m] != copy.states)
        if len(changed) == 0:
            return changed, changed
        graph.states[:m] = copy.states
        graph.positions[:n], graph.quaternions[:n] = copy.positions, copy.quaternions
        newer = loops(graph)
        newer = newer[newer >= m]
        changed = np.concatenate([changed, newer[graph.states[newer] == State.ACTIVE]])
        graph.states[newer] = State.REJECTED
        place_by_ties(graph, n)
        return changed, newer
