"""One connection to a dv network stream: bytes of a TCP socket to packets of AEDAT4.

The server sends the header of an AEDAT4 file (without its signature) and then its packets. Source: dv-processing
(network/ in https://gitlab.com/inivation/dv/dv-processing), and recorded bytes of its NetworkWriter.

The bytes are decoded here, not by dv_processing.io.NetworkReader: that waits without limit for a server that sends no
header, and a packet with a wrong offset ends the process with a segmentation fault.
"""

import contextlib
import errno
import os
import socket
import time
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

from neurove_core.io.formats.aedat.flatbuffer import MAX_PACKET_BYTES
from neurove_core.io.formats.aedat.header import MAX_HEADER_BYTES, PACKET_HEADER, BadHeader, Stream, parse_header

READ_BYTES: Final = 4 << 20
"""Most bytes of one read."""

_AGAIN_S: Final = 0.25
_SIGNATURE: Final = b"#!AER-DAT4.0\r\n"
_KEEPALIVE: Final = {"TCP_KEEPIDLE": 1, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3}
"""A server whose machine or cable is gone is noticed after 4 s [s, s, probes]: silence is not a stationary scene."""


class Address(NamedTuple):
    """Where a stream is."""

    family: int
    sockaddr: tuple[str, int]
    shown: str  # HOST:PORT, as the user wrote it


def resolve(host: str, port: int) -> Address:
    """The address of a host and a port.

    Raises:
        OSError: the host is unknown.
    """
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    found.sort(key=lambda one: one[0] != socket.AF_INET)  # dv listens on an IPv4 address
    family, _, _, _, sockaddr = found[0]
    return Address(family, (str(sockaddr[0]), int(sockaddr[1])), f"{host}:{port}")


class BadStream(Exception):
    """What the server sends is no dv network stream; nothing after it can be read."""


class Link:
    """A connection that connects again after it is lost; no method waits.

    Args:
        address: of the server.
        clock: monotonic clock [s].
    """

    def __init__(self, address: Address, clock: Callable[[], float] = time.monotonic) -> None:
        self.address = address
        self.streams: list[Stream] = []  # of the header; empty before it has arrived
        self.why = ""  # why the newest connection ended
        self.down_since = clock()
        self._clock = clock
        self._socket: socket.socket | None = None
        self._connecting = False
        self._next_try = 0.0
        self._bytes = bytearray()

    @property
    def socket(self) -> socket.socket | None:
        """The socket to wait for: to write while `connecting`, otherwise to read. None between two attempts."""
        return self._socket

    @property
    def connecting(self) -> bool:
        """Whether the connection is not established yet."""
        return self._connecting

    @property
    def is_up(self) -> bool:
        """Whether packets can arrive: the header has arrived, and the connection is not lost."""
        return self._socket is not None and bool(self.streams)

    def connect(self) -> None:
        """Begin to connect, unless a connection exists or the next attempt is not due."""
        if self._socket is not None or self._clock() < self._next_try:
            return
        self._next_try = self._clock() + _AGAIN_S
        self.streams, self._bytes = [], bytearray()
        one = self._socket = socket.socket(self.address.family, socket.SOCK_STREAM)
        one.setblocking(False)
        one.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _KEEPALIVE.items():
            if hasattr(socket, name):
                one.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        self._connecting = True
        failed = one.connect_ex(self.address.sockaddr)
        if failed not in (0, errno.EINPROGRESS):
            self._lose(os.strerror(failed))

    def receive(self) -> Iterator[tuple[int, bytes]]:
        """Stream and content of the packets that have arrived. A connection that is lost ends them.

        Raises:
            BadStream: the bytes are no dv network stream. The connection is closed.
        """
        if self._socket is None:
            return
        if self._connecting:
            failed = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
            if failed:
                self._lose(os.strerror(failed))
                return
            self._connecting = False
        ended = self._read()
        try:
            yield from self._packets()
        except BadStream as error:
            self._lose(str(error))
            raise
        if ended:
            self._lose(ended)

    def _read(self) -> str:
        """Read what is there; why the connection ended, if it did."""
        assert self._socket is not None
        try:
            data = self._socket.recv(READ_BYTES)
        except (BlockingIOError, InterruptedError):
            return ""
        except OSError as error:
            return error.strerror or str(error)
        self._bytes += data
        return "" if data else "the server closed the connection"

    def _packets(self) -> Iterator[tuple[int, bytes]]:
        if not self.streams and not self._header():
            return
        data, at = self._bytes, 0
        while len(data) - at >= PACKET_HEADER.size:
            number, length = PACKET_HEADER.unpack_from(data, at)
            if not 0 <= length <= MAX_PACKET_BYTES:
                raise BadStream(f"a packet of {length} bytes; at most {MAX_PACKET_BYTES} are allowed")
            stop = at + PACKET_HEADER.size + length
            if stop > len(data):
                break
            yield number, bytes(memoryview(data)[at + PACKET_HEADER.size : stop])
            at = stop
        del data[:at]

    def _header(self) -> bool:
        """Take the header off the bytes; whether it has arrived."""
        if self._bytes.startswith(_SIGNATURE):
            del self._bytes[: len(_SIGNATURE)]
        if len(self._bytes) < 4:
            return False
        length = int.from_bytes(self._bytes[:4], "little")
        if not 8 <= length <= MAX_HEADER_BYTES:
            raise BadStream("it does not begin with the header of a dv network stream")
        if len(self._bytes) < 4 + length:
            return False
        try:
            self.streams, _ = parse_header(bytes(self._bytes[4 : 4 + length]))
        except BadHeader as error:
            raise BadStream(f"its header cannot be read: {error}") from None
        if not self.streams:
            raise BadStream("its header names no stream of events, inertial samples, frames or triggers")
        del self._bytes[: 4 + length]
        return True

    def _lose(self, why: str) -> None:
        if self.is_up:
            self.down_since = self._clock()
        self.why = why
        self.close()

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.close()
        self._socket, self._connecting = None, False
