"""A map of the demo's garden, flown once, and other flights over it: how many of their frames are found, how
exactly, and in what time.

python benchmarks/locate_again.py FOLDER [--frames 60] [--seed 0] [--features 500000]

Every frame is searched for by itself, without a prior, and again following the one before. Errors are against
the true place of the node that a fix rests on, as shares of the true height. Latency is by the clock, and
beside it stands the processor time, which others on the machine do not lengthen. With --features the map is
filled up with nodes elsewhere whose descriptors differ from real ones in a quarter of their bits. Writes
locate_again.json.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from overfly.geometry.cameras import Camera, Distortion
from overfly.geometry.poses import Pose
from overfly.localizer import Fix, Localizer
from overfly.mapstore import Map
from overfly.pipeline.mapping import MapRequest, run
from overfly.simulation import SimulatedFlight, simulate, write_flight
from overfly.simulation.paths import Route
from overfly.simulation.scenario import Scenario, declared
from overfly.simulation.vehicles import MULTIROTOR, fly_route
from overfly.threads import one_opencv_thread

CHI2_6_AT_3_SIGMA = 20.06
FISHEYE = Camera(400, 300, 210.0, 210.0, 201.0, 148.0, Distortion.EQUIDISTANT, (-0.01, 0.002, 0.0, 0.0))


@dataclass(frozen=True)
class Again:
    """Another flight: its height, how bright its pictures are, and its camera, None for that of the map."""

    name: str
    height_m: float = 3.1
    brightness: float = 1.0
    vignetting: float = 1.0
    camera: Camera | None = None

    def fly(self, seed: int, frames: int) -> SimulatedFlight:
        """The other way round, crooked, on another day with other noise."""
        base: Scenario = declared("demo").build(seed)
        corners = np.array([[0.6, -3.0], [-1.5, -3.6], [-3.6, -3.0], [-4.2, -1.0], [-3.5, 1.5], [-1.0, 2.5]])
        route = Route(np.column_stack([corners, np.full(len(corners), self.height_m)]), 1.2, ramp_s=0.5)
        (setup,) = base.cameras
        quality = replace(
            setup.quality,
            brightness=self.brightness * setup.quality.brightness,
            vignetting=min(0.9, self.vignetting * setup.quality.vignetting),
        )
        setup = replace(setup, quality=quality, camera=self.camera or setup.camera)
        path = fly_route(route, MULTIROTOR, seed + 9)
        return simulate(replace(base, path=path, cameras=(setup,)), seed + 9, frames)


FLIGHTS = (
    Again("same height"),
    Again("half the height", 1.55),
    Again("two thirds", 2.05),
    Again("one and two thirds", 5.2),
    Again("twice the height", 6.2),
    Again("a quarter of the light", brightness=0.25, vignetting=2.0),
    Again("two and a half times the light", brightness=2.5),
    Again("a fisheye", camera=FISHEYE),
)


def fill_up(known: Map, features: int) -> None:
    """Add nodes to the map until it holds so many features."""
    generator = np.random.default_rng(1)
    real = list(known.visual.nodes)
    held = sum(len(node.features) for node in real)
    while held < features:
        node = real[len(known.visual) % len(real)]
        bits = np.asarray(node.features.descriptors, np.uint8)
        flips = (generator.random((*bits.shape, 8)) < 0.25).astype(np.uint8)
        index, n = len(known.visual), len(node.features)
        there = Pose(np.eye(3), np.array([20.0 * (1 + index // 40), 20.0 * (index % 40), 0.0]))
        copy = replace(
            node,
            index=index,
            features=replace(node.features, descriptors=bits ^ np.packbits(flips, axis=-1)[..., 0]),
            tracks=known.visual.n_tracks + np.arange(n),
            anchor=np.full(n, index),
            anchor_row=np.arange(n),
            parent=-1,
        )
        known.visual.n_tracks += n
        known.visual.add_node(copy, there @ known.visual.graph.pose(node.index))
        held += n


def fixes_of(localizer: Localizer, flight: SimulatedFlight, *, follow: bool) -> Iterator[tuple[Fix, float]]:
    """Each with the milliseconds of processor time that it took."""
    localizer.forget()
    for frame in flight:
        if not follow:
            localizer.forget()
        began = time.thread_time()
        yield localizer.locate(frame), 1e3 * (time.thread_time() - began)


def judge(
    found: list[tuple[Fix, float]], truth: tuple[Pose, ...], known: Map, mapped: tuple[Pose, ...]
) -> dict[str, float | int]:
    """Located, errors over height (median, 95 %), how many within three sigmas, latencies and processor time
    (median, 95 %)."""
    errors, inside = [], 0
    fixes, processor_ms = [fix for fix, _ in found], [ms for _, ms in found]
    for fix, pose in zip(fixes, truth, strict=True):
        if fix.pose is None or fix.node is None or fix.covariance is None:
            continue
        true_place = mapped[known.visual.nodes[fix.node].frame_index].inverse() @ pose
        error = (fix.pose.inverse() @ known.visual.graph.pose(fix.node) @ true_place).log()
        errors.append(float(np.linalg.norm(error[:3])) / float(pose.translation[2]))
        inside += bool(error @ np.linalg.solve(fix.covariance, error) < CHI2_6_AT_3_SIGMA)
    latency = np.array([fix.latency_ms for fix in fixes])
    return {
        "frames": len(fixes),
        "located": len(errors),
        "error_median_percent": 100 * float(np.median(errors)) if errors else float("nan"),
        "error_p95_percent": 100 * float(np.percentile(errors, 95)) if errors else float("nan"),
        "inside_three_sigma": inside,
        "latency_median_ms": float(np.median(latency)),
        "latency_p95_ms": float(np.percentile(latency, 95)),
        "processor_median_ms": float(np.median(processor_ms)),
        "processor_p95_ms": float(np.percentile(processor_ms, 95)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--features", type=int, default=0)
    arguments = parser.parse_args()
    mapped = simulate("demo", arguments.seed)
    write_flight(mapped, arguments.folder / "flight")
    run(MapRequest(arguments.folder / "flight", arguments.folder / "map"), lambda _count, _result: None)
    known = Map.open(arguments.folder / "map" / "map.overfly")
    fill_up(known, arguments.features)
    table: dict[str, Any] = {}
    with one_opencv_thread():
        for again in FLIGHTS:
            flight = again.fly(arguments.seed, arguments.frames)
            localizer = Localizer(known, flight.rig)
            row = {
                way: judge(
                    list(fixes_of(localizer, flight, follow=follow)), flight.truth, known, mapped.truth
                )
                for way, follow in (("searched", False), ("followed", True))
            }
            table[again.name] = row
            print(again.name, *(f"{key} {value:.2f}" for key, value in row["searched"].items()), flush=True)
            print("   followed: located", row["followed"]["located"], "of", row["followed"]["frames"])
    (arguments.folder / "locate_again.json").write_text(json.dumps(table, indent=1))


if __name__ == "__main__":
    main()
