"""Event images: the newest events of a stream as a PNG, made only while a browser looks at it.

All images are drawn in one round, at most ten times per second, and each is made and encoded once, whatever the number
of viewers. The page receives the packets of a stream only for a short time before each round, if that suffices.
"""

import asyncio
import functools
import itertools
import struct
import time
import zlib
from collections.abc import AsyncIterator, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import WirePacket, open_packet
from neurove_service.guard import Guard
from neurove_service.transport import Transport

MAX_HZ: Final = 10.0
"""Most images of a stream in a second, whatever the number of viewers."""

MAX_TOTAL_HZ: Final = 20.0
"""Most images of all streams in a second; several streams share them."""

SPAN_US: Final = 25_000
"""Time of the events in an image [us]."""

LISTEN_S: Final = 0.06
"""The packets of a stream are received for this time before a round, if they cover an image and rounds are rare [s]."""

MAX_WATCHED: Final = 12
"""Streams whose packets the page receives at once."""

HEAD: Final = struct.Struct(">dII")
"""Before each image: time of sending on a clock of the page [s], place of its stream in the request, and bytes."""

QUIET_S: Final = 2.0
"""Without a new image for this time, a head with 0 bytes says that the connection lives [s]."""

_FORGET_S: Final = 2.0  # a stream that no browser has waited for during this time is no longer drawn
_SHORT_ROUNDS: Final = 3  # a stream whose packets come too late or too seldom so many times is received always
_MAX_PACKETS, _MAX_BYTES, _MAX_SIDE = 32, 4 << 20, 480
_PALETTE: Final = bytes((0x10, 0x15, 0x1C, 0xE6, 0x8A, 0x2E, 0x56, 0xB4, 0xE9))  # ground, OFF, ON

Subscribe = Callable[[], tuple[Callable[[], list[bytes]], Callable[[], None]]]
"""Begins to receive the packets of a stream; returns what takes them and what ends it."""


@dataclass
class _Watched:
    """The newest packets of a stream as bytes, and its newest image."""

    asked_at: float
    subscribe: Subscribe
    received: tuple[Callable[[], list[bytes]], Callable[[], None]] | None = None
    packets: list[bytes] = field(default_factory=list)  # of the newest image
    number: int = 0
    png: bytes = b""
    begun: bool = False  # packets are received since this round
    short: int = 0  # rounds of this kind, one after the other, whose packets did not cover an image

    def listen(self) -> None:
        """Receive packets from now on."""
        self.begun = self.received is None
        if self.received is None:
            self.received = self.subscribe()

    def pause(self) -> None:
        """Receive no packets from now on."""
        received, self.received = self.received, None
        if received is not None:
            received[1]()

    def draw(self, numbers: "itertools.count[int]") -> bool:
        """Draw what has arrived, if anything has; whether the next round may begin to listen anew."""
        new = [payload for payload in self.received[0]() if len(payload) <= _MAX_BYTES] if self.received else []
        used = 0
        if new:
            png, self.packets, used = _drawn((self.packets + new)[-_MAX_PACKETS:])
            if png:
                self.png, self.number = png, next(numbers)
        covered = used < len(new) or len(new) == _MAX_PACKETS
        if self.begun:
            self.short = 0 if covered else self.short + 1
        return covered and self.short < _SHORT_ROUNDS


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
        """Streams that are drawn now."""
        return sorted(self._watched)

    async def follow(self, names: Sequence[str], transport: Transport) -> AsyncIterator[bytes]:
        """The new images of every round, each behind a HEAD; without end.

        Args:
            names: streams to look at.
            transport: receives the packets.
        """
        have = dict.fromkeys(names, 0)
        sent_at = time.monotonic()
        while True:
            await self._next_round(names, transport)
            now = time.monotonic()
            parts = []
            for place, name in enumerate(names):
                one = self._watched.get(name)
                if one is not None and one.number != have[name]:
                    have[name] = one.number
                    parts += [HEAD.pack(now, place, len(one.png)), one.png]
            if not parts and now - sent_at > QUIET_S:
                parts.append(HEAD.pack(now, 0, 0))
            if parts:
                sent_at = now
                yield b"".join(parts)

    def forget(self) -> None:
        """Stop receiving the packets of the streams that no browser has waited for recently."""
        now = time.monotonic()
        for name in [name for name, one in self._watched.items() if now - one.asked_at > _FORGET_S]:
            self._watched.pop(name).pause()

    async def _next_round(self, names: Sequence[str], transport: Transport) -> None:
        now = time.monotonic()
        for name in names:
            if name in self._watched:
                self._watched[name].asked_at = now
            elif len(self._watched) < MAX_WATCHED:
                subscribe = functools.partial(transport.subscribe_newest, self._events_key(name), _MAX_PACKETS)
                self._watched[name] = _Watched(now, subscribe)
        if self._round is None or self._round.done():
            self._round = asyncio.create_task(self._draw_all())
        await asyncio.shield(self._round)

    async def _draw_all(self) -> None:
        streams = list(self._watched.values())
        period_s = max(1 / MAX_HZ, len(streams) / MAX_TOTAL_HZ)
        due = self._round_at + period_s
        loop = asyncio.get_running_loop()
        await asyncio.sleep(max(0.0, due - LISTEN_S - time.monotonic()))
        await loop.run_in_executor(self._thread, self._listen, streams)
        await asyncio.sleep(max(0.0, due - time.monotonic()))
        self._round_at = time.monotonic()
        await loop.run_in_executor(self._thread, self._draw, streams, period_s > 2 * LISTEN_S)

    def _listen(self, streams: list[_Watched]) -> None:
        for one in streams:
            with self._guard.at("page images"):
                one.listen()

    def _draw(self, streams: list[_Watched], in_bursts: bool) -> None:
        for one in streams:
            with self._guard.at("page images"):
                if one.draw(self._numbers) and in_bursts:
                    one.pause()


def _drawn(payloads: list[bytes]) -> tuple[bytes, list[bytes], int]:
    """An image of the newest events of some packets, the packets with these, and how many were read for it.

    The image is b"" if no packet can be decoded. Events outside the sensor are left out.
    """
    packets: list[WirePacket] = []
    used: list[bytes] = []
    read = 0
    for payload in reversed(payloads):
        try:
            packet = open_packet(payload)
        except NeuroVEError:
            packet = None
        if packet is not None:
            if packets and (packet.sensor != packets[0].sensor or packet.t0_us < packets[0].t0_us - SPAN_US):
                break
            packets.append(packet)
            used.append(payload)
        read += 1
    if not packets:
        return b"", [], read
    sensor = packets[0].sensor
    columns = [packet.events.columns() for packet in reversed(packets)]
    x, y, p = (np.concatenate([getattr(one, name) for one in columns]) for name in ("x", "y", "p"))
    if x.size and (int(x.max()) >= sensor.width or int(y.max()) >= sensor.height):
        inside = (x < sensor.width) & (y < sensor.height)
        x, y, p = x[inside], y[inside], p[inside]
    step = -(-max(sensor.width, sensor.height) // _MAX_SIDE)
    canvas = np.zeros((-(-sensor.height // step), -(-sensor.width // step)), np.uint8)
    if step > 1:
        x, y = x // step, y // step
    canvas.reshape(-1)[y.astype(np.intp) * canvas.shape[1] + x] = p + np.uint8(1)
    return png_of(canvas), used[::-1], read


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
