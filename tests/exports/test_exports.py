"""Every export is read back by a program that is not Overfly and says what the map says."""

from __future__ import annotations

import io
import json
from pathlib import Path
from xml.etree import ElementTree

import laspy
import numpy as np
import pycolmap
import pytest
import trimesh
import yaml
from evo.tools import file_interface
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from pyproj import Transformer
from tests.exports.world import (
    BODY_FROM_CAM,
    REFERENCE,
    START_NS,
    ground_points,
    node_poses,
    world_poses,
    write_map,
)

from overfly.cli import main
from overfly.geometry.cameras import Camera, Distortion
from overfly.graph.files import read_graph
from overfly.mapstore import Map
from overfly.products.elevation import ElevationGrid
from overfly.products.exports.colmap import write_colmap
from overfly.products.exports.content import GroundPoints, NodeImage, Reconstruction
from overfly.products.exports.occupancy import FREE, OCCUPIED, UNKNOWN, occupancy_of, write_occupancy
from overfly.products.georeference import transform_points
from overfly.trajectory import NS_PER_S


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("map")


@pytest.fixture(scope="module")
def known(folder: Path) -> Map:
    return write_map(folder)


def export(known: Map, form: str, out: Path) -> Path:
    assert known.path is not None
    assert main(["export", str(known.path), "--to", form, "-o", str(out)]) == 0
    return out


def test_tum_and_euroc_say_the_same_to_evo(known: Map, tmp_path: Path) -> None:
    tum = file_interface.read_tum_trajectory_file(str(export(known, "tum", tmp_path / "a.tum")))
    euroc = file_interface.read_euroc_csv_trajectory(str(export(known, "euroc", tmp_path / "a.csv")))
    poses = world_poses(known)
    for number, pose in enumerate(poses):
        np.testing.assert_allclose(tum.poses_se3[number], pose.matrix(), atol=1e-8)
        body = pose @ BODY_FROM_CAM.inverse()
        np.testing.assert_allclose(euroc.poses_se3[number], body.matrix(), atol=1e-8)
    np.testing.assert_allclose(tum.timestamps, [f.t_ns / NS_PER_S for f in known.frames], atol=1e-6)
    np.testing.assert_allclose(euroc.timestamps, tum.timestamps, atol=1e-6)


def test_kitti_is_what_evo_reads(known: Map, tmp_path: Path) -> None:
    found = file_interface.read_kitti_poses_file(str(export(known, "kitti", tmp_path / "a.txt")))
    expected = [pose.matrix() for pose in world_poses(known)]
    np.testing.assert_allclose(found.poses_se3, expected, atol=1e-8)


def test_g2o_holds_the_graph(known: Map, tmp_path: Path) -> None:
    path = export(known, "g2o", tmp_path / "a.g2o")
    graph = read_graph(path)
    np.testing.assert_allclose(graph.positions, known.visual.graph.positions)
    words = [line.split()[0] for line in path.read_text().splitlines()]
    assert words.count("VERTEX_SE3:QUAT") == len(known)
    assert words.count("EDGE_SE3:QUAT") == known.visual.graph.n_constraints


def test_colmap_projects_the_points_where_the_nodes_saw_them(known: Map, tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(str(export(known, "colmap", tmp_path / "model")))
    assert model.num_reg_images() == len(known)
    truth = ground_points()
    n_seen = 0
    for number, (pose, node) in enumerate(zip(node_poses(), known.visual.nodes, strict=True), start=1):
        image = model.images[number]
        np.testing.assert_allclose(image.projection_center(), pose.translation, atol=1e-6)
        assert image.name == f"{node.t_ns}.png"
        for row, point2d in enumerate(image.points2D):
            # the text keeps a thousandth of a pixel; half a pixel would be a wrong convention
            np.testing.assert_allclose(point2d.xy - 0.5, node.features.px[row], atol=2e-3)
            if point2d.has_point3D():
                xyz = model.points3D[point2d.point3D_id].xyz
                np.testing.assert_allclose(xyz, truth[node.tracks[row]], atol=1e-6)
                np.testing.assert_allclose(image.project_point(xyz), point2d.xy, atol=2e-3)
                n_seen += 1
    assert n_seen == model.compute_num_observations() > 100
    assert all(point.track.length() >= 2 for point in model.points3D.values())
    assert max(point.error for point in model.points3D.values()) < 2e-3


@pytest.mark.parametrize(
    "camera",
    [
        Camera(640, 480, 520.0, 521.0, 330.0, 236.0, coefficients=(-0.05, 0.01, 0.0004, -0.0003, 0.002)),
        Camera(640, 480, 250.0, 250.0, 330.0, 236.0, Distortion.EQUIDISTANT, (0.01, -0.004, 0.001, 0.0)),
    ],
    ids=["third radial", "fisheye"],
)
def test_colmap_has_the_same_lens(camera: Camera, tmp_path: Path) -> None:
    pose = node_poses(1)[0]
    point = np.array([[0.7, -0.9, 0.1]])
    px = camera.project(pose.inverse().transform(point))
    image = NodeImage("a.png", 0, pose, px, np.array([0]))
    points = GroundPoints(point, np.array([0.1]), np.array([[1, 2, 3]], np.uint8))
    write_colmap(tmp_path / "model", Reconstruction((camera,), (image,), points))
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    np.testing.assert_allclose(model.images[1].project_point(point[0]) - 0.5, px[0], atol=1e-3)
    assert model.points3D[1].color.tolist() == [1, 2, 3]


def test_tracks_on_earth_are_where_the_reference_puts_them(known: Map, tmp_path: Path) -> None:
    positions = np.array([pose.translation for pose in world_poses(known)])
    expected = transform_points(REFERENCE.crs_from_world(), positions[:, :2])
    heights = REFERENCE.scale * positions[:, 2] + REFERENCE.translation_m[2]
    to_utm = Transformer.from_crs(4326, REFERENCE.crs, always_xy=True)

    def check(lon: list[float], lat: list[float], height: list[float]) -> None:
        np.testing.assert_allclose(np.stack(to_utm.transform(lon, lat), axis=1), expected, atol=1e-3)
        np.testing.assert_allclose(height, heights, atol=1e-3)

    tree = json.loads(export(known, "geojson", tmp_path / "a.geojson").read_text())
    (feature,) = tree["features"]
    check(*zip(*feature["geometry"]["coordinates"], strict=True))
    assert feature["properties"]["t_ns"][0] == START_NS
    kml = ElementTree.parse(export(known, "kml", tmp_path / "a.kml"))
    text = kml.find(".//{http://www.opengis.net/kml/2.2}coordinates")
    assert text is not None and text.text is not None
    check(*np.array([word.split(",") for word in text.text.split()], float).T.tolist())
    gpx = ElementTree.parse(export(known, "gpx", tmp_path / "a.gpx"))
    rows = gpx.findall(".//{*}trkpt")
    elevations = [float(row.findtext("{*}ele") or "nan") for row in rows]
    check([float(row.attrib["lon"]) for row in rows], [float(row.attrib["lat"]) for row in rows], elevations)
    assert rows[0].findtext("{*}time") == "2023-11-14T22:13:20.123456Z"


def test_a_map_that_lies_nowhere_has_no_track_on_earth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_map(tmp_path, None)
    assert main(["export", str(tmp_path), "--to", "kml", "-o", str(tmp_path / "a.kml")]) == 2
    assert "on Earth" in capsys.readouterr().err
    assert not (tmp_path / "a.kml").exists()


def test_point_clouds_hold_the_points(known: Map, tmp_path: Path) -> None:
    seen = np.unique(np.concatenate([node.tracks for node in known.visual.nodes]))
    truth = ground_points()[seen]
    ply = trimesh.load(io.BytesIO(export(known, "ply", tmp_path / "a.ply").read_bytes()), file_type="ply")
    np.testing.assert_allclose(ply.vertices, truth, atol=1e-9)
    with laspy.open(export(known, "las", tmp_path / "a.las")) as reader:
        cloud = reader.read()
        assert reader.header.parse_crs().to_epsg() == 32635
    expected = transform_points(REFERENCE.crs_from_world(), truth[:, :2])
    np.testing.assert_allclose(np.stack([cloud.x, cloud.y], axis=1), expected, atol=1e-3)
    np.testing.assert_allclose(cloud.z, 1.01 * truth[:, 2] + 25.0, atol=1e-3)
    np.testing.assert_allclose(cloud.sigma, 1.01 * 0.02, rtol=1e-5)


def yard(cell_m: float = 0.1) -> ElevationGrid:
    """Sloping ground 10 m wide with a box of 1 m, 0.5 m high, and a corner that nobody saw."""
    x, y = np.meshgrid(np.arange(0.05, 10, cell_m), np.arange(9.95, 0, -cell_m))
    heights = 0.1 * x
    heights[(np.abs(x - 4) < 0.5) & (np.abs(y - 6) < 0.5)] += 0.5
    heights[(x > 8) & (y < 2)] = np.nan
    return ElevationGrid(-3.0, 12.0, cell_m, heights.astype(np.float32), np.zeros_like(heights, np.float32))


def test_what_stands_out_is_occupied_and_a_slope_is_not() -> None:
    cells = occupancy_of(yard(), 0.3)
    assert (cells[80:, 80:] == UNKNOWN)[1:, 1:].all()
    assert (cells[36:44, 36:44] == OCCUPIED).all()
    assert 80 <= np.count_nonzero(cells == OCCUPIED) <= 14 * 14
    assert (occupancy_of(yard(), 0.7) != OCCUPIED).all()


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(0.1, 1.0))
@settings(max_examples=20)
def test_a_plane_has_no_obstacles(slope_x: float, slope_y: float, obstacle_m: float) -> None:
    x, y = np.meshgrid(np.arange(60) * 0.1, np.arange(50) * 0.1)
    heights = (slope_x * x + slope_y * y).astype(np.float32)
    assert (occupancy_of(ElevationGrid(0.0, 5.0, 0.1, heights, heights), obstacle_m) == FREE).all()


def test_map_server_finds_everything_where_it_is(tmp_path: Path) -> None:
    """Read as ROS's map_server does: origin is the lower left corner, thresholds on (255 - value) / 255."""
    write_occupancy(tmp_path / "yard.yaml", yard(), 0.3)
    tree = yaml.safe_load((tmp_path / "yard.yaml").read_text())
    pixels = np.asarray(Image.open(tmp_path / tree["image"]))
    probability = (255.0 - pixels) / 255.0

    def at(x: float, y: float) -> str:
        column = int((x - tree["origin"][0]) / tree["resolution"])
        row = pixels.shape[0] - 1 - int((y - tree["origin"][1]) / tree["resolution"])
        p = probability[row, column]
        if p > tree["occupied_thresh"]:
            return "occupied"
        return "free" if p < tree["free_thresh"] else "unknown"

    assert at(-3.0 + 4.0, 2.0 + 6.0) == "occupied"
    assert at(-3.0 + 1.0, 2.0 + 1.0) == "free"
    assert at(-3.0 + 9.5, 2.0 + 0.5) == "unknown"
    assert tree["negate"] == 0


def test_an_unknown_format_is_wrong_usage(known: Map, tmp_path: Path) -> None:
    assert main(["export", str(known.path), "--to", "dwg", "-o", str(tmp_path / "a")]) == 2
    assert main(["export", str(known.path), "--to", "tum", "-o", str(tmp_path / "a"), "--flight", "3"]) == 2


def test_a_disk_that_cannot_be_written_is_one_line(
    known: Map, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    for form in ("tum", "kitti", "euroc", "g2o", "colmap", "geojson", "ply", "las"):
        assert main(["export", str(known.path), "--to", form, "-o", str(tmp_path / "file" / "a")]) == 1, form
        assert len(capsys.readouterr().err.strip().splitlines()) == 1
