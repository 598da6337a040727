"""The page of the paper's experiments: a table and the counterparts of the paper's figures, in one file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path

import numpy as np

import overfly
from overfly.evaluation import Evaluation
from overfly.files import atomic_path
from overfly.geometry.poses import FloatArray
from overfly.products.charts import Dot, Drawing, Label, svg, tone_styles
from overfly.products.figures import (
    errors_over_time,
    path_from_above,
    path_over_picture,
    shown_width,
    truth_from_above,
)
from overfly.products.pictures import MapPicture, data_url
from overfly.trajectory import Trajectory
from overfly.types import IntArray


@dataclass(frozen=True, slots=True)
class Row:
    """One figure: the paper's, ours with its deviation over the seeds, what must be reached and whether it
    was (None: for information).
    """

    label: str
    unit: str
    paper: str
    ours: float
    sigma: float
    limit: float | None
    reached: bool | None

    def cells(self) -> tuple[str, ...]:
        ours = "none" if math.isnan(self.ours) else f"{self.ours:.3g}"
        if math.isfinite(self.sigma):
            ours += f" ± {self.sigma:.2g}"
        limit = "" if self.limit is None else f"≤ {self.limit:g}"
        verdict = {None: "", True: "reached", False: "missed"}[self.reached]
        return (self.label, self.unit, self.paper, ours, limit, verdict)


@dataclass(frozen=True, slots=True, eq=False)
class ExperimentFigures:
    """Of one seed: paths, constraints (m, 2) times, comparison with the truth, mosaic, landmarks' places."""

    trajectory: Trajectory
    odometry: Trajectory
    constraints_ns: IntArray
    evaluation: Evaluation
    mosaic: MapPicture | None
    landmarks: dict[str, FloatArray]
    report: str  # link to the whole report of that map


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """One experiment. counterpart: which figures and tables of the paper it repeats."""

    name: str
    title: str
    counterpart: str
    rows: tuple[Row, ...]
    figures: ExperimentFigures | None


HEADS = ("", "unit", "paper", "ours", "must reach", "")


def write_experiments(path: Path, sections: Sequence[Section], seeds: int, command: str) -> None:
    """Write the page, whole or not at all. Raises OutputError."""
    judged = [row.reached for section in sections for row in section.rows if row.reached is not None]
    css = tone_styles() + resources.files("overfly.products").joinpath("report.css").read_text("utf-8")
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>The paper's experiments</title><style>{css}</style></head><body><main>"
        "<header><h1>The paper's experiments</h1>"
        '<p class="lead">Steder, Grisetti, Stachniss, Burgard, "Visual SLAM for Flying Vehicles" (2008), '
        f"section V, repeated on the simulator: {seeds} seeds each, default configuration, "
        f"{sum(judged)} of {len(judged)} targets reached.</p></header>"
        f"{''.join(_section(section) for section in sections)}"
        f"<section><h2>How to repeat this</h2><pre>{escape(command)}</pre></section>"
        f"<footer>Written by Overfly {escape(overfly.__version__)}. "
        "Everything on this page is inside this file.</footer></main></body></html>\n"
    )
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _section(section: Section) -> str:
    head = "".join(f"<th>{text}</th>" for text in HEADS)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row.cells()) + "</tr>" for row in section.rows
    )
    table = f'<div class="card scroll"><table><tr>{head}</tr>{body}</table></div>'
    note = f'<p class="note">Repeats {escape(section.counterpart)}.'
    if section.figures is not None:
        note += f' One seed in full: <a href="{escape(section.figures.report)}">report</a>.'
    return f"<section><h2>{escape(section.title)}</h2>{table}{note}</p>{_figures(section.figures)}</section>"


def _figures(figures: ExperimentFigures | None) -> str:
    if figures is None:
        return ""
    bounds = np.concatenate([figures.odometry.positions[:, :2], figures.trajectory.positions[:, :2]])
    before = path_from_above(figures.odometry, figures.constraints_ns, bounds, "By visual odometry alone")
    after = path_from_above(figures.trajectory, figures.constraints_ns, bounds, "After optimisation")
    return (
        _pair(("Visual odometry alone, constraints in grey", before), ("After optimisation", after))
        + _mosaic(figures)
        + _pair(
            ("Against the truth", truth_from_above(figures.evaluation)),
            ("Error", errors_over_time(figures.evaluation)),
        )
    )


def _mosaic(figures: ExperimentFigures) -> str:
    """The map from above with the path and the named landmarks, as in the paper's figures 6, 7 and 9."""
    picture = figures.mosaic
    if picture is None:
        return ""
    height, width = picture.rgba.shape[:2]
    path = picture.pixels_from_world(figures.trajectory.positions[:, :2])
    drawing = path_over_picture(path, width, height, picture.metres_per_px)
    unit = width / shown_width(width, height)
    for name, place in figures.landmarks.items():
        x, y = (float(value) for value in picture.pixels_from_world(place[None, :2])[0])
        drawing.shapes.append(Dot(x, y, "bad", 5.0 * unit))
        drawing.shapes.append(
            Label(x + 8.0 * unit, y - 8.0 * unit, name, "start", "ink", 16.0 * unit, halo=True)
        )
    image = f'<img alt="Map from above" width="{width}" height="{height}" src="{data_url(picture.rgba)}">'
    style = f"max-width:{shown_width(width, height):.0f}px"
    return f'<div class="card map" style="{style}">{image}{svg(drawing)}</div>'


def _pair(*drawings: tuple[str, Drawing]) -> str:
    cards = (
        f'<figure class="card"><h3>{escape(title)}</h3>{svg(drawing)}</figure>' for title, drawing in drawings
    )
    return f'<div class="pair">{"".join(cards)}</div>'
