"""A camera that runs now: camera:0 (the computer's first one), or a stream as rtsp://host/path.

A thread takes every picture as it comes and keeps the newest, so that a slow reader sees the present and not
a queue of the past. Stamps are those of our monotonic clock when a picture arrived, less the camera's delay.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np

from overfly.errors import SourceError, UsageError
from overfly.types import UInt8Array

_DEVICE = re.compile(r"camera:(\d+)$")
_STREAM = re.compile(r"(rtsps?|https?|udp|rtmp|tcp):/{1,2}")  # a path joins two slashes to one
FIRST_PICTURE_S = 10.0
ENDED_AFTER = 50  # failures in a row


class Capture(Protocol):
    """As OpenCV's VideoCapture: waits for a picture, BGR or gray."""

    def read(self) -> tuple[bool, Any]: ...
    def release(self) -> None: ...


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """(H, W) gray or (H, W, 3) RGB, taken at t_ns of the monotonic clock; number: how many came before it."""

    t_ns: int
    number: int
    image: UInt8Array


def is_live(source: str) -> bool:
    """Whether a source is a camera or a stream, not a file."""
    return _DEVICE.match(source) is not None or _STREAM.match(source) is not None


class LiveCamera:
    """The newest picture of a camera; closes as a context manager."""

    def __init__(
        self,
        capture: Capture,
        name: str = "camera",
        delay_s: float = 0.0,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """delay_s: from the exposure until the picture arrives."""
        self.name = name
        self.ended = False
        self._capture = capture
        self._delay_ns = round(delay_s * 1e9)
        self._clock_ns = clock_ns
        self._newest: Picture | None = None
        self._changed = threading.Condition()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._take, name="overfly-camera", daemon=True)
        self._thread.start()

    @staticmethod
    def open(source: str, delay_s: float = 0.0) -> LiveCamera:
        """source: camera:N or the URL of a stream. Raises SourceError in one line when there is none."""
        device = _DEVICE.match(source)
        if not is_live(source):
            raise UsageError(f"{source}: not a live camera; write camera:0 or rtsp://host/path")
        if device:
            capture = cv2.VideoCapture(int(device.group(1)))
        else:
            capture = cv2.VideoCapture(_STREAM.sub(r"\1://", source, count=1))
        if not capture.isOpened():
            raise SourceError(f"{source}: no such camera, or in use by another program")
        return LiveCamera(capture, source, delay_s)

    def __enter__(self) -> LiveCamera:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the reading and give the camera back."""
        self._closing.set()
        self._thread.join(timeout=2.0)  # a camera that hangs must not hold the program
        self._capture.release()

    def next(self, after: Picture | None = None, timeout_s: float = 1.0) -> Picture | None:
        """The newest picture, later than one that is given; None when none came in time."""
        seen = -1 if after is None else after.number

        def is_new() -> bool:
            return self.ended or (self._newest is not None and self._newest.number > seen)

        with self._changed:
            self._changed.wait_for(is_new, timeout_s)
            newest = self._newest
        return newest if newest is not None and newest.number > seen else None

    def first(self) -> Picture:
        """Raises SourceError when the camera shows nothing."""
        picture = self.next(timeout_s=FIRST_PICTURE_S)
        if picture is None:
            raise SourceError(f"{self.name}: no picture within {FIRST_PICTURE_S:g} s; check the camera")
        return picture

    def _take(self) -> None:
        count = failures = 0
        while not self._closing.is_set() and failures < ENDED_AFTER:
            is_read, image = self._capture.read()
            t_ns = self._clock_ns() - self._delay_ns
            if not is_read or image is None:
                failures += 1
                self._closing.wait(0.02)
                continue
            failures = 0
            colours = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
            with self._changed:
                self._newest = Picture(t_ns, count, np.ascontiguousarray(colours, dtype=np.uint8))
                self._changed.notify_all()
            count += 1
        with self._changed:
            self.ended = True
            self._changed.notify_all()
