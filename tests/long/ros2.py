"""The bridge to ROS 2 under load: `python -m tests.long.ros2 [MEV_PER_S ...]`; half a minute, not part of `make test`.

A node in plain zenoh-python publishes EVT3 messages of 4 ms through a router. The bridge decodes them for a real
service. For each rate the run prints what was lost and where, the CPU time of the bridge per second of events, and the
time from publishing the message that completes a window to its velocity on the topic of ROS.
"""

import contextlib
import json
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from neurove_protocol import Sensor
from neurove_service.clients.ask import NoService
from tests import ros_peer
from tests.live.conftest import wait_until
from tests.live.test_ros2 import Place
from tests.ros_peer import EVENTS, TWIST, RosNode, header, make

SENSOR = Sensor(1280, 720)
MESSAGE_US, SECONDS, WINDOW_US = 4_000, 4, 50_000
ROS_NS = 1_700_000_000 * 10**9
CLOCK_HZ = 100  # of /proc/PID/stat


def words(rng, t0_us, count):
    """EVT3 words of uniform events: what a camera sends for single events."""
    t = np.sort(rng.integers(t0_us, t0_us + MESSAGE_US, count))
    y, x = rng.integers(0, SENSOR.height, count), rng.integers(0, SENSOR.width, count)
    table = np.empty((count, 4), np.uint16)
    table[:, 0], table[:, 1] = 8 << 12 | (t >> 12 & 0xFFF), 6 << 12 | (t & 0xFFF)
    table[:, 2], table[:, 3] = y, 2 << 12 | rng.integers(0, 2, count) << 11 | x
    used = np.ones((count, 4), bool)
    used[1:, :2] = np.diff(t)[:, None] > 0
    return t[0], table[used]


def messages(rate_mev_s):
    rng, count = np.random.default_rng(20_700), int(rate_mev_s * MESSAGE_US)
    for i in range(SECONDS * 1_000_000 // MESSAGE_US):
        first_us, data = words(rng, i * MESSAGE_US, count)
        stamp = header(ROS_NS + int(first_us) * 1000)
        size = (SENSOR.height, SENSOR.width)
        yield ros_peer.cdr(make(EVENTS, stamp, *size, i, 0, "evt3", False, data.view(np.uint8)))


def cpu_s(pid):
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / CLOCK_HZ


def answered(place, stream):
    """The counts of the service, which may be late on a busy machine."""
    while True:
        with contextlib.suppress(NoService):
            return place.counted(stream)


def measure(place, rate_mev_s):
    stream, made = f"load{rate_mev_s:g}".replace(".", "_"), list(messages(rate_mev_s))
    bridge = place.bridge(stream, "--camera-info", "none", "--imu", "none", topic=f"/{stream}/events")
    with RosNode(place.endpoint) as node:
        publish, arrived = node.publisher(f"/{stream}/events", EVENTS), []
        twists = node.subscribe(
            f"/neurove/{stream}/velocity", TWIST, on_message=lambda: arrived.append(time.monotonic())
        )
        wait_until(publish.matching)
        before, sent, begin = cpu_s(bridge.child.pid), [], time.monotonic()
        for i, one in enumerate(made):
            due = begin + (i + 1) * MESSAGE_US / 1e6
            threading.Event().wait(max(0.0, due - time.monotonic()))
            sent.append(time.monotonic())
            publish(one)
        took = time.monotonic() - begin
        threading.Event().wait(2.0)
        used, status = cpu_s(bridge.child.pid) - before, answered(place, stream)
    counts = json.loads(bridge.end()[1])["streams"][stream]
    delays = []
    for (message, _), at in zip(twists, arrived, strict=False):
        stamp_us = (message.header.stamp.sec * 10**9 + message.header.stamp.nanosec - ROS_NS) // 1000
        completing = min(len(sent) - 1, round(stamp_us) // MESSAGE_US)
        delays.append((at - sent[completing]) * 1e3)
    p50, p99 = np.percentile(delays, [50, 99]) if delays else (np.nan, np.nan)
    lost = {
        name: count
        for name, count in counts.items()
        if count and name.startswith(("lost", "dropped", "late", "refused"))
    }
    came = f"{counts['messages']} of {len(made)} messages in {took:.1f} s"
    print(f"{rate_mev_s:g} Mev/s: {came}, bridge lost {lost or 'nothing'}, {used / SECONDS:.0%} of a core")
    print(f"  service lost {status.lost.nonzero() or 'nothing'}, {status.windows} windows")
    print(f"  {len(twists)} velocities, p50 {p50:.1f} ms, p99 {p99:.1f} ms after the message that completes the window")


def main():
    rates = [float(word) for word in sys.argv[1:]] or [1.0, 10.0]
    with ExitStack() as stack:
        place = Place(stack)
        for rate in rates:
            measure(place, rate)


if __name__ == "__main__":
    main()
