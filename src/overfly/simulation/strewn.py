"""Kinds of small things that lie about, ready to be strewn on a layer."""

from overfly.simulation.scatter import Outline, Scatter

BLADES = Scatter(
    Outline.BLADE, 2200, (0.03, 0.09), (0.03, 0.06),
    ((0.10, 0.16, 0.04), (0.16, 0.21, 0.07), (0.045, 0.085, 0.02), (0.24, 0.23, 0.11)),
)  # fmt: skip
CLOVER = Scatter(
    Outline.ELLIPSE, 9.0, (0.02, 0.09), (0.7, 1.0), ((0.035, 0.075, 0.022), (0.05, 0.10, 0.035)), shadow=0.1
)
MOLEHILLS = Scatter(
    Outline.ELLIPSE, 0.05, (0.12, 0.35), (0.7, 1.0), ((0.09, 0.065, 0.045), (0.07, 0.05, 0.035))
)
LEAVES = Scatter(
    Outline.LEAF, 2.5, (0.03, 0.11), (0.3, 0.5),
    ((0.30, 0.17, 0.06), (0.22, 0.12, 0.05), (0.12, 0.09, 0.05), (0.36, 0.30, 0.12)), shadow=0.15,
)  # fmt: skip
DAISIES = Scatter(Outline.ELLIPSE, 6.0, (0.012, 0.025), (0.8, 1.0), ((0.75, 0.75, 0.70), (0.70, 0.60, 0.12)))
PEBBLES = Scatter(
    Outline.ELLIPSE, 14.0, (0.008, 0.035), (0.6, 1.0),
    ((0.38, 0.37, 0.35), (0.22, 0.20, 0.18), (0.50, 0.48, 0.44)), shadow=0.3,
)  # fmt: skip
GRAVEL = Scatter(
    Outline.ELLIPSE, 1500.0, (0.012, 0.04), (0.6, 1.0),
    ((0.30, 0.29, 0.27), (0.19, 0.18, 0.165), (0.42, 0.40, 0.37), (0.26, 0.22, 0.18)), shadow=0.25,
)  # fmt: skip
TWIGS = Scatter(
    Outline.RECTANGLE, 0.7, (0.08, 0.30), (0.02, 0.05), ((0.10, 0.07, 0.045), (0.18, 0.14, 0.10)), shadow=0.08
)
LITTER = Scatter(
    Outline.RECTANGLE, 0.25, (0.03, 0.12), (0.4, 1.0),
    ((0.70, 0.70, 0.68), (0.15, 0.22, 0.42), (0.50, 0.10, 0.08), (0.55, 0.50, 0.12)), shadow=0.1,
)  # fmt: skip
SPOTS = Scatter(Outline.ELLIPSE, 1.6, (0.02, 0.10), (0.5, 1.0), ((0.05, 0.05, 0.05), (0.09, 0.085, 0.08)))
BUSHES = Scatter(
    Outline.ELLIPSE, 0.02, (0.6, 2.2), (0.7, 1.0), ((0.035, 0.055, 0.018), (0.045, 0.065, 0.02)), shadow=0.25
)
TUFTS = Scatter(
    Outline.ELLIPSE,
    0.9,
    (0.10, 0.45),
    (0.6, 1.0),
    ((0.06, 0.09, 0.03), (0.17, 0.16, 0.07), (0.10, 0.13, 0.045)),
)
STONES = Scatter(
    Outline.ELLIPSE, 0.05, (0.15, 0.8), (0.6, 1.0), ((0.36, 0.35, 0.33), (0.24, 0.23, 0.22)), shadow=0.4
)
WEEDS = Scatter(
    Outline.ELLIPSE,
    0.12,
    (0.10, 0.9),
    (0.4, 1.0),
    ((0.06, 0.085, 0.03), (0.16, 0.15, 0.075), (0.09, 0.11, 0.045)),
    0.4,
)
