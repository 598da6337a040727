"""Optimise a whole graph at once: one call, two methods."""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from overfly.graph.chordal import initialise_chordal
from overfly.graph.linearise import Freedom, chi2
from overfly.graph.pose_graph import PoseGraph
from overfly.graph.robust import PLAIN, Robust
from overfly.graph.sparse import Pattern, SparseSettings, find_pattern, solve, total_cost


class Method(StrEnum):
    SPARSE = "sparse"  # Gauss-Newton / Levenberg-Marquardt on the sparse normal equations
    TREE = "tree"  # stochastic gradient descent along a spanning tree


class Start(StrEnum):
    """Where the sparse solver begins."""

    BEST = "best"  # the given poses or the chordal ones, whichever cost less
    GIVEN = "given"


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
    began = time.process_time()
    before = chi2(graph)
    freedom = natural_freedom(graph) if freedom is None else freedom
    pattern = find_pattern(graph)
    if start is Start.BEST:
        start_from_better(graph, pattern, robust)
    solution = solve(graph, pattern, freedom, robust, SparseSettings(max_iterations))
    return Report(
        method, len(graph), len(pattern.constraints), solution.iterations, before, chi2(graph), solution.cost_after,
        solution.converged, time.process_time() - began,
    )  # fmt: skip


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


def finite(graph: PoseGraph) -> bool:
    return bool(np.isfinite(graph.positions).all() and np.isfinite(graph.quaternions).all())
