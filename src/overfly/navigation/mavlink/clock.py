"""How an autopilot's clock stands against ours, by the round trips of TIMESYNC."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

KEPT = 60  # round trips that the estimate looks back on
LONGEST_ROUND_TRIP_NS = 200_000_000  # slower ones say nothing


@dataclass(frozen=True, slots=True)
class ClockState:
    """offset_ns: what to add to the autopilot's time to have ours. round_trip_ns: the quickest one, whose
    half bounds the error. drift_ppm: how much faster the autopilot's clock runs, None before enough round
    trips.
    """

    offset_ns: int
    round_trip_ns: int
    drift_ppm: float | None
    n_round_trips: int


@dataclass(slots=True)
class ClockOffset:
    """The quickest of the last round trips has the least to be wrong by: the answer was made within it."""

    _kept: deque[tuple[int, int, int]] = field(default_factory=lambda: deque(maxlen=KEPT))
    _count: int = 0

    def add(self, sent_ns: int, received_ns: int, autopilot_ns: int) -> None:
        """One round trip: sent and received by our clock, answered at autopilot_ns by the autopilot's."""
        took_ns = received_ns - sent_ns
        if not 0 <= took_ns <= LONGEST_ROUND_TRIP_NS:
            return
        offset_ns = (sent_ns + received_ns) // 2 - autopilot_ns
        if self._kept and abs(offset_ns - self._kept[-1][2]) > LONGEST_ROUND_TRIP_NS:
            self._kept.clear()  # the autopilot began anew
        self._kept.append((received_ns, took_ns, offset_ns))
        self._count += 1

    def state(self) -> ClockState | None:
        """The estimate; None before the first round trip."""
        if not self._kept:
            return None
        _, took_ns, offset_ns = min(self._kept, key=lambda entry: entry[1])
        first, last = self._kept[0], self._kept[-1]
        lasted_ns = last[0] - first[0]
        drift = -1e6 * (last[2] - first[2]) / lasted_ns if lasted_ns > 5_000_000_000 else None
        return ClockState(offset_ns, took_ns, drift, self._count)

    def ours(self, autopilot_ns: int) -> int | None:
        """An instant of the autopilot's clock on ours."""
        state = self.state()
        return None if state is None else autopilot_ns + state.offset_ns
