"""`python -m tests.live.fake_camera EVENTS ARGUMENTS...`: the command line with one made-up EVK4 plugged in.

The camera gives nothing until a line arrives on stdin, then EVENTS events in ten packets, of which the sixth follows an
overflow of five USB packets, and is then unplugged. With EVENTS 0 it stays plugged in and gives nothing.
"""

import sys
import threading

import neuromorphic_drivers as nd

from neurove_protocol import Events, Sensor
from neurove_service.cli.main import main
from tests.builders import make_events
from tests.neurove_core.live.nd_device import TIMEOUT, FakeDevice, Step

EVK4 = Sensor(1280, 720)
SERIAL = "00051234"


def camera_events(n: int) -> list[Events]:
    """The events of each packet."""
    events = make_events(n, seed=20060, start_us=5_000_000, duration_us=300_000, sensor=EVK4)
    return [events.span(n * i // 10, n * (i + 1) // 10) for i in range(10)]


def script(n: int):
    go, pause = threading.Event(), threading.Event()
    threading.Thread(target=lambda: (sys.stdin.readline(), go.set()), daemon=True).start()
    while not go.is_set() or not n:
        pause.wait(0.005)
        yield TIMEOUT
    for i, part in enumerate(camera_events(n)):
        pause.wait(0.02)  # by contract, a link may drop packets of a burst
        yield Step(part, [0] if i == 5 else None, dropped=5 if i >= 5 else 0)


if __name__ == "__main__":
    found = nd.ListedDevice(nd.Name.PROPHESEE_EVK4, nd.Connection.USB_SUPER, "1:4", SERIAL, None)
    count = int(sys.argv[1])
    nd.list_devices = lambda: [found]
    nd.open = lambda configuration, serial=None, iterator_timeout=None: FakeDevice(script(count), serial=SERIAL)
    sys.exit(main(sys.argv[2:]))
