"""NeuroVEError and the errors that a node reports to a peer.

Every error has a stable `code` (part of the wire contract), a sentence that names the field, the value and the bound,
the same parts as `details` for machines, and the exit code of a command that fails with it.

    NeuroVEError                     exit code 2: wrong usage
    +- InternalError
    +- InputError                    a message, a field or an event is refused
    |  +- Malformed, UnsupportedVersion, InvalidField, UnknownFormat, BlobLength, EventOutsideSensor, TimeBackwards
    |  +- NoTable
    +- ModelError                    a model is refused, or a model change failed
    |  +- UnknownModel, BadModel, Untrusted, Untrained, Downgrade
    |  +- NoMemory, TooSlow, Diverged, RolledBack, NothingBefore
    +- TransferError                 a pushed bundle is not stored
    |  +- NoStore, TooLarge, NoQuota, NoSpace, TransferInterrupted
    +- RequestError                  the node does not handle the request now
    |  +- Busy, Conflict (exit code 3)
    +- PeerError (control.py)        exit code 1, or 3 for a conflict: a node refused our request

`neurove_core` adds RecordingError (io.errors) and MissingExtra; `neurove_service` adds what a client or a node
reports about its configuration and its connections.
"""

import reprlib
from typing import ClassVar, Final

Detail = str | int | float | bool | None

EXIT_FAILURE: Final = 1
"""Exit code of a command whose answer is bad news: no service, a broken recording, a refused request."""

EXIT_WRONG_USAGE: Final = 2
"""Exit code of a command that was called wrongly: an unknown source, setting, file or field."""

EXIT_CONFLICT: Final = 3
"""Exit code of a command that another client's model change preceded."""

EXIT_PARTIAL: Final = 4
"""Exit code of a command for several nodes of which some, but not all, refused."""

MAX_TEXT_BYTES = 1024
"""Cap of an error's sentence and of each of its details, so that an error reply fits the caps of a message."""


class _Short(reprlib.Repr):
    """A repr with bounded length, depth and cost, for values that a peer sent."""

    repr_bytes = reprlib.Repr.repr_str

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 2
        self.maxstring = self.maxother = 80


_SHORT = _Short()


def shown(value: object) -> str:
    """The value as text for a sentence: its repr, at most 80 characters for any value.

    >>> shown([[[1]]])
    '[[...]]'
    """
    text = _SHORT.repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def _clipped(text: str) -> str:
    data = text.encode("utf-8", "backslashreplace")  # a file name may hold characters that UTF-8 cannot encode
    return (data if len(data) <= MAX_TEXT_BYTES else data[: MAX_TEXT_BYTES - 3] + b"...").decode("utf-8", "ignore")


class NeuroVEError(Exception):
    """Base of all errors that a user or a peer may see: a stable code, a sentence, and its parts as fields."""

    code: ClassVar[str] = "internal"
    exit_code: ClassVar[int] = EXIT_WRONG_USAGE

    def __init__(self, message: str, /, **details: Detail) -> None:
        self.message = _clipped(message)
        self.details: dict[str, Detail] = {
            name: _clipped(value) if isinstance(value, str) else value for name, value in details.items()
        }
        super().__init__(self.message)


class InputError(NeuroVEError):
    """A message, one of its fields, or an event is refused."""


class ModelError(NeuroVEError):
    """A model is refused, or a model change failed."""


class TransferError(NeuroVEError):
    """A pushed bundle is not stored."""


class RequestError(NeuroVEError):
    """The node does not handle the request now."""


class InternalError(NeuroVEError):
    """A bug on the answering side; its log has the traceback."""

    code = "internal"

    def __init__(self) -> None:
        super().__init__("internal error: see the log of the node that answered")


class Malformed(InputError):
    """The bytes are not a message: not msgpack, truncated, with trailing bytes, or with a duplicate key."""

    code = "malformed"

    def __init__(self, what: str, why: str) -> None:
        super().__init__(f"{what}: not a valid message: {why}", what=what)


class UnsupportedVersion(InputError):
    """The message has another major version of the protocol."""

    code = "unsupported_version"

    def __init__(self, what: str, got: object, want: int) -> None:
        value = got if isinstance(got, int) else shown(got)
        super().__init__(f"{what}: protocol version v={value}, this side supports v={want}", field="v", value=value)


class InvalidField(InputError):
    """One field is missing, of the wrong type, or out of its bound."""

    code = "invalid_field"

    def __init__(self, what: str, field: str, value: object, bound: str) -> None:
        field = field if len(field) <= 80 else field[:77] + "..."  # a peer may send a field name of any length
        super().__init__(f"{what}: {field}={shown(value)}: {bound}", field=field, value=shown(value), bound=bound)


class NoTable(InputError):
    """The look-up tables of a service take their maximum memory; this sensor needs another one."""

    code = "no_table"

    def __init__(self, sensor: str, need_bytes: int, used_bytes: int, max_bytes: int) -> None:
        need, used, most = (round(size / (1 << 20), 1) for size in (need_bytes, used_bytes, max_bytes))
        super().__init__(
            f"sensor={sensor}: its look-up table takes {need} MiB, the tables in use take {used} MiB, "
            f"and tables_mib={most} is their maximum",
            field="sensor",
            value=sensor,
            need_mib=need,
            used_mib=used,
            bound=most,
        )


class UnknownFormat(InputError):
    """This side does not know the layout of the event blob."""

    code = "unknown_format"

    def __init__(self, got: str, known: tuple[str, ...]) -> None:
        super().__init__(
            f"event packet: format={shown(got)}: known formats are {', '.join(known)}", field="format", value=got
        )


class BlobLength(InputError):
    """A blob is not n times the size of one record."""

    code = "blob_length"

    def __init__(
        self,
        got: int,
        n: int,
        record_bytes: int,
        *,
        what: str = "event packet",
        field: str = "data",
        items: str = "events",
    ) -> None:
        super().__init__(
            f"{what}: {field} is {got} bytes, n={n} {items} of {record_bytes} bytes need {n * record_bytes}",
            field=field,
            value=got,
            bound=n * record_bytes,
        )


class EventOutsideSensor(InputError):
    """An event lies outside the sensor that its packet names."""

    code = "event_outside_sensor"

    def __init__(self, index: int, x: int, y: int, sensor: object) -> None:
        super().__init__(f"event {index} at x={x} y={y} lies outside the sensor {sensor}", index=index, x=x, y=y)


class TimeBackwards(InputError):
    """Times of a packet run backwards."""

    code = "time_backwards"

    def __init__(self, index: int, before_us: int, t_us: int, item: str = "event") -> None:
        super().__init__(
            f"{item} {index} at t={t_us} us comes after t={before_us} us: time runs backwards",
            index=index,
            value=t_us,
            bound=before_us,
        )


class UnknownModel(ModelError):
    """The node has no model of this name."""

    code = "unknown_model"

    def __init__(self, name: str, available: tuple[str, ...]) -> None:
        super().__init__(f"model={name!r}: not on this node; available: {', '.join(available) or 'none'}", value=name)


class BadModel(ModelError):
    """A model file is unreadable, has another format, or does not match its header."""

    code = "bad_model"

    def __init__(self, name: str, why: str) -> None:
        super().__init__(f"model {name}: {why}", value=name)
        self.why = _clipped(why)


class Untrusted(ModelError):
    """No trusted key signed exactly the bytes of this model."""

    code = "untrusted"

    def __init__(self, name: str, reason: str, why: str) -> None:
        super().__init__(f"model {name}: signature refused ({reason}): {why}", value=name, reason=reason)
        self.why = why


class Untrained(ModelError):
    """A model is untrained, and the node trusts keys: it takes only trained models."""

    code = "untrained"

    def __init__(self, name: str) -> None:
        why = "it is untrained; a node with trusted_keys takes only trained models"
        super().__init__(f"model {name}: {why}", value=name)


class NoStore(TransferError):
    """The node stores no pushed models: no folder is configured, or the folder is not writable."""

    code = "no_store"

    def __init__(self, why: str) -> None:
        super().__init__(f"this node stores no pushed models: {why}", why=why)


class TooLarge(TransferError):
    """A bundle is larger than the node accepts."""

    code = "too_large"

    def __init__(self, name: str, size: int, cap: int) -> None:
        super().__init__(f"model {name}: size={size}: a bundle has at most {cap} bytes", value=size, bound=cap)


class NoQuota(TransferError):
    """With this bundle the node's pushed models would exceed their quota."""

    code = "no_quota"

    def __init__(self, name: str, size: int, used: int, quota: int) -> None:
        super().__init__(
            f"model {name}: size={size}: {used} of {quota} bytes for pushed models are in use",
            value=size,
            used=used,
            bound=quota,
        )


class NoSpace(TransferError):
    """The node's disk is full."""

    code = "no_space"

    def __init__(self, name: str, need: int, free: int) -> None:
        super().__init__(f"model {name}: needs {need} bytes, the node's disk has {free}", value=need, bound=free)


class TransferInterrupted(TransferError):
    """The client that pushed a bundle stopped answering; the node keeps what arrived, and the next push resumes."""

    code = "cut"

    def __init__(self, name: str, have: int, size: int, why: str) -> None:
        super().__init__(
            f"model {name}: interrupted at {have} of {size} bytes: {why}; the next push resumes there",
            value=have,
            bound=size,
        )


class Busy(RequestError):
    """The node handles its maximum number of requests of this kind."""

    code = "busy"

    def __init__(self, at_once: int) -> None:
        super().__init__(f"busy: this node handles at most {at_once} such requests at once", bound=at_once)


class Conflict(RequestError):
    """Another client changes the model, or changed it first."""

    code = "conflict"
    exit_code = EXIT_CONFLICT

    def __init__(self, why: str) -> None:
        super().__init__(f"conflict: {why}", why=why)


class NoMemory(ModelError):
    """A model is refused because it might not fit into memory together with the active one."""

    code = "no_memory"

    def __init__(self, model: str, free_bytes: int, need_bytes: int) -> None:
        super().__init__(
            f"model {model}: free_bytes={free_bytes}: a model change needs {need_bytes} bytes of memory",
            field="free_bytes",
            value=free_bytes,
            bound=need_bytes,
        )


class TooSlow(ModelError):
    """A model is refused because this node cannot run it in time."""

    code = "too_slow"

    def __init__(self, model: str, p99_ms: float, bound_ms: float) -> None:
        p99_ms, bound_ms = round(p99_ms, 3), round(bound_ms, 3)
        super().__init__(
            f"model {model}: p99_ms={p99_ms}: a window may take at most {bound_ms} ms here",
            field="p99_ms",
            value=p99_ms,
            bound=bound_ms,
        )


class Diverged(ModelError):
    """A model is refused because its estimates in shadow differ too much from those of the active model."""

    code = "diverged"

    def __init__(self, model: str, field: str, value: float | str, bound: float | str) -> None:
        value, bound = (round(one, 3) if isinstance(one, float) else one for one in (value, bound))
        super().__init__(f"model {model}: {field}={value}: the bound is {bound}", field=field, value=value, bound=bound)


class RolledBack(ModelError):
    """The node rolled a model back during its probation; the previous model serves again."""

    code = "rolled_back"

    def __init__(self, why: str) -> None:
        super().__init__(f"model change: {why}", why=why)


class NothingBefore(ModelError):
    """There is no previous model."""

    code = "nothing_before"

    def __init__(self) -> None:
        super().__init__("cannot roll back: this node has no previous model")


class Downgrade(ModelError):
    """A model's release is lower than an accepted one, and its signature does not allow a downgrade."""

    code = "downgrade"

    def __init__(self, name: str, release: int, highest: int) -> None:
        why = f"release={release}: release {highest} was accepted before, and the signature does not allow a downgrade"
        super().__init__(f"model {name}: {why}", value=release, bound=highest)
