"""What becomes of a map whose run is killed, whose disk fills up or cannot be written, or whose file is
damaged.

python benchmarks/damage.py FOLDER [--kills 50] [--files 1000] [--frames 66] [--seed 0]

A flight over the demo's garden is mapped in a process of its own that is killed (SIGKILL) at a random moment,
in a folder that holds an older map; the run is then carried on. The same is done on small disks (a tmpfs,
which takes root; otherwise files are limited in size), on a disk that can only be read, and a finished map is
damaged in many ways. Writes damage.json. Linux only.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import multiprocessing
import resource
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np

from overfly.cli import main as overfly_command
from overfly.errors import MapFileError
from overfly.graph.covariance import exact_covariance
from overfly.mapstore import Map
from overfly.pipeline.mapping import MapRequest, run
from overfly.sensors import open_flight
from overfly.simulation import simulate, write_flight
from overfly.simulation.scenario import declared
from overfly.trajectory import read_tum

DISKS_MB = (0.1, 0.3, 0.6, 1.0, 1.5, 2.5)
SERVER = multiprocessing.get_context("forkserver")  # forked while it has no threads
SERVER.set_forkserver_preload(["overfly.pipeline.mapping"])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--files", type=int, default=1000)
    parser.add_argument("--frames", type=int, default=66)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    generator = np.random.default_rng(given.seed)
    write_flight(
        simulate(declared("demo").build(given.seed), given.seed, given.frames), given.folder / "flight"
    )
    case = Case(given.folder)
    found: dict[str, Any] = {"kills": kills(case, generator, given.kills)}
    found["files"] = damage(case, generator, given.files)
    found["disks"] = [small_disk(case, size) for size in DISKS_MB]
    found["read_only"] = read_only_disk(case)
    (given.folder / "damage.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


@dataclass
class Case:
    """A flight, and its map by a run that nothing disturbed."""

    folder: Path
    finish_s: float = 0.0  # from the last frame to the end

    def __post_init__(self) -> None:
        run(MapRequest(self.flight, self.unbroken), lambda _count, _result: None)  # compiles what there is to
        process, count = self.begin(self.folder / "again")
        wait_for(process, count, len(open_flight(self.flight).t_ns), 0.8, 0.0)
        began = time.monotonic()
        process.join()
        self.finish_s = time.monotonic() - began

    @property
    def flight(self) -> Path:
        return self.folder / "flight"

    @property
    def unbroken(self) -> Path:
        return self.folder / "unbroken"

    def begin(self, out: Path) -> tuple[BaseProcess, Any]:
        """A run in another process, and how many frames it has processed."""
        count = SERVER.Value("i", 0)
        return self._in_process(out, resume=False, count=count), count

    def carry_on(self, out: Path) -> int | None:
        process = self._in_process(out, resume=True)
        process.join()
        return process.exitcode

    def _in_process(self, out: Path, *, resume: bool, count: Any = None) -> BaseProcess:
        process = SERVER.Process(target=map_counting, args=(self.flight, out, resume, count))
        process.start()
        return process


def map_counting(flight: Path, out: Path, resume: bool, count: Any) -> None:
    """Map, and tell another process how many frames are done."""

    def progress(done: int, _result: object) -> None:
        if count is not None:
            count.value = done

    run(MapRequest(flight, out, resume=resume), progress)


def kills(case: Case, generator: np.random.Generator, number: int) -> dict[str, Any]:
    """Killed anywhere from its first moment to its last: what opens, what is lost, where the run ends."""
    stamps = open_flight(case.flight).t_ns
    whole = read_tum(case.unbroken / "trajectory.tum")
    sigma_m = last_sigma_m(Map.open(case.unbroken / "map.overfly"))
    older = (case.unbroken / "map.overfly").read_bytes()
    rows = []
    for kill in range(number):
        out = fresh(case.folder / "killed")
        (out / "map.overfly").write_bytes(older)
        process, count = case.begin(out)
        wait_for(process, count, len(stamps), float(generator.random()), case.finish_s)
        process.kill()
        process.join()
        kept = [path.read_bytes() for path in out.glob("*.overfly")]
        known = Map.open(out / "map.overfly") if (out / "map.overfly").exists() else None
        is_new = known is not None and not known.flights[-1].complete
        lost_s = 0.0
        if is_new and count.value:
            saved = known.frames[-1].t_ns if known is not None and len(known.frames) else stamps[0]
            lost_s = max(0.0, 1e-9 * float(stamps[count.value - 1] - saved))
        row = {
            "killed_after_frames": count.value,
            "finished_before": process.exitcode == 0,
            "opens": known is not None or any(content == older for content in kept),
            "older_map_is_there": any(content == older for content in kept) or not is_new,
            "lost_s": lost_s,
        }
        row["exit_of_resumed"] = case.carry_on(out)
        again = read_tum(out / "trajectory.tum")
        same = again.t_ns.tolist() == whole.t_ns.tolist()
        apart = np.linalg.norm(again.positions - whole.positions, axis=1) if same else np.array([np.inf])
        rows.append(row | {"ends_apart_m": float(apart[-1]), "most_apart_m": float(apart.max())})
        print("kill", kill, rows[-1], flush=True)
    print("sigma of the last node", sigma_m)
    return {"rows": rows, "sigma_of_last_node_m": sigma_m}


def wait_for(process: BaseProcess, count: Any, n_frames: int, moment: float, finish_s: float) -> None:
    """Until a moment of the run, 0 to 1: four fifths of it are its frames, the rest is finishing."""
    frame = min(moment / 0.8, 1.0) * n_frames
    while process.is_alive() and count.value < int(frame):
        time.sleep(0.002)
    time.sleep((frame % 1.0) * 0.05 + max(0.0, moment - 0.8) / 0.2 * finish_s)


def last_sigma_m(known: Map) -> float | None:
    """Standard deviation, in metres, of where the newest node is against the first."""
    whole = exact_covariance(known.visual.graph)
    if whole is None:
        return None
    return float(np.sqrt(np.trace(whole.relative(0, len(known) - 1)[:3, :3])))


def small_disk(case: Case, size_mb: float) -> dict[str, Any]:
    """The command on a disk that fills up, in a folder that holds an older map where that fits."""
    with disk(case.folder / "disk", size_mb) as (out, limit):
        older = (case.unbroken / "map.overfly").read_bytes()
        has_older = len(older) < 0.4e6 * size_mb
        if has_older:
            (out / "map.overfly").write_bytes(older)
        code, said = command(["map", str(case.flight), "-o", str(out)], limit)
        files = {path.name: path for path in out.glob("*.overfly")}
        row: dict[str, Any] = {"disk_mb": size_mb, "exit": code, "said": said}
        row["older_map_intact"] = (
            any(path.read_bytes() == older for path in files.values()) if has_older else None
        )
        row["frames_saved"] = len(Map.open(files["map.overfly"]).frames) if "map.overfly" in files else None
    print(row, flush=True)
    return row


def read_only_disk(case: Case) -> dict[str, Any]:
    """The map of an earlier run can be searched; a new one says that it cannot be written."""
    with disk(case.folder / "disk", 8.0) as (out, limit):
        shutil.copy(case.unbroken / "map.overfly", out)
        mounted = subprocess.run(["mount", "-o", "remount,ro", str(out)], check=False, capture_output=True)
        if mounted.returncode:
            print("no disk can be mounted here: a disk that can only be read is not tried")
            return {}
        found = str(case.folder / "found")
        tried = {
            "map": ["map", str(case.flight), "-o", str(out)],
            "resume": ["map", str(case.flight), "-o", str(out), "--resume"],
            "locate": ["locate", str(out / "map.overfly"), str(case.flight), "-o", found],
        }
        rows = {name: command(arguments, limit) for name, arguments in tried.items()}
    print(rows, flush=True)
    return rows


@contextlib.contextmanager
def disk(folder: Path, size_mb: float) -> Iterator[tuple[Path, int]]:
    """A folder on a disk of that size, and to how many bytes a file has to be limited, -1 for not at all."""
    fresh(folder)
    options = ["-t", "tmpfs", "-o", f"size={round(size_mb * 1e3)}k", "tmpfs", str(folder)]
    mounted = subprocess.run(["mount", *options], check=False, capture_output=True).returncode == 0
    try:
        yield folder, resource.RLIM_INFINITY if mounted else round(size_mb * 1e6)
    finally:
        if mounted:
            subprocess.run(["umount", str(folder)], check=True)


def command(arguments: list[str], limit: int) -> tuple[int, str]:
    """The command as a user gives it: exit code, and the last line on stderr that is no progress."""

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))

    done = subprocess.run(
        [sys.executable, "-m", "overfly", *arguments],
        check=False,
        capture_output=True,
        text=True,
        preexec_fn=limited,
    )
    assert "Traceback" not in done.stderr, done.stderr
    said = [line for line in done.stderr.splitlines() if line.startswith("overfly:")]
    return done.returncode, said[-1] if said else ""


def damage(case: Case, generator: np.random.Generator, number: int) -> dict[str, Any]:
    """Bytes flipped, overwritten, zeroed, cut out or cut off: refused in one line, or read as what it was."""
    content = (case.unbroken / "map.overfly").read_bytes()
    sound = summary(Map.open(case.unbroken / "map.overfly"))
    path = fresh(case.folder / "damaged") / "map.overfly"
    outcomes: Counter[str] = Counter()
    for number_of_file in range(number):
        path.write_bytes(damaged(content, generator))
        try:
            same = summary(Map.open(path)) == sound
        except MapFileError as error:
            outcomes["refused"] += 1
            assert str(path) in str(error), error
            assert "\n" not in str(error), error
            if number_of_file % 50 == 0:
                printed = io.StringIO()
                with contextlib.redirect_stderr(printed), contextlib.redirect_stdout(io.StringIO()):
                    code = overfly_command(["info", str(path)])
                assert code == 1, code
                assert printed.getvalue().count("\n") == 1, printed.getvalue()
        else:
            outcomes["read as what it was" if same else "read as something else"] += 1
    print(dict(outcomes), flush=True)
    return dict(outcomes)


def damaged(content: bytes, generator: np.random.Generator) -> bytes:
    """One to eight bits flipped, a piece overwritten, zeroed or cut out, or the end cut off."""
    data = bytearray(content)
    at, length = int(generator.integers(len(data))), int(generator.integers(1, 3000))
    kind = generator.integers(5)
    if kind == 0:
        for place in generator.integers(len(data), size=generator.integers(1, 9)):
            data[place] ^= 1 << int(generator.integers(8))
    elif kind == 1:
        data[at : at + length] = generator.bytes(len(data[at : at + length]))
    elif kind == 2:
        data[at : at + length] = bytes(len(data[at : at + length]))
    elif kind == 3:
        del data[at : at + length]
    else:
        del data[at:]
    return bytes(data)


def summary(known: Map) -> tuple[Any, ...]:
    """What tells two maps apart."""
    graph = known.visual.graph
    arrays: list[np.ndarray] = [
        graph.positions,
        graph.quaternions,
        graph.measured_positions,
        graph.information,
        graph.states,
    ]
    for node in known.visual.nodes:
        arrays += [node.features.descriptors, node.features.px, node.points_in_cam, node.tracks, node.rays]
    entries = [(frame.t_ns, frame.node, frame.reason) for frame in known.frames]
    return [array.tobytes() for array in arrays], entries, [flight.progress for flight in known.flights]


def fresh(folder: Path) -> Path:
    """The folder, empty."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


if __name__ == "__main__":
    main()
