"""A device with the interface of neuromorphic-drivers 0.18, played from a script: no camera is at the machines of CI.

Only the device is made up: its statuses, packets, names and properties are those of the library.
"""

import time

import neuromorphic_drivers as nd
import numpy as np
from neuromorphic_drivers import packet as nd_packet
from neuromorphic_drivers import status as nd_status

EVENT = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])
IMU = np.dtype(
    [("t", "<u8")]
    + [(f"{kind}_{axis}", "<f4") for kind in ("accelerometer", "gyroscope") for axis in "xyz"]
    + [("temperature", "<f4")]
)
UNPLUGGED = "PropheseeEvk4(Usb(Rusb(NoDevice)))"
TIMEOUT = object()


def rows_of(events):
    """Events as the library has them."""
    rows = np.empty(events.n, EVENT)
    rows["t"], rows["x"], rows["y"], rows["on"] = events
    return rows


class Step:
    """What one iteration of a device gives.

    Args:
        events: what arrives; None for nothing.
        overflows: index of the first event after each loss.
        imu: (N, 7) of t [us], acceleration [m/s2] and angular velocity [rad/s], in the axes of the library.
        now_us: time of the camera after it.
        dropped: USB packets that were dropped so far.
        behind_s: age of what is read [s].
        backlog: USB packets that wait afterwards.
    """

    def __init__(self, events=None, overflows=None, imu=None, now_us=None, dropped=0, behind_s=0.0, backlog=0):
        self.events, self.overflows, self.imu = events, overflows, imu
        last_us = int(events.t[-1]) if events is not None and events.n else 0
        self.now_us = last_us if now_us is None else now_us
        self.dropped, self.behind_s, self.backlog = dropped, behind_s, backlog


class FakeDevice:
    """Gives one step at each iteration; an exception in the script is raised, as when the camera is unplugged."""

    def __init__(self, script, name=nd.Name.PROPHESEE_EVK4, serial="00051234"):
        self._script, self._name, self._serial = iter(script), name, serial
        self._backlog, self.cleared, self.closed = 0, [], False

    def __next__(self):
        step = next(self._script, RuntimeError(UNPLUGGED))
        if isinstance(step, Exception):
            raise step
        now = time.time()
        if step is TIMEOUT:
            return nd_status.Status(system_time=now, ring=None), None
        self._backlog = step.backlog
        ring = nd_status.RingStatus(now - step.behind_s, step.backlog, 1, False, step.now_us, step.dropped)
        return nd_status.Status(system_time=now, ring=ring), self._packet(step)

    def _packet(self, step):
        has_imu = self._name is nd.Name.INIVATION_DAVIS346
        packet = nd_packet.Davis346Packet() if has_imu else nd_packet.Evt3Packet()
        packet.polarity_events = None if step.events is None else rows_of(step.events)
        packet.polarity_events_overflow_indices = None if step.overflows is None else np.array(step.overflows)
        if has_imu:
            packet.imu_events = None
            if step.imu is not None:
                packet.imu_events = np.zeros(len(step.imu), IMU)
                for name, column in zip(IMU.names, np.asarray(step.imu).T, strict=False):
                    packet.imu_events[name] = column
        return packet

    def name(self):
        return self._name

    def serial(self):
        return self._serial

    def properties(self):
        return nd.generated.unions.name_to_properties(self._name)

    def backlog(self):
        return self._backlog

    def clear_backlog(self, until):
        self.cleared.append(until)
        self._backlog = 0

    def close(self):
        self.closed = True
