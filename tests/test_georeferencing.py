"""Where GPS would have the nodes of a map: what all frames that hang by a node say, as sure as it may be."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from overfly.adjustment import Positions
from overfly.geometry.geodesy import GeoOrigin, geodetic_from_enu
from overfly.geometry.poses import FloatArray, rotation_z
from overfly.pipeline.georeferencing import _Fixes, _wanted
from overfly.pipeline.position_accuracy import CORRELATION_S
from overfly.sensors.default_sigmas import GPS_ALTITUDE_SIGMA_M, POSITION_SIGMA_M

ORIGIN = GeoOrigin(47.0, 8.0, 400.0)
N_NODES, NODE_S = 60, 2.0


def flown(per_node: int, noise_m: float, seed: int, sigma_m: float = 1.0) -> _Fixes:
    """Along lines of a survey, a node every two seconds, per_node frames behind each, 0.3 m above its camera;
    the world is turned and moved against east, north, up."""
    generator = np.random.default_rng(seed)
    time_s = np.arange(N_NODES * per_node) * NODE_S / per_node
    along = 5.0 * time_s
    line = along // 150.0
    place = np.column_stack([np.where(line % 2, 150.0 - along % 150.0, along % 150.0), 40.0 * line])
    body = np.column_stack([place, 30.0 + np.sin(time_s)])
    node = np.repeat(np.arange(N_NODES), per_node)
    camera = body[::per_node][node] - [0.0, 0.0, 0.3]
    enu = body @ rotation_z(0.7).T + [20.0, -30.0, 5.0] + noise_m * generator.normal(0, 1, body.shape)
    return _Fixes(
        node, (1e9 * time_s).astype(np.int64), camera, body, geodetic_from_enu(enu, ORIGIN),
        np.tile([sigma_m, 1.5 * sigma_m], (len(node), 1)),
    )  # fmt: skip


def wanted(fixes: _Fixes) -> Positions:
    found = _wanted(cast(Any, SimpleNamespace(start=None)), fixes)
    assert found is not None
    return found


def cameras(fixes: _Fixes) -> FloatArray:
    return fixes.camera[np.unique(fixes.node, return_index=True)[1]]


@pytest.mark.parametrize("per_node", [1, 7])
def test_exact_fixes_give_the_cameras_of_the_nodes(per_node: int) -> None:
    fixes = flown(per_node, 0.0, 1)
    found = wanted(fixes)
    assert found.node.tolist() == list(range(N_NODES))
    np.testing.assert_allclose(found.position, cameras(fixes), atol=1e-3)


def test_every_frame_counts() -> None:
    """Sixteen fixes of a node are four times as exact as one, where their errors are independent."""
    rms = [
        np.sqrt(np.mean([(wanted(fixes).position - cameras(fixes)) ** 2 for fixes in flights]))
        for flights in ([flown(k, 1.0, seed) for seed in range(8)] for k in (1, 16))
    ]
    assert 0.2 < rms[1] / rms[0] < 0.35


@pytest.mark.parametrize("per_node", [1, 4, 16])
def test_a_node_is_as_sure_however_often_its_time_was_measured(per_node: int) -> None:
    found = wanted(flown(per_node, 1.0, 3, sigma_m=3.0))
    np.testing.assert_allclose(np.median(found.sigma[:, :2]), 3.0 * np.sqrt(CORRELATION_S / NODE_S), rtol=0.1)


def test_one_wrong_fix_of_a_node_hardly_moves_it() -> None:
    fixes = flown(9, 0.5, 4)
    fixes.geodetic[100, 0] += 1e-3  # a hundred metres
    off = np.linalg.norm(wanted(fixes).position - cameras(fixes), axis=1)
    assert off[fixes.node[100]] < 1.5
    assert np.median(off) > 0.05


def test_positions_of_no_stated_height_accuracy_do_not_hold_nodes() -> None:
    fixes = flown(2, 0.5, 5)
    fixes.sigma[:40, 1] = np.inf
    assert wanted(fixes).node.tolist() == list(range(20, N_NODES))
    fixes.sigma[:, 1] = np.inf
    assert _wanted(cast(Any, SimpleNamespace(start=None)), fixes) is None


def test_fixes_that_state_no_accuracy_are_as_sure_as_they_show() -> None:
    """0.3 m along each axis instead of the default of 3 and 6 m; what is stated stays."""
    fixes = flown(1, 0.3, 6)
    fixes.sigma[:] = POSITION_SIGMA_M, GPS_ALTITUDE_SIGMA_M
    alike = np.sqrt(CORRELATION_S / NODE_S)
    ratio = np.median(wanted(fixes).sigma, axis=0) / alike / 0.3
    assert (ratio > 0.8).all()
    assert (ratio < 1.8).all()  # errors that are independent look smaller than slow ones would
    fixes.sigma[:] = 3.5, 7.0
    np.testing.assert_allclose(np.median(wanted(fixes).sigma, axis=0) / alike, [3.5, 3.5, 7.0])
