"""Where map points, and the patches of ground about them, are in another view."""

from __future__ import annotations

import numpy as np
from numba import njit

from overfly.geometry.poses import FloatArray, Pose
from overfly.types import IntArray

WARP_STEP_PX = 4.0  # over which the warp between two views is differenced


def rays_to(world_from_cam: Pose, world: FloatArray) -> FloatArray:
    """Rays (n, 2) along which a camera sees points (n, 3); NaN where they are not in front of it."""
    return np.asarray(_see(world_from_cam.rotation, world_from_cam.translation, np.ascontiguousarray(world)))


def with_steps(px: FloatArray) -> FloatArray:
    """Positions (5 n, 2): each of (n, 2), a step to its right, to its left, below it, and above it."""
    steps = WARP_STEP_PX * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    return np.asarray((px[:, None, :] + steps).reshape(-1, 2))


def patch_rays(
    rotations: FloatArray,
    translations: FloatArray,
    of_reference: IntArray,
    now: Pose,
    rays: FloatArray,
    world: FloatArray,
    rows: IntArray,
) -> FloatArray:
    """(5 m, 2) rays along which a camera now sees five neighbouring points of the level ground about each of
    some map points, rows (m,); NaN where out of sight.

    rotations (k, 3, 3), translations (k, 3): world_from_cam of the pictures that show the patches;
    of_reference (n,): which of them each point's does; rays (n, 5, 2) of the five points there; world
    (n, 3) metres.
    """
    return np.asarray(
        _transferred(rotations, translations, of_reference, now.rotation, now.translation, rays, world, rows)
    )


def inverse_warp(px: FloatArray) -> FloatArray:
    """Jacobian (n, 2, 2) of pixels in the patches' pictures by pixels in the current one, from where (5 n, 2)
    with_steps of the former are in the latter; NaN where there is none.
    """
    return np.asarray(_inverse_warp(px))


def curvature(px: FloatArray) -> FloatArray:
    """(n, 2) by how much where (5 n, 2) with_steps are in the current picture bends, per squared pixel from
    the middle: the ground about a point lies so much beside where its Jacobian says, on both sides alike.

    What bends it most is the lens: a camera that always moves the same way sees all patches bend alike.
    """
    middle, right, left, below, above = px.reshape(-1, 5, 2).transpose(1, 0, 2)
    return np.asarray((right + left + below + above - 4.0 * middle) / (2.0 * WARP_STEP_PX**2))


@njit(cache=True, nogil=True)
def _see(rotation, translation, world):  # type: ignore[no-untyped-def]
    rays = np.empty((world.shape[0], 2))
    for k in range(world.shape[0]):
        dx, dy, dz = world[k, 0] - translation[0], world[k, 1] - translation[1], world[k, 2] - translation[2]
        z = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
        if not z > 0.0:
            rays[k] = np.nan
            continue
        rays[k, 0] = (rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz) / z
        rays[k, 1] = (rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz) / z
    return rays


@njit(cache=True, nogil=True)
def _transferred(rotations, translations, of_reference, rotation_now, translation_now, rays, world, rows):  # type: ignore[no-untyped-def]
    """Where five neighbouring rays (n, 5, 2) of each point's anchor, which meet level ground about it,
    are seen now: (5 m, 2) rays of the m points of rows, NaN where out of sight.
    """
    there = np.empty((5 * rows.shape[0], 3))
    for k in range(rows.shape[0]):
        rotation, translation = rotations[of_reference[rows[k]]], translations[of_reference[rows[k]]]
        for step in range(5):
            u, v = rays[rows[k], step]
            x = rotation[0, 0] * u + rotation[0, 1] * v + rotation[0, 2]
            y = rotation[1, 0] * u + rotation[1, 1] * v + rotation[1, 2]
            z = rotation[2, 0] * u + rotation[2, 1] * v + rotation[2, 2]
            depth = (world[rows[k], 2] - translation[2]) / z if z != 0.0 else np.nan
            there[5 * k + step, 0] = translation[0] + x * depth
            there[5 * k + step, 1] = translation[1] + y * depth
            there[5 * k + step, 2] = translation[2] + z * depth
    return _see(rotation_now, translation_now, there)


@njit(cache=True, nogil=True)
def _inverse_warp(px):  # type: ignore[no-untyped-def]
    """Jacobian (n, 2, 2) of pixels in the anchor's picture by pixels in the current one, from where (5 n, 2)
    the anchor's steps are in the current picture; NaN where there is none.
    """
    count = px.shape[0] // 5
    warp = np.full((count, 2, 2), np.nan)
    for k in range(count):
        a = (px[5 * k + 1, 0] - px[5 * k + 2, 0]) / (2.0 * WARP_STEP_PX)
        b = (px[5 * k + 3, 0] - px[5 * k + 4, 0]) / (2.0 * WARP_STEP_PX)
        c = (px[5 * k + 1, 1] - px[5 * k + 2, 1]) / (2.0 * WARP_STEP_PX)
        d = (px[5 * k + 3, 1] - px[5 * k + 4, 1]) / (2.0 * WARP_STEP_PX)
        determinant = a * d - b * c
        if abs(determinant) > 1e-3:
            warp[k, 0, 0], warp[k, 0, 1] = d / determinant, -b / determinant
            warp[k, 1, 0], warp[k, 1, 1] = -c / determinant, a / determinant
    return warp
