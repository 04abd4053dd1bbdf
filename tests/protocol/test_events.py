"""The event packet: what its blob means, what is refused, and by which sentence."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from neurove_protocol import EVENT_DTYPE, EventPacket, Events, NeuroVEError, Sensor
from neurove_protocol.errors import (
    BlobLength,
    EventOutsideSensor,
    InvalidField,
    Malformed,
    TimeBackwards,
    UnknownFormat,
)
from neurove_protocol.events import FORMATS, PacketLimits, check_events, decode_packet, encode_packet
from tests.builders import make_events, make_packet
from tests.protocol.messages import (
    EVENT_PACKET,
    EVENTS,
    assert_same_events,
    assert_same_packet,
    bounded,
    pack,
    packets,
    soa,
)

SENSOR = Sensor(346, 260)


def fields_of(events: list[tuple[int, int, int, int]], *, wide: bool = False, **changed: object) -> dict[str, object]:
    """The fields of a packet with these events, written from the contract."""
    data = soa(events, wide=wide)
    return EVENT_PACKET.fields() | {"n": len(events), "format": "soa8" if wide else "soa6", "data": data} | changed


def packet_of(t: list[int], *, t0_us: int = 0, x: int = 0, y: int = 0, p: int = 0) -> EventPacket:
    n = len(t)
    return EventPacket("cam0", 0, SENSOR, t0_us, Events.from_columns(t, [x] * n, [y] * n, [p] * n))


@bounded
@given(packets())
def test_any_packet_survives_the_round_trip_bit_for_bit(packet: EventPacket) -> None:
    assert_same_packet(decode_packet(encode_packet(packet)), packet)


@bounded
@given(packets(max_span_us=65_535))
def test_both_formats_say_the_same(packet: EventPacket) -> None:
    soa6, soa8 = (encode_packet(packet, blob_format) for blob_format in FORMATS)
    assert len(soa8) >= len(soa6) + 2 * packet.events.n
    assert_same_packet(decode_packet(soa6), packet)
    assert_same_packet(decode_packet(soa8), packet)


@bounded
@given(packets())
def test_the_smallest_format_is_chosen_that_holds_the_span(packet: EventPacket) -> None:
    span_us = int(packet.events.t[-1]) - packet.t0_us if packet.events.n else 0
    data = encode_packet(packet)
    assert (b"soa6" in data, b"soa8" in data) == (span_us <= 65_535, span_us > 65_535)


@pytest.mark.parametrize(("span_us", "blob_format"), [(65_535, b"soa6"), (65_536, b"soa8")])
def test_the_format_changes_just_where_soa6_ends(span_us: int, blob_format: bytes) -> None:
    assert blob_format in encode_packet(packet_of([7, 7 + span_us], t0_us=7))


@pytest.mark.parametrize("wide", [False, True])
def test_the_blob_holds_all_offsets_then_all_x_then_all_y_with_the_polarity_in_bit_15(wide: bool) -> None:
    packet = decode_packet(pack(fields_of(EVENTS, wide=wide)))
    assert packet.events.to_records().tolist() == [(offset - 1_000, x, y, p) for offset, x, y, p in EVENTS]
    assert encode_packet(packet, "soa8" if wide else "soa6") == pack(fields_of(EVENTS, wide=wide))


@pytest.mark.parametrize("blob_format", FORMATS)
def test_a_packet_without_events_is_a_good_packet(blob_format: str) -> None:
    packet = EventPacket("cam0", 3, SENSOR, -5, Events.empty())
    decoded = decode_packet(encode_packet(packet, blob_format))
    assert_same_packet(decoded, packet)
    assert decoded.events.n == 0


@pytest.mark.parametrize("polarity", [0, 1])
@pytest.mark.parametrize("blob_format", FORMATS)
def test_one_event_in_the_last_corner_of_the_largest_sensor(blob_format: str, polarity: int) -> None:
    packet = EventPacket("cam0", 0, Sensor(4096, 4096), 0, Events.from_columns([9], [4095], [4095], [polarity]))
    assert decode_packet(encode_packet(packet, blob_format)).events.to_records().tolist() == [(9, 4095, 4095, polarity)]


@pytest.mark.parametrize("t0_us", [-(1 << 62), -1_000_001, -1, 0, (1 << 62) - 1])
def test_sensor_time_may_be_negative_and_long(t0_us: int) -> None:
    packet = packet_of([t0_us, t0_us + 65_535], t0_us=t0_us)
    assert decode_packet(encode_packet(packet)).events.t.tolist() == [t0_us, t0_us + 65_535]


def test_the_columns_of_a_packet_are_read_only() -> None:
    x = decode_packet(EVENT_PACKET.bytes()).events.x
    with pytest.raises(ValueError, match="read-only"):
        x[0] = 1


# --- what a reader refuses


@pytest.mark.parametrize("n", [0, 1, 3, 5, 1_000])
def test_a_blob_that_is_not_n_records_long_is_refused(n: int) -> None:
    with pytest.raises(BlobLength) as caught:
        decode_packet(pack(fields_of(EVENTS, n=n)))
    assert caught.value.details == {"field": "data", "value": 24, "bound": 6 * n}
    assert f"n={n}" in caught.value.message


@pytest.mark.parametrize("cut", [1, -1, 6, -6])
def test_a_blob_with_bytes_missing_or_left_over_is_refused(cut: int) -> None:
    blob = soa(EVENTS)
    with pytest.raises(BlobLength):
        decode_packet(pack(fields_of(EVENTS, data=blob[:-cut] if cut > 0 else blob + bytes(-cut))))


@pytest.mark.parametrize("wide", [False, True])
def test_the_blob_of_one_format_under_the_name_of_the_other_is_refused(wide: bool) -> None:
    with pytest.raises(BlobLength):
        decode_packet(pack(fields_of(EVENTS, wide=wide, format="soa6" if wide else "soa8")))


@pytest.mark.parametrize("name", ["evt3", "", "SOA6", "soa6 ", "aedat4", "\u4e8b" * 250])
def test_an_unknown_format_is_refused_and_the_known_ones_are_named(name: str) -> None:
    with pytest.raises(UnknownFormat) as caught:
        decode_packet(pack(fields_of(EVENTS, format=name)))
    assert caught.value.details["field"] == "format"
    assert all(known in caught.value.message for known in FORMATS)


@pytest.mark.parametrize(("x", "y"), [(346, 0), (0, 260), (65_535, 0), (0, 32_767), (346, 260)])
@pytest.mark.parametrize("index", [0, 1, 3])
def test_the_first_event_outside_the_sensor_is_named(x: int, y: int, index: int) -> None:
    events = [(i, 345, 259, 1) for i in range(5)]
    events[index] = (index, x, y, 1)
    events[4] = (4, 400, 300, 0)
    with pytest.raises(EventOutsideSensor) as caught:
        decode_packet(pack(fields_of(events)))
    assert caught.value.details == {"index": index, "x": x, "y": y}
    assert "346x260" in caught.value.message


@pytest.mark.parametrize("wide", [False, True])
def test_the_first_event_that_goes_back_in_time_is_named(wide: bool) -> None:
    events = [(0, 1, 1, 1), (5, 1, 1, 1), (5, 1, 1, 0), (4, 1, 1, 1), (9, 1, 1, 1), (8, 1, 1, 1)]
    with pytest.raises(TimeBackwards) as caught:
        decode_packet(pack(fields_of(events, wide=wide)))
    assert caught.value.details == {"index": 3, "value": -996, "bound": -995}


@pytest.mark.parametrize(
    ("limits", "field", "bound"),
    [
        (PacketLimits(max_events=3), "n", 3),
        (PacketLimits(max_side_px=345), "width", 345),
        (PacketLimits(max_side_px=200), "width", 200),
        (PacketLimits(max_events=0), "n", 0),
    ],
)
def test_a_packet_beyond_a_configured_cap_is_refused_with_the_cap_in_the_sentence(
    limits: PacketLimits, field: str, bound: int
) -> None:
    with pytest.raises(InvalidField) as caught:
        decode_packet(EVENT_PACKET.bytes(), limits)
    assert caught.value.details["field"] == field
    assert f"cap is {bound}" in caught.value.message


def test_a_tall_sensor_beyond_the_cap_is_refused_by_its_height() -> None:
    with pytest.raises(InvalidField, match=r"height=260: .*cap is 250"):
        decode_packet(pack(fields_of([], width=100)), PacketLimits(max_side_px=250))


def test_a_packet_of_just_the_configured_caps_is_taken() -> None:
    limits = PacketLimits(max_events=len(EVENTS), max_side_px=346)
    assert decode_packet(EVENT_PACKET.bytes(), limits).events.n == len(EVENTS)


def test_a_sensor_that_no_coordinate_can_address_is_refused_under_any_cap() -> None:
    with pytest.raises(InvalidField, match="width=40000"):
        decode_packet(pack(fields_of([], width=40_000)), PacketLimits(max_side_px=1 << 20))


def test_bytes_beyond_the_configured_cap_are_refused_before_they_are_read() -> None:
    limits = PacketLimits(max_events=10)
    with pytest.raises(InvalidField) as caught:
        decode_packet(bytes(limits.max_bytes + 1), limits)
    assert caught.value.details["field"] == "size"
    assert str(limits.max_bytes) in caught.value.message
    with pytest.raises(Malformed):
        decode_packet(bytes(limits.max_bytes), limits)


def test_the_largest_packet_of_the_caps_fits_its_bytes() -> None:
    limits = PacketLimits(max_events=500)
    n = limits.max_events
    events = Events.from_columns(range(n), [4095] * n, [4095] * n, [1] * n)
    packet = EventPacket("s" * 64, (1 << 63) - 1, Sensor(4096, 4096), -(1 << 62), events)
    moved = EventPacket(packet.stream, packet.seq, packet.sensor, 0, events)
    assert decode_packet(encode_packet(moved, "soa8"), limits).events.n == n


# --- what a writer refuses, so that no peer has to


def test_an_event_before_the_start_of_its_packet_is_not_sent() -> None:
    with pytest.raises(TimeBackwards) as caught:
        encode_packet(packet_of([9, 12], t0_us=10))
    assert caught.value.details == {"index": 0, "value": 9, "bound": 10}


def test_events_that_run_backwards_are_not_sent() -> None:
    with pytest.raises(TimeBackwards):
        encode_packet(packet_of([3, 2]))


def test_an_event_outside_the_sensor_is_not_sent() -> None:
    with pytest.raises(EventOutsideSensor):
        encode_packet(packet_of([0, 1], x=346))


@pytest.mark.parametrize(("blob_format", "span_us"), [("soa6", 1 << 16), ("soa8", 1 << 32), (None, 1 << 32)])
def test_a_span_too_long_for_the_format_is_refused(blob_format: str | None, span_us: int) -> None:
    with pytest.raises(InvalidField) as caught:
        encode_packet(packet_of([0, span_us]), blob_format)
    assert str(span_us) in caught.value.message
    encode_packet(packet_of([0, span_us - 1]), blob_format)


def test_a_span_of_more_than_64_bits_is_not_sent_wrapped_around() -> None:
    with pytest.raises(InvalidField, match="t=13835058055282163711"):
        encode_packet(packet_of([(1 << 63) - 1], t0_us=-(1 << 62)))


@pytest.mark.parametrize("polarity", [2, 3, 255])
def test_a_polarity_that_is_no_polarity_is_not_sent_as_another_one(polarity: int) -> None:
    with pytest.raises(InvalidField, match=f"p={polarity}"):
        encode_packet(packet_of([0], p=polarity))


def test_an_unknown_format_is_not_sent() -> None:
    with pytest.raises(UnknownFormat):
        encode_packet(packet_of([0]), "evt3")


@pytest.mark.parametrize(
    ("field", "value"),
    [("stream", "a/b"), ("seq", -1), ("seq", 1 << 63), ("seq", np.int64(3)), ("t0_us", -(1 << 62) - 1), ("t0_us", 1.0)],
)
def test_a_header_that_a_reader_would_refuse_is_not_sent(field: str, value: object) -> None:
    header: dict[str, object] = {"stream": "cam0", "seq": 0, "sensor": SENSOR, "t0_us": 0} | {field: value}
    with pytest.raises(InvalidField) as caught:
        encode_packet(EventPacket(**header, events=Events.empty()))  # type: ignore[arg-type]  # wrong on purpose
    assert caught.value.details["field"] == field


@bounded
@given(
    st.lists(st.tuples(*[st.integers(-3, 70_000)] * 3, st.integers(0, 3)), max_size=4),
    st.integers(-3, 70_000),
    st.sampled_from([None, *FORMATS, "evt3"]),
)
def test_what_a_writer_sends_a_reader_takes(
    rows: list[tuple[int, int, int, int]], t0_us: int, blob_format: str | None
) -> None:
    t, x, y, p = zip(*rows, strict=True) if rows else ((), (), (), ())
    assume(all(0 <= value < 1 << 16 for value in (*x, *y)))
    packet = EventPacket("cam0", 0, Sensor(4096, 4096), t0_us, Events.from_columns(t, x, y, p))
    try:
        data = encode_packet(packet, blob_format)
    except NeuroVEError:
        return
    assert_same_packet(decode_packet(data), packet)


# --- events as columns


def test_records_and_columns_hold_the_same_events() -> None:
    events = make_events(50, seed=1, start_us=-20)
    records = events.to_records()
    assert records.dtype == EVENT_DTYPE
    assert_same_events(Events.from_records(records), events)


@pytest.mark.parametrize("cuts", [[], [0], [50], [10, 10, 40]])
def test_the_parts_of_events_join_to_the_whole(cuts: list[int]) -> None:
    events = make_events(50, seed=2)
    edges = [0, *cuts, 50]
    whole = Events.join([events.span(first, stop) for first, stop in pairwise(edges)])
    assert_same_events(whole, events)


def test_no_parts_join_to_no_events() -> None:
    assert Events.join([]).n == 0


def test_events_on_the_sensor_in_order_of_time_pass_the_check() -> None:
    packet = make_packet(200, seed=3, t0_us=5)
    check_events(packet.events, packet.sensor, packet.t0_us)
    check_events(packet.events, packet.sensor)
    check_events(Events.empty(), packet.sensor, 1 << 40)


@pytest.mark.parametrize(("width", "height", "field"), [(0, 1, "width"), (1, 0, "height"), (32_769, 1, "width")])
def test_a_sensor_has_1_to_32768_pixels_a_side(width: int, height: int, field: str) -> None:
    with pytest.raises(InvalidField) as caught:
        Sensor(width, height)
    assert caught.value.details["field"] == field
    assert str(Sensor(32_768, 1)) == "32768x1"
