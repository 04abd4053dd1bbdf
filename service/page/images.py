"""Event images: the newest events of a stream as a PNG, made only while a browser asks for it."""

import io
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from PIL import Image

from neurove_protocol import EventPacket
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import decode_packet
from neurove_service.transport import Transport

MAX_HZ: Final = 10.0
"""Most images of a stream in a second, whatever the number of viewers."""

MAX_TOTAL_HZ: Final = 20.0
"""Most images of all streams in a second; several streams share them."""

SPAN_US: Final = 25_000
"""Time of the events in an image [us]."""

MAX_WATCHED: Final = 12
"""Streams whose packets the page receives at once."""

_FORGET_S: Final = 2.0  # without a request for this time, the page no longer receives a stream's packets
_MAX_PACKETS, _MAX_BYTES, _MAX_SIDE = 32, 4 << 20, 480
_PALETTE: Final = bytes((0x10, 0x15, 0x1C, 0xE6, 0x8A, 0x2E, 0x56, 0xB4, 0xE9))  # ground, OFF, ON


@dataclass
class _Watched:
    """The newest packets of a stream as bytes, and its newest image."""

    asked_at: float
    undeclare: Callable[[], None]
    packets: deque[bytes] = field(default_factory=lambda: deque(maxlen=_MAX_PACKETS))
    made_at: float = 0.0
    png: bytes | None = None
    lock: threading.Lock = field(default_factory=threading.Lock)


class Images:
    """The images of the streams that somebody looks at.

    Args:
        events_key: gives the key of a stream's packets.
    """

    def __init__(self, events_key: Callable[[str], str]) -> None:
        self._events_key = events_key
        self._watched: dict[str, _Watched] = {}
        self._lock = threading.Lock()

    @property
    def watched(self) -> list[str]:
        """Streams whose packets are received now."""
        with self._lock:
            return sorted(self._watched)

    def fresh(self, stream: str) -> bytes | None:
        """The newest image, if it is too early for another one."""
        now = time.monotonic()
        with self._lock:
            one = self._watched.get(stream)
            if one is None or now - one.made_at >= self._period_s:
                return None
            one.asked_at = now
            return one.png

    @property
    def _period_s(self) -> float:
        return max(1 / MAX_HZ, len(self._watched) / MAX_TOTAL_HZ)

    def png(self, stream: str, transport: Transport) -> bytes | None:
        """The newest image; None before the first packet, or if too many streams are looked at. Runs on any thread."""
        now = time.monotonic()
        with self._lock:
            one = self._watched.get(stream)
            if one is None:
                if len(self._watched) >= MAX_WATCHED:
                    return None
                one = self._watched[stream] = self._watch(stream, transport, now)
            one.asked_at = now
        with one.lock:
            if one.packets and now - one.made_at >= self._period_s:
                one.made_at = now
                one.png = _drawn(list(one.packets)) or one.png
            return one.png

    def forget(self) -> None:
        """Stop receiving the packets of the streams that no browser has asked for recently."""
        now = time.monotonic()
        with self._lock:
            old = [name for name, one in self._watched.items() if now - one.asked_at > _FORGET_S]
            gone = [self._watched.pop(name) for name in old]
        for one in gone:
            one.undeclare()

    def _watch(self, stream: str, transport: Transport, now: float) -> _Watched:
        packets: deque[bytes] = deque(maxlen=_MAX_PACKETS)

        def on_packet(_key: str, payload: bytes, _received_ns: int) -> None:
            if len(payload) <= _MAX_BYTES:
                packets.append(payload)

        return _Watched(now, transport.subscribe(self._events_key(stream), on_packet), packets)


def _drawn(payloads: list[bytes]) -> bytes | None:
    """An image of the newest events of some packets; None if none can be decoded or there is no event."""
    packets: list[EventPacket] = []
    for payload in reversed(payloads):
        try:
            packet = decode_packet(payload)
        except NeuroVEError:
            continue
        if packets and (packet.sensor != packets[0].sensor or packet.t0_us < packets[0].t0_us - SPAN_US):
            break
        packets.append(packet)
    if not packets:
        return None
    sensor = packets[0].sensor
    step = -(-max(sensor.width, sensor.height) // _MAX_SIDE)
    canvas = np.zeros((-(-sensor.height // step), -(-sensor.width // step)), np.uint8)
    for packet in reversed(packets):
        events = packet.events
        canvas[events.y // step, events.x // step] = 1 + events.p
    return png_of(canvas)


def png_of(canvas: "np.ndarray[Any, np.dtype[np.uint8]]") -> bytes:
    """A PNG of pixels 0 (ground), 1 (OFF) and 2 (ON), shape (H, W)."""
    image = Image.fromarray(canvas)
    image.putpalette(_PALETTE)
    file = io.BytesIO()
    image.save(file, "PNG", bits=2, compress_level=1)
    return file.getvalue()
