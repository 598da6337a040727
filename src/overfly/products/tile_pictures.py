"""Pictures as the mosaic's tiles need them: at its resolution, the latest used kept in memory."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass, field

import cv2
import numpy as np

from overfly.geometry.cameras import Camera
from overfly.products.tile_labels import NODE_PX
from overfly.products.views import View
from overfly.types import UInt8Array

CACHE_BYTES = 256 * 2**20


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """pixels: (h, w) or (h, w, 3), at full size; small (h, w, channels): one pixel per NODE_PX."""

    pixels: UInt8Array
    small: UInt8Array

    @property
    def n_bytes(self) -> int:
        return self.small.nbytes + self.pixels.nbytes


@dataclass(slots=True)
class Pictures:
    """Pictures at the resolution of the mosaic, the latest used kept in memory. Threads may share them."""

    views: list[View]
    gsd_m: float
    _kept: OrderedDict[int, Picture] = field(default_factory=OrderedDict)
    _n_bytes: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def camera(self, index: int) -> Camera:
        camera, factor = self.views[index].image.camera, self._factor(index)
        return camera.scaled(max(1, camera.width // factor), max(1, camera.height // factor))

    def get(self, index: int) -> Picture:
        """Averaged down by a whole factor when its pixels are finer than the mosaic's."""
        with self._lock:
            if index in self._kept:
                self._kept.move_to_end(index)
                return self._kept[index]
            self._kept[index] = read = self._read(index)
            self._n_bytes += read.n_bytes
            while len(self._kept) > 1 and self._n_bytes > CACHE_BYTES:
                self._n_bytes -= self._kept.popitem(last=False)[1].n_bytes
            return read

    def _read(self, index: int) -> Picture:
        picture, camera = self.views[index].image.load(), self.camera(index)
        picture = _reduced(picture, camera.width, camera.height)
        rows, columns = max(camera.height // NODE_PX, 1), max(camera.width // NODE_PX, 1)
        small = _reduced(
            picture[: NODE_PX * rows, : NODE_PX * columns], columns, rows
        )  # whole pixels: faster
        return Picture(picture, small.reshape(*small.shape[:2], -1))

    def _factor(self, index: int) -> int:
        return max(1, int(1.15 * self.gsd_m / self.views[index].gsd_m))


def _reduced(picture: UInt8Array, width: int, height: int) -> UInt8Array:
    if picture.shape[:2] == (height, width):
        return picture
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
