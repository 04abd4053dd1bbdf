"""Laws that hold for every message of the contract, run over one table of examples."""

import math
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurove_protocol import CameraInfo, NeuroVEError, Sensor, Trace, Twist, TwistEstimate
from neurove_protocol.control import Losses
from neurove_protocol.errors import InvalidField, UnsupportedVersion
from tests.protocol.messages import (
    ANY,
    BY_NAME,
    EXAMPLES,
    KINDS,
    Fields,
    Kind,
    Path,
    bounded,
    dotted,
    pack,
    paths,
    replaced,
    same,
)

NAN, INF = math.nan, math.inf
WRONG: dict[type, tuple[Any, ...]] = {
    bool: (0, 1, 1.0, "true", None, b"\x01", []),
    int: ("1", 1.0, True, None, b"1", [1], {"a": 1}, NAN),
    float: ("1.0", True, None, b"1", [1.0], {"a": 1.0}, NAN, INF, -INF),
    str: (1, 1.0, True, None, b"cam0", ["cam0"], {"a": "b"}),
    bytes: ("", 1, 1.0, None, [1], {}),
    list: (1, True, "ab", b"ab", {"0": 1}, None),
    dict: (1, False, "ab", b"ab", [], None),
    type(None): (b"", [], {}),
}
NULLABLE = {
    ("TwistEstimate", "covariance"),
    ("TwistEstimate", "node"),
    ("TwistEstimate", "host"),
    ("TwistEstimate", "term"),
    ("DutyReply", "leader"),
    ("DutyReply", "missed_us"),
    ("StateRequest", "after_us"),
    ("TakeRequest", "start_us"),
    ("CameraInfo", "height_m"),
    *(
        (kind, name)
        for kind in ("StreamStatus", "HealthReply")
        for name in ("latency_ms", "imu", "bias_rad_s", "offset_ms", "latency_histogram", "sigma", "standby", "leader")
    ),
    ("ModelsReply", "previous"),
    ("PushRequest", "signature"),
    ("ActivateRequest", "expect"),
    ("ActivateRequest", "force"),
    ("RollbackRequest", "expect"),
}
FREE_MAPS = (
    "details",
    "unreadable",
    "figures",
    "partial",
    "internal_errors",
    "flag_counts",
    "labels",
    "handed",
    "kept",
)
DEFAULTED = {"release", "figures", "signature"}  # of a ModelInfo
DEFAULTED |= {
    "form",
    "recovered_packets",
    "uncounted_packets",
    "refused_cameras",
    "refusal",
    "unrefined_windows",
    "imu",
    "latency_histogram",
    "flag_counts",
    "sigma",
    "standby",
    "other_model",
    "draining",
    "followers",
}  # of a StreamStatus
OUT_OF_BOUND: dict[str, dict[str, tuple[Any, ...]]] = {
    "EventPacket": {
        "stream": ("", "a/b", "@node", "*", "**", ".", "..", "-a", "a" * 65, "caf\u00e9", "a b", "a\n", "$*", "#", "?"),
        "seq": (-1, 1 << 63),
        "width": (0, -1, 4097, 1 << 63),
        "height": (0, -1, 4097),
        "t0_us": (-(1 << 62) - 1, 1 << 62),
        "n": (-1, 1_000_001, 1 << 63),
    },
    "ImuPacket": {
        "stream": ("", "a/b", "@node"),
        "seq": (-1, 1 << 63),
        "n": (-1, 0, 4097, 1 << 63),
        "t": (struct.pack("<2q", 0, 1 << 62), struct.pack("<2q", -(1 << 62) - 1, 0)),
        "accel_m_s2": tuple(struct.pack("<6d", 0, 0, 0, 0, wrong, 0) for wrong in (NAN, INF, -1.1e4)),
        "gyro_rad_s": tuple(struct.pack("<6d", wrong, 0, 0, 0, 0, 0) for wrong in (NAN, -INF, 1.1e3)),
    },
    "CameraInfo": {
        "stream": ("", "a/b", "@node"),
        "width": (0, (1 << 15) + 1),
        "height": (-1, (1 << 15) + 1),
        "lens": ("", "fisheye", "Pinhole"),
        "fx": (0.0, -226.4, 0, 1e-9, 1e150),
        "fy": (0.0, -1e-9, 2e6),
        "cx": (1e150,),
        "cy": (-1e150,),
        "distortion.0": (1e150,),
        "distortion": ([0.0], [0.0] * 3, [0.0] * 6),
        "height_m": (0.0, -0.3, 1e-9, 1e5, 1e150),
    },
    "TwistEstimate": {
        "stream": ("", "a/b", "@node"),
        "seq": (-1, 1 << 63),
        "start_us": (1 << 63,),
        "end_us": (-50_000, -50_001, 1 << 63),
        "bin_end_us": ([],),
        "bin_end_us.1": (1 << 63,),
        "twists": ([], [[0.0] * 6], [[0.0] * 6] * 3),
        "twists.0": ([0.0] * 5, [0.0] * 7, []),
        "digest": ("", "5e" * 31, "5E" * 32, "5e" * 33, "5e" * 32 + "\n", "xy" * 32),
        "epoch": (-1, 1 << 63),
        "events": (-1, 1 << 63),
        "covariance": ([], [0.0] * 35, [0.0] * 37, [0.0, 1.0] + [0.0] * 34, [-1.0] + [0.0] * 35),
        "trace.received_ns": (1 << 63,),
    },
    "StreamStatus": {
        "node": ("", "a/b", "@node"),
        "stream": ("", "a/b", "@node"),
        "verdict": ("", "OK", "bad"),
        **{
            name: (-1, 1 << 63)
            for name, value in EXAMPLES["StreamStatus"].items()
            if type(value) is int and name != "v"
        },
        **{f"lost.{name}": (-1, 1 << 63) for name in Losses.model_fields},
        "imu.samples": (-1, 1 << 63),
        "imu.bias_rad_s": ([], [0.0] * 2, [0.0] * 4),
        "latency_histogram.counts": ([], [0] * 10, [0] * 12),
        "latency_histogram.counts.3": (-1, 1 << 63),
        "latency_histogram.sum_ms": (-1.0,),
        "flag_counts": ({f"flag{i}": 1 for i in range(65)},),
        "sigma": ([], [0.0] * 5, [0.0] * 7),
    },
    "HealthReply": {
        "node": ("*",),
        "epoch": (-1,),
        "refused_streams": (-1,),
        "rollbacks": (-1,),
        "model.parameters": (-1,),
        "streams.0.lost.late_events": (-1,),
        "streams.0.stream": ("a/b",),
        "labels": ({"a/b": "c"}, {"site": ""}, {f"label{i}": "x" for i in range(17)}),
    },
    "ModelsReply": {"node": ("",), "epoch": (-1,), "available.0.parameters": (-1,), "staged.0.release": (-1,)},
    "PushRequest": {
        "digest": ("", "5e" * 31, "5E" * 32, "5e" * 32 + "\n", "../" + "5e" * 31),
        "size": (0, -1, 1 << 63),
        "name": ("", "m" * 129),
        "signature": (b"x" * 65_537,),
    },
    "ChunkRequest": {"offset": (-1, 1 << 63), "length": (0, -1, (1 << 20) + 1)},
    "ProgressReply": {"node": ("",)},
    "PushReply": {"node": ("",), "fetched": (-1,), "model.signature": ("", "good")},
    "ActivateRequest": {
        "model": ("", "m" * 129),
        "expect": ("", "5e5e5e5", "5E5E5E5E", "5e" * 33),
        "shadow_s": (-0.5, 3600.5),
        "canary": (["a/b"], [""]),
        "force": ("", "m" * 201),
    },
    "RollbackRequest": {"expect": ("", "5e5e5e5")},
    "ActivateReply": {"node": ("",), "epoch": (-1,)},
}


def refused(kind: Kind, fields: object) -> NeuroVEError:
    """The error that refuses these fields."""
    with pytest.raises(NeuroVEError) as caught:
        kind.decode(pack(fields))
    return caught.value


def assert_names(error: NeuroVEError, field: str) -> None:
    """The error is about this field (or a part of it), in its sentence and for machines."""
    assert isinstance(error, InvalidField), error
    named = str(error.details["field"])
    assert named == field or named.startswith(field + "."), error
    assert f": {named}=" in error.message
    assert error.details["bound"]


def deep_paths(kind: Kind) -> list[tuple[Path, Any]]:
    """All fields and parts of fields but those inside the free blob of bytes."""
    return list(paths(kind.fields()))


def is_detail(value: object) -> bool:
    """Whether an error reply may carry this value among its details."""
    return value is None or isinstance(value, str | int) or (isinstance(value, float) and math.isfinite(value))


every_kind = pytest.mark.parametrize("kind", KINDS, ids=str)


@every_kind
def test_the_example_decodes_and_encodes_to_the_same_bytes(kind: Kind) -> None:
    assert kind.encode(kind.decode(kind.bytes())) == kind.bytes()


@pytest.mark.parametrize("name", ANY)
@bounded
@given(data=st.data())
def test_any_valid_message_survives_the_round_trip_in_value_and_type(name: str, data: st.DataObject) -> None:
    fields = {"v": 1, **data.draw(ANY[name])}
    kind = BY_NAME[name]
    message = kind.decode(pack(fields))
    again = kind.decode(kind.encode(message))
    assert again == message
    assert same(plain(again.model_dump()), plain(message.model_dump()))
    assert same(plain(message.model_dump()), fields | {"v": 1})


def plain(value: object) -> object:
    """A message's values as the wire has them: arrays for tuples."""
    if isinstance(value, dict):
        return {key: plain(child) for key, child in value.items()}
    return [plain(child) for child in value] if isinstance(value, tuple | list) else value


@every_kind
def test_every_truncation_is_refused(kind: Kind) -> None:
    data = kind.bytes()
    for length in range(len(data)):
        with pytest.raises(NeuroVEError) as caught:
            kind.decode(data[:length])
        assert caught.value.code == "malformed", length


@every_kind
@pytest.mark.parametrize("tail", [b"\x00", b"\xc0", b"\xc1", b"\xff", b"\x80", b"\x81\xa1v\x01"])
def test_bytes_after_the_message_are_refused(kind: Kind, tail: bytes) -> None:
    with pytest.raises(NeuroVEError) as caught:
        kind.decode(kind.bytes() + tail)
    assert caught.value.code == "malformed"


@every_kind
def test_every_field_but_the_optional_ones_must_be_there(kind: Kind) -> None:
    for name in kind.fields().keys() - {"v"}:
        fields = kind.fields()
        del fields[name]
        if name in kind.optional:
            kind.decode(pack(fields))
        else:
            error = refused(kind, fields)
            assert_names(error, name)
            assert "missing" in error.message


@every_kind
def test_every_part_refuses_a_missing_field_by_its_full_name(kind: Kind) -> None:
    for path, value in deep_paths(kind):
        if not isinstance(value, dict) or path[-1] in ("lost", *FREE_MAPS):
            continue  # counters that are not told are 0
        for name in value.keys() - {"v"} - DEFAULTED:
            assert_names(
                refused(kind, replaced(kind.fields(), path, {key: value[key] for key in value if key != name})),
                dotted((*path, name)),
            )


@every_kind
def test_every_value_of_a_wrong_type_is_refused_by_the_name_of_its_field(kind: Kind) -> None:
    for path, value in deep_paths(kind):
        for wrong in WRONG[type(value)]:
            if wrong is None and (kind.name, path[-1]) in NULLABLE:
                continue
            if path[0] == "details" and len(path) > 1 and is_detail(wrong):
                continue
            assert_names(refused(kind, replaced(kind.fields(), path, wrong)), dotted(path))


@pytest.mark.parametrize(
    ("name", "field", "value"),
    [(name, field, value) for name, fields in OUT_OF_BOUND.items() for field in fields for value in fields[field]],
)
def test_every_value_out_of_bound_is_refused_by_the_name_of_its_field(name: str, field: str, value: object) -> None:
    kind = BY_NAME[name]
    path = tuple(int(part) if part.isdecimal() else part for part in field.split("."))
    assert_names(refused(kind, replaced(kind.fields(), path, value)), field)


@every_kind
@pytest.mark.parametrize("version", [0, 2, -1, 1 << 40, "1", 1.0, True, False, None, b"\x01", [1], {"v": 1}])
def test_another_major_version_is_refused_for_any_content(kind: Kind, version: object) -> None:
    for fields in (kind.fields() | {"v": version}, {"v": version}, {"v": version, "new": [1]}):
        error = refused(kind, fields)
        assert isinstance(error, UnsupportedVersion)
        assert error.details["field"] == "v"
        assert "v=1" in error.message


@every_kind
def test_a_message_without_a_version_is_refused(kind: Kind) -> None:
    fields = kind.fields()
    del fields["v"]
    assert isinstance(refused(kind, fields), UnsupportedVersion)


@every_kind
@pytest.mark.parametrize("extra", [1, "x", None, [1, [2]], {"a": {"b": 1}}, 1.5, b"x"])
def test_an_unknown_field_is_ignored_in_data_and_refused_in_requests(kind: Kind, extra: object) -> None:
    fields = kind.fields() | {"added_later": extra}
    if kind.strict:
        assert_names(refused(kind, fields), "added_later")
    else:
        assert kind.encode(kind.decode(pack(fields))) == kind.bytes()


@every_kind
def test_an_unknown_field_inside_a_part_is_ignored(kind: Kind) -> None:
    for path, value in deep_paths(kind):
        if isinstance(value, dict) and path[-1] not in FREE_MAPS:
            fields = replaced(kind.fields(), (*path, "added_later"), 1)
            assert kind.encode(kind.decode(pack(fields))) == kind.bytes()


@every_kind
def test_the_order_of_the_fields_does_not_matter(kind: Kind) -> None:
    fields: Fields = dict(reversed(kind.fields().items()))
    assert kind.encode(kind.decode(pack(fields))) == kind.bytes()


def test_integers_and_float32_are_valid_floats() -> None:
    kind = BY_NAME["CameraInfo"]
    assert kind.decode(pack(kind.fields() | {"fx": 226, "cx": 0})).fx == 226.0
    short = pack(kind.fields()).replace(pack("cx") + pack(173.6), pack("cx") + b"\xca\x43\x2d\x80\x00")
    assert kind.decode(short).cx == 173.5


def test_an_optional_field_that_is_left_out_has_its_default() -> None:
    camera = EXAMPLES["CameraInfo"]
    info = CameraInfo.decode(pack({key: camera[key] for key in camera if key not in ("distortion", "height_m")}))
    assert info.distortion == ()
    assert info.height_m is None
    assert info.sensor == Sensor(346, 260)


@pytest.mark.parametrize(("lens", "terms"), [("pinhole", (0, 4, 5)), ("equidistant", (0, 4))])
def test_a_lens_takes_just_its_own_numbers_of_coefficients(lens: str, terms: tuple[int, ...]) -> None:
    kind = BY_NAME["CameraInfo"]
    for count in range(8):
        fields = kind.fields() | {"lens": lens, "distortion": [0.1] * count}
        if count in terms:
            assert len(kind.decode(pack(fields)).distortion) == count
        else:
            error = refused(kind, fields)
            assert_names(error, "distortion")
            assert lens in error.message


def test_the_newest_twist_is_that_of_the_last_bin() -> None:
    estimate = TwistEstimate.decode(BY_NAME["TwistEstimate"].bytes())
    assert estimate.twist == Twist(0.5, 0.0, 1.5, 0.0, -0.25, 0.0)


def test_latency_is_publishing_minus_receiving() -> None:
    trace = Trace(received_ns=1_000_000, queued_ns=1_500_000, computed_ns=3_000_000, published_ns=4_500_000)
    assert trace.latency_ms == 3.5


def test_nonzero_reports_only_losses_above_zero() -> None:
    assert Losses().nonzero() == {}
    assert Losses(gap_packets=2, late_events=1).nonzero() == {"gap_packets": 2, "late_events": 1}


def test_a_checked_message_is_immutable() -> None:
    estimate = TwistEstimate.decode(BY_NAME["TwistEstimate"].bytes())
    with pytest.raises(ValueError, match="frozen"):
        estimate.seq = 2  # type: ignore[misc]  # wrong on purpose
