"""Events of a recording's pieces, joined into chunks and checked as they pass."""

from collections.abc import Iterator
from pathlib import Path

from neurove_core.io.errors import BrokenRecording
from neurove_core.io.recording import CHUNK_EVENTS, in_chunks, whole
from neurove_protocol.errors import EventOutsideSensor, TimeBackwards
from neurove_protocol.events import Events, Sensor, check_events

_ENOUGH = CHUNK_EVENTS // 4


def checked(path: Path, pieces: Iterator[tuple[str, Events]], sensor: Sensor) -> Iterator[Events]:
    """The events of all pieces, in chunks that are neither empty nor tiny.

    Args:
        path: the recording, to be named.
        pieces: where each lies in it, and its events.
        sensor: the pixel array.

    Raises:
        BrokenRecording: a piece has an event that is outside the sensor or earlier than the one before it, or `pieces`
            raises it; everything before was handed out.
    """
    not_before_us: int | None = None
    for batch, broken in _batches(pieces):
        events = Events.join([piece for _, piece in batch])
        try:
            check_events(events, sensor, not_before_us)
        except (EventOutsideSensor, TimeBackwards):
            yield from in_chunks(whole(events, sensor, not_before_us))
            raise _fault(path, batch, sensor, not_before_us) from None
        yield from in_chunks(events)
        if broken is not None:
            raise broken
        not_before_us = int(events.t[-1]) if events.n else not_before_us


def _batches(
    pieces: Iterator[tuple[str, Events]],
) -> Iterator[tuple[list[tuple[str, Events]], BrokenRecording | None]]:
    """Pieces, some _ENOUGH events at a time, and with the last of them what ended them early."""
    batch: list[tuple[str, Events]] = []
    n = 0
    try:
        for piece in pieces:
            batch.append(piece)
            n += piece[1].n
            if n >= _ENOUGH:
                yield batch, None
                batch, n = [], 0
    except BrokenRecording as error:
        yield batch, error
        return
    yield batch, None


def _fault(path: Path, batch: list[tuple[str, Events]], sensor: Sensor, not_before_us: int | None) -> BrokenRecording:
    """Which of these pieces is bad, and why: one of them is."""
    for where, events in batch:
        try:
            check_events(events, sensor, not_before_us)
        except (EventOutsideSensor, TimeBackwards) as error:
            return BrokenRecording(path, where, f"in this piece, {error.message}")
        not_before_us = int(events.t[-1]) if events.n else not_before_us
    raise AssertionError("no piece is bad alone, so the whole can not be")
