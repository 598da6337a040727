"""How long a busy machine keeps threads waiting: what a stream over it cannot be blamed for."""

from __future__ import annotations

import threading
import time


class Stalls:
    """The longest that this machine kept a thread waiting that wanted to wake every 5 ms."""

    longest_s = 0.0
    n_long = 0  # of more than 80 ms

    def __enter__(self) -> Stalls:
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _watch(self) -> None:
        before = time.monotonic()
        while not self._end.wait(0.005):
            late_s = time.monotonic() - before - 0.005
            self.longest_s = max(self.longest_s, late_s)
            self.n_long += late_s > 0.08
            before = time.monotonic()
