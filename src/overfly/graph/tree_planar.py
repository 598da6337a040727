"""The tree optimiser's sweep for graphs in the plane: poses relative to the parent are x, y, cosine and sine,
so that a path costs a few products a node.

What is resolved, and in which shares, is as in ``tree``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray


def planar_poses(positions: FloatArray, quaternions: FloatArray) -> FloatArray:
    """(n, 4) x, y, cosine and sine of the heading, of (n, 3) and (n, 4)."""
    z, w = quaternions[:, 2], quaternions[:, 3]
    return np.stack([positions[:, 0], positions[:, 1], w * w - z * z, 2.0 * z * w], axis=1)


def write_planar_poses(poses: FloatArray, positions: FloatArray, quaternions: FloatArray) -> None:
    """The other way round, into the arrays given."""
    half = 0.5 * np.arctan2(poses[:, 3], poses[:, 2])
    positions[:, :2] = poses[:, :2]
    quaternions[:, 2], quaternions[:, 3] = np.sin(half), np.cos(half)


@njit(cache=True, nogil=True)
def _climb_planar(parent: Any, node: int, length: int, relative: Any, path: Any, poses: Any) -> None:
    """The path of so many nodes that ends at ``node``, with poses in the axes of the node above it."""
    for k in range(length - 1, -1, -1):
        path[k] = node
        node = parent[node]
    _compose(path, length, relative, poses)


@njit(cache=True, nogil=True)
def _compose(path: Any, length: int, relative: Any, poses: Any) -> None:
    x, y, c, s = 0.0, 0.0, 1.0, 0.0
    for k in range(length):
        n = path[k]
        rx, ry, rc, rs = relative[n, 0], relative[n, 1], relative[n, 2], relative[n, 3]
        x, y = x + c * rx - s * ry, y + s * rx + c * ry
        c, s = c * rc - s * rs, s * rc + c * rs
        poses[k, 0], poses[k, 1], poses[k, 2], poses[k, 3] = x, y, c, s


@njit(cache=True, nogil=True)
def _turn_planar(path: Any, length: int, passing: Any, turn: float, relative: Any) -> None:
    """Turn each node of a leg by its own share; those below turn along."""
    for k in range(length):
        n = path[k]
        angle = turn / passing[n, 1]
        c, s = math.cos(angle), math.sin(angle)
        rc, rs = relative[n, 2], relative[n, 3]
        rc, rs = rc * c - rs * s, rc * s + rs * c
        scale = 1.5 - 0.5 * (rc * rc + rs * rs)  # keeps the length at one
        relative[n, 2], relative[n, 3] = rc * scale, rs * scale


@njit(cache=True, nogil=True)
def _shift_planar(
    path: Any, length: int, passing: Any, shift_x: float, shift_y: float, relative: Any, poses: Any
) -> None:
    c, s = 1.0, 0.0
    for k in range(length):
        n = path[k]
        share = 1.0 / passing[n, 0]
        x, y = share * shift_x, share * shift_y
        relative[n, 0] += c * x + s * y
        relative[n, 1] += c * y - s * x
        c, s = poses[k, 2], poses[k, 3]


@njit(cache=True, nogil=True)
def _sweep_planar(
    parent: Any, level: Any, i: Any, j: Any, measured: Any, constraints: Any, tops: Any, strengths: Any,
    passing: Any, rate: float, relative: Any,
) -> None:  # fmt: skip
    """Resolve these constraints, one after the other. measured (m, 4) and relative (n, 4) as
    ``planar_poses``.
    """
    deepest = level.max() + 1
    path_a, path_b = np.empty(deepest, np.int64), np.empty(deepest, np.int64)
    A, B = np.empty((deepest + 1, 4)), np.empty((deepest + 1, 4))
    A[-1] = B[-1] = np.array([0.0, 0.0, 1.0, 0.0])  # of a leg without nodes, whose last is number -1
    for k in range(len(constraints)):
        constraint = constraints[k]
        a, b = i[constraint], j[constraint]
        length_a, length_b = level[a] - level[tops[k]], level[b] - level[tops[k]]
        _climb_planar(parent, a, length_a, relative, path_a, A)
        _climb_planar(parent, b, length_b, relative, path_b, B)
        sum_t, sum_r = 0.0, 0.0
        for p in range(length_a):
            sum_t += 1.0 / passing[path_a[p], 0]
            sum_r += 1.0 / passing[path_a[p], 1]
        for p in range(length_b):
            sum_t += 1.0 / passing[path_b[p], 0]
            sum_r += 1.0 / passing[path_b[p], 1]
        share_t = min(1.0, rate * strengths[constraint, 0] * sum_t) / sum_t
        share_r = min(1.0, rate * strengths[constraint, 1] * sum_r) / sum_r
        x, y, c, s = measured[constraint]
        end_a, end_b = A[length_a - 1], B[length_b - 1]
        wanted_c, wanted_s = end_a[2] * c - end_a[3] * s, end_a[3] * c + end_a[2] * s
        turn = math.atan2(
            wanted_s * end_b[2] - wanted_c * end_b[3], wanted_c * end_b[2] + wanted_s * end_b[3]
        )
        _turn_planar(path_a, length_a, passing, -share_r * turn, relative)
        _turn_planar(path_b, length_b, passing, share_r * turn, relative)
        _compose(path_a, length_a, relative, A)
        _compose(path_b, length_b, relative, B)
        shift_x = end_a[0] + end_a[2] * x - end_a[3] * y - end_b[0]
        shift_y = end_a[1] + end_a[3] * x + end_a[2] * y - end_b[1]
        _shift_planar(path_a, length_a, passing, -share_t * shift_x, -share_t * shift_y, relative, A)
        _shift_planar(path_b, length_b, passing, share_t * shift_x, share_t * shift_y, relative, B)
