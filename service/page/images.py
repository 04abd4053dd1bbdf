"""Event images: the newest events of a stream as a PNG, made only while a browser asks for it.

All images are drawn in one round, at most ten times per second. A request waits for the next round and receives the
images that its browser does not have yet, so an image is made and encoded once, whatever the number of viewers.
"""

import asyncio
import itertools
import struct
import time
import zlib
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from neurove_protocol import EventPacket
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import decode_packet
from neurove_service.guard import Guard
from neurove_service.transport import Transport

MAX_HZ: Final = 10.0
"""Most images of a stream in a second, whatever the number of viewers."""

MAX_TOTAL_HZ: Final = 20.0
"""Most images of all streams in a second; several streams share them."""

SPAN_US: Final = 25_000
"""Time of the events in an image [us]."""

MAX_WATCHED: Final = 12
"""Streams whose packets the page receives at once."""

HEAD: Final = struct.Struct(">II")
"""Before each image of an answer: its number, and its bytes; 0 bytes if there is no newer image."""

_FORGET_S: Final = 2.0  # without a request for this time, the page no longer receives a stream's packets
_MAX_PACKETS, _MAX_BYTES, _MAX_SIDE = 32, 4 << 20, 480
_PALETTE: Final = bytes((0x10, 0x15, 0x1C, 0xE6, 0x8A, 0x2E, 0x56, 0xB4, 0xE9))  # ground, OFF, ON


@dataclass
class _Watched:
    """The newest packets of a stream as bytes, and its newest image."""

    asked_at: float
    take: Callable[[], list[bytes]]
    undeclare: Callable[[], None]
    packets: list[bytes] = field(default_factory=list)  # of the newest image
    number: int = 0
    png: bytes = b""


class Images:
    """The images of the streams that somebody looks at. Its methods run on the thread of the web server.

    Args:
        events_key: gives the key of a stream's packets.
        guard: counts internal errors.
    """

    def __init__(self, events_key: Callable[[str], str], guard: Guard) -> None:
        self._events_key, self._guard = events_key, guard
        self._watched: dict[str, _Watched] = {}
        self._numbers = itertools.count(1)
        self._thread = ThreadPoolExecutor(1, "page images")  # more threads cost memory and are not faster
        self._round: asyncio.Task[None] | None = None
        self._round_at = 0.0

    @property
    def watched(self) -> list[str]:
        """Streams whose packets are received now."""
        return sorted(self._watched)

    async def newer(self, asked: Mapping[str, int], transport: Transport) -> bytes:
        """The images of streams after the next round, each behind a HEAD, in the order asked for.

        Args:
            asked: stream -> number of the image that the browser has; 0 for none.
            transport: receives the packets.
        """
        now = time.monotonic()
        for name in asked:
            if name in self._watched:
                self._watched[name].asked_at = now
            elif len(self._watched) < MAX_WATCHED:
                self._watched[name] = _Watched(now, *transport.subscribe_newest(self._events_key(name), _MAX_PACKETS))
        if self._round is None or self._round.done():
            self._round = asyncio.create_task(self._draw_all())
        await asyncio.shield(self._round)
        parts = []
        for name, number in asked.items():
            one = self._watched.get(name)
            png = b"" if one is None or one.number == number else one.png
            parts += [HEAD.pack(0 if one is None else one.number, len(png)), png]
        return b"".join(parts)

    def forget(self) -> None:
        """Stop receiving the packets of the streams that no browser has asked for recently."""
        now = time.monotonic()
        for name in [name for name, one in self._watched.items() if now - one.asked_at > _FORGET_S]:
            self._watched.pop(name).undeclare()

    async def _draw_all(self) -> None:
        period_s = max(1 / MAX_HZ, len(self._watched) / MAX_TOTAL_HZ)
        await asyncio.sleep(max(0.0, self._round_at + period_s - time.monotonic()))
        self._round_at = time.monotonic()
        await asyncio.get_running_loop().run_in_executor(self._thread, self._draw, list(self._watched.values()))

    def _draw(self, streams: list[_Watched]) -> None:
        for one in streams:
            with self._guard.at("page images"):
                new = [payload for payload in one.take() if len(payload) <= _MAX_BYTES]
                if new:
                    png, one.packets = _drawn((one.packets + new)[-_MAX_PACKETS:])
                    if png:
                        one.png, one.number = png, next(self._numbers)


def _drawn(payloads: list[bytes]) -> tuple[bytes, list[bytes]]:
    """An image of the newest events of some packets, and the packets with these; b"" if none can be decoded."""
    packets: list[EventPacket] = []
    used: list[bytes] = []
    for payload in reversed(payloads):
        try:
            packet = decode_packet(payload)
        except NeuroVEError:
            continue
        if packets and (packet.sensor != packets[0].sensor or packet.t0_us < packets[0].t0_us - SPAN_US):
            break
        packets.append(packet)
        used.append(payload)
    if not packets:
        return b"", []
    sensor = packets[0].sensor
    step = -(-max(sensor.width, sensor.height) // _MAX_SIDE)
    canvas = np.zeros((-(-sensor.height // step), -(-sensor.width // step)), np.uint8)
    for packet in reversed(packets):
        events = packet.events
        x, y = (events.x, events.y) if step == 1 else (events.x // step, events.y // step)
        canvas[y, x] = 1 + events.p
    return png_of(canvas), used[::-1]


def png_of(canvas: "np.ndarray[Any, np.dtype[np.uint8]]") -> bytes:
    """A PNG of pixels 0 (ground), 1 (OFF) and 2 (ON), shape (H, W): four pixels a byte, with a palette."""
    height, width = canvas.shape
    padded = np.zeros((height, -(-width // 4), 4), np.uint8)
    padded.reshape(height, -1)[:, :width] = canvas
    rows = np.zeros((height, 1 + padded.shape[1]), np.uint8)  # each row begins with its filter, 0 for none
    rows[:, 1:] = padded[:, :, 0] << 6 | padded[:, :, 1] << 4 | padded[:, :, 2] << 2 | padded[:, :, 3]
    head = struct.pack(">IIBBBBB", width, height, 2, 3, 0, 0, 0)  # 2 bits a pixel, colours of a palette
    chunks = ((b"IHDR", head), (b"PLTE", _PALETTE), (b"IDAT", zlib.compress(rows.tobytes(), 1)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )
