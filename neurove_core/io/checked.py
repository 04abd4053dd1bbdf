"""Join the pieces of a recording into chunks of events and check the events."""

from collections.abc import Iterator
from pathlib import Path

from neurove_core.io.errors import BrokenRecording
from neurove_core.io.recording import CHUNK_EVENTS, in_chunks, valid_prefix
from neurove_protocol.errors import EventOutsideSensor, TimeBackwards
from neurove_protocol.events import Events, Sensor, check_events

_MIN_EVENTS = CHUNK_EVENTS // 4


def checked(path: Path, pieces: Iterator[tuple[str, Events]], sensor: Sensor) -> Iterator[Events]:
    """Join the events of all pieces into chunks that are neither empty nor very small.

    Args:
        path: the recording, named in errors.
        pieces: for each piece its place in the recording and its events.
        sensor: the pixel array.

    Raises:
        BrokenRecording: a piece has an event that is outside the sensor or earlier than the event before it, or
            `pieces` raises the error. All events before were yielded.
    """
    not_before_us: int | None = None
    for batch, broken in _batches(pieces):
        events = Events.join([piece for _, piece in batch])
        try:
            check_events(events, sensor, not_before_us)
        except (EventOutsideSensor, TimeBackwards):
            yield from in_chunks(valid_prefix(events, sensor, not_before_us))
            raise _error_of(path, batch, sensor, not_before_us) from None
        yield from in_chunks(events)
        if broken is not None:
            raise broken
        not_before_us = int(events.t[-1]) if events.n else not_before_us


def _batches(
    pieces: Iterator[tuple[str, Events]],
) -> Iterator[tuple[list[tuple[str, Events]], BrokenRecording | None]]:
    """Batches of at least _MIN_EVENTS events, except the last, which has the error that ended the pieces, if any."""
    batch: list[tuple[str, Events]] = []
    n = 0
    try:
        for piece in pieces:
            batch.append(piece)
            n += piece[1].n
            if n >= _MIN_EVENTS:
                yield batch, None
                batch, n = [], 0
    except BrokenRecording as error:
        yield batch, error
        return
    yield batch, None


def _error_of(
    path: Path, batch: list[tuple[str, Events]], sensor: Sensor, not_before_us: int | None
) -> BrokenRecording:
    """The error for the first bad piece. One of the pieces must be bad."""
    for where, events in batch:
        try:
            check_events(events, sensor, not_before_us)
        except (EventOutsideSensor, TimeBackwards) as error:
            return BrokenRecording(path, where, f"in this piece, {error.message}")
        not_before_us = int(events.t[-1]) if events.n else not_before_us
    raise AssertionError("the joined pieces are bad, but no single piece is")
