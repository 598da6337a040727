"""Where a visitor of a finished map begins: all of it is seen, and it fills the page."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from overfly.viewer.scene import LEAST_ASPECT, MapScene

sizes = st.floats(1.0, 500.0)


@given(sizes, sizes, st.floats(0.0, 60.0), st.floats(-1e4, 1e4))
def test_the_whole_map_is_seen_at_first(width: float, length: float, height: float, x: float) -> None:
    low = np.array([x, 5.0, -3.0])
    high = low + np.array([width, length, height])
    camera = SimpleNamespace()
    MapScene.look_from_above(
        SimpleNamespace(unit_m=1.0),  # type: ignore[arg-type]
        SimpleNamespace(initial_camera=camera),  # type: ignore[arg-type]
        low,
        high,
    )
    position, target = np.array(camera.position), np.array(camera.look_at)
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    corners = np.array([(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)]) * (high - low) + low
    ahead = (corners - position) @ forward
    scale = math.tan(0.5 * camera.fov)
    across = (corners - position) @ right / (LEAST_ASPECT * scale * ahead)
    upwards = (corners - position) @ up / (scale * ahead)
    largest = max(np.abs(across).max(), np.abs(upwards).max())
    assert (ahead > 0.0).all()
    assert 0.999 < largest < 1.001
    assert across.mean() < 0.0  # the panel is on the right
