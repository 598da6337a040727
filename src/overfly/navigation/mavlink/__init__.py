"""The autopilot's side of navigation: what it is told, in the form it accepts, and what it tells."""

from overfly.navigation.mavlink.dialect import Autopilot
from overfly.navigation.mavlink.encoders import encode_global_position, encode_odometry
from overfly.navigation.mavlink.fix_stream import FixStream, StreamSettings
from overfly.navigation.mavlink.link import AutopilotLink
from overfly.navigation.mavlink.placement import Placement
from overfly.navigation.mavlink.sender import OdometrySender
from overfly.navigation.mavlink.state import VehicleState

__all__ = [
    "Autopilot",
    "AutopilotLink",
    "FixStream",
    "OdometrySender",
    "Placement",
    "StreamSettings",
    "VehicleState",
    "encode_global_position",
    "encode_odometry",
]
