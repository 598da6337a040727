"""overfly doctor: whether this machine, this installation and an autopilot are as they should be."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import platform
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from overfly.navigation.mavlink.checks import Finding

LEAST_MEMORY_GB = 2.0
LEAST_DISK_GB = 1.0
# What is imported where, and what does not work without it.
PARTS = {
    "numpy": "anything",
    "scipy": "anything",
    "numba": "anything",
    "cv2": "anything",
    "rasterio": "the mosaic and GeoTIFF files",
    "pyproj": "GPS",
    "laspy": "export as LAS",
    "viser": "the viewer",
    "pymavlink": "autopilots and ArduPilot's logs",
    "pyulog": "PX4's logs",
    "rosbags": "ROS bags",
    "serial": "autopilots on a serial port (pip install pyserial)",
}
OPTIONAL = frozenset({"serial"})


def command(
    mavlink: Annotated[
        str | None, typer.Option("--mavlink", help="Check the autopilot there, too: udpin:0.0.0.0:14550.")
    ] = None,
    json_output: Annotated[
        bool, typer.Option("--json", help="Print the findings as one JSON object.")
    ] = False,
) -> int:
    """Check the machine, the installed parts, the compiled cache and, with --mavlink, an autopilot."""
    from overfly.navigation.mavlink.checks import Verdict, check_autopilot

    findings = [*machine(), *parts(), *compiled_cache()]
    if mavlink is not None:
        from overfly.navigation.mavlink import AutopilotLink

        with AutopilotLink.open(mavlink) as link:
            findings += check_autopilot(link)
    wrong = sum(finding.verdict is Verdict.WRONG for finding in findings)
    if json_output:
        print(json.dumps({"wrong": wrong, "findings": [asdict(finding) for finding in findings]}))
    else:
        print("\n".join(as_line(finding) for finding in findings))
        print(f"{wrong} to put right" if wrong else "nothing to put right")
    return 1 if wrong else 0


def as_line(finding: Finding) -> str:
    """One finding for a person."""
    advice = f": {finding.advice}" if finding.advice else ""
    return f"{finding.verdict:<6} {finding.what:<18} {finding.found}{advice}"


def machine() -> list[Finding]:
    """Python, processors, memory, disk."""
    from overfly.navigation.mavlink.checks import Finding, Verdict

    free_gb = shutil.disk_usage(Path.cwd()).free / 1e9
    findings = [
        Finding(
            "Python", Verdict.GOOD, f"{platform.python_version()} on {platform.system()} {platform.machine()}"
        ),
        Finding(
            "processors",
            Verdict.GOOD,
            str(len(os.sched_getaffinity(0)) if _knows_affinity() else os.cpu_count()),
        ),
        _enough("free disk", free_gb, LEAST_DISK_GB, "maps and mosaics may not fit; free some"),
    ]
    memory_gb = _memory_gb()
    if memory_gb is not None:
        findings.append(
            _enough("memory", memory_gb, LEAST_MEMORY_GB, "map smaller pictures: features.max_width_px")
        )
    return findings


def _knows_affinity() -> bool:
    return hasattr(os, "sched_getaffinity")


def _memory_gb() -> float | None:
    """Of the machine; None on systems that do not tell."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (AttributeError, ValueError, OSError):
        return None


def _enough(what: str, gigabytes: float, least: float, advice: str) -> Finding:
    from overfly.navigation.mavlink.checks import Finding, Verdict

    is_enough = gigabytes >= least
    verdict = Verdict.GOOD if is_enough else Verdict.NOTE
    return Finding(what, verdict, f"{gigabytes:.1f} GB", "" if is_enough else advice)


def parts() -> list[Finding]:
    """Packages that Overfly uses: there or not, and their versions."""
    from overfly.navigation.mavlink.checks import Finding, Verdict

    owners = importlib.metadata.packages_distributions()
    findings = []
    for name, needed_for in PARTS.items():
        if importlib.util.find_spec(name) is None:
            verdict = Verdict.NOTE if name in OPTIONAL else Verdict.WRONG
            findings.append(Finding(name, verdict, "not installed", f"needed for {needed_for}"))
            continue
        owner = owners.get(name, [name])[0]
        findings.append(Finding(name, Verdict.GOOD, importlib.metadata.version(owner)))
    import cv2

    if not hasattr(cv2, "xfeatures2d"):
        advice = "install opencv-contrib-python-headless in the place of other OpenCV packages"
        findings.append(Finding("TEBLID", Verdict.WRONG, "missing from OpenCV", advice))
    return findings


def compiled_cache() -> list[Finding]:
    """Whether compiled functions are kept from one run to the next, and how many are."""
    import overfly
    from overfly.navigation.mavlink.checks import Finding, Verdict

    source = Path(overfly.__file__).parent
    folder = Path(os.environ.get("NUMBA_CACHE_DIR", source))
    kept = sum(1 for _ in folder.rglob("*.nbi"))
    if not os.access(folder, os.W_OK):
        advice = "every run compiles for a minute: set NUMBA_CACHE_DIR to a folder that can be written"
        return [Finding("compiled cache", Verdict.NOTE, f"{folder} cannot be written", advice)]
    advice = "" if kept else "the first run will compile for a minute or two"
    verdict = Verdict.GOOD if kept else Verdict.NOTE
    return [Finding("compiled cache", verdict, f"{kept} files below {folder}", advice)]
