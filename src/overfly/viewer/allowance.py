"""How much of a processor core a view may take: what it has spent is waited for before it draws again."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field


def cpu_seconds(threads: Iterable[threading.Thread]) -> float:
    """Processor time that the calling thread and others have used, where the system tells of others."""
    total = time.thread_time()
    if not hasattr(time, "pthread_getcpuclockid"):
        return total
    for thread in threads:
        if thread.is_alive() and thread.ident is not None and thread is not threading.current_thread():
            total += time.clock_gettime(time.pthread_getcpuclockid(thread.ident))
    return total


@dataclass(slots=True, eq=False)
class Allowance:
    """share: of a core, that may be spent; saved_s: seconds that may be saved up for a burst; spent_s: tells
    the processor time spent so far; now_s: the clock."""

    share: float
    saved_s: float
    spent_s: Callable[[], float]
    now_s: Callable[[], float] = time.perf_counter
    _left_s: float = 0.0
    _then: tuple[float, float] | None = field(default=None)

    def wait_s(self) -> float:
        """Seconds until more may be spent; 0 at the first call, from which on it is counted."""
        now, spent = self.now_s(), self.spent_s()
        if self._then is None:
            self._left_s = self.saved_s
        else:
            earned = self.share * (now - self._then[0])
            self._left_s = min(self._left_s + earned, self.saved_s) - (spent - self._then[1])
        self._then = now, spent
        return max(-self._left_s, 0.0) / self.share
