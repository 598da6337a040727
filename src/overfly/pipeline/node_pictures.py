"""Pictures of the nodes, read again when the flight is over and kept while there is room: the elevation and
the mosaic both need them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from overfly.errors import OutputError
from overfly.geometry.cameras import Camera
from overfly.sensors import Flight
from overfly.types import Rig, UInt8Array
from overfly.vision.observation import working_rig

MOST_BYTES = 300 * 2**20


def reduced(picture: UInt8Array, camera: Camera) -> UInt8Array:
    """The picture at the camera's size."""
    size = (camera.width, camera.height)
    if picture.shape[1::-1] == size:
        return picture
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


@dataclass(slots=True, eq=False)
class NodePictures:
    """Pictures no wider than max_width_px; ``rig`` has the cameras that they are of: those of source_rig, or
    of the flight.
    """

    flight: Flight
    max_width_px: int
    source_rig: Rig | None = None
    rig: Rig = field(init=False)
    _kept: OrderedDict[int, tuple[UInt8Array, ...]] = field(default_factory=OrderedDict)
    _n_bytes: int = 0

    def __post_init__(self) -> None:
        self.rig = working_rig(self.source_rig or self.flight.rig, self.max_width_px)

    def get(self, frame_index: int) -> tuple[UInt8Array, ...]:
        """Of a frame, one per camera, gray or RGB. Raises OutputError when it is gone."""
        if frame_index in self._kept:
            self._kept.move_to_end(frame_index)
            return self._kept[frame_index]
        frame = self.flight.read_frame(frame_index)
        if frame is None:
            raise OutputError(
                f"{self.flight.path}: frame {frame_index} could be read before and cannot be read now"
            )
        pictures = [
            reduced(picture, mounted.camera)
            for picture, mounted in zip(frame.images, self.rig.cameras, strict=False)
        ]
        self._kept[frame_index] = tuple(pictures)
        self._n_bytes += sum(picture.nbytes for picture in pictures)
        while len(self._kept) > 1 and self._n_bytes > MOST_BYTES:
            _, gone = self._kept.popitem(last=False)
            self._n_bytes -= sum(picture.nbytes for picture in gone)
        return self._kept[frame_index]

    def loader(self, frame_index: int) -> Callable[[], tuple[UInt8Array, ...]]:
        """Gives the pictures when asked."""
        return lambda: self.get(frame_index)

    def first_loader(self, frame_index: int) -> Callable[[], UInt8Array]:
        """Gives the first camera's picture when asked."""
        return lambda: self.get(frame_index)[0]
