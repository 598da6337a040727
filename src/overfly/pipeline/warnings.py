"""What the user should know about a run, in plain words."""

from __future__ import annotations

import numpy as np

from overfly.attitude_clock import ClockLag
from overfly.graph.pose_graph import KINDS
from overfly.pipeline.recording import Recording
from overfly.sensors import Flight, Quantity
from overfly.slam import Slam
from overfly.types import ConstraintKind

POOR_SHARE = 0.9
TOLD_SHARE = 0.01  # deviation of a refined focal length from which on it counts as not told


def warnings_of(flight: Flight, recording: Recording) -> list[str]:
    """One sentence each; empty when there is nothing to say."""
    found = []
    slam = recording.slam
    n_frames = len(recording.frames)
    if recording.interrupted:
        found.append(f"The run was interrupted after {n_frames} of {len(flight)} frames.")
    if recording.n_located < POOR_SHARE * n_frames:
        reasons = ", ".join(f"{reason}: {count}" for reason, count in recording.lost_by_reason().items())
        found.append(f"Only {recording.n_located} of {n_frames} frames were located ({reasons}).")
    n_pieces = len(np.unique(slam.map.pieces()))
    if n_pieces > 1:
        found.append(
            f"The map is in {n_pieces} pieces: the camera was lost between them, and no place shows in both. "
            "Results show the one with most frames; the others are in map.overfly."
        )
    n_placed = int(np.count_nonzero(slam.map.graph.kinds == KINDS.index(ConstraintKind.POSITIONS)))
    if n_placed:
        found.append(
            f"{n_placed + 1} pieces of the map, between which the camera was lost, lie where GPS says: "
            "between them the map is as exact as GPS, not as the pictures."
        )
    if slam.start is not None and slam.start.source == "none":
        found.append(
            "Nothing in the source gives the scale: lengths are in units of the first frame's height. "
            "Give it with --height-m."
        )
    refined = slam.refined_camera
    if refined is not None:
        focal_px, sigma_px = refined.camera.focal_px, refined.focal_sigma_px
        found.append(
            f"The camera was refined: focal length {focal_px:.1f} +- {sigma_px:.1f} px, given was "
            f"{flight.rig.cam0.camera.focal_px:.1f} px."
        )
        if not sigma_px < TOLD_SHARE * focal_px:
            has_metre = slam.start is not None and slam.start.source == "gps"
            told = "heights above the ground" if has_metre else "lengths"
            found.append(
                f"The flight tells the focal length to {100.0 * sigma_px / focal_px:.1f} % only, and {told} "
                "no better: fly some lines at another height or with the camera tilted"
                f"{'' if has_metre else ', or with GPS'}, or give a calibrated camera with --camera."
            )
    elif flight.rig.calibration_source != "given":
        found.append(
            f"The camera's calibration comes from {flight.rig.calibration_source}: for an accurate map "
            "give a calibrated one with --camera, or let --refine-camera find it from the flight."
        )
    turn_deg = float(np.degrees(np.linalg.norm(slam.rig_turn_rad)))
    if turn_deg > 0.0:
        found.append(
            f"The second camera stands {turn_deg:.2f} degrees from where the calibration has it: the rows of "
            "the pictures do not agree. The map allows for it as far as it shows, but its scale may be "
            "off by several per cent: calibrate the stereo rig again."
        )
    found += _of_sensors(flight, slam)
    if flight.problems:
        found.append(
            f"{len(flight.problems)} files or rows were not used as they are: metrics.json names each."
        )
    return found


def _of_sensors(flight: Flight, slam: Slam) -> list[str]:
    """What the other sensors lack, and what was found wrong with them."""
    found = []
    if all(sensor.quantity is not Quantity.ATTITUDE for sensor in flight.sensors):
        found.append(
            "No attitude sensor: the camera is taken to hang level within "
            f"{slam.config.attitude.level_sigma_deg:g} degrees."
        )
    lag = slam.attitude_lag
    if isinstance(lag, ClockLag) and lag.is_significant:
        found.append(f"The attitude {lag}; the finished map allows for it.")
    offset = slam.adjustment.range_offset if slam.adjustment is not None else None
    if offset is not None:
        long = "long" if offset.offset_m > 0 else "short"
        found.append(
            f"The range sensor reads {100 * abs(offset.offset_m):.1f} +- {100 * offset.sigma_m:.1f} cm too "
            f"{long} at all heights; the finished map allows for it."
        )
    return found
