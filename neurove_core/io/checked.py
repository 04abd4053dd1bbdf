"""Events of a recording's pieces, joined into chunks and checked as they pass."""

from collections.abc import Iterator
from pathlib import Path

from neurove_core.io.errors import BrokenRecording
from neurove_core.io.recording import CHUNK_EVENTS, in_chunks
from protocol.errors import EventOutsideSensor, TimeBackwards
from protocol.events import Events, Sensor, check_events

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
    waiting: list[Events] = []
    broken: BrokenRecording | None = None
    not_before_us: int | None = None
    try:
        for where, events in pieces:
            good, why = _up_to_the_first_fault(events, sensor, not_before_us)
            if good.n:
                waiting.append(good)
                not_before_us = int(good.t[-1])
            if why:
                raise BrokenRecording(path, where, f"in this piece, {why}")
            if sum(one.n for one in waiting) >= _ENOUGH:
                yield from in_chunks(Events.join(waiting))
                waiting = []
    except BrokenRecording as error:
        broken = error
    yield from in_chunks(Events.join(waiting))
    if broken is not None:
        raise broken


def _up_to_the_first_fault(events: Events, sensor: Sensor, not_before_us: int | None) -> tuple[Events, str]:
    try:
        check_events(events, sensor, not_before_us)
    except (EventOutsideSensor, TimeBackwards) as error:
        good = (events.x < sensor.width) & (events.y < sensor.height)
        good[1:] &= events.t[1:] >= events.t[:-1]
        if not_before_us is not None:
            good[0] &= events.t[0] >= not_before_us
        return events.span(0, int(good.argmin())), error.message
    return events, ""
