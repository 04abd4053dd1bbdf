"""The benchmark metrics: windows of a stream while its node counts for Prometheus and is scraped, and without."""

import statistics
import time
import urllib.request
from typing import Final

from neurove_core.bench import Row
from neurove_core.bench.ingest import DURATION_US, SENSOR, sweeping_edge
from neurove_core.ingest.wire import read_packet
from neurove_protocol import Twist
from neurove_protocol.events import EventPacket, Events, encode_packet
from neurove_service import logs
from neurove_service.guard import Guard
from neurove_service.models.slot import ModelSlot
from neurove_service.node.handlers import Handlers
from neurove_service.node.health import stream_status
from neurove_service.node.monitor import Monitor
from neurove_service.streams.intake import Arrival
from neurove_service.streams.stream import Stream

WINDOWS: Final = 800
"""Windows for each scrape: about a second of one core. One camera at real time sends them in 40 s, 16 cameras in 2.5 s;
Prometheus usually scrapes every 15 s."""

EVENTS: Final = 20_000


def metrics(rounds: int, *, quick: bool) -> list[Row]:
    """Windows of the built-in model with counters and one scrape by HTTP, and the same without.

    Times are CPU time of the process, which includes the thread of the HTTP server.

    Args:
        rounds: measured repetitions.
        quick: few windows without warm-up; the times mean nothing.
    """
    logs.configure("warning")
    windows, events = (5, 2_000) if quick else (WINDOWS, EVENTS)
    slot = ModelSlot("default")
    plain, counted = Stream("plain", slot), Stream("counted", slot)
    handlers = Handlers("bench", slot, lambda: [stream_status("bench", counted)])
    monitor = Monitor("bench", "127.0.0.1:0", Guard())
    try:
        monitor.attach(handlers.report, list, time.monotonic)
        times: dict[str, list[float]] = {"plain": [], "counted": []}
        equal = True
        for turn in range(rounds if quick else rounds + 1):
            spent_ms, alike = _interleaved(plain, counted, f"{monitor.url}/metrics", turn * windows, windows, events)
            equal = equal and alike
            for name, value in spent_ms.items():
                if quick or turn:
                    times[name].append(value)
    finally:
        monitor.close()
        slot.close()
    ours, without = (statistics.median(times[name]) for name in ("counted", "plain"))
    return [
        Row(f"{windows} windows with metrics, scraped once", ours, "no metrics", without, without / ours, None, equal)
    ]


def _interleaved(
    plain: Stream, counted: Stream, scrape: str, first: int, windows: int, events: int
) -> tuple[dict[str, float], bool]:
    """CPU time of both streams [ms], and whether their twists are equal; window by window, so that load hits both."""
    spent_s = {plain.name: 0.0, counted.name: 0.0}
    twists: dict[str, list[Twist]] = {plain.name: [], counted.name: []}
    for packets in zip(*(_packets(one.name, first, windows, events) for one in (plain, counted)), strict=True):
        pairs = list(zip((plain, counted), packets, strict=True))
        for stream, payload in pairs if len(twists[plain.name]) % 2 else pairs[::-1]:
            began = time.process_time()
            now_ns = time.monotonic_ns()
            for estimate in stream.accept(read_packet(payload), Arrival(now_ns, now_ns, now_ns // 1000)):
                estimate.encode()
                twists[stream.name].append(estimate.twist)
                if stream is counted:
                    stream.activity.published(estimate)
                else:
                    stream.activity.record(estimate)
            spent_s[stream.name] += time.process_time() - began
    began = time.process_time()
    with urllib.request.urlopen(scrape, timeout=60) as answer:
        answer.read()
    spent_s[counted.name] += time.process_time() - began
    alike = twists[plain.name] == twists[counted.name] and len(twists[plain.name]) >= windows - 1
    return {name: 1e3 * value for name, value in spent_s.items()}, alike


def _packets(stream: str, first: int, windows: int, events: int) -> list[bytes]:
    one = sweeping_edge(events)
    return [
        encode_packet(
            EventPacket(stream, seq, SENSOR, seq * DURATION_US, Events(one.t + seq * DURATION_US, one.x, one.y, one.p))
        )
        for seq in range(first, first + windows)
    ]
