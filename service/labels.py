"""Labels of a node: names and values that its configuration gives it, by which an operator selects nodes."""

from typing import Final

from neurove_protocol.control import MAX_LABELS
from neurove_protocol.keys import NAME_RULE, is_name

RESERVED: Final = ("node", "verdict", "version", "model", "digest", "release", "seen")
"""What `neurove fleet` knows of every node; a label has another name."""


def check_labels(labels: dict[str, str]) -> dict[str, str]:
    """The labels, if they are valid.

    Raises:
        ValueError: names what is wrong, with its bound.

    >>> check_labels({"site": "hall-2"})
    {'site': 'hall-2'}
    """
    if len(labels) > MAX_LABELS:
        raise ValueError(f"{len(labels)} labels, at most {MAX_LABELS}")
    for name, value in labels.items():
        if name in RESERVED:
            raise ValueError(f"label {name!r}: this name is reserved; reserved names: {', '.join(RESERVED)}")
        for what, text in (("name", name), ("value", value)):
            if not is_name(text):
                raise ValueError(f"label {name!r}: its {what} {text[:80]!r} is not valid: {NAME_RULE}")
    return labels
