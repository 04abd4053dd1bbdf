"""Format: how a recording format declares itself, so that `neurove_core.sources` opens it."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from neurove_core.io.recording import Recording
from neurove_protocol.events import Sensor

Open = Callable[[Path, Sensor | None, str | None], Recording]
"""Opens a file or folder: path, sensor that overrides the recording's, and topic of one event stream."""

OpenUrl = Callable[[str, Sensor | None, str | None], Recording]


def every_file(path: Path) -> bool:
    """Accept a file of any content."""
    return path.is_file()


@dataclass(frozen=True, slots=True)
class Format:
    """A format of recordings in files or folders.

    A module of a format ends in `FORMAT = Format(...)`. Several formats may share a suffix; the first one that accepts
    the path opens it. Content has priority over the suffix: a format whose signature matches the first bytes of a file
    opens it, whatever the name of the file is.
    """

    about: str  # for people: what to give and what it is, such as "FILE.aedat4 (DV)"
    open: Open
    suffixes: tuple[str, ...] = ()  # lower case, with the dot; empty: `accepts` alone decides
    accepts: Callable[[Path], bool] = every_file  # looks at a path that has one of the suffixes or the signature
    signature: bytes = b""  # regular expression of the first bytes of a file; empty: the suffix alone decides

    def __post_init__(self) -> None:
        for suffix in self.suffixes:
            if not suffix.startswith(".") or suffix != suffix.lower():
                raise ValueError(f"suffix={suffix!r}: a format's suffix begins with a dot and is lower case")

    def fits(self, path: Path) -> bool:
        """Whether this format opens the path."""
        return (not self.suffixes or path.suffix.lower() in self.suffixes) and self.accepts(path)

    def recognises(self, head: bytes) -> bool:
        """Whether a file that begins with these bytes has this format."""
        return bool(self.signature) and re.match(self.signature, head, re.DOTALL) is not None


@dataclass(frozen=True, slots=True)
class UrlFormat:
    """A source named by a URL, such as `sim://street`."""

    about: str
    scheme: str
    open: OpenUrl
