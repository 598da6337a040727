"""Pictures that are needed again and again, in a file without a name: gone when the process is."""

from __future__ import annotations

import tempfile
from collections import OrderedDict
from pathlib import Path
from typing import IO

import cv2
import numpy as np

from overfly.errors import OutputError
from overfly.types import UInt8Array

QUALITY = 95  # JPEG: an error of a gray level or two
CACHE_BYTES = 96 * 2**20


class PictureSpool:
    """uint8 (h, w) or (h, w, 3) RGB by number; those that were used last are kept in memory."""

    def __init__(self, folder: Path) -> None:
        """Raises OutputError when no file can be made in the folder."""
        self._folder = folder
        self._places: dict[int, tuple[int, int]] = {}
        self._cache: OrderedDict[int, UInt8Array] = OrderedDict()
        self._n_bytes = 0
        try:
            self._file: IO[bytes] = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  lives as long as this
        except OSError as error:
            raise self._failed(error) from error

    def add(self, number: int, picture: UInt8Array) -> None:
        """Raises OutputError when the disk is full."""
        colours = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
        data = cv2.imencode(".jpg", colours, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
        try:
            place = self._file.seek(0, 2)
            self._file.write(data)
            self._file.flush()
        except OSError as error:
            raise self._failed(error) from error
        self._places[number] = (place, len(data))

    def get(self, number: int) -> UInt8Array:
        """A picture that was added. Raises OutputError when it cannot be read back."""
        if number not in self._cache:
            place, size = self._places[number]
            try:
                self._file.seek(place)
                data = np.frombuffer(self._file.read(size), np.uint8)
            except OSError as error:
                raise self._failed(error) from error
            picture = _decoded(data)
            if picture is None:
                raise OutputError(f"a picture that was set aside in {self._folder} cannot be read back")
            self._cache[number] = picture
            self._n_bytes += picture.nbytes
            while len(self._cache) > 1 and self._n_bytes > CACHE_BYTES:
                self._n_bytes -= self._cache.popitem(last=False)[1].nbytes
        self._cache.move_to_end(number)
        return self._cache[number]

    def close(self) -> None:
        self._file.close()

    def _failed(self, error: OSError) -> OutputError:
        return OutputError(f"pictures cannot be set aside in {self._folder}: {error.strerror or error}")


def _decoded(data: UInt8Array) -> UInt8Array | None:
    read = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if read is None or read.ndim == 2:
        return None if read is None else np.asarray(read, np.uint8)
    return np.asarray(cv2.cvtColor(read, cv2.COLOR_BGR2RGB), np.uint8)
