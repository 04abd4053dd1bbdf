"""Errors: a stable code, a sentence, and details that reach the peer whatever went wrong."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurove_protocol import NeuroVEError, Sensor
from neurove_protocol.codec import MAX_STRING_BYTES
from neurove_protocol.control import ErrorReply, PeerError
from neurove_protocol.errors import (
    MAX_TEXT_BYTES,
    BadModel,
    BlobLength,
    Busy,
    Conflict,
    Detail,
    Diverged,
    Downgrade,
    EventOutsideSensor,
    InputError,
    InternalError,
    InvalidField,
    Malformed,
    ModelError,
    NoMemory,
    NoQuota,
    NoSpace,
    NoStore,
    NoTable,
    NothingBefore,
    RequestError,
    RolledBack,
    TimeBackwards,
    TooLarge,
    TooSlow,
    TransferError,
    TransferInterrupted,
    UnknownFormat,
    UnknownModel,
    UnsupportedVersion,
    Untrained,
    Untrusted,
    shown,
)
from tests.protocol.messages import bounded

ERRORS: list[NeuroVEError] = [
    InternalError(),
    Malformed("event packet", "cut short"),
    UnsupportedVersion("event packet", 2, 1),
    InvalidField("event packet", "seq", -1, "Input should be greater than or equal to 0"),
    UnknownFormat("evt3", ("soa6", "soa8")),
    NoTable("4096x4096", 64 << 20, 480 << 20, 512 << 20),
    BlobLength(23, 4, 6),
    EventOutsideSensor(3, 346, 0, Sensor(346, 260)),
    TimeBackwards(3, 20, 10),
    UnknownModel("spire-9", ("spire-7",)),
    BadModel("spire-8", "the header names no network"),
    Untrusted("spire-8", "unknown_key", "signed by a key that is not trusted"),
    Untrained("spire-8"),
    Downgrade("spire-8", 3, 4),
    NoStore("neither models_dir nor state_dir is configured"),
    TooLarge("spire-9.safetensors", 300_000_000, 268_435_456),
    NoQuota("spire-9.safetensors", 3_000_000, 2_000_000, 4_000_000),
    NoSpace("spire-9.safetensors", 3_000_000, 1_000),
    TransferInterrupted("spire-9.safetensors", 1_000, 3_000_000, "whoever pushed it does not answer"),
    Busy(4),
    Conflict("another model change is under way"),
    NoMemory("spire-8", 1_000, 2_000),
    TooSlow("spire-8", 61.23456, 50.0),
    Diverged("spire-8", "divergence", 2.34567, 1.0),
    Diverged("spire-8", "fault", "not finite", "none"),
    NothingBefore(),
    RolledBack("spire-8 was rolled back automatically: stream cam0: divergence 4, the bound is 3"),
]
every_error = pytest.mark.parametrize("error", ERRORS, ids=lambda error: error.code)


MIDDLE = {InputError, ModelError, TransferError, RequestError}


def subclasses(kind: type[NeuroVEError]) -> set[type[NeuroVEError]]:
    """All errors of this package below this one; other packages may add their own."""
    below = {kind, *(found for child in kind.__subclasses__() for found in subclasses(child))}
    return {found for found in below if found.__module__.startswith("neurove_protocol.")}


def test_the_table_of_this_test_is_complete() -> None:
    assert {type(error) for error in ERRORS} == subclasses(NeuroVEError) - {NeuroVEError, PeerError, *MIDDLE}


def test_every_error_has_a_code_of_its_own() -> None:
    codes = [vars(kind)["code"] for kind in {type(error) for error in ERRORS}]
    assert len(set(codes)) == len(codes)
    assert all(code.replace("_", "").isalpha() and code.islower() for code in codes)


@every_error
def test_every_error_has_a_place_in_the_tree_and_an_exit_code(error: NeuroVEError) -> None:
    assert isinstance(error, (*MIDDLE, InternalError))
    assert error.exit_code == (3 if error.code == "conflict" else 2)
    assert PeerError(ErrorReply.of(error)).exit_code == (3 if error.code == "conflict" else 1)


def test_an_error_without_a_code_of_its_own_is_an_internal_one() -> None:
    assert NeuroVEError("x").code == InternalError.code == "internal"


@every_error
def test_code_sentence_and_details_survive_the_wire(error: NeuroVEError) -> None:
    reply = ErrorReply.decode(ErrorReply.of(error).encode())
    assert (reply.code, reply.message, reply.details) == (error.code, error.message, error.details)
    told = PeerError(reply)
    assert (told.code, told.message, told.details) == (error.code, error.message, error.details)
    assert str(told) == str(error) == error.message
    assert ErrorReply.of(told) == reply


@every_error
def test_the_sentence_contains_every_detail(error: NeuroVEError) -> None:
    for name, value in error.details.items():
        assert str(value) in error.message, name


hostile = st.sampled_from(["", "x", "\U0001f916", "\x00", "\udcff", "'", "\\"]).flatmap(
    lambda text: st.integers(0, 6_000).map(lambda times: text * times)
)


@bounded
@given(hostile, st.integers(0, 6_000))
def test_an_error_about_text_of_any_length_still_reaches_the_peer(text: str, times: int) -> None:
    for error in (
        Malformed(text, text),
        UnsupportedVersion("x", text, 1),
        InvalidField("x", text, text, text),
        InvalidField("x", "y", text.encode("utf-8", "backslashreplace"), "z"),
        UnknownFormat(text, ("soa6",)),
        UnknownModel(text, (text,) * (times % 9)),
        BadModel(text, text),
        Untrusted(text, text, text),
        Downgrade(text, times, times),
    ):
        reply = ErrorReply.decode(ErrorReply.of(error).encode())
        for told in (reply.message, *reply.details.values()):
            assert len(str(told).encode()) <= MAX_TEXT_BYTES < MAX_STRING_BYTES


def test_a_long_sentence_ends_in_an_ellipsis_and_a_short_one_does_not() -> None:
    assert BadModel("m", "x" * 5_000).message.endswith("xxx...")
    assert BadModel("m", "short").message == "model m: short"


def test_details_of_a_peer_may_have_any_name() -> None:
    details: dict[str, Detail] = {"message": "a", "self": 1, "reply": None, "not an identifier": True, "": 0.5}
    reply = ErrorReply.decode(ErrorReply(code="new_code", message="why", details=details).encode())
    told = PeerError(reply)
    assert (told.code, told.details) == ("new_code", details)


@pytest.mark.parametrize(
    "value",
    ["x" * 5_000, b"\x00" * 5_000, [["x" * 99] * 99] * 99, {"a" * 99: {"b": {"c": {}}}}, 10**60, list(range(5_000))],
    ids=lambda value: type(value).__name__,
)
def test_a_value_of_any_size_is_shown_in_80_characters(value: object) -> None:
    assert 10 < len(shown(value)) <= 80


@pytest.mark.parametrize("value", [1, -1.5, None, True, "cam0", b"cam0", [1, 2], {"a": 1}, (), float("nan")])
def test_a_short_value_is_shown_as_it_is(value: object) -> None:
    assert shown(value) == repr(value)
