"""Runs: consecutive small packets of one open window as one packet, because each packet costs more than its events."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from neurove_core.ingest.wire import read_packet
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import PacketLimits, WireEvents, WirePacket

SMALL_BYTES = 4096
"""A larger packet is not merged: it costs less than its events."""

MAX_RUN = 256
"""Packets in one run."""


class Run(NamedTuple):
    """Packets that follow each other, as one packet."""

    packet: WirePacket  # with the number of the first one and the events of all
    marks: list[tuple[int, int]]  # number and t0_us of each


def collect(payloads: Sequence[bytes], limits: PacketLimits, expected: int, end_us: int) -> Run | None:
    """The run of packets at the begin of some payloads; None if fewer than two can be merged.

    Args:
        payloads: of packets of one stream, in order of arrival.
        limits: limits of packets.
        expected: number of the next packet.
        end_us: end of the open window; only packets that reach less are merged [us].
    """
    packets: list[WirePacket] = []
    reached_us = -(1 << 63)
    for payload in payloads[:MAX_RUN]:
        packet = _small(payload, limits)
        if packet is None or packet.seq != expected + len(packets) or packet.t0_us < reached_us:
            break
        if packets and (packet.stream, packet.sensor) != (packets[0].stream, packets[0].sensor):
            break
        reached_us = packet.events.last_us
        if reached_us >= end_us:
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
    return Run(first._replace(events=events), [(packet.seq, packet.t0_us) for packet in packets])
