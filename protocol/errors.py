"""NeuroVEError and the errors that a peer can be told.

Every error has a stable `code` (part of the wire contract), a sentence that names field, value and bound, and the same
three as `details` for machines.
"""

import reprlib
from typing import ClassVar

Detail = str | int | float | bool | None

MAX_TEXT_BYTES = 1024
"""Cap of an error's sentence and of each of its details: what a peer is told must fit the caps of a message."""


class _Short(reprlib.Repr):
    """A repr whose length, depth and cost are bounded, for values that a peer sent."""

    repr_bytes = reprlib.Repr.repr_str

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 2
        self.maxstring = self.maxother = 80


_SHORT = _Short()


def shown(value: object) -> str:
    """The value as a sentence shows it: its repr, at most 80 characters however long or deep the value is.

    >>> shown([[[1]]])
    '[[...]]'
    """
    text = _SHORT.repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def _clipped(text: str) -> str:
    data = text.encode("utf-8", "backslashreplace")  # a file name may hold what UTF-8 does not
    return (data if len(data) <= MAX_TEXT_BYTES else data[: MAX_TEXT_BYTES - 3] + b"...").decode("utf-8", "ignore")


class NeuroVEError(Exception):
    """Base of all errors that a user or a peer may see: a stable code, a sentence, and its parts as fields."""

    code: ClassVar[str] = "internal"

    def __init__(self, message: str, /, **details: Detail) -> None:
        self.message = _clipped(message)
        self.details: dict[str, Detail] = {
            name: _clipped(value) if isinstance(value, str) else value for name, value in details.items()
        }
        super().__init__(self.message)


class InternalError(NeuroVEError):
    """A bug on the answering side; its log has the trace back."""

    code = "internal"

    def __init__(self) -> None:
        super().__init__("internal error: see the log of the node that answered")


class Malformed(NeuroVEError):
    """The bytes are no message at all: not msgpack, cut short, trailing bytes, or a key twice."""

    code = "malformed"

    def __init__(self, what: str, why: str) -> None:
        super().__init__(f"{what}: not a valid message: {why}", what=what)


class UnsupportedVersion(NeuroVEError):
    """The message speaks another major version of the protocol."""

    code = "unsupported_version"

    def __init__(self, what: str, got: object, want: int) -> None:
        value = got if isinstance(got, int) else shown(got)
        super().__init__(f"{what}: protocol version v={value}, this side speaks v={want}", field="v", value=value)


class InvalidField(NeuroVEError):
    """One field is missing, of the wrong type, or out of its bound."""

    code = "invalid_field"

    def __init__(self, what: str, field: str, value: object, bound: str) -> None:
        field = field if len(field) <= 80 else field[:77] + "..."  # a misspelt one is the peer's, of any length
        super().__init__(f"{what}: {field}={shown(value)}: {bound}", field=field, value=shown(value), bound=bound)


class UnknownFormat(NeuroVEError):
    """The event blob is in a layout that this side cannot read."""

    code = "unknown_format"

    def __init__(self, got: str, known: tuple[str, ...]) -> None:
        super().__init__(
            f"event packet: format={shown(got)}: known formats are {', '.join(known)}", field="format", value=got
        )


class BlobLength(NeuroVEError):
    """The event blob is not n times the record size of its format."""

    code = "blob_length"

    def __init__(self, got: int, n: int, record_bytes: int) -> None:
        super().__init__(
            f"event packet: data is {got} bytes, n={n} events of {record_bytes} bytes need {n * record_bytes}",
            field="data",
            value=got,
            bound=n * record_bytes,
        )


class EventOutsideSensor(NeuroVEError):
    """An event lies outside the sensor that its packet names."""

    code = "event_outside_sensor"

    def __init__(self, index: int, x: int, y: int, sensor: object) -> None:
        super().__init__(f"event {index} at x={x} y={y} lies outside the sensor {sensor}", index=index, x=x, y=y)


class TimeBackwards(NeuroVEError):
    """Times of a packet run backwards."""

    code = "time_backwards"

    def __init__(self, index: int, before_us: int, t_us: int) -> None:
        super().__init__(
            f"event {index} at t={t_us} us comes after t={before_us} us: time runs backwards",
            index=index,
            value=t_us,
            bound=before_us,
        )


class UnknownModel(NeuroVEError):
    """No model of this name is available on the node."""

    code = "unknown_model"

    def __init__(self, name: str, available: tuple[str, ...]) -> None:
        super().__init__(f"model={name!r}: not on this node; available: {', '.join(available) or 'none'}", value=name)


class BadModel(NeuroVEError):
    """A model file is unreadable, foreign, or does not hold what its header declares."""

    code = "bad_model"

    def __init__(self, name: str, why: str) -> None:
        super().__init__(f"model {name}: {why}", value=name)


class Untrusted(NeuroVEError):
    """A model's signature does not show that someone trusted made exactly these bytes."""

    code = "untrusted"

    def __init__(self, name: str, reason: str, why: str) -> None:
        super().__init__(f"model {name}: signature refused ({reason}): {why}", value=name, reason=reason)


class NoStore(NeuroVEError):
    """The node keeps no pushed models: it was given no folder for them, or one that it can not write to."""

    code = "no_store"

    def __init__(self, why: str) -> None:
        super().__init__(f"this node keeps no pushed models: {why}", why=why)


class TooLarge(NeuroVEError):
    """A bundle is larger than a node takes."""

    code = "too_large"

    def __init__(self, name: str, size: int, cap: int) -> None:
        super().__init__(f"model {name}: size={size}: a bundle has at most {cap} bytes", value=size, bound=cap)


class NoQuota(NeuroVEError):
    """With this bundle the node's pushed models would take more than they may."""

    code = "no_quota"

    def __init__(self, name: str, size: int, used: int, quota: int) -> None:
        super().__init__(
            f"model {name}: size={size}: {used} of {quota} bytes for pushed models are taken",
            value=size,
            used=used,
            bound=quota,
        )


class NoSpace(NeuroVEError):
    """The node's disk is full."""

    code = "no_space"

    def __init__(self, name: str, need: int, free: int) -> None:
        super().__init__(f"model {name}: needs {need} bytes, the node's disk has {free}", value=need, bound=free)


class Cut(NeuroVEError):
    """Whoever pushed a bundle stopped to answer; what came is kept, and the next push goes on from there."""

    code = "cut"

    def __init__(self, name: str, have: int, size: int, why: str) -> None:
        super().__init__(
            f"model {name}: cut at {have} of {size} bytes: {why}; the next push goes on from there",
            value=have,
            bound=size,
        )


class Busy(NeuroVEError):
    """The node works on as many requests of this kind as it takes."""

    code = "busy"

    def __init__(self, at_once: int) -> None:
        super().__init__(f"busy: this node works on at most {at_once} such requests at once", bound=at_once)


class Conflict(NeuroVEError):
    """Somebody else changed the model first, or is about to."""

    code = "conflict"

    def __init__(self, why: str) -> None:
        super().__init__(f"conflict: {why}", why=why)


class NoMemory(NeuroVEError):
    """A model is refused, for it might not fit beside the one that serves."""

    code = "no_memory"

    def __init__(self, model: str, free_bytes: int, need_bytes: int) -> None:
        super().__init__(
            f"model {model}: free_bytes={free_bytes}: a change of model needs {need_bytes} bytes of memory",
            field="free_bytes",
            value=free_bytes,
            bound=need_bytes,
        )


class TooSlow(NeuroVEError):
    """A model is refused, for this node can not run it in time."""

    code = "too_slow"

    def __init__(self, model: str, p99_ms: float, bound_ms: float) -> None:
        p99_ms, bound_ms = round(p99_ms, 3), round(bound_ms, 3)
        super().__init__(
            f"model {model}: p99_ms={p99_ms}: a window may take at most {bound_ms} ms here",
            field="p99_ms",
            value=p99_ms,
            bound=bound_ms,
        )


class Diverged(NeuroVEError):
    """A model is refused, for beside the active one on live streams it did not behave alike."""

    code = "diverged"

    def __init__(self, model: str, field: str, value: float | str, bound: float | str) -> None:
        value, bound = (round(one, 3) if isinstance(one, float) else one for one in (value, bound))
        super().__init__(f"model {model}: {field}={value}: the bound is {bound}", field=field, value=value, bound=bound)


class RolledBack(NeuroVEError):
    """A model served, and was taken back by itself on its probation; the one before serves on."""

    code = "rolled_back"

    def __init__(self, why: str) -> None:
        super().__init__(f"model change: {why}", why=why)


class NothingBefore(NeuroVEError):
    """There is no model to go back to."""

    code = "nothing_before"

    def __init__(self) -> None:
        super().__init__("nothing to roll back to: this node has no model before the active one")


class Downgrade(NeuroVEError):
    """A model's release is lower than one that was accepted before, and its signature does not allow that."""

    code = "downgrade"

    def __init__(self, name: str, release: int, highest: int) -> None:
        why = f"release={release}: release {highest} was here before, and its signature does not allow a downgrade"
        super().__init__(f"model {name}: {why}", value=release, bound=highest)
