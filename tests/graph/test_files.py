"""g2o and TORO files: round trips of any graph, and one clear line for what cannot be read."""

from __future__ import annotations

import numpy as np
import pytest

from overfly.errors import GraphFileError
from overfly.geometry.poses import Pose
from overfly.graph.files import read_graph, repaired, write_graph
from overfly.graph.linearise import chi2, constraint_errors
from overfly.graph.pose_graph import PoseGraph
from overfly.types import Constraint, ConstraintKind


def small_graph(planar: bool) -> PoseGraph:
    random = np.random.default_rng(3)
    graph = PoseGraph(planar)
    plane = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 1.0]) if planar else np.ones(6)
    for _ in range(6):
        graph.add_node(Pose.exp(random.normal(0.0, 1.0, 6) * plane))
    for i, j in [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 0)]:
        root = random.normal(size=(6, 6)) * plane
        measured = graph.pose(i).inverse() @ graph.pose(j) @ Pose.exp(0.01 * random.normal(size=6) * plane)
        kind = ConstraintKind.REVISIT if j == 0 else ConstraintKind.ODOMETRY
        graph.add_constraint(Constraint(i, j, measured, root.T @ root, kind))
    graph.states[5] = 1
    return graph


@pytest.mark.parametrize("name", ["graph.g2o", "graph.g2o.gz"])
@pytest.mark.parametrize("planar", [True, False])
def test_g2o_round_trip(tmp_path, name, planar):
    graph = small_graph(planar)
    write_graph(tmp_path / name, graph)
    again = read_graph(tmp_path / name)
    assert again.planar == planar
    np.testing.assert_allclose(again.positions, graph.positions, atol=1e-12)
    np.testing.assert_allclose(again.information, graph.information, atol=1e-9)
    np.testing.assert_array_equal(again.states, graph.states)
    np.testing.assert_array_equal(again.kinds, graph.kinds)
    assert chi2(again) == pytest.approx(chi2(graph), rel=1e-9)


@pytest.mark.parametrize("planar", [True, False])
def test_toro_round_trip(tmp_path, planar):
    graph = small_graph(planar)
    write_graph(tmp_path / "a.graph", graph, "toro")
    again = read_graph(tmp_path / "a.graph")
    np.testing.assert_allclose(
        constraint_errors(again, np.arange(6)), constraint_errors(graph, np.arange(6)), atol=1e-9
    )
    np.testing.assert_allclose(again.information, graph.information, rtol=1e-9, atol=1e-9)


def test_missing_nodes_are_placed_along_the_edges(tmp_path):
    unit = "1 0 0 1 0 1"
    (tmp_path / "a.g2o").write_text(f"EDGE_SE2 3 4 1 0 0 {unit}\nEDGE_SE2 7 4 0 2 0 {unit}\n\n")
    graph = read_graph(tmp_path / "a.g2o")
    np.testing.assert_allclose(graph.positions, [[0, 0, 0], [1, 0, 0], [1, -2, 0]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no pose graph"),
        ("hello world\n", "line 1: 'hello'"),
        ("EDGE_SE2 0 1 1 0\n", "line 1: EDGE_SE2 needs 11"),
        ("VERTEX_SE2 0 nan 0 0\n", "needs 4 finite"),
        ("VERTEX_SE2 0 0 0 0\nVERTEX_SE3:QUAT 1 0 0 0 0 0 0 1\n", "mixes"),
        ("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 0 0 0 0\n", "twice"),
    ],
)
def test_bad_files_are_named(tmp_path, text, message):
    path = tmp_path / "bad.g2o"
    path.write_text(text)
    with pytest.raises(GraphFileError, match=message) as raised:
        read_graph(path)
    assert "bad.g2o" in str(raised.value)


def test_a_missing_or_cut_file_is_named(tmp_path):
    with pytest.raises(GraphFileError, match="does not exist"):
        read_graph(tmp_path / "none.g2o")
    write_graph(tmp_path / "whole.g2o.gz", small_graph(False))
    cut = tmp_path / "cut.g2o.gz"
    cut.write_bytes((tmp_path / "whole.g2o.gz").read_bytes()[:200])
    with pytest.raises(GraphFileError, match=r"cut\.g2o\.gz"):
        read_graph(cut)


def test_information_is_repaired_only_where_needed():
    good = np.diag([4.0, 3, 2, 1, 1, 5])
    misplaced = good.copy()
    misplaced[2, 3] = misplaced[3, 2] = 3.0  # belongs to (x, yaw)
    wild = good.copy()
    wild[0, 0] = -1.0
    mended = repaired(np.array([good, misplaced, wild]))
    assert np.array_equal(mended[0], good)
    assert mended[1, 0, 5] == 3.0
    assert mended[1, 2, 3] == 0.0
    assert np.linalg.eigvalsh(mended).min() > -1e-12
