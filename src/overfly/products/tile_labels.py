"""Kernels that find out which picture wins where in a tile of the mosaic.

A block is NODE_PX x NODE_PX pixels of a tile, and node k stands in its middle. Where one picture wins on all
nodes in and around a block, it wins on every pixel of it, because costs are interpolated between nodes. Only
in other blocks are pixels compared.

Arrays come from overfly.products.tiles, which says what they hold.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from overfly.geometry.cameras import _bend
from overfly.products.views import BORDER_PX, FADE, STEEPEST_TAN
from overfly.products.visibility import _is_covered

NODE_PX = 8
FAR_COST = 1e12  # in place of what is not seen, so that it can be interpolated
HIDDEN = 1e4  # times as dear is ground that is hidden behind other ground
NOBODY, MIXED = -1, -2  # who wins a block: no picture, more than one

_LOG_FAR = math.log(FAR_COST)


@njit(cache=True, nogil=True)
def ground_points(points, world_from_pixel, left, top, step, heights, frame):  # type: ignore[no-untyped-def]
    """Fill points (rows, columns, 3): the ground in the middle of blocks of step pixels. frame: of the
    heights, x0, y0, cell."""
    a, b, c, d, e, f = world_from_pixel
    x0, y0, cell = frame
    rows, columns = heights.shape
    for i in range(points.shape[0]):
        v = top + step * (i + 0.5)
        for j in range(points.shape[1]):
            u = left + step * (j + 0.5)
            x, y = a * u + b * v + c, d * u + e * v + f
            column = min(max((x - x0) / cell - 0.5, 0.0), columns - 1.0)
            row = min(max((y0 - y) / cell - 0.5, 0.0), rows - 1.0)
            c0, r0 = int(column), int(row)
            c1, r1 = min(c0 + 1, columns - 1), min(r0 + 1, rows - 1)
            fc, fr = column - c0, row - r0
            above = (1.0 - fc) * heights[r0, c0] + fc * heights[r0, c1]
            below = (1.0 - fc) * heights[r1, c0] + fc * heights[r1, c1]
            points[i, j, 0], points[i, j, 1] = x, y
            points[i, j, 2] = (1.0 - fr) * above + fr * below


@njit(cache=True, nogil=True)
def _seen(x, y, z, sight):  # type: ignore[no-untyped-def]
    """Column and row of a ground point in a picture, and its cost: overfly.products.views.look_up."""
    dx, dy, dz = x - sight[9], y - sight[10], z - sight[11]
    a = dx * sight[0] + dy * sight[3] + dz * sight[6]
    b = dx * sight[1] + dy * sight[4] + dz * sight[7]
    c = dx * sight[2] + dy * sight[5] + dz * sight[8]
    squared = dx * dx + dy * dy + dz * dz
    depth = max(c, 0.02 * math.sqrt(squared))
    stretch = max(1.0, math.sqrt(a * a + b * b) / (depth * sight[12]))
    u, v, _, _, _, _ = _bend(a / (depth * stretch), b / (depth * stretch), sight[17:22], sight[22] > 0.0)
    column, row = sight[15] + sight[13] * u * stretch, sight[16] + sight[14] * v * stretch
    width, height = sight[23], sight[24]
    inside = min(column + 0.5, width - 0.5 - column, row + 0.5, height - 0.5 - row)
    if inside < BORDER_PX or c <= 0.0 or squared > (1.0 + STEEPEST_TAN**2) * dz * dz:
        return column, row, np.inf
    fade = min(max(1.0 - inside / (FADE * min(width, height)), 0.0), 1.0)
    return column, row, squared * (1.0 + 2.0 * fade * fade)


@njit(cache=True, nogil=True)
def scout(points, nodes, sight, heights, frame, highest, index, best, lowest):  # type: ignore[no-untyped-def]
    """Enter the view into best and lowest (rows, columns) where it costs least. nodes: first row and end of
    the rows, and so of the columns, that it may see."""
    cx, cy, cz = sight[9], sight[10], sight[11]
    for i in range(nodes[0], nodes[1]):
        for j in range(nodes[2], nodes[3]):
            x, y, z = points[i, j]
            if (x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2 >= lowest[i, j]:
                continue  # the distance alone costs more
            _, _, cost = _seen(x, y, z, sight)
            if cost < lowest[i, j] and _is_covered(heights, frame, x, y, z, cx, cy, cz, highest):
                cost *= HIDDEN
            if cost < lowest[i, j]:
                lowest[i, j], best[i, j] = cost, index


@njit(cache=True, nogil=True)
def look(points, top, left, sight, heights, frame, highest, column, row, log_cost):  # type: ignore[no-untyped-def]
    """Fill column, row and log_cost (rows, columns) of the points from (top, left) on in a picture."""
    for i in range(column.shape[0]):
        for j in range(column.shape[1]):
            x, y, z = points[top + i, left + j]
            column[i, j], row[i, j], cost = _seen(x, y, z, sight)
            if cost < np.inf and _is_covered(
                heights, frame, x, y, z, sight[9], sight[10], sight[11], highest
            ):
                cost *= HIDDEN
            log_cost[i, j] = math.log(min(cost, FAR_COST))


@njit(cache=True, nogil=True)
def label_blocks(table, sizes, nodes, step, label, winners, present):  # type: ignore[no-untyped-def]
    """Which layer wins on each pixel of a tile.

    Fills label (pixels), winners (blocks), NOBODY or MIXED where it is not one, and present (blocks): a bit
    for each layer, by its number modulo 64, that wins a pixel.
    """
    per = NODE_PX // step
    best = _winners_of_nodes(table, nodes, per, per * winners.shape[0] + 2, per * winners.shape[1] + 2)
    active = np.empty(len(table), np.int64)
    lines, lowest = np.empty((3, per + 2), np.float32), np.empty((NODE_PX, NODE_PX), np.float32)
    for r in range(winners.shape[0]):
        for c in range(winners.shape[1]):
            winner = _winner_of_block(table, best, per, r, c)
            winners[r, c] = winner
            _fill(label, r, c, max(winner, NOBODY))
            if winner == MIXED:
                count = _rivals(table, nodes, per, r, c, active)
                lowest[:] = np.inf
                for k in range(count):
                    _compete(table, active[k], sizes, nodes, step, r, c, lines, lowest, label)
            present[r, c] = _bits(label, r, c)


@njit(cache=True, nogil=True)
def _winner_of_block(table, best, per, r, c):  # type: ignore[no-untyped-def]
    """The layer that wins on all nodes in and around a block, NOBODY if none has a part in it, or MIXED."""
    winner = best[per * r, per * c]
    for i in range(per + 2):
        for j in range(per + 2):
            if best[per * r + i, per * c + j] != winner:
                winner = MIXED
    if winner >= 0 and _is_in(table, winner, r, c):
        return winner
    for k in range(len(table)):
        if _is_in(table, k, r, c):
            return MIXED
    return NOBODY


@njit(cache=True, nogil=True)
def _fill(label, r, c, value):  # type: ignore[no-untyped-def]
    for i in range(NODE_PX * r, NODE_PX * (r + 1)):
        for j in range(NODE_PX * c, NODE_PX * (c + 1)):
            label[i, j] = value


@njit(cache=True, nogil=True)
def _bits(label, r, c):  # type: ignore[no-untyped-def]
    """Of the layers that win pixels of a block."""
    found = np.uint64(0)
    for i in range(NODE_PX * r, NODE_PX * (r + 1)):
        for j in range(NODE_PX * c, NODE_PX * (c + 1)):
            if label[i, j] >= 0:
                found |= _bit(label[i, j])
    return found


@njit(cache=True, nogil=True)
def _bit(layer):  # type: ignore[no-untyped-def]
    return np.uint64(1) << np.uint64(layer % 64)


@njit(cache=True, nogil=True)
def _is_in(table, k, r, c):  # type: ignore[no-untyped-def]
    """Whether layer k has a part in block (r, c)."""
    return 0 <= r - table[k, 2] < table[k, 4] and 0 <= c - table[k, 3] < table[k, 5]


@njit(cache=True, nogil=True)
def _winners_of_nodes(table, nodes, per, rows, columns):  # type: ignore[no-untyped-def]
    """(rows, columns) which layer costs least on each node; NOBODY where none sees it."""
    best = np.full((rows, columns), NOBODY, np.int16)
    lowest = np.full((rows, columns), _LOG_FAR, np.float32)
    for k in range(len(table)):
        top, left, width = per * table[k, 2], per * table[k, 3], table[k, 1]
        for i in range(per * table[k, 4] + 2):
            first = table[k, 0] + i * width
            for j in range(width):
                if nodes[2, first + j] < lowest[top + i, left + j]:
                    lowest[top + i, left + j], best[top + i, left + j] = nodes[2, first + j], k
    return best


@njit(cache=True, nogil=True)
def _rivals(table, nodes, per, r, c, active):  # type: ignore[no-untyped-def]
    """Fill active: the layers that may win pixels of a block, which cost somewhere less than another one
    costs everywhere. How many there are."""
    least_of_highest = np.inf
    for k in range(len(table)):
        if _is_in(table, k, r, c):
            least_of_highest = min(least_of_highest, _extremes(table, k, nodes, per, r, c)[1])
    count = 0
    for k in range(len(table)):
        if not _is_in(table, k, r, c):
            continue
        least = _extremes(table, k, nodes, per, r, c)[0]
        if least <= least_of_highest or least_of_highest >= np.float32(_LOG_FAR):
            active[count] = k
            count += 1
    return count


@njit(cache=True, nogil=True)
def _extremes(table, k, nodes, per, r, c):  # type: ignore[no-untyped-def]
    """Least and highest log cost of a layer on the nodes in and around a block."""
    place = table[k, 0] + per * (r - table[k, 2]) * table[k, 1] + per * (c - table[k, 3])
    least, most = np.float32(np.inf), np.float32(-np.inf)
    for i in range(per + 2):
        for j in range(per + 2):
            cost = nodes[2, place + i * table[k, 1] + j]
            least, most = min(least, cost), max(most, cost)
    return least, most


@njit(cache=True, nogil=True)
def _compete(table, k, sizes, nodes, step, r, c, lines, lowest, label):  # type: ignore[no-untyped-def]
    """Label the pixels of a block where layer k costs less than the lowest so far."""
    per = NODE_PX // step
    first = table[k, 0] + per * (r - table[k, 2]) * table[k, 1] + per * (c - table[k, 3])
    width, height = np.float32(sizes[k, 0] - 2.0), np.float32(sizes[k, 1] - 2.0)
    one = np.float32(1.0)
    for i in range(NODE_PX):
        y0, fy = _node_of(i, step)
        place, below = first + y0 * table[k, 1], first + min(y0 + 1, per + 1) * table[k, 1]
        for q in range(3):
            for x in range(per + 2):
                lines[q, x] = (one - fy) * nodes[q, place + x] + fy * nodes[q, below + x]
        for j in range(NODE_PX):
            x0, fx = _node_of(j, step)
            x1 = min(x0 + 1, per + 1)
            u = (one - fx) * lines[0, x0] + fx * lines[0, x1]
            v = (one - fx) * lines[1, x0] + fx * lines[1, x1]
            cost = (one - fx) * lines[2, x0] + fx * lines[2, x1]
            if one <= u <= width and one <= v <= height and cost < lowest[i, j]:
                lowest[i, j], label[NODE_PX * r + i, NODE_PX * c + j] = cost, k


@njit(cache=True, nogil=True)
def _node_of(pixel, step):  # type: ignore[no-untyped-def]
    """The node before a pixel of a block, whose own begin at 1, and how far the pixel is towards the next."""
    place = (pixel + 0.5) / step + 0.5
    return int(place), np.float32(place - int(place))
