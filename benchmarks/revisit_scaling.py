"""How the search for places grows with the map: one node's search, and that of a lost camera, at 10^4 to
10^6 features.

python benchmarks/revisit_scaling.py [--largest 1000000] [--svg docs/revisit_scaling.svg]

The map is a lawn-mower flight over ground of random descriptors, 300 features a node, lanes that overlap;
its poses are the truth and its odometry as uncertain as that of the flights with truth. Between two nodes
lie ten frames, in which the map is tended. Timed is CPU time, the median of 40 searches. At last the
exponents are printed with which the times grow from the smallest map to the largest; that of the square root
is 0.5.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from overfly.config import Config
from overfly.geometry.cameras import Camera
from overfly.geometry.levelling import NADIR_BODY_FROM_CAM
from overfly.geometry.poses import FloatArray, Pose, rotation_from_euler
from overfly.graph.online import OnlineOptimiser
from overfly.revisit.drift import drift_covariance
from overfly.revisit.places import Places
from overfly.revisit.verification import Query, Verifier
from overfly.types import Constraint, Features, MountedCamera, Rig
from overfly.vision.features import create_extractor
from overfly.vision.odometry import information_of_constraint
from overfly.vision.refine import TiltPrior
from overfly.vision.registration import create_registrar
from overfly.visual_map import Node, VisualMap

CAMERA = Camera(320, 240, 250.0, 250.0, 160.0, 120.0)
TILT = TiltPrior(np.asarray(NADIR_BODY_FROM_CAM), 0.01)
HEIGHT_M, STEP_M, LANE_M, LANE_NODES = 2.0, 0.6, 1.4, 16
FEATURES_PER_NODE = 300
SEARCHES = 40
FRAMES_BETWEEN = 10
TIMES = ("node_ms", "node_p95_ms", "tend_p95_ms", "lost_ms")
SIZES = (10_000, 30_000, 100_000, 300_000, 1_000_000)
NOISE = np.diag([0.005**2] * 3 + [0.003**2] * 3)


def lawn_mower(number: int) -> Pose:
    """world_from_cam of the n-th node."""
    lane, along = divmod(number, LANE_NODES)
    x = STEP_M * (along if lane % 2 == 0 else LANE_NODES - 1 - along)
    return Pose(np.asarray(NADIR_BODY_FROM_CAM), np.array([x, LANE_M * lane, HEIGHT_M]))


class Country:
    """Ground of random descriptors, made square by square where the camera comes, always the same."""

    def __init__(self) -> None:
        self._view_m2 = CAMERA.width * CAMERA.height * (HEIGHT_M / CAMERA.fx) ** 2
        self._squares: dict[tuple[int, int], tuple[FloatArray, np.ndarray]] = {}

    def _square(self, at: tuple[int, int]) -> tuple[FloatArray, np.ndarray]:
        if at not in self._squares:
            generator = np.random.default_rng([7, at[0] + 1000, at[1] + 1000])
            count = round(FEATURES_PER_NODE / self._view_m2)
            xy = np.array(at) + generator.random((count, 2))
            points = np.column_stack([xy, np.zeros(count)])
            self._squares[at] = points, generator.integers(0, 256, (count, 32), dtype=np.uint8)
        return self._squares[at]

    def observe(self, pose: Pose, generator: np.random.Generator) -> tuple[Query, FloatArray]:
        """What the camera sees, with noise, and the points in its frame."""
        x, y = np.floor(pose.translation[:2]).astype(int)
        squares = [self._square((int(x) + i, int(y) + j)) for i in range(-2, 3) for j in range(-2, 3)]
        points, descriptors = (np.concatenate(column) for column in zip(*squares, strict=True))
        in_cam = pose.inverse().transform(points)
        px = CAMERA.project(in_cam)
        seen = np.flatnonzero(((px > 0) & (px < [CAMERA.width - 1, CAMERA.height - 1])).all(axis=1))
        noisy = (px[seen] + generator.normal(scale=0.4, size=(len(seen), 2))).astype(np.float32)
        flips = np.packbits(generator.random((len(seen), 256)) < 0.08, axis=1)
        zero = np.zeros(len(seen), np.float32)
        features = Features(noisy, descriptors[seen] ^ flips, zero, zero, zero)
        return Query(features, CAMERA.rays_from_pixels(noisy), None, TILT), in_cam[seen]


class Survey:
    """The map, as large as wanted."""

    def __init__(self) -> None:
        self.country = Country()
        self.generator = np.random.default_rng(1)
        self.map = VisualMap()
        self.optimiser = OnlineOptimiser(self.map.graph)
        config = Config()
        rig = Rig((MountedCamera("cam0", CAMERA, Pose(np.asarray(NADIR_BODY_FROM_CAM), np.zeros(3))),))
        extractor = create_extractor("hessian-teblid", 400)
        registrar = create_registrar(rig, config, extractor.max_distance)
        verifier = Verifier(CAMERA, extractor, registrar, config.revisit)
        self.places = Places(self.map, self.optimiser, verifier, config.revisit)
        self.n_features = 0
        self.tended_s: list[float] = []  # CPU of every frame that is no node

    def extend(self) -> float:
        """One node more; CPU seconds of its search for places."""
        index = len(self.map)
        pose = lawn_mower(index)
        query, in_cam = self.country.observe(pose, self.generator)
        n = len(in_cam)
        node = Node(
            index, index, index * 10**8, query.features, query.rays, in_cam, np.full(n, 0.003),
            np.full(n, np.nan), np.full(n, 0.001), self.map.new_tracks(n), np.full(n, index),
            np.arange(n), TILT, None, index - 1,
        )  # fmt: skip
        self.map.add_node(node, pose)
        self.n_features += n
        if index == 0:
            return 0.0
        step = lawn_mower(index - 1).inverse() @ pose
        covariance = NOISE + drift_covariance(step, HEIGHT_M, 0.0)
        added = self.optimiser.add(Constraint(index - 1, index, step, information_of_constraint(covariance)))
        node.constraint = added.constraint
        began = time.process_time()
        self.places.seek(index, query, np.arange(n))
        spent = time.process_time() - began
        for _ in range(FRAMES_BETWEEN):
            began = time.process_time()
            self.places.tend()
            self.tended_s.append(time.process_time() - began)
        return spent

    def lost(self) -> float:
        """CPU seconds to find a camera somewhere in the map."""
        somewhere = lawn_mower(int(self.generator.integers(len(self.map))))
        turned = Pose(rotation_from_euler(0, 0, 1.0) @ somewhere.rotation, somewhere.translation)
        query, _ = self.country.observe(turned, self.generator)
        began = time.process_time()
        self.places.relocalise(query, 10**15)
        return time.process_time() - began


def warm_up() -> None:
    """Load the kernels."""
    survey = Survey()
    while survey.n_features < SIZES[0]:
        survey.extend()
    survey.lost()


def measure(largest: int) -> list[dict[str, float]]:
    """One row per size of the map."""
    warm_up()
    survey, rows = Survey(), []
    for size in (size for size in SIZES if size <= largest):
        recent: list[float] = []
        while survey.n_features < size:
            recent.append(survey.extend())
        recent = recent[-SEARCHES // 2 :]
        lost = [survey.lost() for _ in range(SEARCHES)]
        rows.append(
            {
                "features": survey.n_features,
                "nodes": len(survey.map),
                "constraints": survey.map.graph.n_constraints,
                "node_ms": 1e3 * float(np.median(recent)),
                "node_p95_ms": 1e3 * float(np.percentile(recent, 95)),
                "tend_p95_ms": 1e3 * float(np.percentile(survey.tended_s[-400:], 95)),
                "lost_ms": 1e3 * float(np.median(lost)),
            }
        )
        print(json.dumps({key: round(value, 3) for key, value in rows[-1].items()}), flush=True)
    return rows


def exponents(rows: list[dict[str, float]]) -> dict[str, float]:
    """With what power of the map's features each time grows, by least squares over all sizes."""
    size = np.log([row["features"] for row in rows])
    return {name: float(np.polyfit(size, np.log([row[name] for row in rows]), 1)[0]) for name in TIMES}


def draw(rows: list[dict[str, float]], path: Path) -> None:
    """Both curves and the square root of the map's size, on logarithmic axes, as SVG."""
    width, height, left, bottom = 640, 400, 70, 50
    n = np.array([row["features"] for row in rows])
    curves = {
        "a node's search, median": ("#1f77b4", np.array([row["node_ms"] for row in rows])),
        "a node's search, 95 %": ("#17becf", np.array([row["node_p95_ms"] for row in rows])),
        "a lost camera": ("#d62728", np.array([row["lost_ms"] for row in rows])),
        "square root of the map": ("#999999", rows[0]["node_ms"] * np.sqrt(n / n[0])),
    }
    low = 10.0 ** np.floor(np.log10(min(values.min() for _, values in curves.values())))
    high = 10.0 ** np.ceil(np.log10(max(values.max() for _, values in curves.values())))

    def x_of(features: FloatArray) -> FloatArray:
        return left + (width - left - 20) * np.log10(features / 1e4) / max(np.log10(n[-1] / 1e4), 1e-9)

    def y_of(ms: FloatArray) -> FloatArray:
        return 20 + (height - bottom - 20) * np.log10(high / ms) / np.log10(high / low)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif" '
        f'font-size="13"><rect width="{width}" height="{height}" fill="white"/>'
    ]
    for ms in 10.0 ** np.arange(np.log10(low), np.log10(high) + 0.5):
        y = float(y_of(np.array(ms)))
        parts.append(f'<path d="M{left} {y:.1f}H{width - 20}" stroke="#ddd"/>')
        parts.append(f'<text x="{left - 8}" y="{y + 4:.1f}" text-anchor="end">{ms:g} ms</text>')
    for features in SIZES:
        if features <= n[-1]:
            x = float(x_of(np.array(float(features))))
            parts.append(f'<text x="{x:.1f}" y="{height - 28}" text-anchor="middle">{features:,}</text>')
    parts.append(f'<text x="{width / 2}" y="{height - 8}" text-anchor="middle">features in the map</text>')
    for place, (name, (colour, values)) in enumerate(curves.items()):
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(x_of(n), y_of(values), strict=True))
        dash = ' stroke-dasharray="6 5"' if colour == "#999999" else ""
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2"{dash}/>')
        parts.append(f'<text x="{left + 14}" y="{38 + 18 * place}" fill="{colour}">{name}</text>')
    path.write_text("\n".join([*parts, "</svg>"]) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--largest", type=int, default=1_000_000)
    parser.add_argument("--svg", type=Path)
    arguments = parser.parse_args()
    rows = measure(arguments.largest)
    if len(rows) > 1:
        print(json.dumps({"exponents": {name: round(one, 2) for name, one in exponents(rows).items()}}))
    if arguments.svg:
        draw(rows, arguments.svg)


if __name__ == "__main__":
    main()
