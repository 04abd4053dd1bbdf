"""Split a stream of events into packets, for the driver and for recordings of its traffic."""

from collections.abc import Iterator
from typing import Final, NamedTuple

from neurove_core.io.errors import BrokenRecording
from neurove_core.io.order import MAX_GAP_US
from neurove_protocol.events import Events

PACKET_US: Final = 4_000
PACKET_EVENTS: Final = 20_000


class Slice(NamedTuple):
    """Events of a recording for one packet."""

    t0_us: int
    end_us: int  # earliest sensor time at which a real camera could send the slice
    events: Events
    skipped_us: int = 0  # sensor time that was skipped since the beginning, in gaps longer than MAX_GAP_US


def slices(chunks: Iterator[Events]) -> Iterator[Slice]:
    """Split ordered events into slices of at most PACKET_US and PACKET_EVENTS.

    A span without events gives an empty slice, which reports the sensor time to the service. So does the end of the
    recording. A span of more than MAX_GAP_US without events is skipped: the next slice begins at the next event.

    Raises:
        BrokenRecording: the chunks raise it. All events before were yielded.
    """
    start_us: int | None = None
    last_us = skipped_us = 0
    carried = Events.empty()
    broken: BrokenRecording | None = None
    try:
        for chunk in chunks:
            events = Events.join([carried, chunk]) if carried.n else chunk
            start_us = int(events.t[0]) if start_us is None else start_us
            last_us = int(events.t[-1])
            done = 0
            while start_us + PACKET_US <= last_us:
                stop = done + int(events.t[done:].searchsorted(start_us + PACKET_US))
                yield from _split(start_us, events.span(done, stop), skipped_us)
                done, start_us = stop, start_us + PACKET_US
                gap_us = int(events.t[done]) - start_us  # there is an event at last_us
                if gap_us > MAX_GAP_US:
                    skipped_us, start_us = skipped_us + gap_us, start_us + gap_us
            carried = events.span(done, events.n)
    except BrokenRecording as error:
        broken = error
    if start_us is not None:
        yield from _split(start_us, carried, skipped_us)
        yield Slice(last_us + 1, last_us + 1, Events.empty(), skipped_us)
    if broken is not None:
        raise broken


def _split(start_us: int, events: Events, skipped_us: int) -> Iterator[Slice]:
    end_us = start_us + PACKET_US
    if events.n <= PACKET_EVENTS:
        yield Slice(start_us, end_us, events, skipped_us)
        return
    for first in range(0, events.n, PACKET_EVENTS):
        part = events.span(first, min(first + PACKET_EVENTS, events.n))
        yield Slice(int(part.t[0]) if first else start_us, int(part.t[-1]) + 1, part, skipped_us)
