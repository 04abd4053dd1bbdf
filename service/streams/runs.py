"""Runs: consecutive small packets of one open window as one packet, because each packet costs more than its events."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from neurove_core.ingest.wire import read_packet
from neurove_protocol import Sensor
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import PacketLimits, WireEvents, WirePacket
from neurove_service.streams.lane import OpenWindow

SMALL_BYTES = 4096
"""A larger packet is not merged: it costs less than its events."""

MAX_RUN = 256
"""Packets in one run."""


class Run(NamedTuple):
    """Packets that follow each other, as one packet."""

    packet: WirePacket  # with the number of the first one and the events of all
    marks: list[tuple[int, int]]  # number and t0_us of each
    first: WirePacket


class Wanted(NamedTuple):
    """Which packets a run may have."""

    stream: str
    sensor: Sensor
    seq: int  # of the first one
    window: OpenWindow  # that all of their events belong to


def collect(payloads: Sequence[bytes], limits: PacketLimits, wanted: Wanted) -> Run | None:
    """The run of packets at the begin of some payloads; None if fewer than two can be merged.

    Args:
        payloads: of packets of one stream, in order of arrival.
        limits: limits of packets.
        wanted: which packets the run may have.
    """
    packets: list[WirePacket] = []
    reached_us = wanted.window.start_us
    for payload in payloads[:MAX_RUN]:
        packet = _small(payload, limits)
        if packet is None or packet.seq != wanted.seq + len(packets) or packet.t0_us < reached_us:
            break
        reached_us = packet.events.last_us
        if (packet.stream, packet.sensor) != (wanted.stream, wanted.sensor) or reached_us >= wanted.window.end_us:
            break
        packets.append(packet)
    return _merged(packets) if len(packets) > 1 else None


def _small(payload: bytes, limits: PacketLimits) -> WirePacket | None:
    """A valid packet with events whose times have 16 bits."""
    if len(payload) > SMALL_BYTES:
        return None
    try:
        packet = read_packet(payload, limits)
    except NeuroVEError:
        return None
    return packet if packet.events.n and not packet.events.wide else None


def _merged(packets: list[WirePacket]) -> Run:
    first = packets[0]
    counts = [packet.events.n for packet in packets]
    columns: list[bytes] = []
    for index in range(3):
        parts = [
            packet.events.blob[2 * n * index : 2 * n * (index + 1)].tobytes()
            for packet, n in zip(packets, counts, strict=True)
        ]
        columns.append(b"".join(parts))
    begins = np.array([packet.t0_us - first.t0_us for packet in packets], np.uint32)
    times = np.frombuffer(columns[0], "<u2").astype("<u4") + np.repeat(begins, counts)
    blob = np.frombuffer(times.tobytes() + columns[1] + columns[2], np.uint8)
    events = WireEvents(first.t0_us, blob, True, 0, times.size)
    return Run(first._replace(events=events), [(packet.seq, packet.t0_us) for packet in packets], first)
