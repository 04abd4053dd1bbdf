"""The fast path from bytes to counts rejects, reads and counts as the reference does, bit for bit."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurove_core.config import CanonicalConfig, WindowConfig
from neurove_core.geometry.camera import OUTSIDE, lookup_table
from neurove_core.ingest.counting import count_events, count_events_reference
from neurove_core.ingest.windows import Pushed, WindowsState, push
from neurove_core.ingest.wire import count_wire, read_packet
from neurove_protocol import EventPacket, Events, NeuroVEError, Sensor
from neurove_protocol.events import (
    DEFAULT_LIMITS,
    FORMATS,
    Packet,
    PacketLimits,
    WireEvents,
    decode_packet,
    encode_packet,
    open_packet,
)
from tests.builders import SENSOR, make_events, make_packet, make_packets
from tests.protocol.messages import EVENT_PACKET, assert_same_events, bounded, pack, packets, soa

LIMITS = PacketLimits(max_events=5, max_side_px=400)
LUT = lookup_table(CanonicalConfig(width=16, height=12), SENSOR, None)
HALF_BLIND = np.where(np.arange(SENSOR.width) < SENSOR.width // 2, OUTSIDE, LUT).astype(np.int32)


def outcome(
    read: Callable[[bytes, PacketLimits], Packet], data: bytes, limits: PacketLimits = DEFAULT_LIMITS
) -> object:
    """The packet as plain values, or the error that reading it raises."""
    try:
        packet = read(data, limits)
    except NeuroVEError as error:
        return type(error), error.message, error.details
    events = packet.events.columns() if isinstance(packet.events, WireEvents) else packet.events
    about = packet.stream, packet.seq, packet.sensor, packet.t0_us
    return about, events.t.dtype, *(column.tolist() for column in events)


def assert_read_alike(data: bytes, limits: PacketLimits = DEFAULT_LIMITS) -> None:
    assert outcome(read_packet, data, limits) == outcome(decode_packet, data, limits)


@bounded
@given(packets(), st.sampled_from([None, "soa8"]))
def test_any_packet_is_read_as_by_the_reference_reader(packet: EventPacket, blob_format: str | None) -> None:
    assert_read_alike(encode_packet(packet, blob_format))


@pytest.mark.parametrize("t0_us", [-(1 << 62), -32_769, -129, -33, -32, 0, 127, 128, 255, 65_536, (1 << 62) - 1])
@pytest.mark.parametrize("seq", [0, 127, 128, 255, 256, 65_535, 65_536, (1 << 32) - 1, 1 << 32, (1 << 63) - 1])
def test_integers_of_every_length_are_read(t0_us: int, seq: int) -> None:
    assert_read_alike(encode_packet(replace(make_packet(3, t0_us=t0_us), seq=seq)))


@pytest.mark.parametrize("stream", ["a", "cam0", "x" * 31, "x" * 32, "x" * 64])
def test_names_of_every_length_are_read(stream: str) -> None:
    assert_read_alike(encode_packet(make_packet(3, stream=stream)))


def test_a_packet_with_fields_in_another_order_or_with_extra_fields_is_read() -> None:
    fields = EVENT_PACKET.fields()
    assert_read_alike(pack(dict(reversed(fields.items()))))
    assert_read_alike(pack({"new": {"x": 1}, **fields}))
    assert_read_alike(pack({**fields, "new": [1, 2]}))


@pytest.mark.parametrize("name", list(EVENT_PACKET.fields()))
@pytest.mark.parametrize(
    "value",
    [None, True, -1, 0, 1, 2, 5, 399, 401, 1 << 15, 1 << 62, (1 << 64) - 1, -(1 << 63), 1.0, "soa8", "", b"", []],
)
def test_a_wrong_field_is_rejected_with_the_same_error_text(name: str, value: object) -> None:
    fields = EVENT_PACKET.fields()
    assert_read_alike(pack(fields | {name: value}), LIMITS)
    assert_read_alike(pack({key: kept for key, kept in fields.items() if key != name}), LIMITS)


@pytest.mark.parametrize("stream", ["", ".", "a/b", "a b", "\u4e8b", "@x", "-x"])
def test_a_bad_name_is_rejected_with_the_same_error_text(stream: str) -> None:
    assert_read_alike(pack(EVENT_PACKET.fields() | {"stream": stream}))


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("index", [0, 1, 4])
@pytest.mark.parametrize(("x", "y", "back_us"), [(346, 0, 0), (0, 260, 0), (65_535, 32_767, 0), (0, 0, 7)])
def test_a_wrong_event_is_named_in_the_same_error_text(wide: bool, index: int, x: int, y: int, back_us: int) -> None:
    events = [(10 + i, 345, 259, i % 2) for i in range(5)]
    events[index] = (events[index][0] - back_us, x, y, 1)
    changed = {"n": 5, "format": "soa8" if wide else "soa6", "data": soa(events, wide=wide)}
    assert_read_alike(pack(EVENT_PACKET.fields() | changed))


def test_every_truncation_and_every_flipped_bit_gives_the_same_result() -> None:
    data = EVENT_PACKET.bytes()
    for size in range(len(data)):
        assert_read_alike(data[:size])
    for place in range(len(data)):
        for bit in range(8):
            assert_read_alike(data[:place] + bytes([data[place] ^ 1 << bit]) + data[place + 1 :])
    assert_read_alike(data + b"\0")


def test_a_packet_above_the_limits_is_rejected_in_the_same_way() -> None:
    data = encode_packet(make_packet(50))
    for limits in (PacketLimits(max_events=49), PacketLimits(max_side_px=63), PacketLimits(max_events=0)):
        assert_read_alike(data, limits)


def test_the_events_of_a_packet_are_not_copied() -> None:
    data = encode_packet(make_packet(1_000))
    assert np.shares_memory(read_packet(data).events.blob, np.frombuffer(data, np.uint8))


@bounded
@given(packets(), st.integers(-5, 70_000), st.integers(-3, 20), st.integers(-3, 20))
def test_events_in_packet_layout_are_split_as_columns_are(
    packet: EventPacket, after_us: int, first: int, stop: int
) -> None:
    events, lying = packet.events, open_packet(encode_packet(packet)).events
    assert lying.n == events.n
    assert lying.before(packet.t0_us + after_us) == events.before(packet.t0_us + after_us)
    part, of_wire = events.span(first, stop), lying.span(first, stop)
    assert of_wire.n == part.n
    assert_same_events(of_wire.columns(), part)
    if part.n:
        assert (of_wire.first_us, of_wire.last_us) == (part.first_us, part.last_us)


@pytest.mark.parametrize("count", [count_events, count_events_reference])
@given(
    seed=st.integers(0, 2**32),
    n=st.integers(0, 3_000),
    start_us=st.integers(-(1 << 60), 1 << 60),
    blob_format=st.sampled_from(FORMATS),
    fill=st.sampled_from([0, 254]),
)
def test_counts_equal_those_of_the_columns_bit_for_bit(count, seed, n, start_us, blob_format, fill) -> None:
    events = make_events(n, seed=seed, start_us=start_us, duration_us=3_000)
    lut = np.random.default_rng(seed).integers(OUTSIDE, 42, (SENSOR.height, SENSOR.width), np.int32)
    t0_us = start_us - int(seed % 1_000)
    lying = read_packet(encode_packet(EventPacket("cam0", seed, SENSOR, t0_us, events), blob_format)).events
    counts, expected = (np.full((6, 6, 7), fill, np.uint8) for _ in range(2))
    first, stop = n // 3, n - n // 5
    outside = count_wire(lying.span(first, stop), start_us, 1_000, lut, counts)
    assert outside == count(events.span(first, stop), start_us, 1_000, lut, expected)
    np.testing.assert_array_equal(counts, expected)


def run(given: list[EventPacket], *, from_wire: bool, lut: np.ndarray) -> list[Pushed]:
    config, canonical = (
        WindowConfig(duration_us=10_000, bins=5, max_hole_windows=3),
        CanonicalConfig(width=16, height=12),
    )
    state, found = WindowsState(), []
    for packet in given:
        events = read_packet(encode_packet(packet)).events if from_wire else packet.events
        found.append(push(events, packet.t0_us, state, lut, config, canonical))
        state = found[-1].state
    return found


@pytest.mark.parametrize("lut", [LUT, HALF_BLIND])
@pytest.mark.parametrize("seed", range(5))
def test_windows_and_losses_are_the_same_from_packet_layout_and_from_columns(seed: int, lut: np.ndarray) -> None:
    rng = np.random.default_rng(seed)
    given = make_packets(60, first_seq=seed, start_us=-30_000, step_us=1_500, n=150)
    order = np.argsort(np.arange(60) + rng.normal(0, 1.5, 60))  # some arrive late
    given = [given[i] for i in order if rng.random() > 0.1]  # some are lost
    given += make_packets(3, start_us=900_000, n=0) + make_packets(9, start_us=950_000, step_us=90_000)
    for plain, wire in zip(*(run(given, from_wire=from_wire, lut=lut) for from_wire in (False, True)), strict=True):
        assert (wire.late_events, wire.skipped_windows) == (plain.late_events, plain.skipped_windows)
        for a, b in zip([*wire.windows, wire.state], [*plain.windows, plain.state], strict=True):
            assert (a.start_us, a.events, a.outside) == (b.start_us, b.events, b.outside)
            np.testing.assert_array_equal(a.counts, b.counts)


def test_the_whole_sensor_of_the_contract_fits() -> None:
    packet = EventPacket("cam0", 0, Sensor(4096, 4096), 0, Events.from_columns([9], [4095], [4095], [1]))
    assert_read_alike(encode_packet(packet))
