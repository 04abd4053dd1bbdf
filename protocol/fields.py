"""What pydantic found wrong with some fields, for the sentences that refuse them."""

from typing import NamedTuple, Self

from pydantic import ValidationError

from neurove_protocol.errors import shown

_MOST = 80  # characters of a field's name: an unknown one is the sender's, of any length


class WrongField(NamedTuple):
    """The first field that was refused."""

    path: tuple[str | int, ...]  # from the outermost inwards; empty: no single field, but how they go together
    value: object  # what came; "missing" where nothing did
    why: str  # what was expected
    kind: str  # pydantic's name of the error, such as extra_forbidden

    @classmethod
    def of(cls, error: ValidationError) -> Self:
        """The first of an error's."""
        first = error.errors(include_url=False)[0]
        value = "missing" if first["type"] == "missing" else first["input"]
        return cls(first["loc"], value, first["msg"].removeprefix("Value error, "), first["type"])

    @property
    def name(self) -> str:
        """Its path with dots, clipped."""
        return ".".join(str(part) for part in self.path)[:_MOST]

    @property
    def sentence(self) -> str:
        """Name, value and bound, as far as there is a name."""
        value = self.value if self.kind == "missing" else shown(self.value)
        return f"{self.name}={value}: {self.why}" if self.path else self.why
