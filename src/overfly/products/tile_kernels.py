"""Kernels that draw the mosaic's tiles: brightness on nodes, colours of blocks.

A block is NODE_PX x NODE_PX pixels of a tile, and node k stands in its middle. A block that is one picture's,
as those around it are, is copied; only along seams are pictures blended.

Arrays come from overfly.products.tiles, which says what they hold.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from overfly.products.tile_labels import _LOG_FAR, MIXED, NOBODY, NODE_PX, _bit, _node_of

BLUR_RADIUS = 6  # of the fine blur, less than a block


@njit(cache=True, nogil=True)
def shade_source(  # type: ignore[no-untyped-def]
    column, row, log_cost, small, size, log_gain, fall_off, tint, gains, tints, source
):
    """Fill gains (rows, columns), by which the picture's colours are to be multiplied, tints (rows, columns,
    channels), by which its colours at large are, too, if it has colours, and source (rows, columns, channels
    + 1): what it then shows, from its small copy, and 1, where it sees the ground; else 0.

    size: of the picture; small (h, w, channels): of NODE_PX x NODE_PX of its pixels each; log_gain, and at
    even steps of the radius fall_off (k,), of its brightness, and tint (3, k), of its colours beside that.
    """
    width, height = size
    for i in range(column.shape[0]):
        for j in range(column.shape[1]):
            x, y = column[i, j] + 0.5 - 0.5 * width, row[i, j] + 0.5 - 0.5 * height
            step = min(2.0 * math.sqrt((x * x + y * y) / (width**2 + height**2)), 1.0) * (len(fall_off) - 1)
            knot = min(int(step), len(fall_off) - 2)
            fallen = fall_off[knot] + (step - knot) * (fall_off[knot + 1] - fall_off[knot])
            gain = math.exp(-(log_gain + fallen))
            gains[i, j] = gain
            for k in range(len(tint) if small.shape[2] == len(tint) else 0):
                tints[i, j, k] = math.exp(
                    -(tint[k, knot] + (step - knot) * (tint[k, knot + 1] - tint[k, knot]))
                )
            if log_cost[i, j] >= _LOG_FAR:
                source[i, j] = 0.0
                continue
            u = min(max((column[i, j] + 0.5) / NODE_PX - 0.5, 0.0), small.shape[1] - 1.0)
            v = min(max((row[i, j] + 0.5) / NODE_PX - 0.5, 0.0), small.shape[0] - 1.0)
            u0, v0 = int(u), int(v)
            u1, v1 = min(u0 + 1, small.shape[1] - 1), min(v0 + 1, small.shape[0] - 1)
            fu, fv = u - u0, v - v0
            for k in range(source.shape[2] - 1):
                c = min(k, small.shape[2] - 1)
                above = (1.0 - fu) * small[v0, u0, c] + fu * small[v0, u1, c]
                below = (1.0 - fu) * small[v1, u0, c] + fu * small[v1, u1, c]
                source[i, j, k] = gain * tints[i, j, k] * ((1.0 - fv) * above + fv * below)
            source[i, j, source.shape[2] - 1] = 1.0


@njit(cache=True, nogil=True)
def mix(smooth, weight, mixed, top, left):  # type: ignore[no-untyped-def]
    """Divide the colours of smooth (rows, columns, channels + 1) by its last channel, what was seen, and add
    them to mixed from (top, left) on, with the weights, whose sum is its last channel. Both in place."""
    last = smooth.shape[2] - 1
    for i in range(smooth.shape[0]):
        for j in range(smooth.shape[1]):
            share = max(smooth[i, j, last], np.float32(1e-6))
            for k in range(last):
                smooth[i, j, k] /= share
                mixed[top + i, left + j, k] += weight[i, j] * smooth[i, j, k]
            mixed[top + i, left + j, last] += weight[i, j]


@njit(cache=True, nogil=True)
def shade(gains, tints, smooth, mixed, top, left, shades):  # type: ignore[no-untyped-def]
    """Fill shades (rows, columns, 1 + channels): the gain, and what is to be added after it. smooth has the
    tints, which the gain has not."""
    last = smooth.shape[2] - 1
    for i in range(smooth.shape[0]):
        for j in range(smooth.shape[1]):
            total = max(mixed[top + i, left + j, last], np.float32(1e-12))
            shades[i, j, 0] = gains[i, j]
            for k in range(last):
                shades[i, j, 1 + k] = mixed[top + i, left + j, k] / total - smooth[i, j, k] / tints[i, j, k]


@njit(cache=True, nogil=True)
def number_seams(winners, edge, seams):  # type: ignore[no-untyped-def]
    """Number the blocks of the tile, which has edge blocks around it, that are to be blended; -1: the others.
    How many there are."""
    count = 0
    for r in range(edge, winners.shape[0] - edge):
        for c in range(edge, winners.shape[1] - edge):
            winner = winners[r, c]
            seams[r, c] = -1
            if winner == NOBODY:
                continue
            around = winners[r - 1 : r + 2, c - 1 : c + 2]
            for y in range(3):
                for x in range(3):
                    if around[y, x] != winner or winner == MIXED:
                        seams[r, c] = count
            if seams[r, c] >= 0:
                count += 1
    return count


@njit(cache=True, nogil=True)
def blocks_of(layer, k, winners, present, seams, edge, blocks):  # type: ignore[no-untyped-def]
    """Fill blocks (n, 2): rows and columns of those in which layer k has a part. How many there are."""
    count, bit = 0, _bit(k)
    top, bottom = max(layer[2], edge), min(layer[2] + layer[4], winners.shape[0] - edge)
    left, right = max(layer[3], edge), min(layer[3] + layer[5], winners.shape[1] - edge)
    for r in range(top, bottom):
        for c in range(left, right):
            wanted = winners[r, c] == k
            if not wanted and seams[r, c] >= 0:
                for y in range(r - 1, r + 2):
                    for x in range(c - 1, c + 2):
                        wanted |= (present[y, x] & bit) != 0
            if wanted:
                blocks[count, 0], blocks[count, 1] = r, c
                count += 1
    return count


@njit(cache=True, nogil=True)
def place_blocks(layer, nodes, step, blocks, column, row):  # type: ignore[no-untyped-def]
    """Fill column and row (NODE_PX, NODE_PX n): where the pixels of n blocks, side by side, lie in the
    picture."""
    per, one = NODE_PX // step, np.float32(1.0)
    line, before, towards = (
        np.empty(per + 2, np.float32),
        np.empty(NODE_PX, np.int64),
        np.empty(NODE_PX, np.float32),
    )
    for j in range(NODE_PX):
        before[j], towards[j] = _node_of(j, step)
    for q, found in ((0, column), (1, row)):
        for n in range(len(blocks)):
            first = layer[0] + per * (blocks[n, 0] - layer[2]) * layer[1] + per * (blocks[n, 1] - layer[3])
            for i in range(NODE_PX):
                place = first + before[i] * layer[1]
                above = nodes[q, place : place + per + 2]
                below = nodes[q, place + layer[1] : place + layer[1] + per + 2] if step > 1 else above
                for x in range(per + 2):
                    line[x] = (one - towards[i]) * above[x] + towards[i] * below[x]
                pixels = found[i, NODE_PX * n : NODE_PX * (n + 1)]
                for j in range(NODE_PX):
                    left = line[before[j]]
                    pixels[j] = left + towards[j] * (line[min(before[j] + 1, per + 1)] - left)


@njit(cache=True, nogil=True)
def paint_blocks(  # type: ignore[no-untyped-def]
    k, blocks, edge, warped, column, row, size, shades, first, label, seams, taps, tile, blended
):
    """Paint n blocks of layer k: into the tile, or where it is not alone, with its weight, into blended
    (seams, NODE_PX, NODE_PX, channels + 1), whose last channel is the sum of weights.

    warped (NODE_PX, NODE_PX n, channels): its colours; shades: of nodes, the first of which is ``first``
    blocks before block 0 (rows, columns); taps (2 BLUR_RADIUS + 1,): of the blur.
    """
    weight = np.ones((NODE_PX, NODE_PX), np.float32)
    tones = np.empty((shades.shape[2], NODE_PX, NODE_PX), np.float32)
    for n in range(len(blocks)):
        r, c = blocks[n, 0], blocks[n, 1]
        _tones(shades, r + first[0], c + first[1], tones)
        colours = warped[:, NODE_PX * n : NODE_PX * (n + 1)]
        if seams[r, c] < 0:
            y, x = NODE_PX * (r - edge), NODE_PX * (c - edge)
            _copy(tones, colours, tile[y : y + NODE_PX, x : x + NODE_PX])
        else:
            _fine_blur(label, k, NODE_PX * r, NODE_PX * c, taps, weight)
            for i in range(NODE_PX):
                for j in range(NODE_PX):
                    u, v = column[i, NODE_PX * n + j], row[i, NODE_PX * n + j]
                    if not (1.0 <= u <= size[0] - 2.0 and 1.0 <= v <= size[1] - 2.0):
                        weight[i, j] = 0.0
                    # the least weight keeps a lonely pixel, which the blur would wash out, its own
                    if label[NODE_PX * r + i, NODE_PX * c + j] == k:
                        weight[i, j] += np.float32(1e-6)
            _blend(tones, weight, colours, blended[seams[r, c]])


@njit(cache=True, nogil=True)
def _tones(shades, r, c, tones):  # type: ignore[no-untyped-def]
    """Fill tones (1 + channels, NODE_PX, NODE_PX): shades on the pixels of the block around node (r, c)."""
    half = NODE_PX // 2
    for q in range(shades.shape[2]):
        for i in range(NODE_PX):
            y = r if i >= half else r - 1
            fy = np.float32((i + 0.5 - half if i >= half else i + 0.5 + half) / NODE_PX)
            west = shades[y, c - 1, q] + fy * (shades[y + 1, c - 1, q] - shades[y, c - 1, q])
            middle = shades[y, c, q] + fy * (shades[y + 1, c, q] - shades[y, c, q])
            east = shades[y, c + 1, q] + fy * (shades[y + 1, c + 1, q] - shades[y, c + 1, q])
            before, after = (middle - west) / np.float32(NODE_PX), (east - middle) / np.float32(NODE_PX)
            for j in range(half):
                tones[q, i, j] = west + before * np.float32(j + 0.5 + half)
                tones[q, i, half + j] = middle + after * np.float32(j + 0.5)


@njit(cache=True, nogil=True)
def _copy(tones, colours, tile):  # type: ignore[no-untyped-def]
    """Write a block that is one picture's into the tile, both (NODE_PX, NODE_PX, ...)."""
    half, least, most = np.float32(0.5), np.float32(0.0), np.float32(255.0)
    is_gray, has_one_tone = colours.shape[2] == 1, len(tones) == 2
    for q in range(3):
        tone, colour = tones[1 if has_one_tone else 1 + q], colours[:, :, 0 if is_gray else q]
        for i in range(NODE_PX):
            for j in range(NODE_PX):
                value = tones[0, i, j] * np.float32(colour[i, j]) + tone[i, j] + half
                tile[i, j, q] = np.uint8(min(max(value, least), most))
    tile[:, :, 3] = 255


@njit(cache=True, nogil=True)
def _blend(tones, weight, colours, blended):  # type: ignore[no-untyped-def]
    """Add a block to what is blended (NODE_PX, NODE_PX, channels + 1), with its weights."""
    last = blended.shape[2] - 1
    for i in range(NODE_PX):
        for j in range(NODE_PX):
            for q in range(last):
                value = np.float32(colours[i, j, min(q, colours.shape[2] - 1)])
                blended[i, j, q] += weight[i, j] * (tones[0, i, j] * value + tones[1 + q, i, j])
            blended[i, j, last] += weight[i, j]


@njit(cache=True, nogil=True)
def _fine_blur(label, k, top, left, taps, weight):  # type: ignore[no-untyped-def]
    """Fill weight (NODE_PX, NODE_PX): the blurred share of layer k on the pixels of a block."""
    across = np.zeros((NODE_PX + 2 * BLUR_RADIUS, NODE_PX), np.float32)
    mine = np.empty(NODE_PX + 2 * BLUR_RADIUS, np.float32)
    for i in range(len(across)):
        for j in range(len(mine)):
            mine[j] = label[top + i - BLUR_RADIUS, left + j - BLUR_RADIUS] == k
        for t in range(len(taps)):
            for j in range(NODE_PX):
                across[i, j] += taps[t] * mine[j + t]
    weight[:] = np.float32(0.0)
    for i in range(NODE_PX):
        for t in range(len(taps)):
            for j in range(NODE_PX):
                weight[i, j] += taps[t] * across[i + t, j]


@njit(cache=True, nogil=True)
def finish_seams(seams, edge, blended, label, tile):  # type: ignore[no-untyped-def]
    """Divide what was blended by its weights, into the tile, where any layer wins."""
    channels = blended.shape[3] - 1
    for r in range(edge, seams.shape[0] - edge):
        for c in range(edge, seams.shape[1] - edge):
            seam = seams[r, c]
            if seam < 0:
                continue
            for i in range(NODE_PX):
                for j in range(NODE_PX):
                    if label[NODE_PX * r + i, NODE_PX * c + j] < 0:
                        continue
                    y, x = NODE_PX * (r - edge) + i, NODE_PX * (c - edge) + j
                    for q in range(3):
                        colour = blended[seam, i, j, min(q, channels - 1)] / blended[seam, i, j, channels]
                        value = min(max(colour + np.float32(0.5), np.float32(0.0)), np.float32(255.0))
                        tile[y, x, q] = np.uint8(value)
                    tile[y, x, 3] = 255
