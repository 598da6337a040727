"""The figures of reports: paths seen from above, heights, errors, what was located."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from overfly.evaluation import Evaluation
from overfly.geometry.poses import FloatArray
from overfly.products.charts import (
    Axes,
    Dot,
    Drawing,
    Label,
    Lines,
    add_frame,
    add_legend,
    add_line,
    axes_around,
    write_chart,
)
from overfly.trajectory import NS_PER_S, Trajectory
from overfly.types import BoolArray, IntArray

WIDTH, HEIGHT = 460.0, 300.0  # of one figure: two stand side by side, on a phone one below the other
LEFT, TOP, RIGHT, BOTTOM = 48.0, 26.0, 12.0, 36.0
PAGE_WIDTH, LEAST_WIDTH, TALLEST = 920.0, 320.0, 1200.0  # of a map on a page, pixels
MOST_CONSTRAINTS = 3000
LEAST_RADIAL, RADIAL = 4, 9.0  # ellipses, and how much more (squared) they reach outwards than around
LOWEST_PATH, TALLEST_PATH = 240.0, 640.0  # figure of a path that is much wider than high, or higher than wide


def path_from_above(
    trajectory: Trajectory,
    constraints_ns: IntArray,
    bounds: FloatArray,
    title: str,
    ellipses: Sequence[FloatArray] = (),
) -> Drawing:
    """A trajectory with its constraints in grey, as in the paper's Fig. 4.

    constraints_ns: (m, 2) times of the two ends of each; bounds: (k, 2) points that the figure must hold,
    so that several figures show the same ground; ellipses: outlines (k, 2) drawn over the path.
    """
    drawing, axes = _from_above(bounds, title)
    drawing.shapes.append(_constraint_lines(axes, trajectory, constraints_ns))
    add_line(drawing, axes, trajectory.positions[:, :2], "path", 1.8)
    drawing.shapes.append(Lines(tuple(axes.place(ellipse) for ellipse in ellipses), "truth", 1.2))
    _add_start_and_end(drawing, axes, trajectory.positions[:, :2])
    return drawing


def are_radial(ellipses: Sequence[FloatArray]) -> bool:
    """Whether ellipses (k, 2) point away from the middle of all: then it is the size that is not known."""
    outlines = np.stack(ellipses)
    centres = 0.5 * (outlines.min(axis=1) + outlines.max(axis=1))
    arms = centres - centres.mean(axis=0)
    arms /= np.maximum(np.linalg.norm(arms, axis=1, keepdims=True), 1e-12)
    around = np.column_stack([-arms[:, 1], arms[:, 0]])
    along, across = (float((np.ptp(np.einsum("nkd,nd->nk", outlines, axis), axis=1) ** 2).sum())
                     for axis in (arms, around))  # fmt: skip
    return len(outlines) >= LEAST_RADIAL and along > RADIAL * across


def heights(trajectory: Trajectory, truth: Trajectory | None = None) -> Drawing:
    """Height of the camera along the path."""
    drawing = Drawing(WIDTH, HEIGHT, "Height of the camera over time")
    start = trajectory.t_ns[0]
    lines = [(_over_time(trajectory, start), "path")]
    if truth is not None:
        lines.insert(0, (_over_time(truth, start), "truth"))
    axes = _plot_area(np.concatenate([line for line, _ in lines]))
    add_frame(drawing, axes, "time (s)", "height (m)")
    for line, tone in lines:
        add_line(drawing, axes, line, tone)
    if truth is not None:
        add_legend(drawing, WIDTH - RIGHT, TOP - 8, [("truth", "truth"), ("estimate", "path")])
    return drawing


def truth_from_above(evaluation: Evaluation) -> Drawing:
    """Aligned estimate over the truth."""
    both = np.concatenate([evaluation.truth.positions[:, :2], evaluation.estimate.positions[:, :2]])
    drawing, axes = _from_above(both, "Estimate and truth from above")
    add_line(drawing, axes, evaluation.truth.positions[:, :2], "truth", 2.4)
    add_line(drawing, axes, evaluation.estimate.positions[:, :2], "path", 1.4)
    add_legend(drawing, WIDTH - RIGHT, TOP - 8, [("truth", "truth"), ("estimate", "path")])
    return drawing


def errors_over_time(evaluation: Evaluation) -> Drawing:
    """Distance from the truth, horizontal and vertical."""
    drawing = Drawing(WIDTH, HEIGHT, "Distance from the truth over time")
    seconds = (evaluation.truth.t_ns - evaluation.truth.t_ns[0]) / NS_PER_S
    horizontal = np.stack([seconds, np.linalg.norm(evaluation.errors_m[:, :2], axis=1)], axis=1)
    vertical = np.stack([seconds, np.abs(evaluation.errors_m[:, 2])], axis=1)
    axes = _plot_area(np.concatenate([horizontal, vertical, [[0.0, 0.0]]]))
    add_frame(drawing, axes, "time (s)", "error (m)")
    add_line(drawing, axes, vertical, "truth")
    add_line(drawing, axes, horizontal, "path")
    add_legend(drawing, WIDTH - RIGHT, TOP - 8, [("vertical", "truth"), ("horizontal", "path")])
    return drawing


def located_strip(t_ns: NDArray[np.int64], located: BoolArray) -> Drawing:
    """A bar over time: located frames in one tone, lost ones in another."""
    width, height = 920.0, 22.0
    drawing = Drawing(
        width, height, f"{np.count_nonzero(located)} of {len(located)} frames located", stretches=True
    )
    if len(t_ns) == 0:
        return drawing
    changes = np.flatnonzero(np.diff(located.astype(np.int8))) + 1
    starts = np.concatenate([[0], changes])
    span = max(1, int(t_ns[-1] - t_ns[0]))
    edges = np.append((t_ns[starts] - t_ns[0]) / span * width, width)
    runs: dict[bool, list[FloatArray]] = {True: [], False: []}
    for start, left, right in zip(starts, edges[:-1], edges[1:], strict=True):
        end = max(float(right), float(left) + 1.5)  # one lost frame must stay visible
        runs[bool(located[start])].append(np.array([[left, height / 2], [end, height / 2]]))
    drawing.shapes.append(Lines(tuple(runs[True]), "good", height, cap="butt"))
    drawing.shapes.append(Lines(tuple(runs[False]), "bad", height, cap="butt"))
    return drawing


def shown_width(width: int, height: int) -> float:
    """How wide a page shows a map's picture: all the room there is, less for a tall one."""
    return min(PAGE_WIDTH, max(LEAST_WIDTH, TALLEST * width / height))


def path_over_picture(
    path_px: FloatArray,
    width: int,
    height: int,
    metres_per_px: float,
    names: Sequence[tuple[str, FloatArray]] = (),
) -> Drawing:
    """A path (n, 2), pixels of a map's picture, named places (2,) as in the paper's Fig. 6, and a scale bar;
    to lie over that picture."""
    drawing = Drawing(float(width), float(height), "Path of the camera over the mosaic")
    unit = width / shown_width(width, height)  # lines and text look alike, whatever the picture's size
    axes = Axes(0.0, 0.0, float(width), float(height), 0.0, float(width), float(-height), 0.0)
    drawn = path_px * [1.0, -1.0]
    add_line(drawing, axes, drawn, "paper", 4.0 * unit)
    add_line(drawing, axes, drawn, "path", 2.0 * unit)
    _add_start_and_end(drawing, axes, drawn, 6.0 * unit)
    for name, (x, y) in names:
        drawing.shapes.append(Dot(float(x), float(y), "paper", 5.0 * unit))
        drawing.shapes.append(Dot(float(x), float(y), "truth", 3.5 * unit))
        beside = float(x) + 9.0 * unit
        drawing.shapes.append(
            Label(beside, float(y) + 5.0 * unit, name, "start", "ink", 15.0 * unit, halo=True)
        )
    length_m = 10.0 ** math.floor(math.log10(0.3 * width * metres_per_px))
    length_m *= max(factor for factor in (1, 2, 5) if factor * length_m <= 0.3 * width * metres_per_px)
    left, y = 16.0 * unit, height - 16.0 * unit
    right = left + length_m / metres_per_px
    bar = (np.array([[left, y], [right, y]]),)
    drawing.shapes += [Lines(bar, "paper", 7.0 * unit), Lines(bar, "ink", 3.0 * unit)]
    drawing.shapes.append(
        Label(left, y - 8.0 * unit, f"{length_m:g} m", "start", "ink", 15.0 * unit, halo=True)
    )
    return drawing


def draw_evaluation(path: str | Path, evaluation: Evaluation) -> None:
    """Estimate and truth from above and the error over time, as one .svg or .png. Raises OutputError."""
    above, below = truth_from_above(evaluation), errors_over_time(evaluation)
    both = Drawing(WIDTH, above.height + below.height, "Estimate against truth", list(above.shapes))
    for shape in below.shapes:
        both.shapes.append(_moved_down(shape, above.height))
    write_chart(path, both)


def _moved_down(shape: Lines | Dot | Label, by: float) -> Lines | Dot | Label:
    if isinstance(shape, Lines):
        return replace(shape, runs=tuple(run + np.array([0.0, by]) for run in shape.runs))
    return replace(shape, y=shape.y + by)


def _from_above(bounds: FloatArray, title: str) -> tuple[Drawing, Axes]:
    """An empty figure for points of the plane (n, 2), as high as they make it."""
    low, high = bounds.min(axis=0), bounds.max(axis=0)
    width = WIDTH - LEFT - RIGHT
    wanted = width * float(high[1] - low[1]) / max(float(high[0] - low[0]), 1e-9)
    height = min(max(wanted + TOP + BOTTOM, LOWEST_PATH), TALLEST_PATH)
    drawing = Drawing(WIDTH, height, title)
    axes = axes_around(LEFT, TOP, width, height - TOP - BOTTOM, bounds).with_equal_scales()
    add_frame(drawing, axes, "x (m)", "y (m)")
    return drawing, axes


def _plot_area(points: FloatArray) -> Axes:
    return axes_around(LEFT, TOP, WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM, points)


def _over_time(trajectory: Trajectory, start_ns: int) -> FloatArray:
    """(n, 2) seconds and height, with a gap where frames are missing."""
    seconds = (trajectory.t_ns - start_ns) / NS_PER_S
    line = np.stack([seconds, trajectory.positions[:, 2]], axis=1)
    steps = np.diff(seconds)
    gaps = np.flatnonzero(steps > 10.0 * np.median(steps)) + 1 if len(steps) else np.zeros(0, np.int64)
    return np.asarray(np.insert(line, gaps, np.nan, axis=0))


def _constraint_lines(axes: Axes, trajectory: Trajectory, constraints_ns: IntArray) -> Lines:
    """Grey lines between the places where the two ends of each constraint are on this trajectory."""
    chosen = constraints_ns[:: max(1, math.ceil(len(constraints_ns) / MOST_CONSTRAINTS))]
    if len(chosen) == 0 or len(trajectory) == 0:
        return Lines((), "constraint")
    rows = np.clip(np.searchsorted(trajectory.t_ns, chosen), 0, len(trajectory) - 1)
    known = (trajectory.t_ns[rows] == chosen).all(axis=1)
    places = axes.place(trajectory.positions[:, :2])[rows[known]]
    return Lines(tuple(places), "constraint", 1.2)


def _add_start_and_end(drawing: Drawing, axes: Axes, points: FloatArray, radius_px: float = 4.5) -> None:
    if len(points) == 0:
        return
    for point, tone in ((points[0], "good"), (points[-1], "bad")):
        x, y = axes.place(point[None, :])[0]
        drawing.shapes.append(Dot(float(x), float(y), "paper", 1.5 * radius_px))
        drawing.shapes.append(Dot(float(x), float(y), tone, radius_px))
