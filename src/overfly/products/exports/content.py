"""What writers of other formats are given: the map as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray, Pose
from overfly.types import IntArray, UInt8Array


@dataclass(frozen=True, slots=True, eq=False)
class GroundPoints:
    """Points that the map measured, n of them.

    positions (n, 3) metres, world; sigma_m (n,) standard deviation of their depth; rgb (n, 3), None where no
    colour is known.
    """

    positions: FloatArray
    sigma_m: FloatArray
    rgb: UInt8Array | None = None

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True, slots=True, eq=False)
class NodeImage:
    """A node as a picture with the points seen in it.

    camera: row of the list of cameras; px (m, 2) pixels of the picture as recorded; point (m,) row of the
    point that was seen there, -1 for none.
    """

    name: str
    camera: int
    world_from_cam: Pose
    px: FloatArray
    point: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """The map as structure from motion knows it."""

    cameras: tuple[Camera, ...]
    images: tuple[NodeImage, ...]
    points: GroundPoints
