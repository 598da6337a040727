"""An autopilot on the loopback: heartbeat, clock, attitude, range and parameters; it
keeps what it is sent.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Mapping
from typing import Any

from pymavlink import mavutil

from overfly.navigation.mavlink.dialect import DIALECT, Autopilot, messages

KINDS = {
    Autopilot.ARDUPILOT: messages.MAV_AUTOPILOT_ARDUPILOTMEGA,
    Autopilot.PX4: messages.MAV_AUTOPILOT_PX4,
}


class FakeAutopilot:
    """Speaks to whoever sends to its UDP port. received: (arrival in ns of the monotonic clock, message)."""

    def __init__(
        self,
        kind: Autopilot = Autopilot.ARDUPILOT,
        parameters: Mapping[str, float] | None = None,
        attitude_hz: float = 50.0,
        boot_ago_s: float = 123.4,
    ) -> None:
        self.kind = kind
        self.parameters = dict(parameters or {})
        self.received: list[tuple[int, Any]] = []
        self.roll, self.pitch, self.yaw, self.range_cm = 0.1, 0.05, 0.3, 500
        self.custom_mode = 0
        self._attitude_s = 1.0 / attitude_hz
        self._boot_ns = time.monotonic_ns() - int(boot_ago_s * 1e9)
        self._connection = mavutil.mavlink_connection(
            "udpin:127.0.0.1:0", source_system=1, source_component=1, dialect=DIALECT
        )
        self.url = f"udpout:127.0.0.1:{self._connection.port.getsockname()[1]}"
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def __enter__(self) -> FakeAutopilot:
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join()
        self._connection.close()

    def of_type(self, kind: str) -> list[tuple[int, Any]]:
        return [entry for entry in list(self.received) if entry[1].get_type() == kind]

    def boot_ns(self) -> int:
        return time.monotonic_ns() - self._boot_ns

    def _run(self) -> None:
        due = {"heartbeat": 0, "attitude": 0}
        while not self._closing.is_set():
            now_ns = time.monotonic_ns()
            mav = self._connection.mav
            if self._connection.clients:
                if now_ns >= due["heartbeat"]:
                    due["heartbeat"] = now_ns + 200_000_000
                    mav.heartbeat_send(2, KINDS[self.kind], 0, self.custom_mode, 4)
                if now_ns >= due["attitude"]:
                    due["attitude"] = now_ns + int(self._attitude_s * 1e9)
                    boot_ms = self.boot_ns() // 1_000_000
                    mav.attitude_send(boot_ms, self.roll, self.pitch, self.yaw, 0, 0, 0)
                    mav.distance_sensor_send(boot_ms, 10, 4000, self.range_cm, 0, 0, 25, 255)
                    mav.local_position_ned_send(boot_ms, 10.0, 20.0, -5.0, 0, 0, 0)
            self._connection.select(0.005)
            while (message := self._connection.recv_msg()) is not None:
                self._answer(message)

    def _answer(self, message: Any) -> None:
        self.received.append((time.monotonic_ns(), message))
        kind = message.get_type()
        if kind == "TIMESYNC" and message.tc1 == 0:
            self._connection.mav.timesync_send(self.boot_ns(), message.ts1)
        elif kind == "PARAM_REQUEST_READ" and message.param_id in self.parameters:
            value = self.parameters[message.param_id]
            is_whole = isinstance(value, int)
            sent = float(value)
            if is_whole and self.kind is Autopilot.PX4:
                (sent,) = struct.unpack("<f", struct.pack("<i", value))
            self._connection.mav.param_value_send(
                message.param_id.encode(), sent, 6 if is_whole else 9, len(self.parameters), 0
            )
