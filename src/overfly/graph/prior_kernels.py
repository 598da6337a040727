"""Compiled kernels of absolute constraints on positions and attitudes, for steps of d numbers as in
``linearise``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from overfly.graph.quaternions import _matrix_into, _quaternion


@njit(cache=True, nogil=True)
def _add_position_priors(
    positions: Any,
    quaternions: Any,
    nodes: Any,
    values: Any,
    information: Any,
    weights: Any,
    diagonal: Any,
    gradient: Any,
) -> None:
    d = gradient.shape[1]
    n_axes = min(d, 3) if d != 3 else 2
    R = np.empty((3, 3))
    for k in range(len(nodes)):
        node = nodes[k]
        if d == 4:  # steps are in world axes
            R[:, :] = np.eye(3)
        else:
            _matrix_into(_quaternion(quaternions[node]), R)
        for r in range(n_axes):
            for a in range(3):
                for b in range(3):
                    value = weights[k] * R[a, r] * information[k, a, b]
                    gradient[node, r] += value * (positions[node, b] - values[k, b])
                    for s in range(n_axes):
                        diagonal[node, r, s] += value * R[b, s]


@njit(cache=True, nogil=True)
def _attitude_error(q: Any, rotation: Any, R: Any) -> Any:
    """Tilt about world x and y, and heading, of R measured^T: (3,)."""
    _matrix_into(q, R)
    u0 = R[0, 0] * rotation[2, 0] + R[0, 1] * rotation[2, 1] + R[0, 2] * rotation[2, 2]
    u1 = R[1, 0] * rotation[2, 0] + R[1, 1] * rotation[2, 1] + R[1, 2] * rotation[2, 2]
    sine = 0.0
    cosine = 0.0
    for t in range(3):
        sine += R[1, t] * rotation[0, t] - R[0, t] * rotation[1, t]
        cosine += R[0, t] * rotation[0, t] + R[1, t] * rotation[1, t]
    return -u1, u0, np.arctan2(sine, cosine)


@njit(cache=True, nogil=True)
def _attitude_errors(quaternions: Any, nodes: Any, rotations: Any) -> Any:
    errors = np.empty((len(nodes), 3))
    R = np.empty((3, 3))
    for k in range(len(nodes)):
        errors[k, 0], errors[k, 1], errors[k, 2] = _attitude_error(
            _quaternion(quaternions[nodes[k]]), rotations[k], R
        )
    return errors


@njit(cache=True, nogil=True)
def _add_attitude_priors(
    quaternions: Any, nodes: Any, rotations: Any, information: Any, weights: Any, diagonal: Any, gradient: Any
) -> None:
    """To first order a turn w in the node's axes changes the error by R w; roll and pitch do not count where
    they are held.
    """
    d = gradient.shape[1]
    R = np.empty((3, 3))
    for k in range(len(nodes)):
        node = nodes[k]
        e = _attitude_error(_quaternion(quaternions[node]), rotations[k], R)
        if d == 6:
            for a in range(3):
                value = weights[k] * information[k, a]
                for r in range(3):
                    gradient[node, 3 + r] += value * R[a, r] * e[a]
                    for s in range(3):
                        diagonal[node, 3 + r, 3 + s] += value * R[a, r] * R[a, s]
        else:
            value = weights[k] * information[k, 2]
            gradient[node, d - 1] += value * e[2]
            diagonal[node, d - 1, d - 1] += value
