"""The map over another one: put in the right place, with residuals that tell who disagrees."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
import yaml
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st
from tests.exports.world import REFERENCE, write_map

from overfly.cli import main
from overfly.errors import SourceError
from overfly.products.cog import RasterFrame, cloud_optimised_geotiff
from overfly.products.georeference import GeoReference, transform_points
from overfly.products.overlay import fit_plane, read_other_map

SPOT = (3.0, 1.0)  # world, metres: a red square of half a metre


def write_mosaic_with_spot(folder: Path, reference: GeoReference) -> None:
    """Grey ground from (-1, -2) to (7, 3), 5 cm a pixel, and the red spot."""
    step = 0.05
    rgba = np.full((100, 160, 4), 255, np.uint8)
    rgba[..., :3] = 90
    x, y = np.meshgrid(-1 + (np.arange(160) + 0.5) * step, 3 - (np.arange(100) + 0.5) * step)
    rgba[(np.abs(x - SPOT[0]) < 0.25) & (np.abs(y - SPOT[1]) < 0.25), :3] = (250, 0, 0)
    transform = reference.crs_from_world() @ Affine(step, 0, -1, 0, -step, 3)
    frame = RasterFrame(reference.crs, transform, 160, 100)
    with cloud_optimised_geotiff(folder / "mosaic.tif", frame) as raster:
        raster.write(rgba)


def middle_of_red(path: Path) -> tuple[float, float]:
    """Coordinates of the red spot in a raster, as GDAL reads its place."""
    with rasterio.open(path) as raster:
        red, green, _, alpha = raster.read()
        rows, columns = np.nonzero((red > 180) & (green < 80) & (alpha > 0))
        assert len(rows) > 20
        x, y = raster.transform @ (columns.mean() + 0.5, rows.mean() + 0.5)
        return float(x), float(y)


@given(
    scale=st.floats(0.01, 50), turn=st.floats(-3.1, 3.1),
    shift=st.tuples(st.floats(-1e3, 1e3), st.floats(-9, 9)), seed=st.integers(0, 99), count=st.integers(2, 8),
)  # fmt: skip
def test_a_similarity_is_found_exactly(
    scale: float, turn: float, shift: tuple[float, float], seed: int, count: int
) -> None:
    world = np.random.default_rng(seed).uniform(-10, 10, (count, 2))
    true = Affine.translation(*shift) @ Affine.rotation(np.degrees(turn)) @ Affine.scale(scale)
    xy = transform_points(true, world)
    fit = fit_plane(world, xy)
    np.testing.assert_allclose(transform_points(fit.xy_from_world, world), xy, atol=1e-6 * scale + 1e-9)
    assert fit.rms < 1e-6 * scale + 1e-9


def test_one_place_is_not_enough() -> None:
    with pytest.raises(SourceError, match="two points"):
        fit_plane(np.zeros((3, 2)), np.random.default_rng(0).normal(size=(3, 2)))


def plan_of(folder: Path) -> tuple[Path, Affine]:
    """A floor plan of 2 cm a pixel in its own coordinates, as a PNG with a world file, and those coordinates
    of the world."""
    xy_from_world = Affine.translation(20.0, 10.0) @ Affine.rotation(30.0)
    path = folder / "plan.png"
    cv2.imwrite(str(path), np.full((700, 900), 230, np.uint8))
    numbers = (0.02, 0, 0, -0.02, 14.01, 18.99)
    path.with_suffix(".pgw").write_text("\n".join(map(str, numbers)) + "\n")
    return path, xy_from_world


@pytest.mark.parametrize("name", ["over.png", "over.tif"])
def test_points_put_the_map_in_its_place(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write_map(tmp_path, None)
    write_mosaic_with_spot(tmp_path, GeoReference.local())
    plan, xy_from_world = plan_of(tmp_path)
    places = {"A": (0.0, 0.0), "B": (5.0, 0.5), "C": (1.0, 2.0)}
    landmarks = {key: {"x_m": x, "y_m": y, "z_m": 0.0} for key, (x, y) in places.items()}
    (tmp_path / "landmarks.json").write_text(json.dumps(landmarks))
    rows = [f"{key},{x},{y}" for key, (x, y) in ((k, xy_from_world @ v) for k, v in places.items())]
    (tmp_path / "points.csv").write_text("name,x,y\n" + "\n".join(rows) + "\n")
    out = tmp_path / name
    arguments = ["--overlay", str(plan), "--points", str(tmp_path / "points.csv"), "-o", str(out), "--json"]
    assert main(["export", str(tmp_path), *arguments]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers["rms"] < 1e-6
    assert numbers["rotation_deg"] == pytest.approx(30.0)
    assert numbers["units_per_metre"] == pytest.approx(1.0)
    assert middle_of_red(out) == pytest.approx(xy_from_world @ SPOT, abs=0.03)


def test_residuals_name_the_point_that_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_map(tmp_path, None)
    write_mosaic_with_spot(tmp_path, GeoReference.local())
    plan, xy_from_world = plan_of(tmp_path)
    places = [(0.0, 0.0), (5.0, 0.5), (1.0, 2.0), (6.0, 2.5), (3.0, -1.5)]
    with rasterio.open(plan) as raster:
        pixels = [~raster.transform @ (xy_from_world @ place) for place in places]
    rows = [f"{x},{y},{c - 0.5},{r - 0.5}" for (x, y), (c, r) in zip(places, pixels, strict=True)]
    rows[2] = f"1.0,2.0,{pixels[2][0] + 50},{pixels[2][1]}"
    (tmp_path / "points.csv").write_text("map_x_m,map_y_m,column,row\n" + "\n".join(rows) + "\n")
    arguments = ["--overlay", str(plan), "--points", str(tmp_path / "points.csv"), "--json"]
    assert main(["export", str(tmp_path), *arguments, "-o", str(tmp_path / "over.png")]) == 0
    residuals = json.loads(capsys.readouterr().out)["residuals"]
    assert max(residuals, key=residuals.get) == "row 4"
    assert 0.3 < residuals["row 4"] < 1.0


def test_maps_that_know_their_place_on_earth_need_no_points(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The other map is in another projection: degrees."""
    write_map(tmp_path)
    write_mosaic_with_spot(tmp_path, REFERENCE)
    from pyproj import Transformer

    to_degrees = Transformer.from_crs(REFERENCE.crs, 4326, always_xy=True)
    east, north = REFERENCE.crs_from_world() @ SPOT
    longitude, latitude = to_degrees.transform(east, north)
    step = 2e-7
    profile = {
        "driver": "GTiff",
        "width": 700,
        "height": 500,
        "count": 1,
        "dtype": "uint8",
    }
    place = Affine(2 * step, 0, longitude - 400 * step, 0, -step, latitude + 300 * step)
    with rasterio.open(tmp_path / "other.tif", "w", crs="EPSG:4326", transform=place, **profile) as raster:
        raster.write(np.full((1, 500, 700), 40, np.uint8))
    arguments = ["--overlay", str(tmp_path / "other.tif"), "-o", str(tmp_path / "over.tif")]
    assert main(["export", str(tmp_path), *arguments]) == 0
    assert "coordinate reference" in capsys.readouterr().out
    x, y = middle_of_red(tmp_path / "over.tif")
    assert to_degrees.transform(x, y, direction="INVERSE") == pytest.approx((east, north), abs=0.05)


def test_a_grid_of_a_robot_lies_where_its_yaml_says(tmp_path: Path) -> None:
    cells = np.full((40, 60), 254, np.uint8)
    cells[30, 10] = 0
    cv2.imwrite(str(tmp_path / "grid.pgm"), cells)
    tree = {"image": "grid.pgm", "resolution": 0.1, "origin": [-2.0, 5.0, 0.0], "negate": 0}
    (tmp_path / "grid.yaml").write_text(yaml.safe_dump(tree))
    other = read_other_map(tmp_path / "grid.yaml")
    assert other.rgba[30, 10, 0] == 0
    assert other.xy_from_pixel @ (10.5, 30.5) == pytest.approx((-2.0 + 1.05, 5.0 + 0.95))


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("name,x,y\nNowhere,1,2\nA,2,3\n", 1),
        ("name,x,y\nA,1,2\n", 1),
        ("map_x_m,map_y_m,x,y\n1,2,three,4\n1,2,3,4\n", 1),
        ("a,b\n1,2\n", 1),
        (None, 2),
    ],
)
def test_points_that_do_not_fit_are_one_clear_line(
    tmp_path: Path, text: str | None, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    write_map(tmp_path, None)
    write_mosaic_with_spot(tmp_path, GeoReference.local())
    plan, _ = plan_of(tmp_path)
    arguments = ["export", str(tmp_path), "--overlay", str(plan), "-o", str(tmp_path / "over.png")]
    if text is not None:
        (tmp_path / "points.csv").write_text(text)
        arguments += ["--points", str(tmp_path / "points.csv")]
    assert main(arguments) == code
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not (tmp_path / "over.png").exists()
