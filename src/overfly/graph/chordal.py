"""A start for poor graphs: rotations first, from a linear problem, then positions (chordal initialisation).

Rotations minimise sum w |R_j - R_i R_ij|^2 over all matrices, which is linear, and are then brought back to
rotations. Source: Carlone et al., "Initialization techniques for 3D SLAM", ICRA 2015; Martinec and Pajdla,
CVPR 2007.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray
from overfly.graph.cholesky import factorise
from overfly.graph.pose_graph import PoseGraph
from overfly.graph.quaternions import _matrix_into, _quaternion
from overfly.graph.sparse import Pattern


def initialise_chordal(graph: PoseGraph, pattern: Pattern) -> bool:
    """Replace all poses but those of the fixed nodes, from the constraints alone; False, and no change, if
    that fails.
    """
    constraints = pattern.constraints
    i, j = graph.i[constraints], graph.j[constraints]
    information = graph.information[constraints]
    measured = rotation_matrices(graph.measured_quaternions[constraints])
    here = rotation_matrices(graph.quaternions)
    places = [5] if graph.planar else [3, 4, 5]
    weights = np.maximum(information[:, places, places].mean(axis=1), 0.0)
    rotations = _rotations(pattern, i, j, measured, weights, here)
    if rotations is None:
        return False
    shifts = np.einsum("kab,kb->ka", rotations[i], graph.measured_positions[constraints])
    omega = rotations[i] @ measured
    omega = omega @ information[:, :3, :3] @ omega.transpose(0, 2, 1)
    if graph.planar:
        omega[:, 2, :] = omega[:, :, 2] = 0.0
        omega[:, 2, 2] = 1.0
    positions = _positions(pattern, i, j, shifts, omega, graph.positions)
    if positions is None:
        return False
    free = ~pattern.fixed
    graph.positions[free] = positions[free]
    graph.quaternions[free] = quaternions_of(rotations)[free]
    return True


def _rotations(
    pattern: Pattern, i: Any, j: Any, measured: FloatArray, weights: FloatArray, here: FloatArray
) -> FloatArray | None:
    """The unknowns are the rows of R, as columns of R^T: R_j^T = R_ij^T R_i^T."""
    n = len(here)
    unit = weights[:, None, None] * np.eye(3)
    towards = -weights[:, None, None] * measured  # block (i, j)
    solution = _solve_linear(pattern, i, j, unit, unit, towards, np.zeros((n, 3, 3)), here.transpose(0, 2, 1))
    if solution is None:
        return None
    U, _, Vt = np.linalg.svd(solution.transpose(0, 2, 1))
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    return np.asarray(U @ Vt)


def _positions(
    pattern: Pattern, i: Any, j: Any, shifts: FloatArray, omega: FloatArray, here: FloatArray
) -> FloatArray | None:
    """t_j - t_i = shift with information omega, both in world axes."""
    right = np.zeros((len(here), 3, 1))
    pull = omega @ shifts[:, :, None]
    np.add.at(right, i, -pull)
    np.add.at(right, j, pull)
    solution = _solve_linear(pattern, i, j, omega, omega, -omega, right, here[:, :, None])
    return None if solution is None else solution[:, :, 0]


def _solve_linear(
    pattern: Pattern, i: Any, j: Any, at_i: FloatArray, at_j: FloatArray, towards: FloatArray,
    right: FloatArray,
    here: FloatArray,
) -> FloatArray | None:  # fmt: skip
    """Solve blocks of 3 for (n, 3, k) with the fixed nodes held at ``here``; unfixed graphs are held at their
    first node.
    """
    fixed = pattern.fixed.copy()
    if not fixed.any():
        fixed[0] = True
    diagonal = np.zeros((len(here), 3, 3))
    np.add.at(diagonal, i, at_i)
    np.add.at(diagonal, j, at_j)
    known_i, known_j = fixed[i], fixed[j]
    right = right.copy()
    np.add.at(right, j[known_i], -(towards[known_i].transpose(0, 2, 1) @ here[i[known_i]]))
    np.add.at(right, i[known_j], -(towards[known_j] @ here[j[known_j]]))
    diagonal[fixed], right[fixed] = np.eye(3), here[fixed]
    blocks = np.where((known_i | known_j)[:, None, None], 0.0, towards)
    blocks[pattern.flipped] = blocks[pattern.flipped].transpose(0, 2, 1)
    off_diagonal = np.zeros((pattern.n_pairs, 3, 3))
    np.add.at(off_diagonal, pattern.slot, blocks)
    factor = factorise(pattern.symbolic, diagonal, off_diagonal)
    return None if factor is None else factor.solve(right)


@njit(cache=True, nogil=True)
def _rotation_matrices(quaternions: Any) -> Any:
    matrices = np.empty((len(quaternions), 3, 3))
    for n in range(len(quaternions)):
        _matrix_into(_quaternion(quaternions[n]), matrices[n])
    return matrices


def rotation_matrices(quaternions: FloatArray) -> FloatArray:
    """(n, 4) unit xyzw -> (n, 3, 3)."""
    return np.asarray(_rotation_matrices(quaternions))


def quaternions_of(rotations: FloatArray) -> FloatArray:
    """(n, 3, 3) -> (n, 4) xyzw with w >= 0; the column of the largest component is normalised (Shepperd
    1978).
    """
    R = rotations
    xx, yy, zz = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    xy, xz, yz = R[:, 0, 1] + R[:, 1, 0], R[:, 0, 2] + R[:, 2, 0], R[:, 1, 2] + R[:, 2, 1]
    wx, wy, wz = R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]
    outer = np.stack(  # 4 q q^T
        [
            np.stack([1 + xx - yy - zz, xy, xz, wx], axis=1),
            np.stack([xy, 1 - xx + yy - zz, yz, wy], axis=1),
            np.stack([xz, yz, 1 - xx - yy + zz, wz], axis=1),
            np.stack([wx, wy, wz, 1 + xx + yy + zz], axis=1),
        ],
        axis=1,
    )
    largest = np.argmax(np.einsum("naa->na", outer), axis=1)
    quaternions = outer[np.arange(len(outer)), largest]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    quaternions[quaternions[:, 3] < 0] *= -1.0
    return np.asarray(quaternions)
