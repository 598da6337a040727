"""Many rotations at once: vectors to matrices and back."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from overfly.geometry.poses import FloatArray


def rotations_from_vectors(vectors: FloatArray) -> FloatArray:
    """Rotation vectors (.., 3), radians, -> matrices (.., 3, 3)."""
    matrices = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return np.asarray(matrices.reshape(*vectors.shape, 3))


def vectors_from_rotations(rotations: FloatArray) -> FloatArray:
    """Matrices (.., 3, 3) -> rotation vectors (.., 3), radians, no longer than pi."""
    vectors = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec()
    return np.asarray(vectors.reshape(rotations.shape[:-1]))
