"""Small line charts as SVG or PNG.

Colours are named tones, so that a page can restyle them, in the dark too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from overfly.files import atomic_path
from overfly.geometry.poses import FloatArray

# tone: (on paper, in the dark)
TONES = {
    "ink": ("#20262c", "#e6e9ec"),
    "muted": ("#69737d", "#98a2ac"),
    "faint": ("#e1e4e8", "#2e353c"),
    "constraint": ("#98a1aa", "#707b86"),
    "path": ("#1668b8", "#6db3f2"),
    "truth": ("#c2571a", "#f0a06a"),
    "good": ("#2c8a57", "#5fc28d"),
    "bad": ("#c0392b", "#f07f72"),
    "paper": ("#ffffff", "#181c20"),
}
MOST_POINTS = 1500  # of one line: more cannot be seen and makes pages heavy
FONT_PX = 11.0


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """Connected points, several runs: each (n, 2) pixels of the drawing. cap: round, or butt where ends
    matter."""

    runs: tuple[FloatArray, ...]
    tone: str
    width_px: float = 1.5
    opacity: float = 1.0
    cap: str = "round"


@dataclass(frozen=True, slots=True)
class Dot:
    x: float
    y: float
    tone: str
    radius_px: float = 4.0


@dataclass(frozen=True, slots=True)
class Label:
    """Text; anchor: start, middle or end, at the baseline.

    halo: outlined in paper, to be read on a picture.
    """

    x: float
    y: float
    text: str
    anchor: str = "start"
    tone: str = "muted"
    size_px: float = FONT_PX
    halo: bool = False


Shape = Lines | Dot | Label


@dataclass(slots=True)
class Drawing:
    """Shapes in the order they are painted, on width x height pixels, y down.

    title: for those who cannot see it. stretches: to whatever size a page gives it, out of shape.
    """

    width: float
    height: float
    title: str
    shapes: list[Shape] = field(default_factory=list)
    stretches: bool = False


@dataclass(frozen=True, slots=True)
class Axes:
    """A rectangle of a drawing that shows a range of data: its place in pixels, y of the data upwards."""

    left: float
    top: float
    width: float
    height: float
    x_low: float
    x_high: float
    y_low: float
    y_high: float

    def place(self, points: FloatArray) -> FloatArray:
        """points: (n, 2) data -> (n, 2) pixels of the drawing."""
        x = self.left + (points[:, 0] - self.x_low) / (self.x_high - self.x_low) * self.width
        y = self.top + (self.y_high - points[:, 1]) / (self.y_high - self.y_low) * self.height
        return np.stack([x, y], axis=1)

    def with_equal_scales(self) -> Axes:
        """One axis widened so that a metre is as long along x as along y."""
        per_px = max((self.x_high - self.x_low) / self.width, (self.y_high - self.y_low) / self.height)
        x, y = 0.5 * (self.x_low + self.x_high), 0.5 * (self.y_low + self.y_high)
        dx, dy = 0.5 * per_px * self.width, 0.5 * per_px * self.height
        return replace(self, x_low=x - dx, x_high=x + dx, y_low=y - dy, y_high=y + dy)


def axes_around(left: float, top: float, width: float, height: float, points: FloatArray) -> Axes:
    """Axes whose range holds all finite points (n, 2), with a margin."""
    points = points[np.isfinite(points).all(axis=1)]
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(2), np.ones(2))
    margin = np.where(high > low, 0.05 * (high - low), 0.5)
    low, high = low - margin, high + margin
    return Axes(left, top, width, height, float(low[0]), float(high[0]), float(low[1]), float(high[1]))


def add_frame(drawing: Drawing, axes: Axes, x_label: str, y_label: str) -> None:
    """Grid lines at round numbers, their labels, and what the axes show."""
    bottom, right = axes.top + axes.height, axes.left + axes.width
    for value, text in ticks(axes.x_low, axes.x_high, max(2, int(axes.width / 70))):
        x = float(axes.place(np.array([[value, 0.0]]))[0, 0])
        drawing.shapes.append(Lines((np.array([[x, axes.top], [x, bottom]]),), "faint", 1.0))
        drawing.shapes.append(Label(x, bottom + 15, text, "middle"))
    for value, text in ticks(axes.y_low, axes.y_high, max(2, int(axes.height / 45))):
        y = float(axes.place(np.array([[0.0, value]]))[0, 1])
        drawing.shapes.append(Lines((np.array([[axes.left, y], [right, y]]),), "faint", 1.0))
        drawing.shapes.append(Label(axes.left - 6, y + 4, text, "end"))
    drawing.shapes.append(Label(right, bottom + 30, x_label, "end"))
    drawing.shapes.append(Label(axes.left, axes.top - 8, y_label))


def add_line(drawing: Drawing, axes: Axes, points: FloatArray, tone: str, width_px: float = 1.5) -> None:
    """A line through points (n, 2) of data, broken where they are not finite."""
    if len(points) == 0:
        return
    kept = points[:: max(1, math.ceil(len(points) / MOST_POINTS))]
    if not np.array_equal(kept[-1], points[-1]):
        kept = np.vstack([kept, points[-1]])
    finite = np.asarray(np.isfinite(kept).all(axis=1))
    pieces = np.split(np.arange(len(kept)), np.flatnonzero(np.diff(finite)) + 1)
    runs = tuple(axes.place(kept[piece]) for piece in pieces if finite[piece[0]] and len(piece) > 1)
    drawing.shapes.append(Lines(runs, tone, width_px))


def add_legend(drawing: Drawing, x: float, y: float, entries: Sequence[tuple[str, str]]) -> None:
    """entries: (text, tone), side by side, ending at x."""
    for text, tone in reversed(entries):
        x -= 6.2 * len(text)
        drawing.shapes.append(Label(x, y, text, "start", "ink"))
        drawing.shapes.append(Lines((np.array([[x - 20.0, y - 4.0], [x - 6.0, y - 4.0]]),), tone, 2.5))
        x -= 34.0


def ticks(low: float, high: float, most: int) -> list[tuple[float, str]]:
    """Round numbers in a range, at most about ``most``, and how to write them."""
    rough = (high - low) / most
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough * 0.999)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [(number * step, f"{number * step:,.{digits}f}") for number in range(first, last + 1)]


def svg(drawing: Drawing, standalone: bool = False) -> str:
    """The drawing as an <svg> element; a standalone one brings its own colours, light and dark."""
    stretch = ' preserveAspectRatio="none"' if drawing.stretches else ""
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {drawing.width:g} {drawing.height:g}" '
        f'role="img" aria-label="{escape(drawing.title)}"{stretch}>',
    ]
    if standalone:
        parts.append(f"<style>{tone_styles()}svg{{background:var(--paper)}}</style>")
    parts.extend(_svg_shape(shape) for shape in drawing.shapes)
    parts.append("</svg>")
    return "".join(parts)


def tone_styles() -> str:
    """CSS: one variable for each tone, light and dark, and the classes s-TONE (stroke) and f-TONE (fill)."""
    light = ";".join(f"--{tone}:{colours[0]}" for tone, colours in TONES.items())
    dark = ";".join(f"--{tone}:{colours[1]}" for tone, colours in TONES.items())
    classes = "".join(
        f".s-{tone}{{stroke:var(--{tone});fill:none}}.f-{tone}{{fill:var(--{tone})}}" for tone in TONES
    )
    font = "svg text{font-family:system-ui,-apple-system,'Segoe UI',Roboto,sans-serif}"
    return f":root{{{light}}}@media (prefers-color-scheme:dark){{:root{{{dark}}}}}{classes}{font}"


def write_chart(path: str | Path, drawing: Drawing) -> None:
    """Write .png, or .svg by any other name. Raises OutputError."""
    with atomic_path(path) as temporary:
        if Path(path).suffix.lower() == ".png":
            _rasterised(drawing).save(temporary)
        else:
            temporary.write_text(svg(drawing, standalone=True), encoding="utf-8")


def _svg_shape(shape: Shape) -> str:
    if isinstance(shape, Lines):
        path = "".join("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in run) for run in shape.runs)
        opacity = f' stroke-opacity="{shape.opacity:g}"' if shape.opacity < 1 else ""
        return (
            f'<path class="s-{shape.tone}" d="{path}" stroke-width="{shape.width_px:g}" '
            f'stroke-linejoin="round" stroke-linecap="{shape.cap}"{opacity}/>'
        )
    if isinstance(shape, Dot):
        return (
            f'<circle class="f-{shape.tone}" cx="{shape.x:.1f}" cy="{shape.y:.1f}" r="{shape.radius_px:g}"/>'
        )
    halo = ' style="paint-order:stroke;stroke:var(--paper);stroke-width:.3em"' if shape.halo else ""
    return (
        f'<text class="f-{shape.tone}"{halo} x="{shape.x:.1f}" y="{shape.y:.1f}" '
        f'font-size="{shape.size_px:g}" text-anchor="{shape.anchor}">{escape(shape.text)}</text>'
    )


def _rasterised(drawing: Drawing, factor: int = 4) -> Image.Image:
    """The drawing on white at twice its size, averaged from twice that again, so that lines are smooth."""
    size = (round(drawing.width * factor), round(drawing.height * factor))
    image = Image.new("RGB", size, TONES["paper"][0])
    draw = ImageDraw.Draw(image)
    anchors = {"start": "ls", "middle": "ms", "end": "rs"}
    for shape in drawing.shapes:
        colour = TONES[shape.tone][0]
        if isinstance(shape, Lines):
            for run in shape.runs:
                points = [(float(x) * factor, float(y) * factor) for x, y in run]
                draw.line(points, fill=colour, width=max(1, round(shape.width_px * factor)), joint="curve")
        elif isinstance(shape, Dot):
            x, y, radius = shape.x * factor, shape.y * factor, shape.radius_px * factor
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)
        else:
            font = ImageFont.load_default(size=shape.size_px * factor)
            place = (shape.x * factor, shape.y * factor)
            draw.text(place, shape.text, fill=colour, font=font, anchor=anchors[shape.anchor])
    return image.resize((size[0] // 2, size[1] // 2), Image.Resampling.BOX)
