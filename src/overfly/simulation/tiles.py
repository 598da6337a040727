"""Ground texture at every scale, painted when first looked at: a cache of square tiles, 2:1 from level to
level.

Level l has texels of 2**(l - 12) metres (level 2: about 1 mm; level 9: 12.5 cm). A tile holds 128 x 128
texels and one more row and column on the far sides, so that linear interpolation never leaves it. Only what
the cameras see is ever painted, and no more than ``capacity`` tiles are kept, whatever the length of the
flight.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from overfly.simulation.kernels import FINEST_EXPONENT, LEVELS, TILE, table_entry
from overfly.simulation.patches import Patch
from overfly.types import Float32Array, IntArray

_WINDOW = 64  # tiles per axis and level that the table can tell apart at one time
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)  # ITU-R BT.709

Painter = Callable[[Patch], Float32Array]


def texel_of_level(level: int) -> float:
    return 2.0 ** (level - FINEST_EXPONENT)


class TileCache:
    """Tiles of one painter, in the form that render kernels read: a pool of tiles and a table that finds
    them.

    paint: patch -> (n, n, 3) linear reflectance. channels: 1 keeps luminance only, 3 keeps colour.
    """

    def __init__(self, paint: Painter, channels: int = 1, capacity: int = 2048) -> None:
        if channels not in (1, 3):
            raise ValueError(f"a ground texture has 1 or 3 channels, not {channels}")
        self._paint = paint
        self.channels = channels
        self.pool: NDArray[np.uint16] = np.zeros((capacity, TILE + 1, TILE + 1, channels), dtype=np.uint16)
        self.keys: IntArray = np.full(capacity, -1, dtype=np.int64)
        self.table: NDArray[np.int32] = np.full(LEVELS * _WINDOW * _WINDOW, -1, dtype=np.int32)
        self.last_used: IntArray = np.zeros(capacity, dtype=np.int64)
        self.clock = 1
        self.painted = 0

    def add(self, wanted: IntArray) -> None:
        """Paint the tiles with these keys (``tile_key``), each in place of the one unused for longest."""
        for key in np.unique(wanted):
            entry = int(table_entry(key))
            slot = int(self.table[entry])
            if slot >= 0 and self.keys[slot] == key:
                continue
            if slot < 0:
                slot = int(np.argmin(self.last_used))
                if self.keys[slot] >= 0:
                    self.table[int(table_entry(self.keys[slot]))] = -1
            self.pool[slot] = self._texels(int(key))
            self.keys[slot] = key
            self.table[entry] = slot
            self.last_used[slot] = self.clock
            self.painted += 1

    def tick(self) -> None:
        """A new frame begins: what it touches is younger than what earlier ones did."""
        self.clock += 1

    def _texels(self, key: int) -> NDArray[np.uint16]:
        level, i, j = key >> 48, ((key >> 24) & 0xFFFFFF) - 0x800000, (key & 0xFFFFFF) - 0x800000
        texel = texel_of_level(level)
        albedo = self._paint(Patch(i * TILE * texel, j * TILE * texel, texel, TILE + 1))
        if self.channels == 1:
            albedo = (albedo @ _LUMINANCE)[..., None]
        return np.asarray(albedo * np.float32(65535.0) + np.float32(0.5)).astype(np.uint16)
