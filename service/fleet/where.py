"""Conditions that select nodes: `--where model=default --where site=hall-*`."""

import fnmatch
from collections.abc import Iterable, Mapping
from typing import NamedTuple, Self

from neurove_protocol.control import HealthReply
from neurove_protocol.errors import InvalidField
from neurove_protocol.keys import is_name
from neurove_service.labels import RESERVED


def facts_of(reply: HealthReply) -> dict[str, str]:
    """What a node says about itself, by name: its labels, and the names of `RESERVED` apart from `seen`."""
    return dict(reply.labels) | {
        "node": reply.node,
        "verdict": "ok" if reply.ok else "not-ok",
        "version": reply.version,
        "model": reply.model.name,
        "digest": reply.model.digest,
        "release": str(reply.model.release),
    }


class Condition(NamedTuple):
    """One condition: the fact of this name matches the pattern, in which `*` and `?` stand for characters."""

    name: str
    pattern: str

    @classmethod
    def parse(cls, text: str) -> Self:
        """A condition from NAME=PATTERN.

        Raises:
            InvalidField: it has no such form.

        >>> Condition.parse("site=hall-*")
        Condition(name='site', pattern='hall-*')
        """
        name, equals, pattern = text.partition("=")
        if not (equals and pattern and is_name(name)) or name == "seen":
            known = ", ".join(one for one in RESERVED if one != "seen")
            raise InvalidField("fleet", "--where", text, f"give NAME=VALUE; NAME is a label or one of {known}")
        return cls(name, pattern)

    def holds(self, facts: Mapping[str, str]) -> bool:
        """Whether a node with these facts is selected; a digest also matches by its first 8 or more digits."""
        value = facts.get(self.name)
        if value is None:
            return False
        if self.name == "digest" and len(self.pattern) >= 8 and value.startswith(self.pattern):
            return True
        return fnmatch.fnmatchcase(value, self.pattern)


def selected(facts: Mapping[str, str], conditions: Iterable[Condition]) -> bool:
    """Whether a node with these facts meets every condition."""
    return all(one.holds(facts) for one in conditions)
