"""Trajectories as KITTI's odometry benchmark and EuRoC's data sets have them. (TUM is Overfly's own.)"""

from __future__ import annotations

from pathlib import Path

from overfly.files import atomic_path
from overfly.geometry.poses import Pose
from overfly.trajectory import Trajectory

EUROC_COLUMNS = (
    "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
)


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """world_from_cam as the twelve numbers of its first three rows, a pose a line; times are not in it.

    Raises OutputError.
    """
    rows = (pose.matrix()[:3].ravel() for pose in trajectory.poses())
    lines = [" ".join(f"{number:.12g}" for number in row) for row in rows]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_euroc(path: Path, trajectory: Trajectory, body_from_cam: Pose) -> None:
    """world_from_body, quaternions w first, times in nanoseconds. Raises OutputError."""
    cam_from_body = body_from_cam.inverse()
    lines = [EUROC_COLUMNS]
    for t_ns, pose in zip(trajectory.t_ns, trajectory.poses(), strict=True):
        body = pose @ cam_from_body
        x, y, z, w = body.quaternion()
        numbers = (*body.translation, w, x, y, z)
        lines.append(f"{t_ns}," + ",".join(f"{number:.12g}" for number in numbers))
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
