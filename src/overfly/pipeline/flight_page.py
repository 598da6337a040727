"""report.html of a flight: how far the vehicle was from its place, where it flew, and what it saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

import overfly
from overfly.pipeline.judging import RETURNED_M, RETURNED_S, Judgement
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
    svg,
)
from overfly.products.pictures import data_url
from overfly.products.report import Figure, card, numbers_row, section, table, write_sections
from overfly.types import UInt8Array

MOST_PICTURES = 64
SHOWN = 8
AFTER_PUSH = 240  # frames after the first push that are kept: long enough to come back


@dataclass(slots=True, eq=False)
class Strip:
    """Pictures of a flight of any length, evenly spaced, and closer about the first push."""

    even: list[tuple[int, UInt8Array]] = field(default_factory=list)
    push: list[tuple[int, UInt8Array]] = field(default_factory=list)
    _row: int = -1
    _every: int = 1
    _push_row: int | None = None

    def see(self, image: UInt8Array, *, held: bool) -> None:
        """The picture of the next row of the log."""
        self._row += 1
        if held and self._push_row is None:
            self._push_row = self._row
        if self._push_row is not None and self._row - self._push_row <= AFTER_PUSH and self._row % 4 == 0:
            self.push.append((self._row, image))
        if self._row % self._every == 0:
            self.even.append((self._row, image))
        if len(self.even) > MOST_PICTURES:
            self.even = self.even[::2]
            self._every *= 2


def write_flight_page(
    path: Path, scenario: str, found: Judgement, strip: Strip, numbers: dict[str, Any]
) -> None:
    """Write the page, whole or not at all. Raises OutputError."""
    count = len(found.arrival_rows)
    did = f"reached {count} place{'s' if count > 1 else ''}" if count else "kept its place"
    title = f"Flight of the {numbers['vehicle']}: it {did}"
    lead = (
        f"Simulated world '{scenario}', seed {numbers['seed']}, wind {numbers['wind_m_s']:g} m/s, "
        f"{numbers['images']} pictures in {numbers['simulated_s'] / 60.0:.1f} minutes; steered by nothing "
        "but where the pictures lie in the map."
    )
    sections = [
        f'<header><h1>{escape(title)}</h1><p class="lead">{escape(lead)}</p></header>',
        numbers_row(_figures(numbers)),
        section("Distance to the place", _distance(found)),
        section("From above", _above(found)),
        section("Growth of the map", _growth(found)),
        section("What it saw", _pictures(strip, found)),
        _arrivals(found),
        section("How to repeat this flight", f"<pre>{escape(numbers['command'])}</pre>"),
    ]
    write_sections(path, title, sections, overfly.__version__)


def _figures(numbers: dict[str, Any]) -> tuple[Figure, ...]:
    figures = []
    if numbers["rms_error_m"] is not None and not numbers["arrived"]:
        figures.append(Figure("distance, settled", f"{numbers['rms_error_m']:.3f} m", "RMS"))
    if numbers["pushes"]:
        figures.append(Figure("pushes", str(numbers["pushes"]), f"came back from {numbers['returned']}"))
        figures.append(Figure("pushed away", f"{numbers['max_error_m']:.1f} m", "farthest"))
    if numbers["arrived"] and numbers["arrival_errors_m"]:
        figures.append(Figure("places reached", str(numbers["arrived"])))
        figures.append(Figure("distance on arrival", f"{max(numbers['arrival_errors_m']):.3f} m", "largest"))
    figures += [
        Figure("without a fix", f"{numbers['longest_lost_s']:.1f} s", "longest"),
        Figure("speed", f"{numbers['realtime_factor']:.1f} x", "real time, world rendered too"),
        Figure("map", f"{numbers['map_nodes']} nodes"),
    ]
    return tuple(figures)


def _distance(found: Judgement) -> str:
    drawing = Drawing(940.0, 300.0, "Distance from the vehicle to its place over time")
    line = np.column_stack([found.t_s, found.distance_m])
    area = axes_around(48.0, 30.0, 880.0, 230.0, np.vstack([line, [[0.0, 0.0]]]))
    add_frame(drawing, area, "time (s)", "distance (m)")
    for row in found.push_rows:
        x = float(area.place(np.array([[found.t_s[row], 0.0]]))[0, 0])
        drawing.shapes.append(Lines((np.array([[x, area.top], [x, area.top + area.height]]),), "truth", 1.0))
        drawing.shapes.append(Dot(x, area.top, "truth", 3.0))
    add_line(drawing, area, line, "path")
    for row in found.arrival_rows:
        x, y = area.place(line[row][None])[0]
        drawing.shapes.append(Dot(float(x), float(y), "good", 3.5))
    words = [("a hand takes it", "truth")] if found.push_rows else []
    words += [("arrived", "good")] if found.arrival_rows else []
    add_legend(drawing, 928.0, 16.0, words)
    near = "" if found.arrival_rows else _near(found)
    note = (
        "True horizontal distance, by the simulator, after the flight. Settled: from when the vehicle has "
        f"been within {RETURNED_M:g} m for {RETURNED_S:g} s until the next push or the next place."
    )
    return card("", svg(drawing)) + near + f'<p class="note">{note}</p>'


def _near(found: Judgement) -> str:
    """The same from nearby: only where it is settled."""
    if not found.settled.any():
        return ""
    drawing = Drawing(940.0, 240.0, "Distance while settled")
    line = np.column_stack([found.t_s, np.where(found.settled, 100.0 * found.distance_m, np.nan)])
    area = axes_around(48.0, 30.0, 880.0, 170.0, np.vstack([line, [[0.0, 0.0], [found.t_s[-1], 0.0]]]))
    add_frame(drawing, area, "time (s)", "settled (cm)")
    add_line(drawing, area, line, "path", 1.2)
    return card("", svg(drawing))


def _growth(found: Judgement) -> str:
    drawing = Drawing(940.0, 200.0, "Nodes of the map over time")
    line = np.column_stack([found.t_s, found.nodes.astype(np.float64)])
    area = axes_around(48.0, 30.0, 880.0, 130.0, np.vstack([line, [[0.0, 0.0]]]))
    add_frame(drawing, area, "time (s)", "nodes")
    add_line(drawing, area, line, "path")
    return card("", svg(drawing)) + (
        '<p class="note">Nodes are added over ground that is new; over ground that the map shows already the '
        "older ones are used again.</p>"
    )


def _above(found: Judgement) -> str:
    drawing = Drawing(940.0, 460.0, "Path of the vehicle from above")
    targets = found.target_xy[np.isfinite(found.target_xy[:, 0])]
    every = np.vstack([found.map_xy, targets])
    area = axes_around(48.0, 26.0, 880.0, 398.0, every).with_equal_scales()
    add_frame(drawing, area, "x (m)", "y (m)")
    add_line(drawing, area, found.map_xy, "path", 1.4)
    changes = np.append(True, np.linalg.norm(np.diff(targets, axis=0), axis=1) > RETURNED_M)
    for number, place in enumerate(targets[changes] if len(targets) else targets, start=1):
        _mark(drawing, area, place, str(number) if found.arrival_rows else "")
    return card("", svg(drawing)) + '<p class="note">Orange: the places it was to keep or to reach.</p>'


def _mark(drawing: Drawing, area: Axes, place: np.ndarray, text: str) -> None:
    x, y = (float(value) for value in area.place(place[None])[0])
    drawing.shapes += [Dot(x, y, "paper", 7.0), Dot(x, y, "truth", 5.0)]
    if text:
        drawing.shapes.append(Label(x + 8.0, y - 6.0, text, "start", "ink", halo=True))


def _pictures(strip: Strip, found: Judgement) -> str:
    parts = [_row(_chosen(strip.even), found)]
    if strip.push:
        parts = [
            "<h3>The first push</h3>", _row(_chosen(strip.push), found),
            "<h3>The whole flight</h3>", *parts,
        ]  # fmt: skip
    return "".join(parts)


def _chosen(pictures: Sequence[tuple[int, UInt8Array]]) -> list[tuple[int, UInt8Array]]:
    picks = np.unique(np.linspace(0, len(pictures) - 1, min(SHOWN, len(pictures))).round().astype(int))
    return [pictures[int(pick)] for pick in picks]


def _row(pictures: Sequence[tuple[int, UInt8Array]], found: Judgement) -> str:
    cells = []
    for row, image in pictures:
        rgb = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
        rgba = np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])
        distance = found.distance_m[row]
        away = f"{distance:.2f} m away" if np.isfinite(distance) else "no place to seek"
        cells.append(
            f'<figure><img alt="The ground at {found.t_s[row]:.0f} s" src="{data_url(rgba)}">'
            f"<figcaption>{found.t_s[row]:.0f} s, {away}</figcaption></figure>"
        )
    return f'<div class="pictures">{"".join(cells)}</div>'


def _arrivals(found: Judgement) -> str:
    if not found.arrival_rows:
        return ""
    rows = [
        (
            str(number),
            *(f"{value:.2f}" for value in found.target_xy[row]),
            f"{found.t_s[row]:.1f}",
            f"{100.0 * found.distance_m[row]:.1f}",
        )
        for number, row in enumerate(found.arrival_rows, start=1)
    ]
    heads = ("place", "x (m)", "y (m)", "arrived (s)", "distance (cm)")
    return section("Arrivals", f'<div class="card scroll">{table(heads, rows)}</div>')
