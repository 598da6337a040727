"""A finished map in a real browser: it is there, in its colours, at its place; the slider and clicks work."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from affine import Affine
from playwright.sync_api import Browser
from tests.exports.world import write_map
from tests.viewer.conftest import Visit, on_screen, visiting

from overfly.errors import OutputError
from overfly.mapstore import Map
from overfly.products.cog import RasterFrame, cloud_optimised_geotiff
from overfly.products.elevation import ElevationGrid, write_elevation
from overfly.products.georeference import GeoReference, transform_points
from overfly.viewer.finished import FinishedView, FlownPath, set_value, view_map

RED, GREEN, BLUE, WHITE = (200, 40, 40), (40, 180, 40), (40, 60, 200), (230, 230, 230)
LOW, HIGH, EDGE = np.array([-1.0, -2.0]), np.array([7.0, 3.0]), np.array([2.5, 0.5])
GROUND_M = 0.2
GSD_M = 0.02


def colour_at(xy: np.ndarray) -> np.ndarray:
    """(..., 3): one colour for each quarter of the ground."""
    east, north = xy[..., 0] > EDGE[0], xy[..., 1] > EDGE[1]
    quarters = np.array([RED, GREEN, BLUE, WHITE], np.uint8)
    return quarters[east.astype(int) + 2 * north.astype(int)]


def write_ground(folder: Path, reference: GeoReference) -> None:
    """mosaic.tif and elevation.tif as overfly map leaves them: north-up, empty beyond the map."""
    to_crs = reference.crs_from_world()
    corners = transform_points(
        to_crs, np.array([[x, y] for x in (LOW[0], HIGH[0]) for y in (LOW[1], HIGH[1])])
    )
    left, top = corners[:, 0].min(), corners[:, 1].max()
    width, height = np.ceil((np.ptp(corners, axis=0)) / GSD_M).astype(int)
    crs_from_pixel = Affine(GSD_M, 0.0, left, 0.0, -GSD_M, top)
    px = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    world = transform_points(~to_crs @ crs_from_pixel, px)
    inside = ((world >= LOW) & (world <= HIGH)).all(axis=-1)
    bands = np.concatenate([colour_at(world), 255 * inside[..., None]], axis=-1).astype(np.uint8)
    bands[~inside] = 0
    frame = RasterFrame(reference.crs, crs_from_pixel, int(width), int(height))
    with cloud_optimised_geotiff(folder / "mosaic.tif", frame) as raster:
        raster.write(bands)
    heights = np.full((20, 20), GROUND_M, np.float32)
    grid = ElevationGrid(-4.0, 6.0, 0.7, heights, np.full_like(heights, 0.01))
    north_up = GeoReference(reference.crs, reference.scale, 0.0, reference.translation_m)
    write_elevation(folder / "elevation.tif", grid, north_up)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("map")


@pytest.fixture(scope="module")
def known(folder: Path) -> Map:
    found = write_map(folder)
    assert found.georeference is not None
    write_ground(folder, found.georeference)
    return found


@pytest.fixture(scope="module")
def view(known: Map, folder: Path) -> Iterator[FinishedView]:
    shown = view_map(known, folder, 0)
    yield shown
    shown.close()


@pytest.fixture(scope="module")
def seen(view: FinishedView, browser: Browser) -> Iterator[Visit]:
    """The page, open for all tests: loading it takes most of their time."""
    with visiting(browser) as open_page:
        visit = open_page(view.page.url)
        visit.wait_until_ready(view.page.server, "scale from range")
        yield visit


def places_on_the_ground() -> np.ndarray:
    """(k, 2) well inside the quarters and away from the path, which runs along y = 0.1 x."""
    return np.array([[x, y] for x in (0.0, 1.5, 4.0, 5.5) for y in (-1.4, -0.8, 1.6, 2.4)])


def test_the_map_is_there_in_its_colours_and_nobody_else_is_asked(view: FinishedView, seen: Visit) -> None:
    server = view.page.server

    def in_its_colours() -> bool:
        picture = seen.picture().astype(int)
        pixels = [on_screen(server, (x, y, GROUND_M)) for x, y in places_on_the_ground()]
        found = np.array([picture[round(row), round(column)] for column, row in pixels])
        off = np.abs(found - colour_at(places_on_the_ground()).astype(int)).max(axis=1)
        return bool(np.count_nonzero(off < 60) >= len(off) - 2)  # a line of the map may stand before a few

    seen.wait_until(in_its_colours, "the quarters of the mosaic in their colours, at their places")
    picture = seen.picture().astype(int)
    column, row = on_screen(server, (-3.0, -3.0, GROUND_M))  # beyond the map: nothing but the background
    assert picture[round(row), round(column)].max() < 80
    assert seen.asked == {"127.0.0.1"}
    assert seen.failures == []


def is_at(view: FinishedView, frame: int) -> bool:
    """The page is drawn by another thread, which writes the numbers first and moves the vehicle then."""
    return np.allclose(view.vehicle_position(), view.path.positions[frame], atol=1e-6)


def test_the_slider_takes_the_vehicle_back(view: FinishedView, seen: Visit) -> None:
    slider = seen.page.get_by_role("slider").first
    slider.wait_for(timeout=60_000)
    assert "6 nodes" in seen.text()
    slider.focus()
    seen.page.keyboard.press("Home")
    seen.wait_until(lambda: view.slider.value == 0.0, "the slider at its beginning")
    seen.wait_until(lambda: "1 nodes" in seen.text(), "the map as it was with one node")
    seen.wait_until(lambda: is_at(view, 0), "the vehicle where it began")
    seen.page.keyboard.press("End")
    seen.wait_until(lambda: "6 nodes" in seen.text(), "the whole map again")
    seen.wait_until(lambda: is_at(view, -1), "the vehicle where it ended")


def test_the_path_keeps_its_colour_when_it_grows(view: FinishedView, seen: Visit) -> None:
    def of_the_path() -> int:
        red, green, blue = seen.picture().astype(int).transpose(2, 0, 1)
        return int(np.count_nonzero((red > 170) & (green > 130) & (blue < 0.6 * green)))

    set_value(view.slider, float(view.path.t_s[3]))
    seen.wait_until(lambda: is_at(view, 3), "the vehicle at its fourth frame")
    seen.wait_until(lambda: of_the_path() > 20, "the beginning of the path in its colour")
    short = of_the_path()
    set_value(view.slider, view.slider.max)
    seen.wait_until(lambda: of_the_path() > 2 * short, "the whole path in its colour")


def test_play_moves_on_by_itself(view: FinishedView, seen: Visit, monkeypatch: pytest.MonkeyPatch) -> None:
    button = seen.page.get_by_role("button", name="Play")
    button.wait_for(timeout=60_000)
    rows: list[int] = []
    draw = view.show_time

    def show_time(t_s: float) -> None:
        if not rows or rows[-1] != view.path.row_at(t_s):
            rows.append(view.path.row_at(t_s))
        draw(t_s)

    monkeypatch.setattr(view, "show_time", show_time)
    button.click()
    seen.wait_until(lambda: min(rows, default=11) <= 2, "the slider back at the start")
    played = rows.index(min(rows))
    seen.wait_until(lambda: rows[-1] == 11, "the flight played to its end")
    assert len(rows[played:]) >= 4
    assert rows[played:] == sorted(rows[played:])
    seen.page.get_by_role("button", name="Play").wait_for(timeout=10_000)  # and no longer 'Pause'


def test_clicks_tell_coordinates_and_distance(view: FinishedView, seen: Visit) -> None:
    server = view.page.server
    first, second = (0.5, -1.2, GROUND_M), (3.5, 1.5, GROUND_M)
    text = seen.page.get_by_text(re.compile(r"distance \d"))
    for place in (first, second):
        column, row = on_screen(server, place)
        seen.page.mouse.click(column, row)
        seen.wait_until(lambda place=place: nearly(place, seen.text()), f"the click at {place} is told")
    text.first.wait_for(timeout=60_000)
    distance = float(re.findall(r"distance ([\d.]+) m", seen.text())[0])
    assert distance == pytest.approx(np.hypot(3.0, 2.7), abs=0.06)
    assert "EPSG:32635" in seen.text()


def nearly(place: tuple[float, float, float], content: str) -> bool:
    """Whether the page names coordinates within two pixels or so of the place."""
    found = re.findall(r"x (-?[\d.]+) m, y (-?[\d.]+) m, z (-?[\d.]+) m", content)
    return any(np.allclose([float(word) for word in words], place, atol=0.05) for words in found)


def test_a_port_that_is_taken_is_one_clear_line(view: FinishedView, known: Map, folder: Path) -> None:
    port = view.page.server.get_port()
    with pytest.raises(OutputError, match=rf"port {port} is in use"):
        view_map(known, folder, port)


def test_the_path_of_a_map_is_that_of_its_frames(tmp_path: Path) -> None:
    known = write_map(tmp_path)
    path = FlownPath.of(known)
    assert len(path.t_s) == len(known.frames)
    assert (np.diff(path.t_s) > 0).all()
    assert path.n_nodes.tolist() == [1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6]
    for row, t_s in enumerate(path.t_s):
        assert path.row_at(float(t_s)) == row
        assert path.row_at(float(t_s) + 0.05) == row
    np.testing.assert_allclose(path.positions[::2], known.visual.graph.positions, atol=1e-12)
