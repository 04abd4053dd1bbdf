"""Recording: the interface of every source of events."""

from abc import abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry.motion import Poses, Twists
from neurove_core.io.errors import UnknownSource
from neurove_core.io.faults import Faults
from neurove_protocol.camera import CameraInfo
from neurove_protocol.events import Events, Sensor
from neurove_protocol.imu import Imu

CHUNK_EVENTS: Final = 1 << 18
"""Maximum number of events in one chunk. An event has 13 bytes, so a chunk has at most 3.4 MB."""

BLOCK_BYTES: Final = 4 << 20
"""Size of the blocks in which a file is read [bytes]."""


class Triggers(NamedTuple):
    """Edges on a camera's trigger input, ordered by time."""

    t: NDArray[np.int64]  # (N,) sensor clock [us]
    channel: NDArray[np.uint8]  # (N,) number of the input
    level: NDArray[np.uint8]  # (N,) 1 rising, 0 falling


class Frame(NamedTuple):
    """An image that the camera took while it recorded events."""

    t_us: int  # sensor clock, start of exposure where the format has it
    image: NDArray[np.uint8]  # (H, W), or (H, W, 3) as RGB


class Recording(Protocol):
    """Events of one camera, ordered by time, and the other data that was recorded with them.

    Every method can be called any number of times. Each call starts from the beginning of the recording.
    """

    @property
    def name(self) -> str:
        """Short name to display."""

    @property
    def sensor(self) -> Sensor:
        """The pixel array of the events."""

    @property
    def endless(self) -> bool:
        """Whether `chunks` never ends."""

    @property
    def streams(self) -> tuple[str, ...]:
        """The kinds of data in the recording: some of events, imu, frames, triggers, poses and twists."""

    @property
    def faults(self) -> Faults:
        """What the newest pass over each stream skipped, discarded or could not read."""

    def camera(self, stream: str) -> CameraInfo | None:
        """The camera parameters to use for this stream, or None if the recording does not have them."""

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning, ordered by time over all chunks. No chunk is empty.

        Times are in the sensor's clock [us]. A chunk has at most CHUNK_EVENTS events. Memory use is bounded for a
        recording of any length.

        What cannot be used is skipped and counted in `faults`, and the reading goes on where it can.
        """

    def since(self, t_us: int) -> Iterator[Events]:
        """As `chunks`, from the first event at or after this time [us]. Some formats do not read earlier data."""

    def imu(self) -> Iterator[Imu]:
        """All samples of the inertial unit, in batches that are not empty, in SI units.

        The axes are those of the camera's optical frame (x right, y down, z forward) if the format gives the mounting
        of the unit, otherwise those of the unit. The reader's docstring states which.
        """

    def triggers(self) -> Iterator[Triggers]:
        """All trigger edges, in batches that are not empty."""

    def frames(self) -> Iterator[Frame]:
        """All images, ordered by time."""

    def poses(self) -> Poses | None:
        """Ground truth of the camera pose, or None if it was not recorded."""

    def twists(self) -> Twists | None:
        """Ground truth of the camera twist: recorded, or derived from the poses. None if neither was recorded."""


class EventsOnly:
    """Base class of a recording that has only events. Readers of other formats override the methods for their data.

    A reader that counts faults has a field `faults: Faults`.
    """

    __slots__ = ()

    @property
    def faults(self) -> Faults:
        """None: this source has no faults, or its reader does not count them."""
        return Faults()

    @property
    def streams(self) -> tuple[str, ...]:
        """Only events."""
        return ("events",)

    @abstractmethod
    def chunks(self) -> Iterator[Events]:
        """See `Recording`."""

    def camera(self, stream: str) -> CameraInfo | None:
        """None: the format has no camera parameters."""
        return None

    def since(self, t_us: int) -> Iterator[Events]:
        """As `chunks`, from this time [us]. Earlier events are read and skipped."""
        return later(self.chunks(), t_us)

    def imu(self) -> Iterator[Imu]:
        """Nothing."""
        return iter(())

    def triggers(self) -> Iterator[Triggers]:
        """Nothing."""
        return iter(())

    def frames(self) -> Iterator[Frame]:
        """Nothing."""
        return iter(())

    def poses(self) -> Poses | None:
        """None."""
        return None

    def twists(self) -> Twists | None:
        """None."""
        return None


def in_chunks(events: Events) -> Iterator[Events]:
    """Split events into spans of at most CHUNK_EVENTS. Without events there is no span."""
    for first in range(0, events.n, CHUNK_EVENTS):
        yield events.span(first, min(first + CHUNK_EVENTS, events.n))


def later(chunks: Iterator[Events], t_us: int) -> Iterator[Events]:
    """The same chunks without the events before this time [us]."""
    for chunk in chunks:
        first = int(chunk.t.searchsorted(t_us))
        if first < chunk.n:
            yield chunk.span(first, chunk.n)


def refuse_topic(source: str | Path, topic: str | None) -> None:
    """Refuse a topic for a recording that has only one event stream.

    Raises:
        UnknownSource: a topic is given.
    """
    if topic is not None:
        raise UnknownSource(source, f"it has one event stream and no topic {topic!r}")


def valid_prefix(events: Events, sensor: Sensor, not_before_us: int | None) -> Events:
    """The events before the first one that is outside the sensor or out of order."""
    if not events.n:
        return events
    valid = (events.x < sensor.width) & (events.y < sensor.height)
    valid[1:] &= events.t[1:] >= events.t[:-1]
    if not_before_us is not None:
        valid[0] &= events.t[0] >= not_before_us
    return events.span(0, events.n if valid.all() else int(valid.argmin()))


def empty_events(n: int) -> Events:
    """Columns without values, into which a decoder writes up to n events."""
    return Events(np.empty(n, np.int64), np.empty(n, np.uint16), np.empty(n, np.uint16), np.empty(n, np.uint8))
