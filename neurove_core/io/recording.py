"""Recording: what every source of events looks like to its reader."""

from collections.abc import Iterator
from typing import Final, Protocol

from protocol.camera import CameraInfo
from protocol.events import Events, Sensor

CHUNK_EVENTS: Final = 1 << 18
"""Most events in one chunk; 13 bytes each, so 3.4 MB."""

BLOCK_BYTES: Final = 4 << 20
"""How much of a file is read at once [bytes]."""

SUPPORTED: Final = (
    "FILE.aedat4 (DV)",
    "FILE.raw (Prophesee EVT2, EVT3)",
    "a folder with events.txt, or FILE.txt (Event Camera Dataset)",
    "pattern:// (built-in)",
)
"""The sources that `open_source` knows."""


class Recording(Protocol):
    """Events of one camera, in order, as often as one likes."""

    @property
    def name(self) -> str:
        """Short, for people."""

    @property
    def sensor(self) -> Sensor:
        """The pixel array that all events lie on."""

    @property
    def endless(self) -> bool:
        """Whether `chunks` never ends."""

    def camera(self, stream: str) -> CameraInfo | None:
        """The lens as it is to be told for this stream, or None where the recording does not know it."""

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning, ordered by time over all chunks, none of them empty.

        Times are of the sensor's clock [us]. A chunk has at most CHUNK_EVENTS events, and memory stays bounded however
        long the recording is.

        Raises:
            BrokenRecording: after everything whole was handed out.
        """


def in_chunks(events: Events) -> Iterator[Events]:
    """The same events in spans of at most CHUNK_EVENTS; no span where there are none."""
    for first in range(0, events.n, CHUNK_EVENTS):
        yield events.span(first, min(first + CHUNK_EVENTS, events.n))
