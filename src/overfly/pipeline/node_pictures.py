"""Pictures of the nodes, kept while mapping as long as there is room, and otherwise read again: the elevation
and the mosaic both need them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from overfly.errors import OutputError
from overfly.geometry.cameras import Camera
from overfly.sensors import Flight
from overfly.types import Frame, Rig, UInt8Array
from overfly.vision.observation import working_rig

MOST_BYTES = 300 * 2**20


def reduced(picture: UInt8Array, camera: Camera) -> UInt8Array:
    """The picture at the camera's size."""
    size = (camera.width, camera.height)
    if picture.shape[1::-1] == size:
        return picture
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


@dataclass(slots=True, eq=False)
class KeptPictures:
    """Pictures of frames, as they came or reduced to max_width_px. Those that come first are kept: products
    go through all of them in order, again and again, so that the latest would be the wrong ones.
    """

    max_width_px: int
    _kept: dict[int, tuple[UInt8Array, ...]] = field(default_factory=dict)
    _n_bytes: int = 0

    def keep(self, frame: Frame, rig: Rig) -> tuple[UInt8Array, ...]:
        """The pictures of a frame, gray or RGB, at their final size; rig: that took them."""
        small = working_rig(rig, self.max_width_px)
        pictures = tuple(
            reduced(picture, mounted.camera)
            for picture, mounted in zip(frame.images, small.cameras, strict=False)
        )
        size = sum(picture.nbytes for picture in pictures)
        if frame.index not in self._kept and self._n_bytes + size <= MOST_BYTES:
            self._kept[frame.index] = pictures
            self._n_bytes += size
        return pictures

    def get(self, frame_index: int) -> tuple[UInt8Array, ...] | None:
        return self._kept.get(frame_index)


@dataclass(frozen=True, slots=True, eq=False)
class NodePictures:
    """Pictures of a flight no wider than its kept ones; source_rig: the cameras they are of, as recorded."""

    flight: Flight
    kept: KeptPictures
    source_rig: Rig

    @property
    def rig(self) -> Rig:
        """The cameras that the pictures are of."""
        return working_rig(self.source_rig, self.kept.max_width_px)

    def get(self, frame_index: int) -> tuple[UInt8Array, ...]:
        """Of a frame, one per camera, gray or RGB. Raises OutputError when it is gone."""
        pictures = self.kept.get(frame_index)
        if pictures is not None:
            return pictures
        frame = self.flight.read_frame(frame_index)
        if frame is None:
            raise OutputError(
                f"{self.flight.path}: frame {frame_index} could be read before and cannot be read now"
            )
        return self.kept.keep(frame, self.source_rig)

    def loader(self, frame_index: int) -> Callable[[], tuple[UInt8Array, ...]]:
        """Gives the pictures when asked."""
        return lambda: self.get(frame_index)

    def first_loader(self, frame_index: int) -> Callable[[], UInt8Array]:
        """Gives the first camera's picture when asked."""
        return lambda: self.get(frame_index)[0]
