"""The report of a run: one page that needs no other file and makes no request, for screen, phone or paper."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from overfly.evaluation import Evaluation
from overfly.files import atomic_path
from overfly.geometry.poses import FloatArray
from overfly.products.charts import Drawing, svg, tone_styles
from overfly.products.figures import (
    are_radial,
    errors_over_time,
    heights,
    located_strip,
    path_from_above,
    path_over_picture,
    shown_width,
    truth_from_above,
)
from overfly.products.perspective import PerspectiveView
from overfly.products.pictures import MapPicture, data_url
from overfly.trajectory import NS_PER_S, Trajectory
from overfly.types import BoolArray, IntArray

LEAST_TURN_DEG = 2.0  # of the map's axes against north, that is worth saying


@dataclass(frozen=True, slots=True)
class Figure:
    """One summary number: what it is, its value with unit, and at most a few words more."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True, slots=True)
class StageTiming:
    """Time that a stage took per frame, milliseconds."""

    name: str
    p50_ms: float
    p95_ms: float
    max_ms: float


@dataclass(frozen=True, slots=True)
class SensorUse:
    """A sensor of the flight: whether it was used, and how or why not."""

    name: str
    used: bool
    detail: str


@dataclass(frozen=True, slots=True)
class LandmarkRow:
    """Estimated place of a named landmark, metres, world; error_m against a truth, where there is one."""

    name: str
    position_m: tuple[float, float, float]
    sigma_m: float
    error_m: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ElevationPicture:
    """Shaded heights, and the heights (metres) that their colours span."""

    picture: MapPicture
    low_m: float
    high_m: float


@dataclass(frozen=True, slots=True)
class RevisitCounts:
    """How often a place was sought again and found; rejected: (reason, how often)."""

    tried: int
    accepted: int
    rejected: tuple[tuple[str, int], ...]


@dataclass(frozen=True, slots=True, eq=False)
class ReportData:
    """What the page tells. Trajectories are world_from_cam; empty or None parts are left out.

    constraints_ns: (m, 2) times of the frames that each constraint of the graph joins; frame_ns, located
    (n,): all frames of the flight; lost_reasons: (reason, how many frames). command and settings: how to
    repeat the run. ellipses: outlines (k, 2), metres, of where some of the cameras are within three standard
    deviations; products_s: (what, seconds) of what was made once the flight was over.
    """

    title: str
    subtitle: str
    numbers: tuple[Figure, ...]
    trajectory: Trajectory
    odometry: Trajectory
    constraints_ns: IntArray
    frame_ns: NDArray[np.int64]
    located: BoolArray
    scale_source: str
    command: str
    version: str
    lost_reasons: tuple[tuple[str, int], ...] = ()
    warnings: tuple[str, ...] = ()
    mosaic: MapPicture | None = None
    elevation: ElevationPicture | None = None
    evaluation: Evaluation | None = None
    stages: tuple[StageTiming, ...] = ()
    sensors: tuple[SensorUse, ...] = ()
    landmarks: tuple[LandmarkRow, ...] = ()
    settings: str = ""
    ellipses: tuple[FloatArray, ...] = ()
    revisits: RevisitCounts | None = None
    perspective: PerspectiveView | None = None
    products_s: tuple[tuple[str, float], ...] = ()


def write_report(path: str | Path, data: ReportData) -> None:
    """Write the page, whole or not at all. Raises OutputError."""
    sections = [
        _header(data),
        _mosaic(data),
        _perspective(data),
        _trajectories(data),
        _revisits(data),
        _height(data),
        _truth(data),
        _located(data),
        _landmarks(data),
        _sensors(data),
        _timings(data),
        _reproduce(data),
    ]
    write_sections(path, data.title, sections, data.version)


def write_sections(path: str | Path, title: str, sections: Sequence[str], version: str) -> None:
    """A page of sections that are HTML already, whole or not at all. Raises OutputError."""
    css = tone_styles() + resources.files("overfly.products").joinpath("report.css").read_text("utf-8")
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(title)}</title><style>{css}</style></head><body><main>"
        f"{''.join(sections)}<footer>Written by Overfly {escape(version)}. "
        "Everything on this page is inside this file.</footer></main></body></html>\n"
    )
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _header(data: ReportData) -> str:
    warnings = "".join(f"<li>{escape(warning)}</li>" for warning in data.warnings)
    return (
        f'<header><h1>{escape(data.title)}</h1><p class="lead">{escape(data.subtitle)}</p></header>'
        + (
            f'<aside class="warnings"><strong>Worth knowing</strong><ul>{warnings}</ul></aside>'
            if warnings
            else ""
        )
        + numbers_row(data.numbers)
    )


def numbers_row(figures: Sequence[Figure]) -> str:
    """Summary numbers side by side."""
    cells = "".join(
        f"<div><dt>{escape(figure.label)}</dt><dd>{escape(figure.value)}"
        f"{f'<small>{escape(figure.note)}</small>' if figure.note else ''}</dd></div>"
        for figure in figures
    )
    return f'<dl class="numbers">{cells}</dl>'


def _mosaic(data: ReportData) -> str:
    if data.mosaic is None:
        return ""
    picture = data.mosaic
    height, width = picture.rgba.shape[:2]
    path = picture.pixels_from_world(data.trajectory.positions[:, :2])
    names = [
        (row.name, picture.pixels_from_world(np.array([row.position_m[:2]]))[0]) for row in data.landmarks
    ]
    overlay = svg(path_over_picture(path, width, height, picture.metres_per_px, names))
    image = (
        f'<img alt="Mosaic of the ground" width="{width}" height="{height}" src="{data_url(picture.rgba)}">'
    )
    return section(
        "Mosaic",
        f'<div class="card map" style="max-width:{shown_width(width, height):.0f}px">{image}{overlay}</div>'
        '<p class="note">The ground from straight above, '
        "and the path of the camera over it, from the green dot to the red one"
        f"{', with the named landmarks' if names else ''}.</p>",
    )


def _trajectories(data: ReportData) -> str:
    bounds = np.concatenate([data.odometry.positions[:, :2], data.trajectory.positions[:, :2]])
    if len(bounds) == 0:
        return ""
    before = path_from_above(data.odometry, data.constraints_ns, bounds, "Path by visual odometry alone")
    after = path_from_above(
        data.trajectory, data.constraints_ns, bounds, "Path after optimisation", data.ellipses
    )
    sigma = ""
    if data.ellipses:
        widest = max(float(np.ptp(ellipse, axis=0).max()) for ellipse in data.ellipses)
        sigma = (
            " Ellipses on the right hold the camera within three standard deviations, wherever the map as a "
            f"whole may be; the largest is {widest:.3g} m across. What neighbouring measurements err by in "
            "common is in them; what leads a whole flight astray, such as a wrong calibration, is not."
        )
        if are_radial(data.ellipses):
            sigma += " They point away from the middle: it is the size of the map that is not known better."
    return section(
        "Trajectory",
        _pair(("Visual odometry alone", before), ("After optimisation", after))
        + '<p class="note">Grey lines join frames that a constraint of the graph joins. On the left, long '
        f"ones show how far odometry had drifted when the vehicle came back to a place it knew.{sigma}"
        f"{_where_north_is(data.mosaic)}</p>",
    )


def _where_north_is(mosaic: MapPicture | None) -> str:
    """Said where the mosaic is turned against x and y, to have north at its top; else empty."""
    if mosaic is None or abs(mosaic.turn_deg) < LEAST_TURN_DEG:
        return ""
    return (
        " Here x and y are the map's own: north, which is at the top of the mosaic, is "
        f"{abs(mosaic.turn_deg):.0f} degrees to the {'right' if mosaic.turn_deg > 0.0 else 'left'} of y."
    )


def _perspective(data: ReportData) -> str:
    if data.perspective is None:
        return ""
    view = data.perspective
    rows, columns = view.rgba.shape[:2]
    raised = f" Heights are raised {view.raised:.1f} times." if view.raised > 1.05 else ""
    image = (
        f'<img alt="The ground seen from the side" width="{columns}" height="{rows}" '
        f'src="{data_url(view.rgba)}">'
    )
    pale = (
        " What is pale has no height of its own: it lies as high as what is nearest." if view.has_pale else ""
    )
    note = f'<p class="note">The mosaic on the elevation, seen from the side.{raised}{pale}</p>'
    return section("Relief", f'<div class="card map">{image}</div>{note}')


def _revisits(data: ReportData) -> str:
    found = data.revisits
    if found is None or found.tried == 0:
        return ""
    rows = [("believed", str(found.accepted)), *((reason, str(n)) for reason, n in found.rejected)]
    body = table(("what became of it", "times"), rows)
    return section(
        "Places seen again",
        f"<p>{found.tried} times a place of the map lay within reach and was compared with the picture.</p>"
        f'<div class="card scroll">{body}</div>',
    )


def _height(data: ReportData) -> str:
    if len(data.trajectory) == 0:
        return ""
    cards = card("Camera", svg(heights(data.trajectory)))
    if data.elevation is not None:
        rows, columns = data.elevation.picture.rgba.shape[:2]
        source = data_url(data.elevation.picture.rgba)
        image = f'<img alt="Height of the ground" width="{columns}" height="{rows}" src="{source}">'
        low, high = data.elevation.low_m, data.elevation.high_m
        digits = max(0, 1 - math.floor(math.log10(max(high - low, 1e-6))))
        note = f"Dark to light: {low:.{digits}f} m to {high:.{digits}f} m."
        cards += card("Ground", f'{image}<p class="note">{note}</p>')
    return section("Height", f'<div class="pair">{cards}</div>')


def _truth(data: ReportData) -> str:
    found = data.evaluation
    if found is None:
        return ""
    rows = [
        (name, *(f"{value:.3f}" for value in (part.rmse, part.median, part.p95, part.max)))
        for name, part in (
            ("position", found.ate_m),
            ("horizontal", found.ate_horizontal_m),
            ("vertical", found.ate_vertical_m),
        )
    ]
    scale = "" if found.scale_error is None else f" Scale error {100 * found.scale_error:+.2f} %."
    percent = "" if found.final_error_percent is None else f" ({found.final_error_percent:.2f} % of the path)"
    return section(
        "Against the truth",
        _pair(("From above", truth_from_above(found)), ("Error", errors_over_time(found)))
        + '<div class="card scroll" style="margin-top:1rem">'
        + table(("error (m)", "rmse", "median", "95 %", "max"), rows)
        + f'</div><p class="note">Alignment: {escape(str(found.align))}, over {found.n_frames} frames '
        f"({100 * found.coverage:.1f} % of the truth's), {found.path_m:.1f} m of path. "
        f"Started together, the two end {found.final_error_m:.3f} m apart{percent}.{scale}</p>",
    )


def _located(data: ReportData) -> str:
    if len(data.frame_ns) == 0:
        return ""
    seconds = (int(data.frame_ns[-1]) - int(data.frame_ns[0])) / NS_PER_S
    lost = "; ".join(f"{escape(reason)}: {count}" for reason, count in data.lost_reasons)
    strip = svg(located_strip(data.frame_ns, data.located))
    found, count = np.count_nonzero(data.located), len(data.located)
    summary = f"{found} of {count} frames located (green), the others lost."
    if found == count:
        summary = f"All {count} frames located."
    return section(
        "Frames",
        f'<div class="card strip">{strip}'
        f'<div class="ends"><span>0 s</span><span>{seconds:.1f} s</span></div></div>'
        f'<p class="note">{summary}{f" Why: {lost}." if lost else ""}</p>',
    )


def _landmarks(data: ReportData) -> str:
    if not data.landmarks:
        return ""
    has_truth = any(row.error_m is not None for row in data.landmarks)
    rows = []
    for row in data.landmarks:
        cells = [row.name, *(f"{value:.3f}" for value in row.position_m), f"{row.sigma_m:.3f}"]
        if has_truth:
            cells.append("" if row.error_m is None else f"{row.error_m:.3f}")
        rows.append(tuple(cells))
    heads = ("landmark", "x (m)", "y (m)", "z (m)", "sigma (m)", *(("error (m)",) if has_truth else ()))
    return section("Landmarks", f'<div class="card scroll">{table(heads, rows)}</div>')


def _sensors(data: ReportData) -> str:
    rows = "".join(
        f'<tr><td>{escape(sensor.name)}</td><td class="{"yes" if sensor.used else "no"}">'
        f"{'used' if sensor.used else 'not used'}</td><td>{escape(sensor.detail)}</td></tr>"
        for sensor in data.sensors
    )
    table = f'<div class="card scroll"><table class="words">{rows}</table></div>' if rows else ""
    return section(
        "Sensors and scale", f"<p>Scale from: <strong>{escape(data.scale_source)}</strong>.</p>{table}"
    )


def _timings(data: ReportData) -> str:
    if not data.stages:
        return ""
    longest = max(1e-9, *(stage.p95_ms for stage in data.stages))
    rows = "".join(
        f"<tr><td>{escape(stage.name)}</td><td>{stage.p50_ms:.2f}</td><td>{stage.p95_ms:.2f}</td>"
        f'<td>{stage.max_ms:.2f}</td><td class="bar-cell"><span class="bar" '
        f'style="width:{100 * stage.p95_ms / longest:.1f}%"></span></td></tr>'
        for stage in data.stages
    )
    head = (
        "<tr><th>stage, ms per frame</th><th>median</th><th>95 %</th><th>max</th>"
        '<th class="bar-cell">bars: 95 %</th></tr>'
    )
    after = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in data.products_s)
    note = f'<p class="note">After the flight: {after}.</p>' if after else ""
    return section("Time", f'<div class="card scroll"><table>{head}{rows}</table></div>{note}')


def _reproduce(data: ReportData) -> str:
    settings = ""
    if data.settings:
        settings = (
            f"<details><summary>Settings of this run</summary><pre>{escape(data.settings)}</pre></details>"
        )
    command = f"<pre>{escape(data.command)}</pre>" if data.command else ""
    return section("How to repeat this run", command + settings) if command or settings else ""


def section(title: str, body: str) -> str:
    """A section; body is HTML."""
    return f"<section><h2>{escape(title)}</h2>{body}</section>"


def card(title: str, body: str) -> str:
    """A figure in a frame; body is HTML."""
    head = f"<h3>{escape(title)}</h3>" if title else ""
    return f'<figure class="card">{head}{body}</figure>'


def _pair(*drawings: tuple[str, Drawing]) -> str:
    return '<div class="pair">' + "".join(card(title, svg(drawing)) for title, drawing in drawings) + "</div>"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of texts."""
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"
