"""The report and its charts: complete, self-contained, and true to the numbers."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from overfly.evaluation import Align, evaluate
from overfly.products.charts import Dot, Drawing, Label, axes_around, svg, ticks, write_chart
from overfly.products.cog import RasterFrame, cloud_optimised_geotiff
from overfly.products.elevation import ElevationGrid
from overfly.products.figures import (
    are_radial,
    draw_evaluation,
    located_strip,
    path_from_above,
    path_over_picture,
)
from overfly.products.georeference import GeoReference
from overfly.products.perspective import PerspectiveView
from overfly.products.pictures import MapPicture, elevation_picture, map_picture
from overfly.products.report import (
    ElevationPicture,
    Figure,
    LandmarkRow,
    ReportData,
    RevisitCounts,
    SensorUse,
    StageTiming,
    write_report,
)
from overfly.trajectory import Trajectory

VOID = {"meta", "img", "br", "path", "circle"}


def circle(n: int = 200, radius: float = 5.0, noise: float = 0.0) -> Trajectory:
    angle = np.linspace(0, 2 * np.pi, n)
    positions = np.stack([radius * np.cos(angle), radius * np.sin(angle), 2 + 0.1 * angle], axis=1)
    positions += np.random.default_rng(0).normal(0, noise, positions.shape) if noise else 0.0
    return Trajectory(np.arange(n) * 100_000_000, positions, np.tile([1.0, 0, 0, 0], (n, 1)))


def picture() -> MapPicture:
    rgba = np.full((240, 320, 4), 128, np.uint8)
    return MapPicture(rgba, Affine(0.05, 0, -8.0, 0, -0.05, 6.0))


def full_report() -> ReportData:
    truth = circle()
    located = np.ones(200, dtype=bool)
    located[50:60] = False
    grid = ElevationGrid(
        0.0,
        5.0,
        0.5,
        np.random.default_rng(0).normal(0, 1, (10, 12)).astype(np.float32),
        np.zeros((10, 12), np.float32),
    )
    return ReportData(
        title="Flight <3 & co",
        subtitle="200 frames",
        numbers=(Figure("Frames located", "190 of 200", "95 %"), Figure("Path", "31.4 m")),
        trajectory=circle(noise=0.02),
        odometry=circle(radius=5.5),
        constraints_ns=np.stack([truth.t_ns[:-1], truth.t_ns[1:]], axis=1),
        frame_ns=truth.t_ns,
        located=located,
        scale_source="stereo baseline",
        command="overfly map flight -o out",
        version="0.1.0",
        lost_reasons=(("too few matches", 10),),
        warnings=("10 frames were lost.",),
        mosaic=picture(),
        elevation=ElevationPicture(elevation_picture(grid), -1.0, 1.0),
        evaluation=evaluate(circle(noise=0.02), truth, Align.SE3),
        stages=(StageTiming("features", 4.0, 6.0, 20.0), StageTiming("matching", 1.0, 2.0, 3.0)),
        sensors=(SensorUse("attitude0", True, "prior"), SensorUse("imu0", False, "not needed")),
        landmarks=(LandmarkRow("A", (1.0, 2.0, 0.0), 0.01, 0.02), LandmarkRow("B", (3.0, 2.0, 0.0), 0.01)),
        settings="features:\n  count: 500\n",
        ellipses=(np.array([[4.9, 0.0], [5.0, 0.125], [5.1, 0.0], [4.9, 0.0]]),),
        revisits=RevisitCounts(14, 9, (("too few matches", 3), ("disagrees with its neighbours", 2))),
        perspective=PerspectiveView(picture().rgba, 2.5),
        products_s=(("elevation", 1.25), ("mosaic", 2.0)),
    )


class Balance(HTMLParser):
    """Fails on tags that are not closed in order; collects what is referred to."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.references: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.references += [
            value or "" for name, value in attrs if name in ("src", "href", "srcset", "action")
        ]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag


def test_a_mosaic_that_is_turned_to_north_is_said(tmp_path: Path) -> None:
    for turn_deg, words in (
        (0.0, None),
        (30.0, "30 degrees to the left of y"),
        (-75.0, "75 degrees to the right"),
    ):
        shown = replace(picture(), world_from_pixel=Affine.rotation(turn_deg) @ picture().world_from_pixel)
        write_report(tmp_path / "report.html", replace(full_report(), mosaic=shown))
        page = (tmp_path / "report.html").read_text(encoding="utf-8")
        assert ("north" in page) == (words is not None)
        assert words is None or words in page


def test_page_is_whole_closed_and_asks_for_nothing(tmp_path: Path) -> None:
    write_report(tmp_path / "report.html", full_report())
    page = (tmp_path / "report.html").read_text()
    parser = Balance()
    parser.feed(page)
    assert parser.open == []
    assert parser.references
    assert all(reference.startswith("data:") for reference in parser.references)
    assert "<script" not in page
    assert not re.search(r"url\((?!data:)|@import", page)
    for words in (
        "Flight &lt;3 &amp; co",
        "190 of 200",
        "stereo baseline",
        "too few matches: 10",
        "overfly map flight -o out",
        "10 frames were lost.",
        "Visual odometry alone",
        "count: 500",
        "the largest is 0.2 m across",
        "<td>believed</td><td>9</td>",
        "<td>disagrees with its neighbours</td><td>2</td>",
        "14 times a place",
        "raised 2.5 times",
        "elevation 1.2 s, mosaic 2.0 s.",
    ):
        assert words in page
    assert "nan" not in re.sub(r"base64,[^\"]*", "", page).lower()
    for drawing in re.findall(r"<svg.*?</svg>", page, re.S):
        ElementTree.fromstring(drawing)


def test_page_without_the_optional_parts(tmp_path: Path) -> None:
    nothing = Trajectory(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 4)))
    data = ReportData(
        title="Nothing found",
        subtitle="",
        numbers=(),
        trajectory=nothing,
        odometry=nothing,
        constraints_ns=np.zeros((0, 2), np.int64),
        frame_ns=np.arange(3),
        located=np.zeros(3, dtype=bool),
        scale_source="none",
        command="overfly map x -o y",
        version="0",
        mosaic=picture(),
    )
    write_report(tmp_path / "report.html", data)
    page = (tmp_path / "report.html").read_text()
    assert "0 of 3 frames located" in page
    assert "Against the truth" not in page


@given(st.floats(-1e4, 1e4), st.floats(1e-3, 1e5), st.integers(2, 12))
def test_ticks_are_round_inside_and_neither_few_nor_many(low: float, span: float, most: int) -> None:
    found = ticks(low, low + span, most)
    assert 1 <= len(found) <= most + 1 or most == 2
    values = np.array([value for value, _ in found])
    assert (values >= low - 1e-6 * span - 1e-9).all()
    assert (values <= low + span + 1e-6 * span + 1e-9).all()
    assert len({text for _, text in found}) == len(found)
    for value, text in found:
        assert float(text.replace(",", "")) == pytest.approx(value, abs=1e-9 + 1e-6 * span)


def test_equal_scales_keep_circles_round() -> None:
    axes = axes_around(0, 0, 400, 100, np.array([[0.0, 0.0], [10.0, 10.0]])).with_equal_scales()
    placed = axes.place(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    assert placed[1, 0] - placed[0, 0] == pytest.approx(placed[0, 1] - placed[2, 1])
    assert (placed >= 0).all()


def test_constraints_are_drawn_between_the_frames_they_join() -> None:
    trajectory = circle()
    ends = np.array(
        [[trajectory.t_ns[0], trajectory.t_ns[100]], [trajectory.t_ns[5], 123]]
    )  # the second is not known
    drawing = path_from_above(trajectory, ends, trajectory.positions[:, :2], "x")
    constraints = next(shape for shape in drawing.shapes if getattr(shape, "tone", "") == "constraint")
    assert len(constraints.runs) == 1
    length_px = np.linalg.norm(np.diff(constraints.runs[0], axis=0))
    across_px = 10.0 / 11.0 * (460 - 60)  # the circle's diameter in a range 1.1 times as large
    assert length_px == pytest.approx(across_px, rel=0.02)


@pytest.mark.parametrize(("width_m", "height_m"), [(100.0, 1.0), (1.0, 100.0), (10.0, 14.0), (7.0, 0.0)])
def test_a_path_is_as_large_as_the_figure_allows(width_m: float, height_m: float) -> None:
    corners = np.array([[0.0, 0.0], [width_m, height_m]])
    drawing = path_from_above(circle(2), np.zeros((0, 2), np.int64), corners, "x")
    assert drawing.width == 460
    assert 240 <= drawing.height <= 640
    axes = axes_around(48.0, 26.0, 400.0, drawing.height - 62.0, corners).with_equal_scales()
    size_px = np.abs(np.diff(axes.place(corners), axis=0))[0]
    free = [size_px[0] / 400.0, size_px[1] / (drawing.height - 62.0)]
    assert max(free) == pytest.approx(1 / 1.1, rel=0.02)


def test_named_places_stand_on_the_picture() -> None:
    ground = picture()
    names = [("A", ground.pixels_from_world(np.array([[0.0, 0.0]]))[0])]
    drawing = path_over_picture(np.zeros((0, 2)), 320, 240, 0.05, names)
    dot = next(shape for shape in drawing.shapes if isinstance(shape, Dot) and shape.tone == "truth")
    assert (dot.x, dot.y) == pytest.approx((160, 120))
    label = next(shape for shape in drawing.shapes if isinstance(shape, Label) and shape.text == "A")
    assert label.halo
    assert 160 < label.x < 175


def test_path_lies_on_the_picture_where_the_camera_was() -> None:
    ground = picture()
    np.testing.assert_allclose(
        ground.pixels_from_world(np.array([[-8.0, 6.0], [0.0, 0.0]])), [[0, 0], [160, 120]]
    )
    assert ground.metres_per_px == pytest.approx(0.05)
    drawing = path_over_picture(ground.pixels_from_world(circle().positions[:, :2]), 320, 240, 0.05)
    line = next(shape for shape in drawing.shapes if getattr(shape, "tone", "") == "path")
    np.testing.assert_allclose(line.runs[0][0], [260, 120], atol=1e-6)
    label = next(shape for shape in drawing.shapes if isinstance(shape, Label))
    assert label.text == "2 m"  # the largest round length within 30 % of 16 m, 1-2-5


def test_strip_shows_one_lost_frame_of_many() -> None:
    located = np.ones(100_000, dtype=bool)
    located[5000] = False
    drawing = located_strip(np.arange(100_000), located)
    lost = next(shape for shape in drawing.shapes if shape.tone == "bad")
    assert len(lost.runs) == 1
    assert 1.0 <= np.ptp(lost.runs[0][:, 0]) <= 3.0
    assert lost.cap == "butt"  # round ends would make it look like hundreds


def test_elevation_picture_is_transparent_where_unknown() -> None:
    heights = np.arange(100, dtype=np.float32).reshape(10, 10)
    heights[0, 0] = np.nan
    shown = elevation_picture(ElevationGrid(0, 10, 1, heights, heights)).rgba
    assert shown[0, 0, 3] == 0
    assert (shown[1:, 1:, 3] == 255).all()
    assert shown[9, 9, :3].sum() > shown[0, 1, :3].sum()  # light is high


def test_level_ground_does_not_look_like_hills() -> None:
    """Of 5 mm that are known to 5 mm little is seen; hills of 5 m take all colours, and the page says so."""
    noise = np.random.default_rng(2).normal(0.0, 1.0, (40, 40)).astype(np.float32)
    sigma = np.full_like(noise, 0.005)
    level, hills = (ElevationGrid(0, 10, 1, 3.0 + size * noise, sigma) for size in (0.005, 5.0))
    seen = [np.ptp(elevation_picture(grid).rgba[..., 2].astype(float)) for grid in (level, hills)]
    assert seen[0] < 0.75 * seen[1]
    low, high = level.shown_range_m()
    assert high - low == pytest.approx(0.06)
    assert 0.5 * (low + high) == pytest.approx(3.0, abs=0.003)
    low, high = hills.shown_range_m()
    assert (low, high) == pytest.approx(tuple(np.percentile(hills.heights, [2, 98])))
    nowhere = ElevationGrid(
        0, 10, 1, np.full((2, 2), np.nan, np.float32), np.full((2, 2), np.nan, np.float32)
    )
    assert not elevation_picture(nowhere).rgba[..., 3].any()


@pytest.mark.parametrize("suffix", ["svg", "png"])
def test_evaluation_is_drawn(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"plot.{suffix}"
    draw_evaluation(path, evaluate(circle(noise=0.05), circle(), Align.SE3))
    if suffix == "png":
        with Image.open(path) as image:
            assert image.width == 920
            assert image.height == pytest.approx(2 * (460 - 60 + 62 + 300), rel=0.03)  # a circle is square
            assert len(image.convert("P").getcolors()) > 10
    else:
        root = ElementTree.parse(path).getroot()
        assert "prefers-color-scheme" in ElementTree.tostring(root, "unicode")


def test_text_in_drawings_is_escaped(tmp_path: Path) -> None:
    drawing = Drawing(100, 50, 'a "quoted" <title>', [Label(1, 2, "<b> & c")])
    ElementTree.fromstring(svg(drawing))
    write_chart(tmp_path / "a.svg", drawing)
    assert "&lt;b&gt; &amp; c" in (tmp_path / "a.svg").read_text()
    assert math.isclose(drawing.width, 100)


def test_mosaic_file_becomes_a_picture_in_world_coordinates(tmp_path: Path) -> None:
    reference = GeoReference("EPSG:32635", 1.0, 0.0, (1000.0, 2000.0, 0.0))
    frame = RasterFrame(reference.crs, Affine(0.1, 0, 990, 0, -0.1, 2020), 800, 600)
    with cloud_optimised_geotiff(tmp_path / "m.tif", frame) as raster:
        raster.write(np.full((600, 800, 4), 255, np.uint8))
    shown = map_picture(tmp_path / "m.tif", reference, longest_px=200)
    assert shown.rgba.shape == (150, 200, 4)
    np.testing.assert_allclose(
        shown.pixels_from_world(np.array([[-10.0, 20.0], [70.0, -40.0]])), [[0, 0], [200, 150]], atol=1e-6
    )


@given(st.floats(0.0, 3.1), st.floats(0.2, 5.0), st.floats(-1e3, 1e3))
def test_ellipses_that_point_outwards_tell_of_the_size(turn: float, long: float, x: float) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 33)
    circle = np.column_stack([long * np.cos(angle), 0.2 * long * np.sin(angle)])

    def around(beside: float) -> list[np.ndarray]:
        """Twelve ellipses on a ring, turned from the way outwards."""
        found = []
        for way in turn + np.arange(12) * np.pi / 6:
            (c, s), out = (np.cos(way + beside), np.sin(way + beside)), [np.cos(way), np.sin(way)]
            found.append(circle @ np.array([[c, s], [-s, c]]) + 30.0 * np.array(out) + [x, 0.0])
        return found

    assert are_radial(around(0.0))
    assert not are_radial(around(0.5 * np.pi))
    assert not are_radial(around(0.8))
    assert not are_radial(around(0.0)[:3])
