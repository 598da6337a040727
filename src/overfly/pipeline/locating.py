"""overfly locate: frames of a source in a map that exists. run() is the list of what happens."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from overfly.config import Config
from overfly.errors import ConfigError
from overfly.localizer import Fix, Localizer
from overfly.mapstore import Map
from overfly.pipeline.prefetch import read_ahead
from overfly.pipeline.recording import interrupt_deferred
from overfly.pipeline.results import prepare_folder, write_json, write_text
from overfly.pipeline.watching import Announce, watching
from overfly.self_calibration import as_refined
from overfly.sensors import Flight, ReadOptions, open_flight
from overfly.threads import one_opencv_thread
from overfly.trajectory import Trajectory, write_tum
from overfly.viewer.interface import Viewer

FixProgress = Callable[[int, Fix], None]


@dataclass(frozen=True, slots=True)
class LocateRequest:
    """Which frames to find in which map. settings: as given beside the map's own, by section and field."""

    map_file: Path
    source: Path
    out: Path
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    reading: ReadOptions = field(default_factory=ReadOptions)
    watch: Announce | None = None  # show the run on a page, whose address this is told


@dataclass(slots=True, eq=False)
class Fixes:
    """One per frame, in the order of time. interrupted: ended early, by Ctrl-C."""

    fixes: list[Fix] = field(default_factory=list)
    interrupted: bool = False


def run(request: LocateRequest, progress: FixProgress) -> tuple[dict[str, Any], bool]:
    """Find every frame, and write fixes.jsonl and fixes.tum. Returns the numbers, and whether the run was
    interrupted.

    Raises OverflyError in one line each.
    """
    known = Map.open(request.map_file)
    flight = open_flight(request.source, request.reading)
    prepare_folder(request.out)
    rig = as_refined(flight.rig, known.rig)
    localizer = Localizer(known, rig, with_settings(known.config, request.settings))
    with watching(request.watch, rig, localizer, known) as viewer:
        found = locate_flight(flight, localizer, progress, viewer)
    write_fixes(request.out / "fixes.jsonl", found.fixes)
    write_located(request.out / "fixes.tum", found.fixes)
    metrics = numbers_of(found.fixes, known, flight)
    write_json(request.out / "locate.json", metrics)
    return metrics, found.interrupted


def locate_flight(
    flight: Flight, localizer: Localizer, progress: FixProgress, viewer: Viewer | None = None
) -> Fixes:
    """All frames in the order of time. An interrupt (Ctrl-C) ends after the current frame."""
    found = Fixes()
    ahead = closing(read_ahead(flight, localizer.observe))
    with one_opencv_thread(), interrupt_deferred(found), ahead as views:
        for view in views:
            found.fixes.append(localizer.locate(view))
            progress(len(found.fixes), found.fixes[-1])
            if viewer is not None:
                viewer.show_frame(view.frame, found.fixes[-1])
            if found.interrupted:
                break
    return found


def with_settings(config: Config, settings: dict[str, dict[str, Any]]) -> Config:
    """The map's settings with some replaced. Raises ConfigError for other features than the map has."""
    tree = config.model_dump(mode="json")
    for section, fields in settings.items():
        tree[section] = tree[section] | fields
    changed = Config.model_validate(tree)
    if changed.features.extractor != config.features.extractor:
        raise ConfigError(
            f"features.extractor: {changed.features.extractor} cannot be compared with what the map holds, "
            f"{config.features.extractor}"
        )
    return changed


def write_fixes(path: Path, fixes: list[Fix]) -> None:
    """fixes.jsonl: one JSON object a line. Raises OutputError."""
    write_text(path, "".join(json.dumps(fix_to_json(fix), allow_nan=False) + "\n" for fix in fixes))


def fix_to_json(fix: Fix) -> dict[str, Any]:
    """As the contract names it: poses as a translation in metres and a quaternion xyzw."""
    status = "lost" if fix.pose is None else "located"
    entry: dict[str, Any] = {"stamp_ns": fix.t_ns, "status": status}
    if fix.pose is None or fix.covariance is None:
        entry |= {"reason": str(fix.reason), "detail": fix.detail}
    else:
        entry |= {
            "world_from_cam": {
                "translation_m": fix.pose.translation.tolist(),
                "quaternion_xyzw": fix.pose.quaternion().tolist(),
            },
            "covariance": fix.covariance.tolist(),
            "node": fix.node,
        }
    return entry | {
        "inliers": fix.n_inliers,
        "searched": fix.searched,
        "latency_ms": round(fix.latency_ms, 3),
    }


def write_located(path: Path, fixes: list[Fix]) -> None:
    """fixes.tum: world_from_cam of the frames that were located. Raises OutputError."""
    located = [(fix.t_ns, fix.pose) for fix in fixes if fix.pose is not None]
    write_tum(path, Trajectory.from_poses([t_ns for t_ns, _ in located], [pose for _, pose in located]))


def numbers_of(fixes: list[Fix], known: Map, flight: Flight) -> dict[str, Any]:
    """What --json prints and locate.json holds."""
    latency = np.array([fix.latency_ms for fix in fixes])
    lost = Counter(str(fix.reason) for fix in fixes if fix.pose is None)
    return {
        "map": str(known.path),
        "map_nodes": len(known),
        "map_features": known.n_features,
        "source": str(flight.path),
        "frames": len(fixes),
        "located": sum(fix.pose is not None for fix in fixes),
        "lost_by_reason": dict(sorted(lost.items())),
        "searched": sum(fix.searched for fix in fixes),
        "latency_ms": {
            "p50": float(np.percentile(latency, 50)),
            "p95": float(np.percentile(latency, 95)),
            "max": float(latency.max()),
        }
        if len(fixes)
        else None,
        "problems": [f"{problem.where}: {problem.what}" for problem in flight.problems],
    }
