"""Whatever bytes come in, a reader answers with a message or a NeuroVEError: msgpack's corners, noise, damage."""

import struct

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neurove_protocol import NeuroVEError
from neurove_protocol.codec import MAX_ITEMS, MAX_MESSAGE_BYTES, MAX_STRING_BYTES
from neurove_protocol.errors import InvalidField, Malformed
from neurove_protocol.imu import MAX_IMU_BYTES
from tests.protocol.messages import EVENT_PACKET, EXAMPLES, KINDS, MODELS, Kind, bounded, pack

V1 = b"\xa1v\x01"  # the key v and the value 1
every_kind = pytest.mark.parametrize("kind", KINDS, ids=str)


def refusal(kind: Kind, data: bytes) -> NeuroVEError:
    with pytest.raises(NeuroVEError) as caught:
        kind.decode(data)
    return caught.value


def with_value(key: str, value: bytes) -> bytes:
    """A map of v = 1 and one more key with a value of raw bytes."""
    return b"\x82" + V1 + pack(key) + value


NO_MAP = [
    b"",
    b"\x01",
    b"\xc0",
    b"\xc3",
    b"\xc1",
    b"\x93\x01\x02\x03",
    b"\xa4text",
    b"\xc4\x01x",
    pack(1.5),
    b"\xd4\x05x",
]


@every_kind
@pytest.mark.parametrize("data", NO_MAP, ids=repr)
def test_bytes_that_are_no_map_are_malformed(kind: Kind, data: bytes) -> None:
    assert isinstance(refusal(kind, data), Malformed)


@every_kind
def test_a_duplicate_key_is_malformed_at_any_depth(kind: Kind) -> None:
    for name, value in kind.fields().items():
        head = kind.bytes()[0]
        long = head == 0xDE  # 16 fields and more
        count, body = (
            (struct.unpack(">H", kind.bytes()[1:3])[0], kind.bytes()[3:]) if long else (head & 15, kind.bytes()[1:])
        )
        twice = struct.pack(">BH", 0xDE, count + 1) + body + pack(name) + pack(value)
        assert "duplicate key" in refusal(kind, twice).message
    assert "duplicate key" in refusal(kind, with_value("added", b"\x82\xa1a\x01\xa1a\x01")).message


CAPS = {model.__name__: model.max_bytes for model in MODELS} | {"ImuPacket": MAX_IMU_BYTES}
HEALTH = next(kind for kind in KINDS if kind.name == "HealthReply")


BAD_VALUES = {
    "ext with a byte": b"\xd4\x05x",
    "ext with 16 bytes": b"\xd8\x05" + bytes(16),
    "timestamp": b"\xd6\xff" + bytes(4),
    "empty timestamp": b"\xc7\x00\xff",
    "reserved byte": b"\xc1",
    "str of 4 GB that is not there": b"\xdb\xff\xff\xff\xff",
    "bin of 4 GB that is not there": b"\xc6\xff\xff\xff\xff",
    "array of 4 billion that is not there": b"\xdd\xff\xff\xff\xff",
    "map of 4 billion that is not there": b"\xdf\xff\xff\xff\xff",
    "ext of 4 GB that is not there": b"\xc9\xff\xff\xff\xff\x05",
    "str longer than the rest": b"\xa9short",
    "str that is no UTF-8": b"\xa2\xc3\x28",
    "str with half a surrogate": b"\xa3\xed\xa0\x80",
    "str beyond the cap": pack("x" * (MAX_STRING_BYTES + 1)),
    "array beyond the cap": pack([0] * (MAX_ITEMS + 1)),
    "map beyond the cap": pack({str(i): 0 for i in range(MAX_ITEMS + 1)}),
    "map with a number as key": b"\x81\x01\x01",
    "map with bytes as key": b"\x81\xc4\x01a\x01",
    "map with nil as key": b"\x81\xc0\x01",
    "map with an array as key": b"\x81\x91\x01\x01",
    "map with a map as key": b"\x81\x80\x01",
    "map with NaN as key": b"\x81" + pack(float("nan")) + b"\x01",
    "arrays 100,000 deep": b"\x91" * 100_000 + b"\xc0",
    "maps 100,000 deep": b"\x81\xa1a" * 100_000 + b"\xc0",
}


@every_kind
@pytest.mark.parametrize("value", BAD_VALUES.values(), ids=BAD_VALUES)
def test_what_msgpack_can_say_and_the_contract_does_not_use_is_malformed_even_in_an_unknown_field(
    kind: Kind, value: bytes
) -> None:
    error = refusal(kind, with_value("added", value))
    assert isinstance(error, Malformed) or error.details["field"] in ("size", "header")


@every_kind
@pytest.mark.parametrize("key", [b"\xc4\x01v", b"\xc4\x05added", b"\x05", b"\xc0", b"\x90", b"\xc3"], ids=repr)
def test_a_key_that_is_no_string_is_malformed(kind: Kind, key: bytes) -> None:
    assert isinstance(refusal(kind, b"\x82" + V1 + key + b"\x01"), Malformed)


@every_kind
@pytest.mark.parametrize("depth", [10, 500, 1_000, 1_018, 1_022])
@pytest.mark.parametrize("level", [b"\x91", b"\x81\xa1a"], ids=["arrays", "maps"])
def test_a_value_of_any_depth_is_refused_by_a_short_sentence(kind: Kind, depth: int, level: bytes) -> None:
    for key in [*kind.fields(), "v"]:
        error = refusal(kind, with_value(key, level * depth + b"\xc0"))
        assert len(error.message) < 1_000


@every_kind
def test_an_ext_without_a_body_is_a_wrong_value_like_any_other(kind: Kind) -> None:
    for key in kind.fields().keys() - {"v"}:
        fields = pack(kind.fields() | {key: msgpack.ExtType(5, b"")})
        assert str(refusal(kind, fields).details["field"]).split(".")[0] == key


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind is not EVENT_PACKET], ids=str)
def test_a_message_beyond_the_cap_is_refused_before_it_is_read(kind: Kind) -> None:
    cap = CAPS[kind.name]
    error = refusal(kind, b"\xc1" * (cap + 1))
    assert isinstance(error, InvalidField)
    assert error.details["field"] == "size"
    assert str(cap) in error.message
    assert isinstance(refusal(kind, b"\xc1" * cap), Malformed)


def test_a_message_with_too_many_maps_is_refused() -> None:
    assert "maps" in refusal(HEALTH, with_value("added", pack([[{}] * 4096] * 3))).message


def test_a_string_and_an_array_of_just_the_cap_are_read() -> None:
    for kind in KINDS:
        if not kind.strict and CAPS.get(kind.name, 0) >= MAX_MESSAGE_BYTES:
            kind.decode(pack(kind.fields() | {"added": ["x" * MAX_STRING_BYTES] + [0] * (MAX_ITEMS - 1)}))


def test_the_longest_forms_of_msgpack_mean_the_same_as_the_shortest() -> None:
    fields = EXAMPLES["ActivateRequest"]
    long = b"\xdf\x00\x00\x00\x02" + b"\xdb\x00\x00\x00\x01v" + b"\xcf" + bytes(7) + b"\x01"
    long += b"\xda\x00\x05model" + b"\xd9\x07" + fields["model"].encode()
    kind = next(kind for kind in KINDS if kind.name == "ActivateRequest")
    assert kind.decode(long) == kind.decode(pack({"v": 1, "model": fields["model"]}))


@every_kind
@bounded
@given(data=st.binary(max_size=200))
def test_noise_is_only_ever_refused_with_an_error_of_ours(kind: Kind, data: bytes) -> None:
    for noise in (data, bytes([0x80 + len(data) % 16]) + data, b"\x82" + V1 + data):
        try:
            kind.decode(noise)
        except NeuroVEError:
            continue
        assert noise == kind.bytes() or kind.fields() == {"v": 1}


anything = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
    | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from("abv"), inner, max_size=3),
    max_leaves=6,
)


@every_kind
@settings(bounded, max_examples=30)
@given(data=st.data())
def test_any_value_in_any_field_is_taken_or_refused_with_an_error_of_ours(kind: Kind, data: st.DataObject) -> None:
    names = st.sampled_from([*kind.fields(), "added"])
    fields = kind.fields() | data.draw(st.dictionaries(names, anything, min_size=1, max_size=3))
    try:
        message = kind.decode(pack(fields))
    except NeuroVEError:
        return
    assert kind.encode(kind.decode(kind.encode(message))) == kind.encode(message)


damage = st.lists(
    st.tuples(st.sampled_from(["flip", "insert", "delete"]), st.integers(0, 1 << 16), st.integers(0, 255)),
    min_size=1,
    max_size=4,
)


def damaged(data: bytes, steps: list[tuple[str, int, int]]) -> bytes:
    """The bytes after each step: a bit flipped, a byte put in, or one taken out."""
    spoilt = bytearray(data)
    for step, where, value in steps:
        at = where % (len(spoilt) or 1)
        if step == "insert":
            spoilt.insert(at, value)
        elif spoilt and step == "delete":
            del spoilt[at]
        elif spoilt:
            spoilt[at] ^= 1 << value % 8
    return bytes(spoilt)


@every_kind
@bounded
@given(steps=damage)
def test_a_damaged_message_is_taken_or_refused_with_an_error_of_ours(
    kind: Kind, steps: list[tuple[str, int, int]]
) -> None:
    try:
        message = kind.decode(damaged(kind.bytes(), steps))
    except NeuroVEError:
        return
    kind.encode(message)


@pytest.mark.parametrize("seed", range(4))
def test_a_packet_that_survives_its_damage_still_keeps_every_promise(seed: int) -> None:
    rng = np.random.default_rng(seed)
    taken = 0
    for _ in range(500):
        steps = [
            (str(rng.choice(["flip", "flip", "insert", "delete"])), int(rng.integers(1 << 16)), int(rng.integers(256)))
            for _ in range(int(rng.integers(1, 3)))
        ]
        try:
            packet = EVENT_PACKET.decode(damaged(EVENT_PACKET.bytes(), steps))
        except NeuroVEError:
            continue
        taken += 1
        events = packet.events
        assert all(column.size == events.n for column in events)
        assert (events.x < packet.sensor.width).all()
        assert (events.y < packet.sensor.height).all()
        assert (np.diff(events.t, prepend=packet.t0_us) >= 0).all()
        assert set(events.p.tolist()) <= {0, 1}
    assert taken > 10  # the law was put to the test
