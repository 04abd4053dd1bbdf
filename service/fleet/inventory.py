"""The inventory: a text file of the nodes that an operator expects, with their labels and when they answered last.

One node a line, then its labels as NAME=VALUE; `#` begins a comment::

    # hall 2
    rover-1 site=hall-2 seen=2026-11-29T20:06:29Z
    rover-2 site=hall-2
"""

import re
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, NamedTuple

from neurove_core.files import atomic_path
from neurove_protocol.errors import InvalidField
from neurove_protocol.keys import NAME_RULE, is_name
from neurove_service.labels import check_labels

MAX_NODES: Final = 100_000
"""Most nodes of an inventory."""

_SEEN = "%Y-%m-%dT%H:%M:%SZ"


class Expected(NamedTuple):
    """A node of the inventory."""

    labels: Mapping[str, str]
    seen: datetime | None = None  # when it answered last (UTC); None: never, as far as the file knows


def read(path: Path) -> dict[str, Expected]:
    """The nodes of an inventory, by name, in the order of the file.

    Raises:
        OSError: the file cannot be read. InvalidField: a line is wrong; it is named with its number.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise InvalidField("fleet", "--expect-nodes", str(path), "is not a text file in UTF-8") from None
    found: dict[str, Expected] = {}
    for number, line in enumerate(lines, 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            name, expected = _parse(words)
            if name in found:
                raise ValueError(f"node {name!r} occurs twice")
        except ValueError as error:
            raise InvalidField("fleet", "--expect-nodes", f"{path}, line {number}", str(error)) from None
        found[name] = expected
        if len(found) > MAX_NODES:
            raise InvalidField("fleet", "--expect-nodes", str(path), f"it has more than {MAX_NODES} nodes")
    return found


def _parse(words: list[str]) -> tuple[str, Expected]:
    name, *pairs = words
    if not is_name(name):
        raise ValueError(f"node {name[:80]!r} is not valid: {NAME_RULE}")
    labels: dict[str, str] = {}
    seen = None
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals:
            raise ValueError(f"{pair[:80]!r}: give NAME=VALUE")
        if key in labels:
            raise ValueError(f"label {key!r} occurs twice")
        if key == "seen":
            seen = datetime.strptime(value, _SEEN).replace(tzinfo=UTC)
        else:
            labels[key] = value
    return name, Expected(check_labels(labels), seen)


def update(path: Path, answered: Mapping[str, Mapping[str, str]], now: datetime) -> None:
    """Write the labels and the time of the nodes that answered; add new nodes; keep all else, comments included.

    Args:
        path: the inventory; it is created if it does not exist.
        answered: labels of the nodes that answered, by name.
        now: the time (UTC).

    Raises:
        OSError: it cannot be written.
    """
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    left = dict(answered)
    written = []
    for line in lines:
        content, hash_sign, comment = line.partition("#")
        name = (content.split() or [""])[0]
        if name in left:
            gap = re.search(r"\s*$", content)
            line = _line(name, left.pop(name), now) + (f"{gap[0] if gap else ' '}#{comment}" if hash_sign else "")
        written.append(line)
    written += [_line(name, left[name], now) for name in sorted(left)]
    with atomic_path(path) as part:
        part.write_text("".join(f"{line}\n" for line in written), encoding="utf-8")


def _line(name: str, labels: Mapping[str, str], now: datetime) -> str:
    return " ".join((name, *(f"{key}={value}" for key, value in labels.items()), f"seen={now.strftime(_SEEN)}"))
