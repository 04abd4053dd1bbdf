import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurove_protocol.errors import InvalidField, Malformed
from neurove_protocol.events import MAX_HEADER_BYTES, decode_packet
from neurove_protocol.header import header_bytes
from tests.protocol.messages import EVENT_PACKET

KEY = b"\xa4data"
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


@given(fields=st.dictionaries(st.text().filter(lambda name: name != "data"), VALUES), blob=st.binary())
def test_the_size_of_a_header_is_that_of_the_message_without_its_blob(fields, blob):
    whole = msgpack.packb(fields | {"data": blob})
    size = len(whole) - len(blob) - len(msgpack.packb(blob)[: len(msgpack.packb(blob)) - len(blob)])
    nested = b"\xa4data\xc4" in msgpack.packb(fields) or b"\xa4data\xc5" in msgpack.packb(fields)
    assert nested or header_bytes(whole, KEY, 1 << 30) == size


@given(data=st.binary(max_size=60))
def test_noise_has_a_size(data):
    assert header_bytes(data, KEY, 100) >= 0


@pytest.mark.parametrize(
    "value",
    [
        b"\x91" * 2_000 + b"\xc0",
        b"\x81\xa1a" * 2_000_000 + b"\xc0",
        msgpack.packb(["x" * 1000, "y" * 100]),
        b"\xdd\x00\x78\x00\x00" + bytes(0x780000),
        b"\xc6\x00\x78\x00\x00" + bytes(0x780000),
    ],
    ids=["nested arrays", "6 MB of nested maps", "strings", "8 MB of numbers", "7.9 MB in another field"],
)
def test_a_packet_is_no_longer_than_its_header_and_its_events(value):
    fields = EVENT_PACKET.fields()
    data = bytes([0x80 + len(fields) + 1]) + msgpack.packb(fields)[1:] + msgpack.packb("added") + value
    with pytest.raises(InvalidField) as refused:
        decode_packet(data)
    assert refused.value.details["field"] == "header"
    assert str(MAX_HEADER_BYTES) in refused.value.message


def test_bytes_after_a_packet_are_refused():
    with pytest.raises(Malformed):
        decode_packet(EVENT_PACKET.bytes() + bytes(7_000_000))


def test_a_second_blob_counts_as_header():
    fields = EVENT_PACKET.fields()
    blob = msgpack.packb("data") + msgpack.packb(bytes(5000))
    data = bytes([0x80 + len(fields) + 2]) + blob + msgpack.packb(fields)[1:] + blob
    with pytest.raises(InvalidField, match="header"):
        decode_packet(data)
