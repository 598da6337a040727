"""How well a simulated flight kept its places: after the flight, by where the simulator says the vehicle was.

Places belong to the map, whose origin and heading are its own. They are compared after the map's fixes have
been laid over the true positions, turned and shifted but not stretched: distances are true metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from overfly.geometry.poses import FloatArray, Pose
from overfly.navigation.pilot import Situation
from overfly.types import BoolArray, IntArray

RETURNED_M = 0.15  # the vehicle is back at its place when it has been this near to it
RETURNED_S = 2.0  # for so long


@dataclass(slots=True, eq=False)
class FlightLog:
    """One row a frame: time (s), fix in the map or NaN, target in the map or NaN, true position, whether a
    fix was found, whether a hand held the vehicle."""

    t_s: list[float] = field(default_factory=list)
    fix: list[FloatArray] = field(default_factory=list)
    target: list[FloatArray] = field(default_factory=list)
    really: list[FloatArray] = field(default_factory=list)
    located: list[bool] = field(default_factory=list)
    held: list[bool] = field(default_factory=list)
    status: list[str] = field(default_factory=list)
    nodes: list[int] = field(default_factory=list)  # of the map
    arrivals: list[int] = field(default_factory=list)  # rows in which the vehicle said that it had arrived

    def add(self, situation: Situation, really: Pose, nodes: int, *, held: bool, arrived: bool) -> None:
        state, target = situation.state, situation.target
        located = state is not None and situation.lost_s <= 0.0
        self.t_s.append(situation.t_ns * 1e-9)
        self.fix.append(state.position if state is not None and located else np.full(3, math.nan))
        self.target.append(np.full(2, math.nan) if target is None else np.array([target.x_m, target.y_m]))
        self.really.append(really.translation)
        self.located.append(located)
        self.held.append(held)
        self.status.append(str(situation.status))
        self.nodes.append(nodes)
        if arrived:
            self.arrivals.append(len(self.t_s) - 1)


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """t_s (n,) from the first frame; distance_m (n,) from the vehicle's true place to that of its target, NaN
    without one; settled (n,): between its return after a push and the next push.

    nodes (n,): of the map; map_xy, target_xy (n, 2): true place and target, in the map's world; returns_s:
    for each push how long the way back took, inf if it was not back before the next one.
    """

    t_s: FloatArray
    distance_m: FloatArray
    settled: BoolArray
    held: BoolArray
    nodes: IntArray
    map_xy: FloatArray
    target_xy: FloatArray
    numbers: dict[str, Any]
    returns_s: tuple[float, ...]
    push_rows: tuple[int, ...]
    arrival_rows: tuple[int, ...]


def judge(log: FlightLog) -> Judgement:
    """Distances and what follows from them."""
    t_s = np.array(log.t_s) - log.t_s[0]
    fixes, really = np.array(log.fix), np.array(log.really)
    target, held = np.array(log.target), np.array(log.held)
    map_xy = _in_the_map(really[:, :2], fixes[:, :2])
    distance = np.linalg.norm(map_xy - target, axis=1)
    begins = np.flatnonzero(held & ~np.append(False, held[:-1]))
    settled, returns = _settled(t_s, distance, held, target, begins)
    lost = _lost_spans(t_s, np.array(log.located))
    errors = distance[settled]
    numbers = {
        "images": len(t_s),
        "simulated_s": float(t_s[-1]),
        "pushes": len(begins),
        "returned": int(np.isfinite(returns).sum()),
        "longest_return_s": _finite(max(returns, default=math.nan)),
        "rms_error_m": _finite(float(np.sqrt(np.mean(errors**2))) if len(errors) else math.nan),
        "largest_settled_error_m": _finite(float(errors.max()) if len(errors) else math.nan),
        "settled_s": float(settled.sum() * np.median(np.diff(t_s))) if len(t_s) > 1 else 0.0,
        "max_error_m": _finite(float(np.nanmax(distance)) if np.isfinite(distance).any() else math.nan),
        "lost_s": float(sum(lost)),
        "longest_lost_s": float(max(lost, default=0.0)),
        "arrived": len(log.arrivals),
        "arrival_errors_m": [round(float(distance[row]), 4) for row in log.arrivals],
        "final_error_m": _finite(float(distance[-1])),
        "height_rms_m": float(np.std(really[:, 2])),
    }
    return Judgement(
        t_s, distance, settled, held, np.array(log.nodes), map_xy, target, numbers, tuple(returns),
        tuple(int(row) for row in begins), tuple(log.arrivals),
    )  # fmt: skip


def _in_the_map(really: FloatArray, fixes: FloatArray) -> FloatArray:
    """True positions (n, 2) turned and shifted on to the fixes (n, 2), by least squares."""
    known = np.isfinite(fixes[:, 0])
    if not known.any():
        return np.full_like(really, math.nan)
    source = really[:, 0] + 1j * really[:, 1]
    there = fixes[known, 0] + 1j * fixes[known, 1]
    middle, middle_there = source[known].mean(), there.mean()
    turn = np.sum(np.conj(source[known] - middle) * (there - middle_there))
    turn = turn / abs(turn) if abs(turn) > 1e-9 else 1.0
    moved = turn * (source - middle) + middle_there
    return np.column_stack([moved.real, moved.imag])


def _settled(
    t_s: FloatArray, distance: FloatArray, held: BoolArray, target: FloatArray, begins: IntArray
) -> tuple[BoolArray, list[float]]:
    """Rows in which the vehicle is back at its place, and the seconds each way back took.

    Each push, and each new target, begins a stretch; it is settled from the moment on at which the vehicle
    has been within RETURNED_M for RETURNED_S, until the stretch ends, wherever it is then.
    """
    jumps = np.linalg.norm(np.diff(target, axis=0), axis=1)
    fresh = np.flatnonzero(~(jumps < RETURNED_M)) + 1
    edges = np.unique(np.concatenate([[0], begins, fresh, [len(t_s)]])).tolist()
    settled = np.zeros(len(t_s), np.bool_)
    returns = []
    for first, last in pairwise(edges):
        free = first + int(np.argmin(held[first:last])) if held[first:last].any() else first
        back = _came_back(t_s[free:last], distance[free:last])
        if back is not None:
            settled[free + back : last] = True
        if first in begins:
            returns.append(math.inf if back is None else float(t_s[free + back] - t_s[free] - RETURNED_S))
    return settled, returns


def _came_back(t_s: FloatArray, distance: FloatArray) -> int | None:
    """The first row that ends RETURNED_S within RETURNED_M; None if there is none."""
    since = math.inf
    for row, (time_s, far) in enumerate(zip(t_s.tolist(), distance.tolist(), strict=True)):
        since = min(since, time_s) if far < RETURNED_M else math.inf
        if time_s - since >= RETURNED_S:
            return row
    return None


def _lost_spans(t_s: FloatArray, located: BoolArray) -> list[float]:
    """Seconds of each stretch without a fix, from the last fix before it to the first after it."""
    spans, since = [], t_s[0]
    was_lost = False
    for time_s, found in zip(t_s, located, strict=True):
        if found:
            if was_lost:
                spans.append(float(time_s - since))
            since, was_lost = time_s, False
        else:
            was_lost = True
    if was_lost:
        spans.append(float(t_s[-1] - since))
    return spans


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
