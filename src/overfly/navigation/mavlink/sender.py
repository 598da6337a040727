"""The stream of ODOMETRY to an autopilot: fixes as they come, guesses where one is late,
silence when lost.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from overfly.navigation.mavlink.dialect import Autopilot
from overfly.navigation.mavlink.encoders import encode_global_position, encode_odometry
from overfly.navigation.mavlink.fix_stream import FixStream, Located
from overfly.navigation.mavlink.placement import Placement
from overfly.navigation.mavlink.state import VehicleState
from overfly.types import Attitude

# ArduPilot's EKF3 passes over what comes within 20 ms of the last; PX4 stops at 200 ms without a sample.
SHORTEST_INTERVAL_S = 0.025
GUESS_AFTER_S = 0.12
GLOBAL_EVERY_S = 0.2
WAKE_EVERY_S = 0.01


class Link(Protocol):
    """Where messages go."""

    def send(self, message: Any) -> None: ...


@dataclass(slots=True)
class SendingReport:
    """fixes, guesses: messages sent. longest_gap_s: between two of them, while there was
    something to send.
    """

    fixes: int = 0
    guesses: int = 0
    silences: int = 0
    longest_gap_s: float = 0.0
    latency_s: float = 0.0  # from the picture to the message, smoothed


class OdometrySender:
    """Takes what became of every frame; a thread of its own fills what is late with guesses."""

    def __init__(
        self,
        link: Link,
        stream: FixStream,
        autopilot: Autopilot,
        placement: Placement | None = None,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.stream = stream
        self.placement = placement or Placement()
        self.report = SendingReport()
        self.newest: VehicleState | None = None  # what was sent last
        self._link = link
        self._autopilot = autopilot
        self._clock_ns = clock_ns
        self._lock = threading.Lock()
        self._sent_ns = 0  # when
        self._global_ns = 0
        self._is_silent = True
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._fill, name="overfly-odometry", daemon=True)
        self._thread.start()

    def __enter__(self) -> OdometrySender:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Nothing is sent from now on."""
        self._closing.set()
        self._thread.join()

    def observe(self, located: Located, attitude: Attitude | None = None) -> VehicleState | None:
        """What became of one frame. Returns what was sent for it."""
        with self._lock:
            state = self.stream.observe(located, attitude)
            if state is None or state.is_guess:  # the other thread sends those, at its own pace
                return None
            latency_s = (self._clock_ns() - state.t_ns) * 1e-9
            share = 0.1 if self.report.fixes else 1.0
            self.report.latency_s += share * (latency_s - self.report.latency_s)
            return state if self._send(state) else None

    def _fill(self) -> None:
        while not self._closing.wait(WAKE_EVERY_S):
            with self._lock:
                now_ns = self._clock_ns()
                if self._sent_ns and now_ns - self._sent_ns < GUESS_AFTER_S * 1e9:
                    continue
                # As old as a fix would be: the next one must not come before it in time.
                guess = self.stream.guess(now_ns - int(self.report.latency_s * 1e9))
                if guess is not None:
                    self._send(guess)
                elif not self._is_silent:
                    self._is_silent = True
                    self.report.silences += 1

    def _send(self, state: VehicleState) -> bool:
        """Send unless it comes too soon after the last, or is older than it."""
        last = self.newest
        if last is not None and not self._is_silent:
            since_s = (state.t_ns - last.t_ns) * 1e-9
            if since_s < SHORTEST_INTERVAL_S:
                return False
        now_ns = self._clock_ns()
        self._link.send(encode_odometry(state, self.placement, self._autopilot))
        if not self._is_silent:
            gap_s = (now_ns - self._sent_ns) * 1e-9
            self.report.longest_gap_s = max(self.report.longest_gap_s, gap_s)
        self._is_silent, self._sent_ns, self.newest = False, now_ns, state
        self.report.fixes += not state.is_guess
        self.report.guesses += state.is_guess
        if not state.is_guess and now_ns - self._global_ns >= GLOBAL_EVERY_S * 1e9:
            self._send_global(state, now_ns)
        return True

    def _send_global(self, state: VehicleState, now_ns: int) -> None:
        message = encode_global_position(state, self.placement, self._autopilot, now_ns, time.time())
        if message is not None:
            self._link.send(message)
            self._global_ns = now_ns
