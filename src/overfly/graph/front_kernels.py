"""The numbers in a tree of fronts (``front_tree``, which explains the arrays): factorising some, solving,
and parts of the inverse.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from overfly.graph.lapack import (
    _at,
    _cholesky_in_place,
    _solve_right_transposed,
    _solve_transposed,
    _subtract_square,
    _subtract_transposed_times,
)


@njit(cache=True, nogil=True)
def _factor(routines: Any, tree: Any, nodes: Any, values: Any, names: Any, equations: Any) -> bool:
    """Assemble and eliminate these fronts, children before parents; False if one is not positive definite."""
    d = tree.stiffness.shape[1]
    place = np.full(len(tree.front), -1, np.int64)  # of each node in the present front
    failed = np.zeros(1, np.int32)
    for front in names:
        begin, width = tree.nodes_at[front], tree.width[front]
        n_front = width + tree.below[front]
        W, S = width * d, tree.below[front] * d
        H = W + S
        panel = tree.values_at[front]
        update = panel + H * W
        right = update + S * S
        values[panel : right + H] = 0.0
        for p in range(n_front):
            place[nodes[begin + p]] = p
        for p in range(width):
            _add_node(tree, values, nodes[begin + p], p, width, panel, update, right, W, S, place, equations)
        child = tree.first_child[front]
        while child >= 0:
            _add_child(tree, nodes, values, child, d, width, panel, update, right, W, S, place)
            child = tree.sibling[child]
        _cholesky_in_place(routines, W, _at(values, panel), H, failed)
        if failed[0] != 0:
            return False
        if S > 0:
            lower = _at(values, panel + W)
            _solve_right_transposed(routines, S, W, _at(values, panel), H, lower, H)
            _subtract_square(routines, S, W, lower, H, _at(values, update), S)
        gain = 0.0
        for c in range(W):
            column = panel + c * H
            y = values[right + c] / values[column + c]
            values[right + c] = y
            gain += y * y
            for r in range(c + 1, H):
                values[right + r] -= values[column + r] * y
        tree.gain[front] = gain
        for p in range(n_front):
            place[nodes[begin + p]] = -1
    return True


@njit(cache=True, nogil=True)
def _add_node(
    tree: Any, values: Any, node: int, p: int, width: int, panel: int, update: int, right: int, W: int,
    S: int, place: Any, equations: Any,
) -> None:  # fmt: skip
    """Absolute constraints on this node (place p of the front), and those that meet in it, but those that a
    front below has had.
    """
    d = tree.stiffness.shape[1]
    if equations.fixed[node]:
        for r in range(d):
            values[panel + (p * d + r) * (W + S + 1)] = 1.0
        return
    stiffness, i, j, used, fixed = tree.stiffness, equations.i, equations.j, equations.used, equations.fixed
    blocks, gradients = equations.blocks, equations.gradients
    first, following = equations.first, equations.following
    for r in range(d):
        stiffness[node, r] = 0.0
    if len(equations.own_gradients) > 0:
        own_blocks = equations.own_blocks.reshape((len(first), 1, d, d))
        _add_block(values, d, width, panel, update, W, S, p, p, own_blocks, node, 0, False)
        for r in range(d):
            stiffness[node, r] += equations.own_blocks[node, r, r]
            values[right + p * d + r] -= equations.own_gradients[node, r]
    entry = first[node]
    while entry >= 0:
        c, side = entry // 2, entry % 2
        entry = following[c, side]
        if not used[c]:
            continue
        for r in range(d):
            stiffness[node, r] += blocks[c, 2 * side, r, r]
        other = j[c] if side == 0 else i[c]
        q = place[other]
        held = fixed[other]
        if not held and (q < 0 or q < p):  # eliminated before
            continue
        _add_block(values, d, width, panel, update, W, S, p, p, blocks, c, 2 * side, False)
        for r in range(d):
            values[right + p * d + r] -= gradients[c, side, r]
        if held:
            continue
        _add_block(values, d, width, panel, update, W, S, q, q, blocks, c, 2 - 2 * side, False)
        _add_block(values, d, width, panel, update, W, S, q, p, blocks, c, 1, side == 0)
        for r in range(d):
            values[right + q * d + r] -= gradients[c, 1 - side, r]


@njit(cache=True, nogil=True)
def _add_block(
    values: Any, d: int, width: int, panel: int, update: int, W: int, S: int, row: int, column: int,
    blocks: Any, k: int, which: int, transposed: bool,
) -> None:  # fmt: skip
    """Add blocks[k, which] where block row and column of the front meet, row >= column."""
    for c in range(d):
        if column < width:
            to = panel + (column * d + c) * (W + S) + row * d
        else:
            to = update + ((column - width) * d + c) * S + (row - width) * d
        for r in range(d):
            values[to + r] += blocks[k, which, c, r] if transposed else blocks[k, which, r, c]


@njit(cache=True, nogil=True)
def _add_child(
    tree: Any, nodes: Any, values: Any, child: int, d: int, width: int, panel: int, update: int, right: int,
    W: int, S: int, place: Any,
) -> None:  # fmt: skip
    """What a child passes on, its rows in whatever order they stand there."""
    n_rows = tree.below[child]
    size = n_rows * d
    child_W = tree.width[child] * d
    source = tree.values_at[child] + (child_W + size) * child_W
    begin = tree.nodes_at[child] + tree.width[child]
    for column in range(n_rows):
        q = place[nodes[begin + column]]
        for r in range(d):
            values[right + q * d + r] += values[source + size * size + child_W + column * d + r]
        for row in range(column, n_rows):
            p = place[nodes[begin + row]]
            low, high = min(p, q), max(p, q)
            for c in range(d):
                if low < width:
                    to = panel + (low * d + c) * (W + S) + high * d
                else:
                    to = update + ((low - width) * d + c) * S + (high - width) * d
                if p >= q:
                    at = source + (column * d + c) * size + row * d
                    for r in range(d):
                        values[to + r] += values[at + r]
                else:
                    at = source + column * d * size + row * d + c
                    for r in range(d):
                        values[to + r] += values[at + r * size]


@njit(cache=True, nogil=True)
def _solve(
    routines: Any, tree: Any, nodes: Any, values: Any, steps: Any, fresh: Any, least: float
) -> Any:  # fmt: skip
    """L^T x = y from the roots down, into ``steps``; the nodes that changed noticeably. fresh (n,): fronts
    that were replaced, by name.
    """
    n, d = steps.shape
    front_of, parent, first_child, sibling = tree.front, tree.parent, tree.first_child, tree.sibling
    nodes_at, values_at, width, below = tree.nodes_at, tree.values_at, tree.width, tree.below
    stiffness = tree.stiffness
    needed, changed = fresh.copy(), np.zeros(n, np.bool_)
    stack, n_waiting = np.empty(n, np.int64), 0
    for front in range(n):
        if front_of[front] == front and parent[front] < 0:
            stack[n_waiting] = front
            n_waiting += 1
    x = np.empty(d * n)
    heap, at_x = _at(values, 0), _at(x, 0)
    while n_waiting > 0:
        n_waiting -= 1
        front = stack[n_waiting]
        own, separator = nodes_at[front], nodes_at[front] + width[front]
        end = separator + below[front]
        for p in range(separator, end):
            needed[front] |= changed[nodes[p]]
        if not needed[front]:
            continue
        _solve_front(routines, heap, values, values_at[front], nodes, own, separator, end, steps, at_x, x)
        for p in range(own, separator):
            _take_step(steps, nodes[p], x, (p - own) * d, stiffness, least, changed)
        child = first_child[front]
        while child >= 0:
            stack[n_waiting] = child
            n_waiting += 1
            child = sibling[child]
    return np.flatnonzero(changed)


@njit(cache=True, nogil=True)
def _solve_front(
    routines: Any, heap: Any, values: Any, panel: int, nodes: Any, own: int, separator: int, end: int,
    steps: Any, at_x: Any, x: Any,
) -> None:  # fmt: skip
    """The steps of a front's own nodes, nodes[own:separator], from those below them, nodes[separator:end],
    into the beginning of x. heap, at_x: addresses of values and x.
    """
    d = steps.shape[1]
    W, S = (separator - own) * d, (end - separator) * d
    right = panel + (W + S) * W + S * S
    for r in range(W):
        x[r] = values[right + r]
    for p in range(separator, end):
        for r in range(d):
            x[(p - own) * d + r] = steps[nodes[p], r]
    column = heap + np.uint64(8 * panel)
    if S > 0:
        lower, below = column + np.uint64(8 * W), at_x + np.uint64(8 * W)
        _subtract_transposed_times(routines, S, W, lower, W + S, below, at_x)
    _solve_transposed(routines, W, column, W + S, at_x)


@njit(cache=True, nogil=True)
def _take_step(steps: Any, node: int, x: Any, at: int, stiffness: Any, least: float, changed: Any) -> None:
    """Take over the new step of a node, at x[at:], where it differs noticeably."""
    d = steps.shape[1]
    change = 0.0
    for r in range(d):
        change += stiffness[node, r] * (x[at + r] - steps[node, r]) ** 2
    if change > least:
        changed[node] = True
        for r in range(d):
            steps[node, r] = x[at + r]


@njit(cache=True, nogil=True)
def _inverse_blocks(tree: Any, nodes: Any, values: Any, wanted: Any) -> Any:
    """E^T A^-1 E = (L^-1 E)^T (L^-1 E), where L^-1 E is zero except on the ways to the root."""
    n, d = tree.stiffness.shape
    k = len(wanted) * d
    inverse = np.zeros((k, k))
    x = np.zeros((n * d, k))
    for a in range(len(wanted)):
        for r in range(d):
            x[wanted[a] * d + r, a * d + r] = 1.0
    depth = np.zeros(len(wanted), np.int64)
    reached = tree.front[wanted]
    for a in range(len(wanted)):
        front = reached[a]
        while front >= 0:
            depth[a] += 1
            front = tree.parent[front]
    while True:
        deepest = np.argmax(depth)
        if depth[deepest] == 0:
            return inverse
        front = reached[deepest]
        for a in range(len(wanted)):
            if depth[a] > 0 and reached[a] == front:
                reached[a] = tree.parent[front]
                depth[a] -= 1
        _forward(tree, nodes, values, front, x, inverse)


@njit(cache=True, nogil=True)
def _forward(tree: Any, nodes: Any, values: Any, front: int, x: Any, inverse: Any) -> None:
    """x <- L^-1 x for the columns of one front, and what they add to x^T x."""
    d, k = tree.stiffness.shape[1], x.shape[1]
    begin, width = tree.nodes_at[front], tree.width[front]
    n_rows = width + tree.below[front]
    for p in range(width):
        for c in range(d):
            here = nodes[begin + p] * d + c
            column = tree.values_at[front] + (p * d + c) * n_rows * d
            for a in range(k):
                x[here, a] /= values[column + p * d + c]
            for a in range(k):
                if x[here, a] != 0.0:
                    for b in range(k):
                        inverse[a, b] += x[here, a] * x[here, b]
            for q in range(p, n_rows):
                to = nodes[begin + q] * d
                for r in range(c + 1 if q == p else 0, d):
                    value = values[column + q * d + r]
                    for a in range(k):
                        x[to + r, a] -= value * x[here, a]
