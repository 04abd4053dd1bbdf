"""The time from packets on a real Zenoh link to windows, compared with the time to receive them and view their blob."""

import itertools
import multiprocessing
import socket
import statistics
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import Annotated, Final, NamedTuple

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from neurove_core.bench import Row
from neurove_core.bench.ingest import DURATION_US, SENSOR, sweeping_edge
from neurove_core.config import ModelConfig
from neurove_core.geometry.camera import lookup_table
from neurove_core.ingest import windows
from neurove_core.ingest.counting import count_events_reference
from neurove_core.ingest.wire import read_packet
from neurove_protocol.events import SCHEMA, EventPacket, Events, encode_packet
from neurove_service.transport import Transport, open_transport

PACKET_US: Final = 1_000
PATIENCE_S: Final = 20.0

Receive = Callable[[bytes], None]


class _FloorHeader(BaseModel):
    """The fields that the cheapest reader checks before it views a blob."""

    model_config = ConfigDict(strict=True)

    stream: str
    seq: Annotated[int, Field(ge=0)]
    n: Annotated[int, Field(ge=0)]
    data: bytes


class Times(NamedTuple):
    """CPU time of the receiving process for a packet [ms], Zenoh's own threads included."""

    floor_ms: float
    ours_ms: float


def wire(rounds: int, *, quick: bool) -> list[Row]:
    """Receive and count one window of 10 million events per second, in packets of 1 ms, from another process.

    The floor is a reader that receives the bytes, unpacks and checks the header and views the blob.

    Args:
        rounds: measured repetitions.
        quick: small input without warm-up; the times mean nothing.
    """
    events = sweeping_edge(5_000 if quick else 500_000)
    packets = _packets(events)
    config = ModelConfig()
    lut = lookup_table(config.canonical, SENSOR, None)
    closed: list[windows.Window] = []
    state = windows.WindowsState()

    def ours(payload: bytes) -> None:
        nonlocal state
        packet = read_packet(payload)
        pushed = windows.push(packet.events, packet.t0_us, state, lut, config.window, config.canonical)
        state = pushed.state
        closed.extend(pushed.windows)

    def begin() -> None:
        nonlocal state
        closed.clear()
        state = windows.WindowsState()

    for packet in packets:  # compile
        ours(packet)
    with _Link(packets) as link:
        times = _interleaved(link, ours, begin, rounds, warm_up=0 if quick else 2)
    expected = np.zeros_like(closed[0].counts)
    count_events_reference(events, 0, config.window.bin_us, lut, expected)
    equal = [window.start_us for window in closed] == [0] and bool(np.array_equal(closed[0].counts, expected))
    name = f"wire to window, packets of {events.n * PACKET_US // DURATION_US} events"
    ratio = times.floor_ms / times.ours_ms
    return [Row(name, times.ours_ms, "receive and frombuffer", times.floor_ms, ratio, ratio, equal)]


def _interleaved(link: "_Link", ours: Receive, begin: Callable[[], None], rounds: int, warm_up: int) -> Times:
    measured: dict[str, list[float]] = {"floor": [], "ours": []}
    for turn in range(warm_up + rounds):
        begin()
        for name, receive in (("floor", _view), ("ours", ours)):
            spent_ms = link.run(receive)
            if turn >= warm_up:
                measured[name].append(spent_ms)
    return Times(*(statistics.median(measured[name]) for name in ("floor", "ours")))


def _view(payload: bytes) -> None:
    header = _FloorHeader.model_validate(msgpack.unpackb(payload))
    n = header.n
    _: tuple[NDArray[np.uint16], ...] = tuple(np.frombuffer(header.data, "<u2", n, 2 * n * i) for i in range(3))


def _packets(events: Events) -> list[bytes]:
    """The window as packets of 1 ms, then an empty packet that closes it."""
    edges = np.searchsorted(events.t, np.arange(0, DURATION_US + 1, PACKET_US)).tolist()
    packets = [
        EventPacket("bench", seq, SENSOR, seq * PACKET_US, events.span(first, stop))
        for seq, (first, stop) in enumerate(itertools.pairwise(edges))
    ]
    tick = EventPacket("bench", len(packets), SENSOR, DURATION_US, Events.empty())
    return [encode_packet(packet) for packet in (*packets, tick)]


class _Link:
    """A driver in another process that sends to this one.

    Args:
        packets: packets that the driver sends in each run, 1 ms apart.
    """

    def __init__(self, packets: list[bytes]) -> None:
        self._packets = packets
        self._done = threading.Event()
        self._left = 0
        self._receive: Receive = _view

    def __enter__(self) -> "_Link":
        endpoint = f"tcp/127.0.0.1:{_free_port()}"
        self._transport: Transport = open_transport("peer", listen=(endpoint,))
        self._transport.subscribe("bench/events", self._on_sample)
        spawn = multiprocessing.get_context("spawn")  # a fork would copy Zenoh without its threads
        self._control, other = spawn.Pipe()
        self._driver = spawn.Process(target=_drive, args=(endpoint, self._packets, other), daemon=True)
        self._driver.start()
        other.close()
        self._control.recv()  # the driver is connected
        return self

    def __exit__(self, *_: object) -> None:
        self._control.close()
        self._driver.join(PATIENCE_S)
        self._transport.close()

    def run(self, receive: Receive) -> float:
        """Receive all packets once, and return this process's CPU time per packet [ms].

        Args:
            receive: called with each packet.

        Raises:
            TimeoutError: not all packets arrived.
        """
        self._receive, self._left = receive, len(self._packets)
        self._done.clear()
        began = time.process_time()
        self._control.send("go")
        if not self._done.wait(PATIENCE_S):
            raise TimeoutError(f"{self._left} of {len(self._packets)} packets did not arrive within {PATIENCE_S:.0f} s")
        return 1e3 * (time.process_time() - began) / len(self._packets)

    def _on_sample(self, _key: str, payload: bytes, _received_ns: int) -> None:
        if not self._left:
            return
        self._receive(payload)
        self._left -= 1
        if not self._left:
            self._done.set()


def _drive(endpoint: str, packets: list[bytes], control: Connection) -> None:  # pragma: no cover (another process)
    with open_transport("client", connect=(endpoint,), patience_s=PATIENCE_S) as transport:
        publisher = transport.publisher("bench/events", SCHEMA)
        while not publisher.matching:
            time.sleep(0.01)
        control.send("ready")
        for _ in _requests(control):
            began = time.monotonic()
            for index, packet in enumerate(packets):
                time.sleep(max(0.0, began + index * PACKET_US * 1e-6 - time.monotonic()))
                transport.put("bench/events", packet, SCHEMA)


def _requests(control: Connection) -> Iterator[str]:  # pragma: no cover (another process)
    while True:
        try:
            yield control.recv()
        except EOFError:
            return


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
