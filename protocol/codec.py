"""Bytes <-> checked messages: msgpack maps with a version field, validated by pydantic, refused with our own errors."""

from typing import Annotated, Any, ClassVar, Final, Literal, Self, TypeVar, cast

import msgpack
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import PydanticCustomError

from neurove_protocol.errors import InvalidField, Malformed, UnsupportedVersion
from neurove_protocol.fields import WrongField
from neurove_protocol.keys import NAME_RULE, is_name

PROTOCOL_VERSION: Final = 1
"""Major version on the wire. Fields may be added within a version; readers of data messages ignore unknown ones."""

MAX_STRING_BYTES = 4096
MAX_ITEMS = 4096
MAX_MAPS = 8192
"""Cap of the maps in one message, nested ones too."""

MAX_MESSAGE_BYTES = 1 << 20
"""Cap of a message that has no cap of its own; the one of an event packet is in events.PacketLimits."""


def _name(value: str) -> str:
    if not is_name(value):
        raise PydanticCustomError("name", NAME_RULE)
    return value


Name = Annotated[str, AfterValidator(_name)]
"""Name of a stream or a node: valid as one chunk of a key."""

Int64 = Annotated[int, Field(ge=-(1 << 63), lt=1 << 63)]
Count = Annotated[int, Field(ge=0, lt=1 << 63)]
"""Integers fit into a signed 64-bit integer, which every language has."""


class Part(BaseModel):
    """A part of a message: immutable, strictly typed, finite numbers only."""

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", allow_inf_nan=False)


class Message(Part):
    """A message on the wire: a part with a protocol version."""

    what: ClassVar[str] = "message"
    max_bytes: ClassVar[int] = MAX_MESSAGE_BYTES
    v: Literal[1] = PROTOCOL_VERSION

    def encode(self) -> bytes:
        """This message as a msgpack map."""
        return cast(bytes, msgpack.packb(self.model_dump()))

    @classmethod
    def decode(cls, data: bytes) -> Self:
        """Read and check a message.

        Raises:
            Malformed, UnsupportedVersion, InvalidField: for the first error; never any other exception.
        """
        return validate(cls, unpack(data, cls.what, cls.max_bytes))


MessageT = TypeVar("MessageT", bound=Message)


def validate(kind: type[MessageT], fields: dict[str, Any]) -> MessageT:
    """The message of this kind with these fields; InvalidField names the first field that is wrong."""
    try:
        return kind.model_validate(fields)
    except ValidationError as error:
        wrong = WrongField.of(error)
        raise InvalidField(kind.what, wrong.name or "?", wrong.value, wrong.why) from None


def unpack(data: bytes, what: str, max_bytes: int = MAX_MESSAGE_BYTES) -> dict[str, Any]:
    """The msgpack map in `data`: no duplicate key, bounded in size, of our protocol version.

    Raises:
        Malformed: not one whole msgpack map. InvalidField: too large. UnsupportedVersion: another major version.
    """
    if len(data) > max_bytes:
        raise InvalidField(what, "size", len(data), f"a message has at most {max_bytes} bytes")
    try:
        fields = msgpack.unpackb(
            data,
            object_pairs_hook=_Maps(),
            max_str_len=MAX_STRING_BYTES,
            max_bin_len=max_bytes,
            max_array_len=MAX_ITEMS,
            max_map_len=MAX_ITEMS,
            max_ext_len=0,
        )
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
        raise Malformed(what, str(error) or type(error).__name__) from None
    if not isinstance(fields, dict):
        raise Malformed(what, f"a map is expected, not {type(fields).__name__}")
    version = fields.get("v")
    if type(version) is not int or version != PROTOCOL_VERSION:
        raise UnsupportedVersion(what, version, PROTOCOL_VERSION)
    return fields


class _Maps:
    """Builds the maps of one message: their keys are strings, no key occurs twice, and their number is bounded."""

    def __init__(self) -> None:
        self._left = MAX_MAPS

    def __call__(self, pairs: list[tuple[Any, Any]]) -> dict[str, Any]:
        self._left -= 1
        if self._left < 0:
            raise ValueError(f"more than {MAX_MAPS} maps")
        fields = dict(pairs)
        for key in fields:
            if not isinstance(key, str):
                raise ValueError("a key of a map is not a string")
        if len(fields) != len(pairs):
            raise ValueError("duplicate key in a map")
        return fields
