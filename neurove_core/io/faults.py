"""Faults of a recording, counted by reason: what a reader skipped, discarded or could not read, and went on."""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any


class Reason(StrEnum):
    """Why something of a recording is not used as it was recorded."""

    OUTSIDE = "outside_sensor"  # an event lies outside the sensor: skipped
    LATE = "late"  # earlier than what came before it: discarded
    STALE_START = "stale_start"  # old items before the clock of the recording: discarded
    NEW_CLOCK = "new_clock"  # the clock began again: its times continue 1 s after the last one
    TIME_JUMP = "time_jump"  # a short excursion of the clock into the future: discarded
    GAP = "gap"  # a long span without data
    RESERVED = "reserved_word"  # a word of an unknown type: skipped
    INVALID = "invalid"  # a value that the format does not allow: skipped
    DAMAGED = "damaged"  # a line, message, packet or chunk that cannot be read: skipped
    LOST = "lost"  # of a live source: lost in its transmission
    UNREAD = "unread"  # the recording cannot be read beyond this place


_MAX_TEXT = 300  # characters

_TEXTS = {
    Reason.OUTSIDE: "outside the sensor, skipped",
    Reason.LATE: "late, discarded",
    Reason.STALE_START: "from before the clock of the recording, discarded",
    Reason.NEW_CLOCK: "restart of the clock; the times continue after 1 s",
    Reason.TIME_JUMP: "with a time far ahead of what follows, discarded",
    Reason.GAP: "long gap in time",
    Reason.RESERVED: "of an unknown word type, skipped",
    Reason.INVALID: "invalid, skipped",
    Reason.DAMAGED: "damaged, skipped",
    Reason.LOST: "lost in transmission",
    Reason.UNREAD: "place beyond which nothing can be read",
}


@dataclass(frozen=True, slots=True)
class Fault:
    """All faults of one reason in one stream of a recording."""

    stream: str  # kind of data, such as `events`
    reason: Reason
    count: int
    where: str  # place of the first one in the recording
    why: str  # what is wrong with the first one

    def __str__(self) -> str:
        """One line for people."""
        return f"{self.stream}: {self.count:,} {_TEXTS[self.reason]}; the first at {self.where}: {self.why}"

    def as_json(self) -> dict[str, Any]:
        """The fault as a dict for `json.dumps`."""
        names = ("stream", "reason", "count", "where", "why")
        return {name: getattr(self, name) for name in names}


def _line(text: str) -> str:
    r"""A short text in one line without control characters: it may hold parts of a damaged file.

    >>> _line("a\n\x1b[31m")
    'a\\n\\x1b[31m'
    """
    text = text[:_MAX_TEXT] + ("..." if len(text) > _MAX_TEXT else "")
    return "".join(one if one.isprintable() else repr(one)[1:-1] for one in text)


class Tally:
    """The faults that one pass over one stream finds.

    >>> tally = Tally("events")
    >>> tally.add(Reason.LATE, "byte 8", "t=1 us comes after t=5 us", 3)
    >>> print(*tally.faults)
    events: 3 late, discarded; the first at byte 8: t=1 us comes after t=5 us
    """

    __slots__ = ("_found", "stream")

    def __init__(self, stream: str) -> None:
        self.stream = stream
        self._found: dict[Reason, Fault] = {}

    def add(self, reason: Reason, where: str, why: str, count: int = 1) -> None:
        """Count faults of one reason.

        Args:
            reason: the reason.
            where: place of the first of them in the recording.
            why: what is wrong with it, with its value and the bound.
            count: how many.
        """
        if count:
            found = self._found.get(reason)
            more = Fault(self.stream, reason, count, _line(where), _line(why))
            self._found[reason] = more if found is None else replace(found, count=found.count + count)

    @property
    def faults(self) -> tuple[Fault, ...]:
        """The faults so far, one for each reason, in the order in which the reasons first occurred."""
        return tuple(self._found.values())


class Faults:
    """The faults of a recording: for each stream those of its newest pass. A pass that has not ended counts too."""

    __slots__ = ("_tallies",)

    def __init__(self) -> None:
        self._tallies: dict[str, Tally] = {}

    def begin(self, stream: str) -> Tally:
        """The tally of a new pass over a stream; it takes the place of the pass before."""
        tally = self._tallies[stream] = Tally(stream)
        return tally

    def of(self, stream: str) -> Tally:
        """The tally of the newest pass over a stream."""
        return self._tallies.get(stream) or self.begin(stream)

    @property
    def found(self) -> tuple[Fault, ...]:
        """All faults so far."""
        return tuple(fault for tally in self._tallies.values() for fault in tally.faults)

    @property
    def unread(self) -> tuple[Fault, ...]:
        """Those beyond which nothing could be read."""
        return tuple(fault for fault in self.found if fault.reason is Reason.UNREAD)
