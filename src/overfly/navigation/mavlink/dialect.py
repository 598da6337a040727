"""The one place that imports MAVLink: its messages, and which autopilots are known."""

from __future__ import annotations

import os
from enum import StrEnum

os.environ.setdefault("MAVLINK20", "1")  # ODOMETRY exists in version 2 only

from pymavlink.dialects.v20 import development as messages

__all__ = ["COMPONENT", "DIALECT", "Autopilot", "autopilot_of", "messages"]

# Who we are on the link: the component that visual odometry is known by, of the vehicle's own system.
COMPONENT = messages.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
DIALECT = "development"  # common and what it is tried out in, GLOBAL_POSITION_SENSOR among it


class Autopilot(StrEnum):
    """Autopilots whose rules are known; see docs/autopilots.md."""

    ARDUPILOT = "ArduPilot"
    PX4 = "PX4"


def autopilot_of(heartbeat_autopilot: int) -> Autopilot | None:
    """Which one a heartbeat comes from; None for others, whose rules are not known."""
    known = {
        messages.MAV_AUTOPILOT_ARDUPILOTMEGA: Autopilot.ARDUPILOT,
        messages.MAV_AUTOPILOT_PX4: Autopilot.PX4,
    }
    return known.get(heartbeat_autopilot)
