"""What stands in the panel beside the map: coloured lines, tables, the annotated picture."""

from __future__ import annotations

import math

import cv2
import numpy as np

from overfly.geometry.cameras import Camera
from overfly.types import UInt8Array
from overfly.viewer.moment import Moment

SHOWN_WIDTH_PX = 320
FEATURE = (0, 230, 118)
# Pixels of the ring about a feature: all rings at once cost a tenth of drawing one after the other.
RING = np.array([(x, y) for x in range(-2, 3) for y in range(-2, 3) if 3 < x * x + y * y < 6])


def badge(text: str, colour: str) -> str:
    """A line of HTML on a coloured ground."""
    return (
        f'<div style="background:{colour};color:#fff;border-radius:6px;padding:6px 10px;margin:4px 8px;'
        f'font-weight:600;font-size:0.9em">{text}</div>'
    )


def table(rows: list[tuple[str, str]]) -> str:
    """Names and values, HTML."""
    cells = "".join(
        f'<tr><td style="opacity:.65;padding-right:1em">{name}</td><td>{value}</td></tr>'
        for name, value in rows
    )
    return f'<table style="font-size:0.85em;margin:2px 12px">{cells}</table>'


def length(metres: float | None) -> str:
    """A standard deviation for a person."""
    if metres is None or not math.isfinite(metres):
        return "unknown"
    if metres < 0.01:
        return f"{1e3 * metres:.1f} mm"
    return f"{1e2 * metres:.1f} cm" if metres < 1.0 else f"{metres:.1f} m"


def annotated(moment: Moment, camera: Camera) -> UInt8Array:
    """The picture (h, w, 3), small, with the map's points where it should show them."""
    height, width = moment.picture.shape[:2]
    size = (SHOWN_WIDTH_PX, max(1, round(height * SHOWN_WIDTH_PX / width)))
    small = cv2.resize(moment.picture, size, interpolation=cv2.INTER_AREA)
    if small.ndim == 2:
        small = cv2.cvtColor(small, cv2.COLOR_GRAY2RGB)
    if moment.pose is not None and len(moment.points):
        px = camera.scaled(*size).project(moment.pose.inverse().transform(moment.points))
        px = px[np.isfinite(px).all(axis=1) & (np.abs(px) < 2 * SHOWN_WIDTH_PX).all(axis=1)]
        x, y = (px.round().astype(np.int64)[:, None, :] + RING).reshape(-1, 2).T
        inside = (x >= 0) & (y >= 0) & (x < size[0]) & (y < size[1])
        small[y[inside], x[inside]] = FEATURE
    return np.asarray(small, np.uint8)
