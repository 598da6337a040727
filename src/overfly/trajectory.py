"""Trajectories and their TUM files: ``t tx ty tz qx qy qz qw``, seconds and metres, one pose a line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from overfly.errors import GraphFileError
from overfly.files import atomic_path
from overfly.geometry.poses import FloatArray, Pose

NS_PER_S = 1_000_000_000
TUM_COLUMNS = "timestamp [s] tx ty tz qx qy qz qw"


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses over time, n of them: world_from_cam unless the file says otherwise.

    t_ns (n,) int64, increasing; positions (n, 3) metres, in the world; quaternions_xyzw (n, 4), unit length.
    """

    t_ns: NDArray[np.int64]
    positions: FloatArray
    quaternions_xyzw: FloatArray

    @staticmethod
    def from_poses(t_ns: Sequence[int] | NDArray[np.int64], poses: Sequence[Pose]) -> Trajectory:
        """t_ns: n times; poses: as many ``world_from_cam``."""
        return Trajectory(
            np.asarray(t_ns, dtype=np.int64).reshape(-1),
            np.array([pose.translation for pose in poses], dtype=np.float64).reshape(-1, 3),
            np.array([pose.quaternion() for pose in poses], dtype=np.float64).reshape(-1, 4),
        )

    def __len__(self) -> int:
        return len(self.t_ns)

    def pose(self, index: int) -> Pose:
        return Pose.from_quaternion(self.quaternions_xyzw[index], self.positions[index])

    def poses(self) -> list[Pose]:
        return [self.pose(index) for index in range(len(self))]

    def at(self, indices: NDArray[np.int64]) -> Trajectory:
        """The poses at these rows, in this order."""
        return Trajectory(self.t_ns[indices], self.positions[indices], self.quaternions_xyzw[indices])

    def path_m(self) -> FloatArray:
        """(n,) metres travelled from the first pose to each."""
        steps = np.linalg.norm(np.diff(self.positions, axis=0), axis=1)
        return np.concatenate([np.zeros(min(1, len(self))), np.cumsum(steps)])


def read_tum(path: str | Path) -> Trajectory:
    """Read a TUM trajectory.

    Raises GraphFileError, naming file and row, for anything but increasing times and finite poses.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not a text file"
        raise GraphFileError(f"cannot read trajectory {path}: {reason}") from error
    t_ns: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        stamp, numbers = _parse_row(line, f"{path}, row {number}")
        if t_ns and stamp <= t_ns[-1]:
            raise GraphFileError(f"{path}, row {number}: time does not increase; sort the file by time")
        t_ns.append(stamp)
        rows.append(numbers)
    if not rows:
        raise GraphFileError(f"{path} holds no pose; a TUM file has lines of: {TUM_COLUMNS}")
    table = np.array(rows)
    quaternions = table[:, 3:] / np.linalg.norm(table[:, 3:], axis=1, keepdims=True)
    return Trajectory(np.array(t_ns, dtype=np.int64), table[:, :3].copy(), quaternions)


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a TUM trajectory, whole or not at all. Raises OutputError."""
    lines = [f"# {TUM_COLUMNS}"]
    rows = zip(trajectory.t_ns, trajectory.positions, trajectory.quaternions_xyzw, strict=True)
    for stamp, position, quaternion in rows:
        x, y, z = position
        qx, qy, qz, qw = quaternion
        lines.append(
            f"{_seconds(int(stamp))} {x:.9f} {y:.9f} {z:.9f} {qx:.12f} {qy:.12f} {qz:.12f} {qw:.12f}"
        )
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _parse_row(line: str, where: str) -> tuple[int, list[float]]:
    """Time and seven numbers of a line; the time in decimal, for doubles lose this century's nanoseconds."""
    words = line.replace(",", " ").split()
    if len(words) != 8:
        raise GraphFileError(f"{where}: {len(words)} columns, expected 8: {TUM_COLUMNS}")
    try:
        stamp = int((Decimal(words[0]) * NS_PER_S).to_integral_value())
        numbers = [float(word) for word in words[1:]]
    except (InvalidOperation, ValueError, OverflowError) as error:
        raise GraphFileError(f"{where}: a word that is not a number") from error
    if abs(stamp) > np.iinfo(np.int64).max:
        raise GraphFileError(f"{where}: time {words[0]} is no time in seconds")
    if not np.isfinite(numbers).all():
        raise GraphFileError(f"{where}: a number that is not finite")
    if not any(numbers[3:]):
        raise GraphFileError(f"{where}: the quaternion is zero")
    return stamp, numbers


def _seconds(t_ns: int) -> str:
    seconds, rest = divmod(abs(t_ns), NS_PER_S)
    return f"{'-' if t_ns < 0 else ''}{seconds}.{rest:09d}"
