"""Block sparse Cholesky factorisation, multifrontal: dense fronts along the elimination tree, compiled, BLAS
inside.

Source: Duff and Reid, "The multifrontal solution of indefinite sparse symmetric linear equations", ACM TOMS
1983; Liu, "The multifrontal method for sparse matrix solution", SIAM Review 1992.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray
from overfly.graph.lapack import (
    _at,
    _cholesky_in_place,
    _solve_right_transposed,
    _subtract_square,
    addresses,
)
from overfly.graph.steps import Steps, to_the_end
from overfly.graph.symbolic import Symbolic
from overfly.types import IntArray

INVERSION_STEP = 2e7  # multiplications in one step of a selected inversion, about


@dataclass(frozen=True, eq=False)
class Factor:
    """L of P A P^T = L L^T. values: one column-major panel per supernode, its columns over all its rows, from
    panels[s] on.
    """

    symbolic: Symbolic
    block: int
    panels: IntArray
    values: FloatArray

    @property
    def n_nodes(self) -> int:
        return self.symbolic.n_nodes

    def solve(self, right: FloatArray) -> FloatArray:
        """A^-1 right; right (n, block) or (n, block, k), in the order of the nodes."""
        symbolic, n = self.symbolic, self.symbolic.n_nodes
        columns = right.reshape(n, self.block, -1)
        x = np.ascontiguousarray(columns[symbolic.order]).reshape(n * self.block, -1)
        arguments = (
            symbolic.starts,
            symbolic.row_starts,
            symbolic.rows,
            self.block,
            self.panels,
            self.values,
        )
        _solve_forward(*arguments, x)
        _solve_backward(*arguments, x)
        return x.reshape(columns.shape)[symbolic.rank].reshape(right.shape)

    def inverse_blocks(self, nodes: IntArray) -> FloatArray:
        """(k d, k d) part of A^-1 that belongs to these nodes (k,); costs a walk from each up the elimination
        tree.
        """
        symbolic, d = self.symbolic, self.block
        x = np.zeros(
            (symbolic.n_nodes * d, len(nodes) * d)
        )  # pages that the walk does not touch cost nothing
        inverse = np.zeros((len(nodes) * d, len(nodes) * d))
        _inverse_blocks(
            symbolic.starts, symbolic.row_starts, symbolic.rows, symbolic.parent, symbolic.supernode, d,
            self.panels,
            self.values, symbolic.rank[nodes], x, inverse,
        )  # fmt: skip
        return inverse

    def inverse_diagonal(self) -> FloatArray:
        """(n, d, d) diagonal blocks of A^-1 for all nodes at once."""
        return to_the_end(self.selected_inverse())[0]

    def selected_inverse(self) -> Steps[tuple[FloatArray, FloatArray]]:
        """Blocks of A^-1, bit by bit: (n, d, d) of all nodes, and (pairs, d, d) of (first, second) of the
        pairs given to :func:`overfly.graph.symbolic.analyse` (selected inversion, Takahashi et al. 1973).
        """
        symbolic, d = self.symbolic, self.block
        heights = (np.diff(symbolic.starts) + np.diff(symbolic.row_starts)) * d
        fronts = np.concatenate([[0], np.cumsum(heights**2)])
        store = np.empty(fronts[-1])
        work = np.cumsum((heights.astype(float) ** 3)[::-1])
        begin = 0
        while begin < len(heights):  # from the root down
            done = work[begin - 1] if begin > 0 else 0.0
            end = max(int(np.searchsorted(work, done + INVERSION_STEP)), begin + 1)
            _invert_fronts(
                len(heights) - end, len(heights) - begin, symbolic.starts, symbolic.row_starts,
                symbolic.parent, symbolic.places, d, self.panels, self.values, fronts, store,
            )  # fmt: skip
            begin = end
            yield
        found = np.empty((symbolic.n_nodes, d, d))
        pairs = np.empty((len(symbolic.pair_row), d, d))
        _pick_blocks(
            symbolic.starts, symbolic.row_starts, symbolic.pair_supernode, symbolic.pair_row,
            symbolic.pair_column, symbolic.pair_transposed, d, fronts, store, found, pairs,
        )  # fmt: skip
        return found[symbolic.rank], pairs


def factorise(symbolic: Symbolic, diagonal: FloatArray, off_diagonal: FloatArray) -> Factor | None:
    """Factor the symmetric matrix with these blocks; None when it is not positive definite.

    diagonal: (n, d, d), in the order of the nodes. off_diagonal: (pairs, d, d), block (first, second) of each
    pair given to :func:`overfly.graph.symbolic.analyse`.
    """
    block = diagonal.shape[-1]
    panels = panel_starts(symbolic, block)
    values = np.zeros(panels[-1])
    _scatter_blocks(
        symbolic.starts, symbolic.row_starts, symbolic.supernode, symbolic.order, symbolic.pair_supernode,
        symbolic.pair_row, symbolic.pair_column, symbolic.pair_transposed, panels, diagonal, off_diagonal,
        values,
    )  # fmt: skip
    succeeded = _factorise(
        addresses(),
        symbolic.starts,
        symbolic.row_starts,
        symbolic.parent,
        symbolic.places,
        block,
        panels,
        values,
    )
    return Factor(symbolic, block, panels, values) if succeeded else None


def panel_starts(symbolic: Symbolic, block: int) -> IntArray:
    """(S + 1,) where each supernode's panel begins in the values of a factor."""
    widths = np.diff(symbolic.starts) * block
    heights = widths + np.diff(symbolic.row_starts) * block
    return np.concatenate([[0], np.cumsum(widths * heights)])


@njit(cache=True, nogil=True)
def _scatter_blocks(
    starts: Any, row_starts: Any, supernode: Any, order: Any, pair_supernode: Any, pair_row: Any,
    pair_column: Any,
    pair_transposed: Any, panels: Any, diagonal: Any, off_diagonal: Any, values: Any,
) -> None:  # fmt: skip
    d = diagonal.shape[-1]
    for k in range(len(order)):
        s = supernode[k]
        height = (starts[s + 1] - starts[s] + row_starts[s + 1] - row_starts[s]) * d
        corner = panels[s] + (k - starts[s]) * d * (height + 1)
        node = order[k]
        for c in range(d):
            for r in range(d):
                values[corner + c * height + r] += diagonal[node, r, c]
    for k in range(len(pair_supernode)):
        s = pair_supernode[k]
        height = (starts[s + 1] - starts[s] + row_starts[s + 1] - row_starts[s]) * d
        corner = panels[s] + pair_column[k] * d * height + pair_row[k] * d
        for c in range(d):
            for r in range(d):
                value = off_diagonal[k, c, r] if pair_transposed[k] else off_diagonal[k, r, c]
                values[corner + c * height + r] += value


@njit(cache=True, nogil=True)
def _factorise(
    routines: Any, starts: Any, row_starts: Any, parent: Any, places: Any, d: int, panels: Any, values: Any
) -> bool:
    """Supernodes in postorder: take in the children's updates, eliminate the own columns, leave an update for
    the parent.
    """
    n_supernodes = len(parent)
    failed = np.zeros(1, np.int32)
    children = np.zeros(n_supernodes, np.int64)
    for s in range(n_supernodes):
        if parent[s] >= 0:
            children[parent[s]] += 1
    waiting = np.empty(n_supernodes, np.int64)  # children whose updates lie on the stack, oldest first
    n_waiting, top = 0, 0
    stack = np.empty(_stack_size(row_starts, children, d))
    for s in range(n_supernodes):
        width = (starts[s + 1] - starts[s]) * d
        below = (row_starts[s + 1] - row_starts[s]) * d
        height = width + below
        update = top
        stack[update : update + below * below] = 0.0
        source = top
        for k in range(n_waiting - 1, n_waiting - children[s] - 1, -1):
            child = waiting[k]
            size = (row_starts[child + 1] - row_starts[child]) * d
            source -= size * size
            place = places[row_starts[child] : row_starts[child + 1]]
            _add_update(stack, source, size, place, d, values, panels[s], height, width, update, below)
        panel = _at(values, panels[s])
        _cholesky_in_place(routines, width, panel, height, failed)
        if failed[0] != 0:
            return False
        if below > 0:
            lower = _at(values, panels[s] + width)
            _solve_right_transposed(routines, below, width, panel, height, lower, height)
            _subtract_square(routines, below, width, lower, height, _at(stack, update), below)
            for k in range(below * below):  # over the children's updates, which are no longer needed
                stack[source + k] = stack[update + k]
        n_waiting -= children[s]
        waiting[n_waiting] = s
        n_waiting += 1
        top = source + below * below
    return True


@njit(cache=True, nogil=True)
def _stack_size(row_starts: Any, children: Any, d: int) -> int:
    n_supernodes = len(children)
    sizes = np.empty(n_supernodes, np.int64)
    n_waiting, top, largest = 0, 0, 1
    for s in range(n_supernodes):
        below = (row_starts[s + 1] - row_starts[s]) * d
        largest = max(largest, top + below * below)
        for _ in range(children[s]):
            n_waiting -= 1
            top -= sizes[n_waiting]
        sizes[n_waiting] = below * below
        n_waiting += 1
        top += below * below
    return largest


@njit(cache=True, nogil=True)
def _add_update(
    stack: Any, source: int, size: int, place: Any, d: int, values: Any, panel: int, height: int, width: int,
    update: int, below: int,
) -> None:  # fmt: skip
    """Add a child's update (lower triangle) where its rows stand in this front: own columns, or this
    update.
    """
    n_blocks = size // d
    for column in range(n_blocks):
        target_column = place[column] * d
        for c in range(d):
            start = source + (column * d + c) * size
            own = target_column < width
            if own:
                target = panel + (target_column + c) * height
            else:
                target = update + (target_column - width + c) * below - width
            for row in range(column, n_blocks):
                to = target + place[row] * d
                begin = start + row * d
                if own:
                    for r in range(d):
                        values[to + r] += stack[begin + r]
                else:
                    for r in range(d):
                        stack[to + r] += stack[begin + r]


@njit(cache=True, nogil=True)
def _forward_step(
    s: int, starts: Any, row_starts: Any, rows: Any, d: int, panels: Any, values: Any, x: Any
) -> None:
    """The part of x <- L^-1 x that belongs to the columns of one supernode."""
    first = starts[s] * d
    width = starts[s + 1] * d - first
    n_rows = row_starts[s + 1] - row_starts[s]
    height = width + n_rows * d
    for c in range(width):
        column = panels[s] + c * height
        for k in range(x.shape[1]):
            value = x[first + c, k] / values[column + c]
            x[first + c, k] = value
            if value == 0.0:
                continue
            for r in range(c + 1, width):
                x[first + r, k] -= values[column + r] * value
            for row in range(n_rows):
                to = rows[row_starts[s] + row] * d
                begin = column + width + row * d
                for r in range(d):
                    x[to + r, k] -= values[begin + r] * value


@njit(cache=True, nogil=True)
def _solve_forward(starts: Any, row_starts: Any, rows: Any, d: int, panels: Any, values: Any, x: Any) -> None:
    """x <- L^-1 x, x (n d, k) in elimination order."""
    for s in range(len(starts) - 1):
        _forward_step(s, starts, row_starts, rows, d, panels, values, x)


@njit(cache=True, nogil=True)
def _inverse_blocks(
    starts: Any, row_starts: Any, rows: Any, parent: Any, supernode: Any, d: int, panels: Any, values: Any,
    places: Any,
    x: Any, inverse: Any,
) -> None:  # fmt: skip
    """E^T A^-1 E = (L^-1 E)^T (L^-1 E), where L^-1 E is zero except on the paths to the root."""
    for k in range(len(places)):
        for r in range(d):
            x[places[k] * d + r, k * d + r] = 1.0
    pending = supernode[places]
    while True:
        s = len(parent)
        for k in range(len(pending)):  # the lowest supernode any path has reached
            if pending[k] >= 0:
                s = min(s, pending[k])
        if s == len(parent):
            return
        _forward_step(s, starts, row_starts, rows, d, panels, values, x)
        for row in range(starts[s] * d, starts[s + 1] * d):
            for a in range(x.shape[1]):
                if x[row, a] != 0.0:
                    for b in range(x.shape[1]):
                        inverse[a, b] += x[row, a] * x[row, b]
        for k in range(len(pending)):
            if pending[k] == s:
                pending[k] = parent[s]


@njit(cache=True, nogil=True)
def _solve_backward(
    starts: Any, row_starts: Any, rows: Any, d: int, panels: Any, values: Any, x: Any
) -> None:
    """x <- L^-T x, x (n d, k) in elimination order."""
    for s in range(len(starts) - 2, -1, -1):
        first = starts[s] * d
        width = starts[s + 1] * d - first
        n_rows = row_starts[s + 1] - row_starts[s]
        height = width + n_rows * d
        for c in range(width - 1, -1, -1):
            column = panels[s] + c * height
            for k in range(x.shape[1]):
                value = x[first + c, k]
                for r in range(c + 1, width):
                    value -= values[column + r] * x[first + r, k]
                for row in range(n_rows):
                    to = rows[row_starts[s] + row] * d
                    begin = column + width + row * d
                    for r in range(d):
                        value -= values[begin + r] * x[to + r, k]
                x[first + c, k] = value / values[column + c]


@njit(cache=True, nogil=True)
def _invert_fronts(
    begin: int, end: int, starts: Any, row_starts: Any, parent: Any, places: Any, d: int, panels: Any,
    values: Any, fronts: Any, store: Any,
) -> None:  # fmt: skip
    """Supernodes end - 1 to begin, the root being the last: Z = A^-1 on a front follows from Z on the rows
    below it, which the parent's front holds.

    With L = (L1; L2) of the front and Y = L2 L1^-1: Z21 = -Z22 Y, Z11 = (L1 L1^T)^-1 - Y^T Z21.
    """
    for s in range(end - 1, begin - 1, -1):
        width = (starts[s + 1] - starts[s]) * d
        below = (row_starts[s + 1] - row_starts[s]) * d
        height = width + below
        Z = store[fronts[s] : fronts[s + 1]].reshape(height, height)
        panel = values[panels[s] : panels[s + 1]].reshape(
            width, height
        )  # transposed: row c holds column c of L
        factor = panel[:, :width].copy()  # L1^T, but for what was never overwritten below its diagonal
        for r in range(width):
            for c in range(r):
                factor[r, c] = 0.0
        inverse = np.linalg.inv(factor)
        Z[:width, :width] = inverse @ inverse.T
        if below > 0:
            p = parent[s]
            above = (starts[p + 1] - starts[p] + row_starts[p + 1] - row_starts[p]) * d
            Zp = store[fronts[p] : fronts[p + 1]].reshape(above, above)
            place = places[row_starts[s] : row_starts[s + 1]]
            Z22 = np.empty((below, below))
            for a in range(len(place)):
                for b in range(len(place)):
                    Z22[a * d : a * d + d, b * d : b * d + d] = Zp[
                        place[a] * d : place[a] * d + d, place[b] * d : place[b] * d + d
                    ]
            Yt = inverse @ np.ascontiguousarray(panel[:, width:])
            Z12 = -(Yt @ Z22)
            Z[:width, width:] = Z12
            Z[width:, :width] = Z12.T
            Z[width:, width:] = Z22
            Z[:width, :width] -= Z12 @ Yt.T


@njit(cache=True, nogil=True)
def _pick_blocks(
    starts: Any, row_starts: Any, pair_supernode: Any, pair_row: Any, pair_column: Any, pair_transposed: Any,
    d: int, fronts: Any, store: Any, found: Any, pairs: Any,
) -> None:  # fmt: skip
    """Diagonal blocks, in elimination order, and those of the pairs, from the inverse on the fronts."""
    for s in range(len(starts) - 1):
        height = (starts[s + 1] - starts[s] + row_starts[s + 1] - row_starts[s]) * d
        Z = store[fronts[s] : fronts[s + 1]].reshape(height, height)
        for k in range(starts[s + 1] - starts[s]):
            found[starts[s] + k] = Z[k * d : k * d + d, k * d : k * d + d]
    for k in range(len(pair_row)):
        s = pair_supernode[k]
        height = (starts[s + 1] - starts[s] + row_starts[s + 1] - row_starts[s]) * d
        Z = store[fronts[s] : fronts[s + 1]].reshape(height, height)
        row, column = pair_row[k] * d, pair_column[k] * d
        block = Z[row : row + d, column : column + d]
        pairs[k] = block.T if pair_transposed[k] else block
