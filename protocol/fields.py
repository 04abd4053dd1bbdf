"""The first field that pydantic refused, as parts of an error sentence."""

from typing import NamedTuple, Self

from pydantic import ValidationError

from neurove_protocol.errors import shown

_MOST = 80  # characters of a field's name: a peer may send a name of any length


class WrongField(NamedTuple):
    """The first field that was refused."""

    path: tuple[str | int, ...]  # from the outermost field inwards; empty if the fields contradict each other
    value: object  # the value; "missing" if there is none
    why: str  # what is expected
    kind: str  # pydantic's name of the error, such as extra_forbidden

    @classmethod
    def of(cls, error: ValidationError) -> Self:
        """The first wrong field of a validation error."""
        first = error.errors(include_url=False)[0]
        value = "missing" if first["type"] == "missing" else first["input"]
        return cls(first["loc"], value, first["msg"].removeprefix("Value error, "), first["type"])

    @property
    def name(self) -> str:
        """Its path with dots, shortened."""
        return ".".join(str(part) for part in self.path)[:_MOST]

    @property
    def sentence(self) -> str:
        """Name, value and bound; only the bound if no single field is wrong."""
        value = self.value if self.kind == "missing" else shown(self.value)
        return f"{self.name}={value}: {self.why}" if self.path else self.why
