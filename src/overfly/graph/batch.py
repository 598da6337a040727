"""Optimise a whole graph at once: one call, two methods."""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import StrEnum

from overfly.errors import UsageError
from overfly.geometry.poses import FloatArray
from overfly.graph.chordal import initialise_chordal
from overfly.graph.linearise import Freedom, chi2
from overfly.graph.pose_graph import PoseGraph
from overfly.graph.robust import PLAIN, Kernel, Robust
from overfly.graph.sparse import Pattern, Solution, SparseSettings, find_pattern, solve_in_steps, total_cost
from overfly.graph.steps import Steps, to_the_end
from overfly.graph.tree import TreeOptimiser


class Method(StrEnum):
    SPARSE = "sparse"  # Gauss-Newton / Levenberg-Marquardt on the sparse normal equations
    TREE = "tree"  # stochastic gradient descent along a spanning tree


class Start(StrEnum):
    """Where the sparse solver begins."""

    BEST = "best"  # the given poses or the chordal ones, whichever cost less
    GIVEN = "given"
    EACH = "each"  # one after the other, and the lower end counts; where roll and pitch are held, as given


@dataclass(frozen=True)
class Report:
    """What an optimisation did. chi2 without robust kernels; cpu_s in this process."""

    method: Method
    nodes: int
    constraints: int
    iterations: int
    chi2_before: float
    chi2_after: float
    cost_after: float
    converged: bool
    cpu_s: float


def optimise_batch(
    graph: PoseGraph,
    method: Method = Method.SPARSE,
    robust: Robust = PLAIN,
    freedom: Freedom | None = None,
    start: Start = Start.BEST,
    max_iterations: int = 100,
) -> Report:
    """Move the nodes of the graph, in place, to where its active constraints agree best.

    freedom: all six by default, three in planar graphs. robust: kernel on the revisits (sparse only).
    """
    if method is Method.TREE and len(graph):
        return _optimise_tree(graph, robust, max_iterations)
    return to_the_end(optimise_in_steps(graph, robust, freedom, start, max_iterations))


def optimise_in_steps(
    graph: PoseGraph,
    robust: Robust = PLAIN,
    freedom: Freedom | None = None,
    start: Start = Start.BEST,
    max_iterations: int = 100,
) -> Steps[Report]:
    """:func:`optimise_batch` by the sparse method, pausing after every iteration."""
    began = time.process_time()
    before = chi2(graph)
    freedom = natural_freedom(graph) if freedom is None else freedom
    if len(graph) == 0:
        return Report(Method.SPARSE, 0, 0, 0, 0.0, 0.0, 0.0, True, 0.0)
    pattern = find_pattern(graph)
    settings = SparseSettings(max_iterations)
    if start is Start.BEST:
        start_from_better(graph, pattern, robust)
    given = graph.positions.copy(), graph.quaternions.copy()
    yield
    solution = yield from solve_in_steps(graph, pattern, freedom, robust, settings)
    if start is Start.EACH and freedom is not Freedom.LEVELLED:
        solution = yield from _solve_again(graph, pattern, freedom, robust, settings, given, solution)
    return Report(
        Method.SPARSE, len(graph), len(pattern.constraints), solution.iterations, before, chi2(graph),
        solution.cost_after,
        solution.converged, time.process_time() - began,
    )  # fmt: skip


def _solve_again(
    graph: PoseGraph, pattern: Pattern, freedom: Freedom, robust: Robust, settings: SparseSettings,
    given: tuple[FloatArray, FloatArray], solution: Solution,
) -> Steps[Solution]:  # fmt: skip
    """Solve from the chordal start too, and leave what costs less: wrong loops that are gone may have left a
    stretch of poses turned once too often, which no step undoes.
    """
    first = graph.positions.copy(), graph.quaternions.copy()
    graph.positions[:], graph.quaternions[:] = given
    if len(graph) > 1 and initialise_chordal(graph, pattern):
        yield
        other = yield from solve_in_steps(graph, pattern, freedom, robust, settings)
        if other.cost_after < (1.0 - settings.relative_gain) * solution.cost_after:
            return other
    graph.positions[:], graph.quaternions[:] = first
    return solution


def _optimise_tree(graph: PoseGraph, robust: Robust, iterations: int) -> Report:
    began, before = time.process_time(), chi2(graph)
    if robust.kernel is not Kernel.NONE:
        raise UsageError("robust kernels belong to the sparse method; the tree method has none")
    if len(graph.position_priors[0]) or len(graph.attitude_priors[0]):
        raise UsageError(
            "absolute constraints belong to the sparse method; the tree method resolves relative ones"
        )
    TreeOptimiser(graph, iterations).iterate(iterations)
    after = chi2(graph)
    cpu_s = time.process_time() - began
    return Report(Method.TREE, len(graph), len(graph.active), iterations, before, after, after, True, cpu_s)


def natural_freedom(graph: PoseGraph) -> Freedom:
    return Freedom.PLANAR if graph.planar else Freedom.FULL


def start_from_better(graph: PoseGraph, pattern: Pattern, robust: Robust) -> None:
    """Take over the chordal initialisation if it costs less than the poses the graph has."""
    given = graph.positions.copy(), graph.quaternions.copy()
    cost = total_cost(graph, pattern, robust)
    if len(graph) > 1 and (
        not initialise_chordal(graph, pattern) or not total_cost(graph, pattern, robust) < cost
    ):
        graph.positions[:], graph.quaternions[:] = given
