"""`dv://HOST:PORT`: events of a dv network stream, of dv-gui, dv-runtime or any NetworkWriter of dv-processing.

A server of dv sends one kind of data on each port, so inertial samples have a port of their own: `?imu=PORT`.
"""

import select
import threading
import time
from collections.abc import Iterator
from typing import Final
from urllib.parse import parse_qsl, urlsplit

import numpy as np

from neurove_core.io.errors import UnknownSource
from neurove_core.io.faults import Faults, Reason
from neurove_core.io.formats.aedat.aedat4 import decode_events, decode_imu
from neurove_core.io.formats.aedat.flatbuffer import BadPacket
from neurove_core.io.formats.aedat.header import Stream
from neurove_core.live.dv_link import Address, BadStream, Link, resolve
from neurove_core.live.order import ImuOrder, LiveOrder
from neurove_core.live.source import WAIT_S, Batch, LiveEnded, LiveFormat, NoCamera, QuietClock
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import InvalidField
from neurove_protocol.events import Events, Sensor
from neurove_protocol.imu import Imu

OPEN_S: Final = 5.0
"""Longest wait for the header of a stream [s]."""

DELAY_S: Final = 0.1
"""Default of the longest delay of the transmission [s]: dv sends a packet every 10 ms."""

RECONNECT_S: Final = 5.0
"""Default of the time for which a lost stream is tried again [s]."""

_FIELDS: Final = {"imu", "delay", "reconnect"}


class DvStream:
    """Events, and inertial samples, of a dv network stream; see `LiveSource`.

    Samples are in the optical frame, see `axes.OPTICAL`: dv sends deg/s and g, and they become rad/s and m/s2.

    Args:
        url: as the user wrote it.
        events: where the events are.
        imu: where the inertial samples are, if not on the same port; None without.
        sensor: its pixel array, which takes precedence over the size in the header.
        delay_s: longest delay of the transmission [s], see `QuietClock`.
        reconnect_s: a lost stream is tried again for so long [s].

    Raises:
        NoCamera: no server sends such a stream.
    """

    def __init__(
        self,
        url: str,
        events: Address,
        imu: Address | None = None,
        sensor: Sensor | None = None,
        *,
        delay_s: float = DELAY_S,
        reconnect_s: float = RECONNECT_S,
    ) -> None:
        self.name, self._reconnect_s = url, reconnect_s
        self.faults = Faults()
        self._tally, self._imu_tally = self.faults.begin("events"), self.faults.begin("imu")
        self._events, self._imu = Link(events), Link(imu) if imu is not None else None
        self._links = [link for link in (self._events, self._imu) if link is not None]
        self._quiet = QuietClock(delay_s)
        self._pause = threading.Event()  # never set
        self._lost = False  # events are missing before the next ones
        self._lost_after = False  # and after those that have arrived
        self._opened = False
        self._arrived: tuple[list[Events], list[Imu]] = ([], [])
        try:
            self._open()
            self.sensor = self._size(sensor)
        except BaseException:
            self.close()
            raise
        self._opened, self._sensor_given = True, sensor is not None
        self._order, self._imu_order = LiveOrder(self.sensor, self._tally), ImuOrder(self._imu_tally)
        has_imu = self._imu is not None or _stream(self._events, "imu") is not None
        self.streams: tuple[str, ...] = ("events", "imu") if has_imu else ("events",)

    def camera(self, stream: str) -> CameraInfo | None:
        """None: the stream has no camera parameters."""
        return None

    def close(self) -> None:
        """Close the connections."""
        for link in self._links:
            link.close()

    def batches(self) -> Iterator[Batch]:
        """What arrives; see `LiveSource`. After a connection is lost, the next events follow a gap."""
        while True:
            self._wait(WAIT_S)
            yield from self._batch()
            down_s = time.monotonic() - self._events.down_since
            if not self._events.is_up and down_s >= self._reconnect_s:
                again = f", and does not answer for {self._reconnect_s:g} s" if self._reconnect_s else ""
                raise LiveEnded(self.name, f"the stream ended: {self._events.why or 'no answer'}{again}")

    def _batch(self) -> Iterator[Batch]:
        """What has arrived, in parts at the places of a loss."""
        events, samples = self._arrived
        self._arrived = ([], [])
        taken = self._order.take(Events.join(events))
        inertial = self._imu_order.take(_joined(samples))
        lost = self._lost and bool(taken.events.n)
        self._lost = self._lost_after or (self._lost and not lost)
        self._lost_after = False
        if taken.events.n:
            if self._events.is_up:
                self._quiet.arrived(int(taken.events.t[-1]))
            yield Batch(taken.events, inertial, None, lost, taken.restarted)
        else:
            now_us = self._quiet.now_us() if self._events.is_up else None
            yield Batch(Events.empty(), inertial, self._order.tick(now_us))

    def _open(self) -> None:
        """Wait for the header of each stream."""
        deadline = time.monotonic() + OPEN_S
        while not all(link.streams for link in self._links):
            left_s = deadline - time.monotonic()
            link = next(link for link in self._links if not link.streams)
            if left_s <= 0 or (link.why and link.socket is None):
                why = f"no dv network stream at {link.address.shown}: {link.why or 'it sends no header'}"
                raise NoCamera(self.name, why)
            self._wait(min(left_s, WAIT_S))
        for kind, one in zip(("events", "imu"), self._links, strict=False):
            if _stream(one, kind) is None:
                kinds = ", ".join(stream.kind for stream in one.streams)
                raise NoCamera(self.name, f"the stream at {one.address.shown} has {kinds}, no {kind}")

    def _size(self, sensor: Sensor | None) -> Sensor:
        """The pixel array, given or of the header."""
        stream = _stream(self._events, "events")
        found = sensor or (stream.sensor if stream is not None else None)
        if found is None:
            raise NoCamera(self.name, "its header has no valid sensor size; give --sensor WIDTHxHEIGHT")
        return found

    def _wait(self, wait_s: float) -> None:
        """Wait until something arrives, at most this time [s], and take it."""
        for link in self._links:
            link.connect()
        readable = [link.socket for link in self._links if link.socket is not None and not link.connecting]
        writable = [link.socket for link in self._links if link.socket is not None and link.connecting]
        if not readable and not writable:
            self._pause.wait(wait_s)
            return
        ready = {one.fileno() for group in select.select(readable, writable, [], wait_s)[:2] for one in group}
        for link in self._links:
            if link.socket is not None and link.socket.fileno() in ready:
                self._take(link)

    def _take(self, link: Link) -> None:
        """Decode what has arrived on a connection."""
        was_up = link.is_up
        tally = self._tally if link is self._events else self._imu_tally
        try:
            for number, packet in link.receive():
                self._decode(link, number, packet)
        except BadStream as error:
            tally.add(Reason.DAMAGED, link.address.shown, str(error))
        if was_up and not link.is_up:
            tally.add(Reason.LOST, link.address.shown, link.why)
            if link is self._events:
                self._lost_after = True
                self._quiet.stop()
        elif link is self._events and link.is_up and not was_up and self._opened:
            self._check_size(link)

    def _check_size(self, link: Link) -> None:
        """Refuse a stream that returns with another camera."""
        stream = _stream(link, "events")
        if stream is None or (not self._sensor_given and stream.sensor != self.sensor):
            now = "no events" if stream is None else f"events of {stream.sensor}"
            raise LiveEnded(self.name, f"the stream has {now} since it connected again, and had {self.sensor}")

    def _decode(self, link: Link, number: int, packet: bytes) -> None:
        events, samples = self._arrived
        kinds = ("events", "imu") if link is self._events else ("imu",)
        kind = next((one for one in kinds if (found := _stream(link, one)) and found.number == number), None)
        try:
            if kind == "events":
                events.append(decode_events(packet))
            elif kind == "imu":
                samples.append(decode_imu(packet))
        except BadPacket as why:
            self.faults.of(str(kind)).add(Reason.DAMAGED, link.address.shown, f"this packet cannot be read: {why}")
            self._lost = self._lost or kind == "events"


def _stream(link: Link, kind: str) -> Stream | None:
    """The first stream of a kind on a connection."""
    return next((stream for stream in link.streams if stream.kind == kind), None)


def _joined(parts: list[Imu]) -> Imu:
    return Imu(*(np.concatenate(columns) for columns in zip(*parts, strict=True))) if parts else Imu.empty()


def _seconds(url: str, query: dict[str, str], name: str, default: float) -> float:
    """A number of seconds in the query of a URL.

    Raises:
        InvalidField: it is no finite number from 0 to 3600.
    """
    text = query.get(name, str(default))
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value <= 3600:
        raise InvalidField(url, name, text, "expected seconds from 0 to 3600")
    return value


def _port(url: str, text: str) -> int:
    if not (text.isascii() and text.isdecimal() and 0 < int(text) < 1 << 16):
        raise InvalidField(url, "port", text, "expected a whole number from 1 to 65535")
    return int(text)


def open_stream(url: str, sensor: Sensor | None = None) -> DvStream:
    """Connect to the stream of `dv://HOST:PORT`, with `?imu=PORT`, `delay=SECONDS` and `reconnect=SECONDS`.

    Raises:
        UnknownSource: the URL has other parts. InvalidField: a value is out of bounds.
        NoCamera: no server sends such a stream.
    """
    parts = urlsplit(url)
    query = dict(parse_qsl(parts.query, keep_blank_values=True))
    host, _, port = parts.netloc.rpartition(":")
    if not host or parts.path.strip("/") or query.keys() - _FIELDS:
        raise UnknownSource(url, "expected dv://HOST:PORT, with ?imu=PORT, delay=SECONDS and reconnect=SECONDS")
    events_port, imu_port = _port(url, port), _port(url, query["imu"]) if "imu" in query else None
    delay_s = _seconds(url, query, "delay", DELAY_S)
    reconnect_s = _seconds(url, query, "reconnect", RECONNECT_S)
    try:
        events = resolve(host.strip("[]"), events_port)
        imu = resolve(host.strip("[]"), imu_port) if imu_port is not None else None
    except OSError as error:
        raise NoCamera(url, f"the host {host!r} is unknown: {error.strerror or error}") from None
    return DvStream(url, events, imu, sensor, delay_s=delay_s, reconnect_s=reconnect_s)


FORMAT = LiveFormat("dv://HOST:PORT (dv network stream of dv-gui, dv-runtime or dv-processing)", "dv", open_stream)
