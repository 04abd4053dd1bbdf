"""Recording of live traffic: event packets and camera infos as they were published, into one file."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any, Final, NamedTuple

from neurove_core.io import PacketWriter
from neurove_core.io.formats.packet_log.reader import LIMITS
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import decode_packet
from neurove_protocol.keys import Keys
from neurove_service import logs
from neurove_service.transport import Transport

log = logs.get(__name__)

QUEUE_BYTES: Final = 64 << 20
"""So much may wait to be written; what comes while it is full is dropped and counted."""

_ASK_S = 0.5
_POLL_S = 0.1


class _Message(NamedTuple):
    stream: str
    kind: str  # events or camera
    payload: bytes
    received_ns: int  # monotonic clock


@dataclass
class Account:
    """What came of one stream; packets are counted as they stand in the file."""

    packets: int = 0
    events: int = 0
    bytes: int = 0
    missing: int = 0  # numbers that no readable packet in the file has, whoever lost them
    dropped: int = 0  # by us, for the disk did not keep up; missing counts them too
    refused: int = 0  # packets that can not be read: they are in the file as they came
    restarts: int = 0  # the numbers began anew, or went back
    first_us: int | None = None
    last_us: int | None = None


@dataclass
class _Inbox:
    """What was received and not yet written; filled on Zenoh's thread."""

    waiting: deque[_Message] = field(default_factory=deque)
    cap: int = QUEUE_BYTES
    size: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)
    filled: threading.Event = field(default_factory=threading.Event)

    def put(self, message: _Message) -> None:
        with self.lock:
            if self.size + len(message.payload) > self.cap:
                self.dropped[message.stream] = self.dropped.get(message.stream, 0) + 1
                return
            self.size += len(message.payload)
            self.waiting.append(message)
        self.filled.set()

    def take(self) -> list[_Message]:
        with self.lock:
            taken, self.size = list(self.waiting), 0
            self.waiting.clear()
            self.filled.clear()
        return taken


class Recorder:
    """Writes the streams of a deployment, from the moment it is made.

    Args:
        writer: of the file.
        transport: an open session.
        keys: of the deployment.
        streams: which; None for all that are published.
        queue_bytes: so much may wait to be written.
    """

    def __init__(
        self,
        writer: PacketWriter,
        transport: Transport,
        keys: Keys,
        streams: tuple[str, ...] | None = None,
        queue_bytes: int = QUEUE_BYTES,
    ) -> None:
        self._writer, self._keys, self._streams = writer, keys, streams
        self._inbox = _Inbox(cap=queue_bytes)
        self._accounts: dict[str, Account] = {}
        self._next: dict[str, int] = {}
        self._cameras: dict[str, bytes] = {}
        self._unix_ns = time.time_ns() - time.monotonic_ns()  # one clock for the whole file: it never jumps
        for stream in streams or ("*",):
            transport.subscribe(keys.events(stream), self._receiver("events"))
            transport.subscribe(keys.camera(stream), self._receiver("camera"))
            for answer in transport.ask(keys.camera(stream), b"", _ASK_S):  # drivers that spoke before we listened
                self._receiver("camera")(answer.key, answer.payload, time.monotonic_ns())

    def _receiver(self, kind: str) -> Callable[[str, bytes, int], None]:
        def on_sample(key: str, payload: bytes, received_ns: int) -> None:
            try:
                stream = self._keys.stream_of(key)
            except NeuroVEError:
                return  # a key whose stream has no valid name is nobody's
            self._inbox.put(_Message(stream, kind, payload, received_ns))

        return on_sample

    def run(
        self, stop: threading.Event, duration_s: float, progress: Callable[[dict[str, Account]], None] | None = None
    ) -> dict[str, Account]:
        """Write until the stop event or for so long; then what has been received by then.

        Args:
            stop: ends it.
            duration_s: at most so many seconds from now.
            progress: told some ten times a second.

        Returns:
            what came, by stream.
        """
        deadline = time.monotonic() + duration_s
        while not stop.is_set() and time.monotonic() < deadline:
            self._inbox.filled.wait(_POLL_S)
            self._write()
            if progress:
                progress(self._accounts)
            stop.wait(_POLL_S)  # so that a burst is one turn
        self._write()
        return self._accounts

    def _write(self) -> None:
        for message in self._inbox.take():
            log_ns = message.received_ns + self._unix_ns
            if message.kind == "events":
                self._writer.write(message.stream, message.payload, log_ns)
                self._count(message)
            elif self._cameras.get(message.stream) != message.payload:
                self._cameras[message.stream] = message.payload
                self._writer.add(message.stream, "camera", message.payload, log_ns)
        for stream, dropped in self._inbox.dropped.copy().items():
            self._account(stream).dropped = dropped

    def _account(self, stream: str) -> Account:
        return self._accounts.setdefault(stream, Account())

    def _count(self, message: _Message) -> None:
        account = self._account(message.stream)
        account.packets += 1
        account.bytes += len(message.payload)
        try:
            packet = decode_packet(message.payload, LIMITS)
        except NeuroVEError as error:
            if not account.refused:
                log.warning("packet can not be read", stream=message.stream, why=error.message)
            account.refused += 1
            return
        expected = self._next.get(message.stream, packet.seq)
        if packet.seq > expected:
            account.missing += packet.seq - expected
        elif packet.seq < expected:
            account.restarts += 1
        self._next[message.stream] = packet.seq + 1
        account.events += packet.events.n
        first_us = int(packet.events.t[0]) if packet.events.n else packet.t0_us
        account.first_us = first_us if account.first_us is None else account.first_us
        account.last_us = int(packet.events.t[-1]) if packet.events.n else packet.t0_us


def as_json(accounts: dict[str, Account]) -> dict[str, Any]:
    """The accounts as plain values."""
    return {stream: asdict(account) for stream, account in sorted(accounts.items())}
