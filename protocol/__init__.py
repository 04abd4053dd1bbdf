"""The messages between camera drivers, the NeuroVE service and its consumers.

A driver or a consumer needs only this package (numpy, msgpack, pydantic). Importing it imports neither torch nor zenoh.
README.md in this folder is the contract.
"""

from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import EVENT_DTYPE, EventPacket, Events, Sensor
from neurove_protocol.imu import Imu, ImuPacket
from neurove_protocol.velocity import Flag, HostTime, Trace, Twist, TwistEstimate

__all__ = [
    "EVENT_DTYPE",
    "CameraInfo",
    "EventPacket",
    "Events",
    "Flag",
    "HostTime",
    "Imu",
    "ImuPacket",
    "NeuroVEError",
    "Sensor",
    "Trace",
    "Twist",
    "TwistEstimate",
]
