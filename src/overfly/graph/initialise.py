"""First poses for nodes that have none: walk along the constraints from nodes that do."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from overfly.graph.pose_graph import PoseGraph
from overfly.graph.quaternions import _conjugate, _multiply, _quaternion, _rotate, _vector
from overfly.graph.symbolic import adjacency
from overfly.types import BoolArray


def initialise_along_edges(graph: PoseGraph, missing: BoolArray) -> None:
    """Place the missing nodes (n,) by composing active constraints, breadth first, from the nodes that have a
    pose.

    In a part of the graph where no node has one, the node with the lowest number keeps the pose it has.
    """
    if not missing.any():
        return
    active = graph.active
    starts, neighbours = adjacency(len(graph), graph.i[active], graph.j[active])
    source = np.concatenate([graph.i[active], graph.j[active]])
    constraints = np.concatenate([active, active])[np.argsort(source, kind="stable")]
    _walk(
        starts, neighbours, constraints, graph.i, graph.measured_positions, graph.measured_quaternions,
        ~missing,
        graph.positions, graph.quaternions,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _walk(
    starts: Any, neighbours: Any, constraints: Any, i: Any, measured_t: Any, measured_q: Any, known: Any,
    positions: Any,
    quaternions: Any,
) -> None:  # fmt: skip
    n = len(known)
    queue = np.empty(n, np.int64)
    end = 0
    for node in range(n):
        if known[node]:
            queue[end] = node
            end += 1
    head = 0
    fresh = 0
    while True:
        while head < end:
            node = queue[head]
            head += 1
            for p in range(starts[node], starts[node + 1]):
                other = neighbours[p]
                if known[other]:
                    continue
                c = constraints[p]
                q, t = _quaternion(measured_q[c]), _vector(measured_t[c])
                if i[c] != node:  # the constraint looks the other way
                    q = _conjugate(q)
                    t = _rotate(q, (-t[0], -t[1], -t[2]))
                here = _quaternion(quaternions[node])
                shift = _rotate(here, t)
                turned = _multiply(here, q)
                for r in range(3):
                    positions[other, r] = positions[node, r] + shift[r]
                for r in range(4):
                    quaternions[other, r] = turned[r]
                known[other] = True
                queue[end] = other
                end += 1
        while fresh < n and known[fresh]:
            fresh += 1
        if fresh == n:
            return
        known[fresh] = True
        queue[end] = fresh
        end += 1
