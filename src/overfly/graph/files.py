"""Pose graphs as text: g2o and TORO files, planar and spatial, gzip read and written by the name's ending.

TORO spatial files carry Euler angles (roll, pitch, yaw) and information in their order; they are turned into
the g2o convention at reading. A constraint that was voted out is written behind a comment sign, marked
REJECTED, so that other programs pass over it and Overfly reads it back.
"""

from __future__ import annotations

import gzip
import math
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from overfly.errors import GraphFileError, OutputError, UsageError
from overfly.geometry.poses import (
    FloatArray,
    euler_from_rotation,
    quaternion_from_rotation,
    rotation_from_euler,
    rotation_from_quaternion,
)
from overfly.graph.initialise import initialise_along_edges
from overfly.graph.pose_graph import KINDS, PoseGraph, State
from overfly.types import ConstraintKind

REJECTED = "# REJECTED "
ODOMETRY, REVISIT = KINDS.index(ConstraintKind.ODOMETRY), KINDS.index(ConstraintKind.REVISIT)

# Numbers on a line after the tag: vertices, then edges.
VERTICES = {"VERTEX_SE2": 4, "VERTEX2": 4, "VERTEX": 4, "VERTEX_SE3:QUAT": 8, "VERTEX3": 7}
EDGES = {"EDGE_SE2": 11, "EDGE2": 11, "EDGE": 11, "EDGE_SE3:QUAT": 30, "EDGE3": 29}
PLANAR = {"VERTEX_SE2", "VERTEX2", "VERTEX", "EDGE_SE2", "EDGE2", "EDGE"}


def read_graph(path: Path) -> PoseGraph:
    """Read a g2o or TORO file. Nodes keep the order of their numbers in the file; missing ones are placed
    along the edges.

    Raises GraphFileError, naming the line, when the file is missing, damaged, mixed or holds no graph.
    """
    tables: dict[str, list[list[float]]] = {}
    rejected: list[bool] = []
    kinds: list[str] = []
    for number, line in enumerate(_lines(path), 1):
        out = line.startswith(REJECTED)
        tag, *words = (line[len(REJECTED) :] if out else line).split() or [""]
        if tag not in VERTICES and tag not in EDGES:
            if tag and not tag.startswith("#") and tag not in {"FIX", "PARAMS_SE3OFFSET"}:
                raise GraphFileError(
                    f"{path}, line {number}: '{tag[:40]}' is not a pose graph line Overfly knows"
                )
            continue
        row = _numbers(path, number, tag, words)
        tables.setdefault(tag, []).append(row)
        if tag in EDGES:
            rejected.append(out)
            kinds.append(tag)
    if not kinds and not any(tag in VERTICES for tag in tables):
        raise GraphFileError(f"{path} holds no pose graph; a g2o or TORO file is needed")
    planar = {tag in PLANAR for tag in tables}
    if len(planar) > 1 or len({tag for tag in tables if tag in EDGES}) > 1:
        raise GraphFileError(f"{path} mixes kinds of nodes or edges; split it into one file for each")
    return _assemble(path, planar.pop(), tables, np.array(rejected, dtype=bool))


def _lines(path: Path) -> Iterator[str]:
    try:
        with path.open("rb") as file:
            packed = file.read(2) == b"\x1f\x8b"
        with gzip.open(path, "rt") if packed else path.open() as text:
            yield from text
    except FileNotFoundError as error:
        raise GraphFileError(f"{path} does not exist") from error
    except (OSError, EOFError, UnicodeDecodeError) as error:
        raise GraphFileError(f"{path} cannot be read: {error}") from error


def _numbers(path: Path, number: int, tag: str, words: list[str]) -> list[float]:
    wanted = VERTICES.get(tag) or EDGES[tag]
    try:
        row = [float(word) for word in words]
    except ValueError:
        row = []
    if len(row) != wanted or not all(math.isfinite(value) for value in row):
        raise GraphFileError(f"{path}, line {number}: {tag} needs {wanted} finite numbers")
    return row


def _assemble(
    path: Path, planar: bool, tables: dict[str, list[list[float]]], rejected: FloatArray
) -> PoseGraph:
    vertex_tag = next((tag for tag in tables if tag in VERTICES), None)
    edge_tag = next((tag for tag in tables if tag in EDGES), None)
    vertices = np.array(tables[vertex_tag]) if vertex_tag else np.empty((0, 8))
    edges = np.array(tables[edge_tag]) if edge_tag else np.empty((0, 30))
    numbers = np.unique(np.concatenate([vertices[:, 0], edges[:, 0], edges[:, 1]]))
    if len(np.unique(vertices[:, 0])) < len(vertices):
        raise GraphFileError(f"{path} names a node twice")
    graph = PoseGraph(planar)
    positions, quaternions = np.zeros((len(numbers), 3)), np.tile([0.0, 0.0, 0.0, 1.0], (len(numbers), 1))
    known = np.searchsorted(numbers, vertices[:, 0])
    if vertex_tag:
        positions[known], quaternions[known] = _poses(vertex_tag, vertices[:, 1:])
    graph.add_nodes(positions, quaternions)
    if edge_tag:
        i, j = np.searchsorted(numbers, edges[:, 0]), np.searchsorted(numbers, edges[:, 1])
        if (i == j).any():
            raise GraphFileError(f"{path} holds an edge from a node to itself")
        n_measured = VERTICES[vertex_tag or _vertex_of(edge_tag)] - 1
        measured = _poses(_vertex_of(edge_tag), edges[:, 2 : 2 + n_measured])
        information = _information(edge_tag, edges[:, 2 + n_measured :])
        kinds = np.where(np.abs(i - j) == 1, ODOMETRY, REVISIT).astype(np.uint8)
        graph.add_constraints(i, j, *measured, information, kinds, rejected.astype(np.uint8))
    missing = np.ones(len(numbers), dtype=bool)
    missing[known] = False
    initialise_along_edges(graph, missing)
    return graph


def _vertex_of(edge_tag: str) -> str:
    return edge_tag.replace("EDGE", "VERTEX")


def _poses(tag: str, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Positions (n, 3) and quaternions (n, 4) of rows of numbers as a vertex line holds them."""
    positions, quaternions = np.zeros((len(rows), 3)), np.zeros((len(rows), 4))
    if tag in PLANAR:
        positions[:, :2] = rows[:, :2]
        quaternions[:, 2], quaternions[:, 3] = np.sin(rows[:, 2] / 2), np.cos(rows[:, 2] / 2)
        return positions, quaternions
    positions[:] = rows[:, :3]
    if tag == "VERTEX3":
        quaternions[:] = [quaternion_from_rotation(rotation_from_euler(*angles)) for angles in rows[:, 3:6]]
        return positions, quaternions
    lengths = np.linalg.norm(rows[:, 3:7], axis=1, keepdims=True)
    if (lengths == 0).any():
        raise GraphFileError("a quaternion of length zero")
    quaternions[:] = rows[:, 3:7] / lengths
    quaternions[quaternions[:, 3] < 0] *= -1.0
    return positions, quaternions


# Euler angles are twice the vector part of the quaternion for small errors.
_EULER_SCALE = np.outer(np.repeat([1.0, 2.0], 3), np.repeat([1.0, 2.0], 3))

# Order of the upper triangle: TORO's planar files list (xx, xy, yy, tt, xt, yt), g2o's row by row.
_TORO_PLANAR = [(0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2)]


def _information(tag: str, rows: FloatArray) -> FloatArray:
    """(m, 6, 6) information of (translation, vector part of the quaternion); angle in the last place if
    planar.
    """
    size = 3 if tag in PLANAR else 6
    places = _TORO_PLANAR if tag in {"EDGE2", "EDGE"} else _row_by_row(size)
    small = np.zeros((len(rows), size, size))
    for k, (r, s) in enumerate(places):
        small[:, r, s] = small[:, s, r] = rows[:, k]
    if size == 6:
        return repaired(small * _EULER_SCALE if tag == "EDGE3" else small)
    information = np.zeros((len(rows), 6, 6))
    for k, r in enumerate((0, 1, 5)):
        information[:, r, [0, 1, 5]] = small[:, k]
    return information


def _row_by_row(size: int) -> list[tuple[int, int]]:
    return [(r, s) for r in range(size) for s in range(r, size)]


def repaired(information: FloatArray) -> FloatArray:
    """Make every matrix (m, 6, 6) positive semidefinite; those that are stay as they are.

    Planar scans written into spatial files sometimes have their (x, yaw) and (y, yaw) entries two columns too
    far left and two rows too low, at (z, roll) and (z, pitch); where putting them back helps, that is done,
    else negative eigenvalues go.
    """
    values = np.linalg.eigvalsh(information)
    bad = np.flatnonzero(values[:, 0] < -1e-9 * np.abs(values[:, -1]))
    if len(bad) == 0:
        return information
    moved = information[bad]
    for axis in (0, 1):
        moved[:, axis, 5] = moved[:, 5, axis] = moved[:, 2, 3 + axis]
        moved[:, 2, 3 + axis] = moved[:, 3 + axis, 2] = 0.0
    values, vectors = np.linalg.eigh(information[bad])
    clipped = (vectors * np.maximum(values, 0.0)[:, None, :]) @ vectors.transpose(0, 2, 1)
    helps = (np.linalg.eigvalsh(moved)[:, 0] >= 0) & (information[bad][:, [0, 1], [5, 5]] == 0).all(axis=1)
    mended = information.copy()
    mended[bad] = np.where(helps[:, None, None], moved, clipped)
    return mended


def write_graph(path: Path, graph: PoseGraph, form: str = "g2o") -> None:
    """Write as "g2o" or "toro": nodes, then odometry, then revisits. Appears whole or not at all; raises
    OutputError.
    """
    if form not in {"g2o", "toro"}:
        raise UsageError(f"a graph can be written as g2o or toro, not as {form}")
    temporary = path.with_name(f".{path.name}.part")
    try:
        with gzip.open(temporary, "wt") if path.suffix == ".gz" else temporary.open("w") as file:
            file.writelines(line + "\n" for line in _graph_lines(graph, form))
        os.replace(temporary, path)  # noqa: PTH105  atomic on every system
    except OSError as error:
        with suppress(OSError):  # where nothing could be written there is nothing to remove
            temporary.unlink()
        raise OutputError(f"{path} cannot be written: {error}") from error


def _graph_lines(graph: PoseGraph, form: str) -> Iterator[str]:
    vertex = {("g2o", True): "VERTEX_SE2", ("g2o", False): "VERTEX_SE3:QUAT", ("toro", True): "VERTEX2"}.get(
        (form, graph.planar), "VERTEX3"
    )
    edge = vertex.replace("VERTEX", "EDGE")
    for node, numbers in enumerate(_pose_numbers(vertex, graph.positions, graph.quaternions)):
        yield f"{vertex} {node} {_text(numbers)}"
    measured = _pose_numbers(
        edge.replace("EDGE", "VERTEX"), graph.measured_positions, graph.measured_quaternions
    )
    information = _information_numbers(edge, graph.information)
    for k in np.argsort(graph.kinds, kind="stable"):
        mark = REJECTED if graph.states[k] == State.REJECTED else ""
        yield f"{mark}{edge} {graph.i[k]} {graph.j[k]} {_text(measured[k])} {_text(information[k])}"


def _text(numbers: FloatArray) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _pose_numbers(tag: str, positions: FloatArray, quaternions: FloatArray) -> FloatArray:
    if tag in PLANAR:
        angle = 2.0 * np.arctan2(quaternions[:, 2], quaternions[:, 3])
        return np.column_stack([positions[:, :2], np.arctan2(np.sin(angle), np.cos(angle))])
    if tag == "VERTEX3":
        angles = [euler_from_rotation(rotation_from_quaternion(quaternion)) for quaternion in quaternions]
        return np.column_stack([positions, np.array(angles).reshape(-1, 3)])
    return np.column_stack([positions, quaternions])


def _information_numbers(tag: str, information: FloatArray) -> FloatArray:
    if tag in PLANAR:
        small = information[:, [0, 1, 5]][:, :, [0, 1, 5]]
        places = _TORO_PLANAR if tag == "EDGE2" else _row_by_row(3)
    else:
        small = information / _EULER_SCALE if tag == "EDGE3" else information
        places = _row_by_row(6)
    return np.column_stack([small[:, r, s] for r, s in places])
