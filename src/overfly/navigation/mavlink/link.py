"""A link to an autopilot: its messages taken as they come, its clock followed, ours sent without mixing."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from pymavlink import mavutil

from overfly.errors import SourceError
from overfly.navigation.mavlink.clock import ClockOffset
from overfly.navigation.mavlink.dialect import COMPONENT, DIALECT, Autopilot, autopilot_of, messages
from overfly.navigation.mavlink.telemetry import Telemetry
from overfly.types import Altitude, Attitude

TIMESYNC_EVERY_S = 0.2
HEARTBEAT_EVERY_S = 1.0
REQUEST_EVERY_S = 5.0  # the autopilot may begin anew and forget what was asked for
WAKE_EVERY_S = 0.02
SILENT_AFTER_S = 3.0
ANSWER_S = 10.0  # for the first heartbeat
DEFAULT_BAUD = 921_600
# Messages that are asked for, and how often a second.
WANTED_HZ = {
    messages.MAVLINK_MSG_ID_ATTITUDE: 50.0,
    messages.MAVLINK_MSG_ID_DISTANCE_SENSOR: 20.0,
    messages.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 10.0,
}
_INTEGER_TYPES = {
    messages.MAV_PARAM_TYPE_UINT8: "<Bxxx",
    messages.MAV_PARAM_TYPE_INT8: "<bxxx",
    messages.MAV_PARAM_TYPE_UINT16: "<Hxx",
    messages.MAV_PARAM_TYPE_INT16: "<hxx",
    messages.MAV_PARAM_TYPE_UINT32: "<I",
    messages.MAV_PARAM_TYPE_INT32: "<i",
}


class AutopilotLink:
    """Open with :meth:`open`; closes as a context manager. A thread of its own reads; any thread may send.

    clock_ns: our clock, by which pictures are stamped, too; it must not jump.
    """

    def __init__(self, connection: Any, url: str, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self.url = url
        self.clock_ns = clock_ns
        self.telemetry = Telemetry()
        self.clock = ClockOffset()
        self.received: Counter[str] = Counter()  # messages of the autopilot, by type
        self.heartbeat: Any | None = None
        self._heard_ns = 0
        self._connection = connection
        self._sending = threading.Lock()
        self._changed = threading.Condition()
        self._parameters: dict[str, float] = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="overfly-mavlink", daemon=True)
        self._thread.start()

    @staticmethod
    def open(url: str, clock_ns: Callable[[], int] = time.monotonic_ns) -> AutopilotLink:
        """url: udpin:0.0.0.0:14550, udpout:host:port, tcp:host:port, or a serial port as /dev/ttyAMA0,921600.

        Raises SourceError in one line when it cannot be opened.
        """
        device, _, baud = url.partition(",")
        try:
            connection = mavutil.mavlink_connection(
                device,
                baud=int(baud) if baud else DEFAULT_BAUD,
                source_component=COMPONENT,
                dialect=DIALECT,
                autoreconnect=True,
                retries=1,
            )
        except ModuleNotFoundError as error:
            raise SourceError(f"{url}: serial ports need one more package: pip install pyserial") from error
        except (OSError, ValueError, IndexError, socket.gaierror) as error:
            raise SourceError(
                f"{url}: no link ({error}); give udpin:0.0.0.0:14550, udpout:host:port, tcp:host:port "
                "or a serial port as /dev/ttyAMA0,921600"
            ) from error
        return AutopilotLink(connection, url, clock_ns)

    def __enter__(self) -> AutopilotLink:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the reading and close the port."""
        self._closing.set()
        self._thread.join()
        self._connection.close()

    # -- what the autopilot is

    def wait_for_autopilot(self, timeout_s: float | None = None) -> Autopilot:
        """Which autopilot answers. Raises SourceError when none does, or one whose rules are not known."""
        timeout_s = ANSWER_S if timeout_s is None else timeout_s
        if not self._wait(lambda: self.heartbeat is not None, timeout_s):
            raise SourceError(
                f"{self.url}: no heartbeat of an autopilot within {timeout_s:g} s; check port and cable"
            )
        kind = self.autopilot
        if kind is None:
            raise SourceError(f"{self.url}: neither ArduPilot nor PX4 answers there; no other is known")
        return kind

    @property
    def autopilot(self) -> Autopilot | None:
        return None if self.heartbeat is None else autopilot_of(self.heartbeat.autopilot)

    @property
    def is_silent(self) -> bool:
        """Nothing was heard for a while."""
        return self.heartbeat is None or self.clock_ns() - self._heard_ns > SILENT_AFTER_S * 1e9

    @property
    def target(self) -> tuple[int, int]:
        """System and component of the autopilot; (0, 0), everybody, before its first heartbeat."""
        if self.heartbeat is None:
            return 0, 0
        return self.heartbeat.get_srcSystem(), self.heartbeat.get_srcComponent()

    # -- what its sensors say

    def attitude_at(self, t_ns: int, wait_s: float = 0.0) -> Attitude | None:
        """Attitude at an instant of our clock; waits up to wait_s for a sample after it."""
        self._wait(lambda: (self.telemetry.newest_attitude_ns or 0) >= t_ns, wait_s)
        return self.telemetry.attitude_at(t_ns)

    def range_at(self, t_ns: int) -> Altitude | None:
        """Distance to the ground below at an instant of our clock."""
        return self.telemetry.range_at(t_ns)

    def parameter(self, name: str, timeout_s: float = 1.0) -> float | None:
        """Value of a parameter as the autopilot has it now; None when it does not answer or has none."""
        self._parameters.pop(name, None)
        for _ in range(3):  # requests get lost on radio links
            system, component = self.target
            self.send(messages.MAVLink_param_request_read_message(system, component, name.encode(), -1))
            if self._wait(lambda: name in self._parameters, timeout_s / 3.0):
                return self._parameters[name]
        return None

    # -- sending

    def send(self, message: Any) -> None:
        """One message of pymavlink's. Raises SourceError when the link is broken for good."""
        with self._sending:
            try:
                self._connection.mav.send(message)
            except ConnectionRefusedError:
                pass  # nobody listens at the other end yet
            except OSError as error:
                raise SourceError(f"{self.url}: the link broke ({error})") from error

    # -- the reading thread

    def _wait(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        with self._changed:
            return self._changed.wait_for(condition, timeout_s)

    def _run(self) -> None:
        due = dict.fromkeys(("heartbeat", "timesync", "request"), 0)
        while not self._closing.is_set():
            self._send_what_is_due(due)
            try:
                self._connection.select(WAKE_EVERY_S)
                while (message := self._connection.recv_msg()) is not None:
                    self._take(message)
            except OSError:  # the peer is gone for now; it may come back
                self._closing.wait(WAKE_EVERY_S)

    def _send_what_is_due(self, due: dict[str, int]) -> None:
        now_ns = self.clock_ns()
        for name, every_s in (
            ("heartbeat", HEARTBEAT_EVERY_S),
            ("timesync", TIMESYNC_EVERY_S),
            ("request", REQUEST_EVERY_S),
        ):
            if now_ns < due[name] or (name == "request" and self.heartbeat is None):
                continue
            due[name] = now_ns + int(every_s * 1e9)
            try:
                self._send_one(name)
            except SourceError:
                return  # it may come back

    def _send_one(self, name: str) -> None:
        if name == "heartbeat":
            self.send(
                messages.MAVLink_heartbeat_message(
                    messages.MAV_TYPE_ONBOARD_CONTROLLER,
                    messages.MAV_AUTOPILOT_INVALID, 0, 0, messages.MAV_STATE_ACTIVE, 3,
                )
            )  # fmt: skip
        elif name == "timesync":
            self.send(messages.MAVLink_timesync_message(0, self.clock_ns()))
        else:
            for message_id, rate_hz in WANTED_HZ.items():
                self.send(
                    messages.MAVLink_command_long_message(
                        *self.target, messages.MAV_CMD_SET_MESSAGE_INTERVAL, 0,
                        message_id, 1e6 / rate_hz, 0, 0, 0, 0, 0,
                    )
                )  # fmt: skip

    def _take(self, message: Any) -> None:
        now_ns = self.clock_ns()
        kind = message.get_type()
        if kind == "BAD_DATA":
            return
        with self._changed:
            if kind == "HEARTBEAT" and message.autopilot != messages.MAV_AUTOPILOT_INVALID:
                self.heartbeat = message
                self._connection.mav.srcSystem = message.get_srcSystem()  # we are a part of that vehicle
            if kind == "TIMESYNC":
                self._synchronise(message, now_ns)
            if self.heartbeat is None or (message.get_srcSystem(), message.get_srcComponent()) == self.target:
                self.received[kind] += 1
                self._heard_ns = now_ns
                self._take_values(message, kind, now_ns)
            self._changed.notify_all()

    def _synchronise(self, message: Any, now_ns: int) -> None:
        """Answer a request, or learn from an answer to ours."""
        if message.tc1 == 0:
            self.send(messages.MAVLink_timesync_message(now_ns, message.ts1))
        elif message.ts1 > 0:
            self.clock.add(message.ts1, now_ns, message.tc1)

    def _take_values(self, message: Any, kind: str, now_ns: int) -> None:
        if kind == "PARAM_VALUE":
            self._parameters[message.param_id] = self._parameter_value(message)
            return
        boot_ms = getattr(message, "time_boot_ms", None)
        if boot_ms is not None:
            t_ns = self.clock.ours(int(boot_ms) * 1_000_000)
            if t_ns is not None:
                self.telemetry.take(message, min(t_ns, now_ns))

    def _parameter_value(self, message: Any) -> float:
        """PX4 sends the bytes of an integer in the place of the float, ArduPilot its value."""
        layout = _INTEGER_TYPES.get(message.param_type)
        if self.autopilot is Autopilot.PX4 and layout is not None:
            return float(struct.unpack(layout, struct.pack("<f", message.param_value))[0])
        return float(message.param_value)
