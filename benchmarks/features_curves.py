"""Robustness curves: correct matches over one change at a time, drawn as a small plain SVG."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from features_pairs import Change, evaluate, make_pair

from overfly.vision.features import Extractor

# Title of each panel, the field of Change that is varied, its values.
SWEEPS: dict[str, tuple[str, tuple[float, ...]]] = {
    "motion blur, px": ("blur_px", (0, 3, 6, 9, 12, 16, 20)),
    "noise, grey levels": ("noise_sigma", (0, 2, 4, 8, 12, 16, 20)),
    "contrast": ("contrast", (0.1, 0.15, 0.25, 0.4, 0.6, 0.8, 1.0)),
    "rotation, degrees": ("rotation_deg", (0, 15, 30, 45, 60, 90, 120, 150, 180)),
    "scale, octaves": ("octaves", (-1.0, -0.7, -0.4, -0.2, 0.0, 0.2, 0.4, 0.7, 1.0)),
    "tilt, degrees": ("tilt_deg", (0, 10, 20, 30, 40, 50)),
}
COLOURS = ("#0b6e99", "#d1495b", "#edae49", "#2e7d4f", "#6a4c93")
PANEL_WIDTH, PANEL_HEIGHT, MARGIN = 250, 170, 42
Curves = dict[
    str, dict[str, list[float]]
]  # panel -> extractor -> mean number of correct matches at each value


def measure_curves(
    extractors: list[Extractor], pictures: dict[str, list[np.ndarray]], size: tuple[int, int], seed: int
) -> Curves:
    """Mean number of correct matches over all pictures, for every value of every sweep."""
    curves: Curves = {}
    for title, (field, values) in SWEEPS.items():
        curves[title] = {extractor.name: [] for extractor in extractors}
        for value in values:
            rng = np.random.default_rng(seed)
            base = Change(noise_sigma=1.0, shift_px=(7.3, -4.6), rotation_deg=3.0, blur_direction_deg=30.0)
            changed: dict[str, Any] = {field: value}
            change = replace(base, **changed)
            pairs = [
                make_pair(picture, size, change, rng, group, title)
                for group, members in pictures.items()
                for picture in members
            ]
            for extractor in extractors:
                correct = [evaluate(extractor, pair).correct for pair in pairs]
                curves[title][extractor.name].append(float(np.mean(correct)))
        print(f"{title} done", flush=True)
    return curves


def draw_curves(curves: Curves, file: Path) -> None:
    """Writes the panels, three in a row, with one legend below."""
    top = 1.05 * max(max(line) for panel in curves.values() for line in panel.values())
    rows = -(-len(curves) // 3)
    width, height = 3 * (PANEL_WIDTH + MARGIN) + 20, rows * (PANEL_HEIGHT + 2 * MARGIN) + 30
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        'font-family="sans-serif" font-size="11">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
    ]
    for k, (title, panel) in enumerate(curves.items()):
        left, upper = MARGIN + (k % 3) * (PANEL_WIDTH + MARGIN), 24 + (k // 3) * (PANEL_HEIGHT + 2 * MARGIN)
        parts += _panel(title, panel, SWEEPS[title][1], top, left, upper)
    names = list(next(iter(curves.values())))
    for k, name in enumerate(names):
        x, y = MARGIN + 150 * k, height - 14
        parts.append(f'<path d="M{x} {y - 4}h22" stroke="{COLOURS[k]}" stroke-width="2.5"/>')
        parts.append(f'<text x="{x + 28}" y="{y}">{name}</text>')
    file.write_text("\n".join([*parts, "</svg>"]) + "\n")


def _panel(
    title: str,
    panel: dict[str, list[float]],
    values: tuple[float, ...],
    top: float,
    left: float,
    upper: float,
) -> list[str]:
    lower = upper + PANEL_HEIGHT
    span = values[-1] - values[0]

    def x_of(value: float) -> float:
        return left + PANEL_WIDTH * (value - values[0]) / span

    def y_of(correct: float) -> float:
        return lower - PANEL_HEIGHT * correct / top

    parts = [f'<text x="{left + PANEL_WIDTH / 2:.0f}" y="{lower + 30}" text-anchor="middle">{title}</text>']
    for level in range(0, int(top) + 1, 50):
        y = y_of(level)
        parts.append(f'<path d="M{left} {y:.1f}h{PANEL_WIDTH}" stroke="#ddd"/>')
        parts.append(f'<text x="{left - 5}" y="{y + 4:.1f}" text-anchor="end">{level}</text>')
    parts += [
        f'<text x="{x_of(value):.1f}" y="{lower + 15}" text-anchor="middle">{value:g}</text>'
        for value in (values[0], values[len(values) // 2], values[-1])
    ]
    for colour, line in zip(COLOURS, panel.values(), strict=False):
        points = " ".join(f"{x_of(v):.1f},{y_of(c):.1f}" for v, c in zip(values, line, strict=True))
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2"/>')
    return parts
