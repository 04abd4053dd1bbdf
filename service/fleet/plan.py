"""The plan of a rollout: how many nodes have the bundle after each step."""

import math
import re
from collections.abc import Sequence
from typing import Final

from neurove_protocol.errors import InvalidField

MAX_STEPS: Final = 50
DEFAULT: Final = ("1", "10%", "100%")
"""One node, a tenth of them, all of them."""

_STEP = re.compile(r"([0-9]{1,7})(%?)")


def parse(text: str) -> tuple[str, ...]:
    """The steps of a plan, as counts or shares of the nodes: `1,10%,100%`.

    Raises:
        InvalidField: it is no plan.

    >>> parse("1,10%,100%")
    ('1', '10%', '100%')
    """
    steps = tuple(part.strip() for part in text.split(","))
    if len(steps) > MAX_STEPS:
        raise InvalidField("rollout", "--plan", text, f"it has {len(steps)} steps, at most {MAX_STEPS}")
    for step in steps:
        found = _STEP.fullmatch(step)
        if not found or not int(found[1]) or (found[2] and int(found[1]) > 100):
            bound = "give numbers of nodes above 0 or shares from 1% to 100%, such as 1,10%,100%"
            raise InvalidField("rollout", "--plan", text, bound)
    for kind in (True, False):
        same = [int(step.rstrip("%")) for step in steps if step.endswith("%") is kind]
        if same != sorted(set(same)):
            raise InvalidField("rollout", "--plan", text, "each step must be larger than the one before")
    return steps


def sizes(steps: Sequence[str], nodes: int) -> list[int]:
    """The number of nodes that have the bundle after each step.

    A share is rounded up. Each step adds at least one node, as long as there are any; one that adds none is left out.

    >>> sizes(("1", "10%", "100%"), 6), sizes(("1", "10%", "100%"), 200), sizes(("5",), 3)
    ([1, 2, 6], [1, 20, 200], [3])
    """
    found: list[int] = []
    for step in steps:
        wanted = math.ceil(int(step[:-1]) * nodes / 100) if step.endswith("%") else int(step)
        before = found[-1] if found else 0
        size = min(nodes, max(wanted, before + 1))
        if size > before:
            found.append(size)
    return found
