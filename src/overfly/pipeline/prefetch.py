"""Frames read, decoded and prepared ahead, on the second core, while the present one is processed.

They are the same in the same order, so that results do not depend on it.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from typing import TypeVar

FRAMES_AHEAD = 3
Read = TypeVar("Read")
Prepared = TypeVar("Prepared")
STOP_WITHIN_S = 2.0  # a source that gives no frames is not waited for longer
WAKE_EVERY_S = 0.1  # how often a reader that waits for room looks whether it is still wanted


@dataclass(frozen=True, slots=True, eq=False)
class _Ended:
    """The last thing in the queue: what ended the reading, None at the end of the flight."""

    error: BaseException | None


def read_ahead(
    frames: Iterable[Read], prepare: Callable[[Read], Prepared], count: int = FRAMES_AHEAD
) -> Generator[Prepared, None, None]:
    """What prepare makes of the frames, up to count of them before they are asked for.

    prepare must not depend on what becomes of the frames before. What reading or preparing raises is raised
    here, after the frames before it. Reading stops when this is closed.
    """
    waiting: queue.Queue[Prepared | _Ended] = queue.Queue(count)
    stop = threading.Event()

    def put(item: Prepared | _Ended) -> bool:
        while not stop.is_set():
            try:
                waiting.put(item, timeout=WAKE_EVERY_S)
            except queue.Full:
                continue
            return True
        return False

    def read() -> None:
        try:
            for frame in frames:
                if not put(prepare(frame)):
                    return
        except BaseException as error:  # raised where the frames are asked for
            put(_Ended(error))
        else:
            put(_Ended(None))

    reader = threading.Thread(target=read, name="overfly-reader", daemon=True)
    reader.start()
    try:
        while True:
            item = waiting.get()
            if isinstance(item, _Ended):
                if item.error is not None:
                    raise item.error
                return
            yield item
    finally:
        stop.set()
        reader.join(STOP_WITHIN_S)
