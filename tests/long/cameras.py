"""Cameras in a process of their own: `python -m tests.long.cameras ENDPOINT WINDOW_US EVENTS NAME...`, until SIGTERM.

Each publishes one packet per window, paced, so that the measuring process does not delay them.
"""

import signal
import sys
import threading
import time
from dataclasses import replace

from neurove_protocol.events import encode_packet
from neurove_service.config import ClientConfig
from tests.builders import make_packets
from tests.live.conftest import Source, client


class Camera:
    """Publishes one packet per window, paced, until `end` is called."""

    def __init__(self, source: Source, stream: str, window_us: int, events: int) -> None:
        self._source, self._window_us = source, window_us
        self._packets = make_packets(50, stream=stream, n=events, step_us=window_us)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        began, seq = time.monotonic(), 0
        while not self._stop.wait(max(0.0, began + seq * self._window_us / 1e6 - time.monotonic())):
            packet = self._packets[seq % len(self._packets)]
            t0_us = seq * self._window_us
            events = packet.events._replace(t=packet.events.t + t0_us - packet.t0_us)
            self._source.put(encode_packet(replace(packet, seq=seq, t0_us=t0_us, events=events)))
            seq += 1

    def end(self) -> None:
        self._stop.set()
        self._thread.join()


def main(endpoint: str, window_us: int, events: int, names: list[str]) -> None:
    """Publish until SIGTERM or SIGINT."""
    ended = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: ended.set())
    config = ClientConfig(connect=(endpoint,))
    with client(endpoint) as transport:
        cameras = [Camera(Source(transport, config, name), name, window_us, events) for name in names]
        ended.wait()
        for camera in cameras:
            camera.end()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4:])
