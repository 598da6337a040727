"""Rays meet the ground where it is; pictures lie on it where they were taken; meshes are read by others."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.exports.world import CAMERA
from tests.viewer.flights import HEIGHT_M, above, plain_picture

from overfly.geometry.poses import Pose
from overfly.viewer import drape as drape_module
from overfly.viewer.drape import Drape
from overfly.viewer.glb import grid_faces, textured_mesh
from overfly.viewer.ground import Surface

ordinary = st.floats(-20.0, 20.0)


def hilly(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    return np.asarray(0.8 * np.sin(0.3 * x_m) * np.cos(0.4 * y_m))


@given(x=ordinary, y=ordinary, height=st.floats(2.0, 50.0), dx=st.floats(-1.0, 1.0), dy=st.floats(-1.0, 1.0))
def test_a_ray_meets_hilly_ground_where_it_is(
    x: float, y: float, height: float, dx: float, dy: float
) -> None:
    origin, direction = np.array([x, y, height]), np.array([dx, dy, -1.0])
    direction /= np.linalg.norm(direction)
    place = Surface(hilly, -0.8, 0.8).meet(origin, direction)
    assert place is not None
    assert place[2] == pytest.approx(hilly(place[0], place[1]), abs=1e-6)
    along = place - origin
    np.testing.assert_allclose(np.cross(along, direction), 0.0, atol=1e-9)
    assert along @ direction > 0
    before = origin + np.linspace(0.0, along @ direction, 300)[:-2, None] * direction
    assert (before[:, 2] > hilly(before[:, 0], before[:, 1]) - 0.02).all()  # the first place, not a later one


@given(x=ordinary, y=ordinary, dx=ordinary, dz=st.floats(0.0, 5.0))
def test_a_ray_that_looks_up_meets_nothing(x: float, y: float, dx: float, dz: float) -> None:
    assert Surface.flat(0.0).meet(np.array([x, y, 3.0]), np.array([dx, 1.0, dz])) is None


def test_ground_below_nodes_is_as_high_as_the_nearest() -> None:
    surface = Surface.below_nodes(np.array([[0.0, 0.0, 1.0], [10.0, 0.0, 3.0]]))
    assert surface.height_at(np.array([4.0, 6.0]), np.array([0.0, 1.0])).tolist() == [1.0, 3.0]


@given(rows=st.integers(2, 9), columns=st.integers(2, 9))
def test_a_grid_is_covered_once(rows: int, columns: int) -> None:
    faces = grid_faces(rows, columns).astype(np.int64)
    place = np.stack([faces % columns, faces // columns], axis=-1).astype(float)
    (a, b), (c, d) = (place[:, 1] - place[:, 0]).T, (place[:, 2] - place[:, 0]).T
    area = 0.5 * (a * d - b * c)
    assert (area < 0).all() or (area > 0).all()  # all turned the same way
    assert abs(area.sum()) == (rows - 1) * (columns - 1)


@pytest.mark.parametrize("channels", [1, 3])
def test_a_mesh_is_what_an_independent_reader_finds(channels: int) -> None:
    generator = np.random.default_rng(3)
    vertices, places = generator.normal(size=(12, 3)), generator.random((12, 2))
    faces = grid_faces(3, 4)
    picture = np.full((20, 30) if channels == 1 else (20, 30, 3), 90, np.uint8)
    data = textured_mesh(vertices, places, faces, picture)
    found = trimesh.load(io.BytesIO(data), file_type="glb", process=False).to_geometry()
    np.testing.assert_allclose(found.vertices, vertices, atol=1e-6)
    np.testing.assert_array_equal(found.faces, faces)
    np.testing.assert_allclose(found.visual.uv[:, 0], places[:, 0], atol=1e-6)
    np.testing.assert_allclose(1.0 - found.visual.uv[:, 1], places[:, 1], atol=1e-6)  # it counts from below
    image = found.visual.material.baseColorTexture
    assert image.size == (30, 20)
    assert np.abs(np.asarray(image.convert("L")).astype(int) - 90).max() <= 2


def vertices_of(mesh: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Vertices that a face uses (n, 3), and their places in the picture (n, 2), from its top-left corner."""
    found = trimesh.load(io.BytesIO(mesh), file_type="glb", process=False).to_geometry()
    used = np.unique(found.faces)
    return found.vertices[used], (found.visual.uv * [1, -1] + [0, 1])[used]


@settings(max_examples=25)
@given(
    tilt=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)),
    yaw=st.floats(-3, 3),
    ground=st.floats(-1.0, 1.0),
)
def test_a_picture_lies_where_its_pixels_see_the_ground(
    tilt: tuple[float, float], yaw: float, ground: float
) -> None:
    pose = above(1.0, -2.0, yaw) @ Pose.exp(np.array([0, 0, 0, *tilt, 0.0]))
    piece = Drape(CAMERA).add(0, plain_picture((1, 2, 3)), pose, ground)
    assert piece is not None
    in_cam, places = vertices_of(piece.mesh)
    px = places * [CAMERA.width, CAMERA.height] - 0.5
    np.testing.assert_allclose(CAMERA.project(in_cam), px, atol=0.05)
    np.testing.assert_allclose(pose.transform(in_cam)[:, 2], ground, atol=1e-5 * HEIGHT_M)


def test_what_was_seen_before_gets_no_second_picture() -> None:
    drape, picture = Drape(CAMERA), plain_picture((9, 9, 9))
    whole = drape.add(0, picture, above(0.0, 0.0), 0.0)
    assert whole is not None
    for number in range(1, 50):  # hovering
        pose = above(0.05 * math.sin(number), 0.05 * math.cos(number), 0.01 * math.sin(3 * number))
        assert drape.add(number, picture, pose, 0.0) is None
    ahead = drape.add(50, picture, above(2.0, 0.0), 0.0)
    assert ahead is not None
    assert drape.add(51, picture, above(2.02, 0.01), 0.0) is None
    new_share = 2.0 / (HEIGHT_M * CAMERA.width / CAMERA.fx)
    assert new_share < area_of(ahead.mesh) / area_of(whole.mesh) < new_share + 0.2  # and a little more


def area_of(mesh: bytes) -> float:
    return float(trimesh.load(io.BytesIO(mesh), file_type="glb", process=False).to_geometry().area)


def test_ground_is_laid_without_gaps() -> None:
    """Every place that one of three overlapping pictures shows lies in a triangle of one of the pieces."""
    drape, picture = Drape(CAMERA), plain_picture((9, 9, 9))
    poses = [above(0.0, 0.0, 0.1), above(2.6, 0.4, 0.5), above(0.4, 2.3, -0.7)]
    triangles = []
    for number, pose in enumerate(poses):
        piece = drape.add(number, picture, pose, 0.0)
        assert piece is not None
        found = trimesh.load(io.BytesIO(piece.mesh), file_type="glb", process=False).to_geometry()
        triangles.append(pose.transform(np.asarray(found.vertices))[found.faces][..., :2])
    corners = np.concatenate(triangles)
    places = np.random.default_rng(1).uniform([-2.5, -2.0], [5.0, 4.5], (600, 2))
    shown = np.zeros(len(places), bool)
    for pose in poses:
        px = CAMERA.project(pose.inverse().transform(np.column_stack([places, np.zeros(len(places))])))
        edge = 0.05 * np.array([CAMERA.width, CAMERA.height])
        shown |= ((px > edge) & (px < [CAMERA.width, CAMERA.height] - edge)).all(axis=1)
    assert 200 < np.count_nonzero(shown) < 550
    for place in places[shown]:
        a, b, c = np.moveaxis(corners - place, 1, 0)
        turns = np.stack([p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] for p, q in ((a, b), (b, c), (c, a))])
        assert ((turns >= -1e-12).all(axis=0) | (turns <= 1e-12).all(axis=0)).any(), place


def test_the_number_of_pieces_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drape_module, "MOST_PIECES", 5)
    drape, picture, gone = Drape(CAMERA), plain_picture((9, 9, 9)), []
    for number in range(12):
        assert drape.add(number, picture, above(4.0 * number, 0.0), 0.0) is not None
        gone += drape.outgrown()
    assert gone == list(range(7))
    assert drape.pieces == list(range(7, 12))
    assert drape.add(12, picture, above(0.0, 0.0), 0.0) is not None  # the oldest ground may be shown again
