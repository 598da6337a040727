"""The online optimiser: one constraint at a time, and work only where and when it is needed.

A constraint that closes a loop is first judged against the estimate and its covariance (the paper's 3 sigma
region). One that agrees costs nothing more than being kept. What the accepted ones could still gain is added
up, and only when that is a noticeable part of chi2 does the solver run, from the present poses, for a bounded
number of iterations. Rejected constraints are judged again when the covariance has changed. Sources: section
III of the paper; Grisetti et al., "Online constraint network optimization for efficient maximum likelihood
map learning", ICRA 2008; Kaess et al., "iSAM2", IJRR 2012 for the comparison.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from overfly.geometry.poses import FloatArray
from overfly.graph.batch import Report, natural_freedom
from overfly.graph.consistency import Corroboration
from overfly.graph.covariance import ExactCovariance, tangent_information
from overfly.graph.elimination import whole_fronts
from overfly.graph.gate import Gate
from overfly.graph.in_flight import RevisionInFlight
from overfly.graph.incremental import MUCH_WORK, IncrementalSolver
from overfly.graph.linearise import Freedom, constraint_chi2, displaced
from overfly.graph.pose_graph import PoseGraph, State
from overfly.graph.revision import revise
from overfly.graph.robust import PLAIN, Kernel, Robust
from overfly.graph.snooping import innovation_vector, squared_distances
from overfly.graph.sparse import REVISIT, SparseSettings, factor_now, find_pattern, solve
from overfly.graph.steps import to_the_end
from overfly.types import Constraint, ConstraintKind, IntArray, Reason

LONGEST_WAIT = 0.05  # of the constraints: new ones between two solutions that lead nowhere
NOTHING: IntArray = np.empty(0, np.int64)  # no nodes, no constraints
LATE_LOOPS = 20  # judged with one constraint
MULTIPLICATIONS = 5e7  # a constraint, all in all: the solver waits when it has used more


class Decision(StrEnum):
    ACCEPTED = "accepted"
    REJECTED = "rejected"
    PENDING = "pending"  # waits until there are enough loops, or an estimate, to judge it by


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of a constraint.

    constraint: its number in the graph. innovation: squared Mahalanobis distance from the estimate, None
    where it was not judged. moved (k,): nodes that moved noticeably. reconsidered (r,): older constraints
    whose state changed. seconds: by the clock.
    """

    constraint: int
    decision: Decision
    reason: Reason | None = None
    innovation: float | None = None
    optimised: bool = False
    moved: IntArray = field(default_factory=NOTHING.copy)
    reconsidered: IntArray = field(default_factory=NOTHING.copy)
    seconds: float = 0.0


@dataclass(frozen=True)
class OnlineSettings:
    """freedom: of the nodes, all by default. gate_sigma: bound of the innovation, None accepts everything.
    calibrate: believe the stated noise (0), or learn its scale from so many first loops, which wait until
    then. corroborate: believe a loop only when another agrees whose ends lie within so many nodes of its own
    (0: believe single loops).

    tolerance: the solver runs when this part of chi2 could be gained. iterations_per_step and
    retries_per_step bound the work that one constraint can cause. refresh: covariances are recomputed after
    so many new loops, as part of the graph.
    """

    freedom: Freedom | None = None
    robust: Robust = PLAIN
    gate_sigma: float | None = 3.0
    calibrate: int = 0
    corroborate: int = 0
    tolerance: float = 0.005
    iterations_per_step: int = 2
    retries_per_step: int = 4
    refresh: float = 0.1


class OnlineOptimiser:
    """Keeps a growing graph optimised. Nodes are added to the graph; constraints through :meth:`add`."""

    def __init__(self, graph: PoseGraph, settings: OnlineSettings = OnlineSettings()) -> None:
        self.graph = graph
        self.settings = settings
        self.freedom = natural_freedom(graph) if settings.freedom is None else settings.freedom
        self._covariance: ExactCovariance | None = None
        self._n_tied = _tied(graph)
        self._unsettled = 0.0  # chi2 that the solver could still gain
        self._settled_cost = 0.0
        self._loops_since_factor = 0
        self._next_retry = 0
        self._wait = self._waited = 0  # constraints to let pass where solving leads nowhere
        self._multiplications = 0.0  # by the solver so far
        self._solver: IncrementalSolver | None = None
        self._gate: Gate | None = None
        if settings.gate_sigma is not None:
            self._gate = Gate(settings.gate_sigma, 3 if graph.planar else 6, settings.calibrate)
        self._corroboration: Corroboration | None = None
        if settings.corroborate > 0:
            cycles = Gate(settings.gate_sigma or 3.0, 3 if graph.planar else 6, settings.calibrate)
            self._corroboration = Corroboration(graph, settings.corroborate, cycles)
        self._pending: list[int] = []
        self._revision: RevisionInFlight | None = None
        if self._gate is not None and not settings.calibrate and not settings.corroborate:
            self._revision = RevisionInFlight(graph, self._gate, settings.robust, self.freedom)
        self._unjudged: list[int] = []  # loops that came during a revision that changed the estimate

    def add(self, constraint: Constraint) -> Outcome:
        """Add a constraint between two nodes of the graph, and optimise if that is worth while."""
        began = time.perf_counter()
        number = self.graph.add_constraint(constraint)
        decision, innovation = Decision.ACCEPTED, None
        if self._is_tie(constraint):
            self._attach(constraint)
        elif constraint.kind is ConstraintKind.REVISIT and self._gate is not None:
            decision, innovation = self._judge(number, constraint, self._gate)
        else:
            self._count(number, 0.0)
        reconsidered, moved = self._revise()
        optimised = len(reconsidered) > 0
        if not optimised:
            reconsidered = self._judge_late()
            optimised, moved = self._optimise_if_worth_while()
        if optimised:
            reconsidered = np.concatenate([reconsidered, self._vote_out(), self._reconsider()])
        reason = Reason.OUTSIDE_GATE if decision is Decision.REJECTED else None
        return Outcome(
            number, decision, reason, innovation, optimised, moved, reconsidered, time.perf_counter() - began
        )

    def _judge(self, number: int, constraint: Constraint, gate: Gate) -> tuple[Decision, float | None]:
        """Accept or set aside a loop; while the gate is still learning its scale, all wait, to be judged
        together. An estimate that is far from settled, and has to wait for the solver, judges nothing.
        """
        if self._revision is not None:
            self._revision.count()
        if self._overspent and self._unsettled > self._settled_cost:
            self.graph.states[number] = State.REJECTED
            return Decision.PENDING, None
        self.graph.states[number] = State.REJECTED  # so that it is not judged by itself
        innovation = self.innovation(constraint)
        confirmed = [number] if self._corroboration is None else self._corroboration.add(number)
        for loop in confirmed:
            gate.remember(innovation if loop == number else self.innovation(self.graph.constraint(loop)))
        self._pending += confirmed
        if not gate.ready or number not in self._pending:
            self._release(gate, number, innovation)
            return Decision.PENDING, innovation
        self._release(gate, number, innovation)
        kept = self.graph.states[number] == State.ACTIVE
        return (Decision.ACCEPTED if kept else Decision.REJECTED), innovation

    def _release(self, gate: Gate, newest: int, innovation: float) -> None:
        """Judge the loops that have been waiting; of the newest the distance is known."""
        if not gate.ready:
            return
        waiting, self._pending = self._pending, []
        for number in waiting:
            distance = innovation if number == newest else self.innovation(self.graph.constraint(number))
            if self._believes(number, distance, gate):
                self.graph.states[number] = State.ACTIVE
                self._count(number, distance)

    def _revise(self) -> tuple[IntArray, IntArray]:
        """Go on revising which loops are believed. Where that ended and changed something, the loops whose
        state changed and the nodes that moved.
        """
        if self._revision is None:
            return NOTHING, NOTHING
        revised = self._revision.advance(self._settled_cost, self._wait > 0)
        if revised is None:
            return NOTHING, NOTHING
        before = self.graph.positions.copy(), self.graph.quaternions.copy()
        changed, newer = self._revision.take_over()
        if len(changed) == 0:
            return NOTHING, NOTHING
        self._unjudged = [int(number) for number in newer]
        self._unsettled, self._settled_cost, self._wait = 0.0, revised.report.cost_after, 0
        self.refresh()
        return changed, displaced(self.graph, *before)

    def _believes(self, number: int, distance: float, gate: Gate) -> bool:
        if self._revision is None:
            return gate.keeps(distance)
        return self._revision.believes(number, distance, self._settled_cost)

    def _judge_late(self) -> IntArray:
        """Judge a few of the loops that came while a revision was under way or have just been confirmed;
        those that are believed.
        """
        if self._revision is not None and self._revision.confirmed_late:
            waiting, self._revision.confirmed_late = self._revision.confirmed_late, []
            self._unjudged += [loop for loop in waiting if self.graph.states[loop] == State.REJECTED]
        if not self._unjudged:
            return NOTHING
        some, self._unjudged = self._unjudged[:LATE_LOOPS], self._unjudged[LATE_LOOPS:]
        return self._judge_again(some)

    def finish(self) -> Report:
        """Optimise to the end, as when a flight is over; see whether loops fit better that were chosen from
        dead reckoning alone; and test every accepted loop once more against all the others.
        """
        revised = to_the_end(revise(self.graph, self._gate, self.settings.robust, self.freedom))
        self._unsettled, self._settled_cost = 0.0, revised.report.cost_after
        self._factor_now()
        return revised.report

    def _is_tie(self, constraint: Constraint) -> bool:
        """Whether this is the first constraint of the newest node, which places it and cannot contradict
        anything.
        """
        return max(constraint.i, constraint.j) >= self._n_tied

    def _attach(self, constraint: Constraint) -> None:
        self._n_tied = max(constraint.i, constraint.j) + 1
        if self._covariance is None:
            self._factor_now()
        elif max(constraint.i, constraint.j) == len(self._covariance):
            self._covariance.extend(constraint)
        else:
            self._factor_now()

    def _factor_now(self) -> None:
        """Covariances of the graph as it is, without moving it."""
        solver = self._incremental()
        if solver is not None and solver.take_in():
            self._covariance = ExactCovariance(self.graph, self.freedom, solver.factor, solver.fixed)
            return
        self._solver = self._covariance = None
        pattern = find_pattern(self.graph)
        factor = factor_now(self.graph, pattern, self.freedom, self.settings.robust)
        if factor is not None:
            self._covariance = ExactCovariance(self.graph, self.freedom, factor, pattern.fixed)

    def _incremental(self) -> IncrementalSolver | None:
        """The solver that keeps the solution up to date; None where robust kernels need the whole graph."""
        if self.settings.robust.kernel is not Kernel.NONE or self.graph.robust_position_priors.any():
            self._solver = None
        elif self._solver is None:
            self._solver = IncrementalSolver(self.graph, self.freedom)
        return self._solver

    def _count(self, number: int, innovation: float) -> None:
        """Add what accepting this constraint lets the solver gain: its chi2 now, less what would remain of
        it.
        """
        residual = float(constraint_chi2(self.graph, np.array([number]))[0])
        self._unsettled += max(residual - innovation, 0.0)
        self._loops_since_factor += 1

    @property
    def _overspent(self) -> bool:
        """Whether the solver has used more than the constraints so far allow it."""
        return self._multiplications > MULTIPLICATIONS * self.graph.n_constraints

    def _optimise_if_worth_while(self) -> tuple[bool, IntArray]:
        settings = self.settings
        noticeable = max(settings.tolerance * self._settled_cost, 1e-9)
        grown = self._loops_since_factor > settings.refresh * self.graph.n_constraints + 10
        self._waited += 1
        if (self._unsettled <= noticeable and not grown) or self._waited < self._wait or self._overspent:
            return False, NOTHING
        self._waited = 0
        before = self.graph.positions.copy(), self.graph.quaternions.copy()
        self._loops_since_factor = 0
        solver = self._incremental()
        settled, spent = None, 0.0
        if solver is not None:
            spent = -solver.factor.multiplications
            settled = solver.solve(settings.iterations_per_step, settings.tolerance / 2.0)
            spent += solver.factor.multiplications
            self._multiplications += spent
        if solver is not None and settled is not None:
            self._unsettled = 0.0 if settled.converged else settled.mismatch
            self._settled_cost = settled.cost
            self._covariance = ExactCovariance(self.graph, self.freedom, solver.factor, solver.fixed)
            self._wait //= 2
        else:
            self._solve_whole(settings.iterations_per_step if spent < MUCH_WORK else 1)
            if solver is not None and self._unsettled > noticeable:
                self._wait = min(2 * self._wait + 1, int(LONGEST_WAIT * self.graph.n_constraints))
        return True, displaced(self.graph, *before)

    def _solve_whole(self, max_iterations: int) -> None:
        """Optimise the whole graph with a damped solver, where what is known of it does not lead further."""
        settings = self.settings
        pattern = find_pattern(self.graph)
        limits = SparseSettings(max_iterations, settings.tolerance / 2.0)
        solution = solve(self.graph, pattern, self.freedom, settings.robust, limits)
        fronts = whole_fronts(pattern.symbolic)
        self._multiplications += solution.iterations * fronts.multiplications(int(self.freedom))
        self._unsettled = 0.0 if solution.converged else solution.mismatch
        self._settled_cost = solution.cost_after
        self._solver = self._covariance = None
        if solution.factor is not None:
            self._covariance = ExactCovariance(self.graph, self.freedom, solution.factor, pattern.fixed)

    def _vote_out(self) -> IntArray:
        """Set aside accepted loops that the settled estimate contradicts; what they held is free to move
        again.
        """
        if self._gate is None or not self._gate.ready or self._unsettled > 0.0:
            return NOTHING
        revisits = self.graph.active
        revisits = revisits[self.graph.kinds[revisits] == REVISIT]
        residual = constraint_chi2(self.graph, revisits)
        out = revisits[residual > self._gate.bound]
        self.graph.states[out] = State.REJECTED
        self._unsettled += float(residual[residual > self._gate.bound].sum())
        return np.asarray(out)

    def _reconsider(self) -> IntArray:
        """Judge a few rejected constraints again, in turn."""
        if self._gate is None or not self._gate.ready:
            return NOTHING
        rejected = np.flatnonzero(self.graph.states == State.REJECTED)
        if self._corroboration is not None:
            rejected = np.array([k for k in rejected if int(k) in self._corroboration.confirmed], np.int64)
        if len(rejected) == 0:
            return NOTHING
        count = min(self.settings.retries_per_step, len(rejected))
        turn = (self._next_retry + np.arange(count)) % len(rejected)
        self._next_retry = int(turn[-1]) + 1
        return self._judge_again(rejected[turn])

    def _judge_again(self, numbers: Iterable[int]) -> IntArray:
        """Believe those of these rejected loops that the estimate agrees with; their numbers."""
        changed = []
        for number in map(int, numbers):
            innovation = self.innovation(self.graph.constraint(number))
            if self._gate is not None and self._believes(number, innovation, self._gate):
                self.graph.states[number] = State.ACTIVE
                self._count(number, innovation)
                changed.append(number)
        return np.array(changed, np.int64)

    def refresh(self) -> None:
        """The graph was changed from outside (rescaled, constraints rewritten): take its covariances anew
        when next asked.
        """
        self._covariance = None
        self._n_tied = _tied(self.graph)
        if self._solver is not None:
            self._solver.refresh()

    def innovation(self, constraint: Constraint) -> float:
        """Squared Mahalanobis distance of the measurement from the estimate: r^T (Sigma_ij + Omega^-1)^-1
        r.
        """
        information = tangent_information(constraint.information, self.graph.planar)
        relative = self.relative_covariance(constraint.i, constraint.j)
        return float(squared_distances(innovation_vector(self.graph, constraint), information, relative))

    def covariance(self, node: int) -> FloatArray:
        """(6, 6) covariance of world_from_node, (translation, rotation vector) on the right, in the frame of
        the first node.
        """
        return self._current_covariance().marginal(node)

    def covariance_at_hand(self, node: int) -> FloatArray | None:
        """The same without computing anything anew; None where that would be needed."""
        known = self._covariance
        return None if known is None or node >= len(known) else known.marginal(node)

    def relative_covariance(self, i: int, j: int) -> FloatArray:
        """(6, 6) covariance of the pose of j seen from i."""
        return self._current_covariance().relative(i, j)

    def relative_covariances(self, nodes: Sequence[int], j: int) -> FloatArray:
        """(k, 6, 6) the same of j seen from each of some nodes."""
        return self._current_covariance().relatives(nodes, j)

    def _current_covariance(self) -> ExactCovariance:
        if self._covariance is None or len(self._covariance) < len(self.graph):
            self._factor_now()
        if self._covariance is None:
            raise ValueError("the graph has no covariance: its constraints do not determine it")
        return self._covariance


def _tied(graph: PoseGraph) -> int:
    """Number of the oldest nodes up to the newest that has a constraint."""
    return 1 + int(max(graph.i.max(initial=0), graph.j.max(initial=0)))
