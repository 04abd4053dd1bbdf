"""Recording: what every source of events looks like to its reader."""

from abc import abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from neurove_core.geometry.motion import Poses, Twists
from neurove_core.io.errors import UnknownSource
from neurove_protocol.camera import CameraInfo
from neurove_protocol.events import Events, Sensor

CHUNK_EVENTS: Final = 1 << 18
"""Most events in one chunk; 13 bytes each, so 3.4 MB."""

BLOCK_BYTES: Final = 4 << 20
"""How much of a file is read at once [bytes]."""


class Imu(NamedTuple):
    """Samples of an inertial unit, ordered by time, in SI."""

    t: NDArray[np.int64]  # (N,) sensor clock [us]
    accel_m_s2: NDArray[np.float64]  # (N, 3) specific force
    gyro_rad_s: NDArray[np.float64]  # (N, 3)


class Triggers(NamedTuple):
    """Edges on a camera's trigger input, ordered by time."""

    t: NDArray[np.int64]  # (N,) sensor clock [us]
    channel: NDArray[np.uint8]  # (N,) which input
    level: NDArray[np.uint8]  # (N,) 1 rising, 0 falling


class Frame(NamedTuple):
    """An image that the camera took beside its events."""

    t_us: int  # sensor clock, start of exposure where the format tells it
    image: NDArray[np.uint8]  # (H, W), or (H, W, 3) as RGB


class Recording(Protocol):
    """Events of one camera, in order, as often as one likes, and what was recorded beside them."""

    @property
    def name(self) -> str:
        """Short, for people."""

    @property
    def sensor(self) -> Sensor:
        """The pixel array that all events lie on."""

    @property
    def endless(self) -> bool:
        """Whether `chunks` never ends."""

    @property
    def streams(self) -> tuple[str, ...]:
        """What it holds, of events, imu, frames, triggers, poses and twists."""

    def camera(self, stream: str) -> CameraInfo | None:
        """The lens as it is to be told for this stream, or None where the recording does not know it."""

    def chunks(self) -> Iterator[Events]:
        """All events from the beginning, ordered by time over all chunks, none of them empty.

        Times are of the sensor's clock [us]. A chunk has at most CHUNK_EVENTS events, and memory stays bounded however
        long the recording is.

        Raises:
            BrokenRecording: after everything whole was handed out.
        """

    def since(self, t_us: int) -> Iterator[Events]:
        """As `chunks`, from the first event at or after this time on; where the format allows, without reading on."""

    def imu(self) -> Iterator[Imu]:
        """All samples of the inertial unit, some at a time, none of them empty; in SI.

        In the camera's optical frame (x right, y down, z forward) where the format tells how the unit is mounted, else
        in its own; the reader's docstring says which.
        """

    def triggers(self) -> Iterator[Triggers]:
        """All trigger edges, some at a time, none of them empty."""

    def frames(self) -> Iterator[Frame]:
        """All images, ordered by time."""

    def poses(self) -> Poses | None:
        """Where the camera truly was, or None where that was not recorded."""

    def twists(self) -> Twists | None:
        """How the camera truly moved: recorded as such, or from the poses; None where neither was recorded."""


class EventsOnly:
    """What a recording answers that holds events alone; the readers of richer formats override what theirs has."""

    __slots__ = ()

    @property
    def streams(self) -> tuple[str, ...]:
        """Events, and nothing else."""
        return ("events",)

    @abstractmethod
    def chunks(self) -> Iterator[Events]:
        """See `Recording`."""

    def camera(self, stream: str) -> CameraInfo | None:
        """None: the format does not tell the lens."""
        return None

    def since(self, t_us: int) -> Iterator[Events]:
        """As `chunks`, from this time on; what is earlier is read and left out."""
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
    """The same events in spans of at most CHUNK_EVENTS; no span where there are none."""
    for first in range(0, events.n, CHUNK_EVENTS):
        yield events.span(first, min(first + CHUNK_EVENTS, events.n))


def later(chunks: Iterator[Events], t_us: int) -> Iterator[Events]:
    """The same chunks without the events before this time."""
    for chunk in chunks:
        first = int(chunk.t.searchsorted(t_us))
        if first < chunk.n:
            yield chunk.span(first, chunk.n)


def refuse_topic(source: str | Path, topic: str | None) -> None:
    """Refuse a choice among event streams where there is one stream only.

    Raises:
        UnknownSource: a topic is given.
    """
    if topic is not None:
        raise UnknownSource(source, f"it has one event stream and no topic {topic!r}")


def whole(events: Events, sensor: Sensor, not_before_us: int | None) -> Events:
    """The events before the first that is outside the sensor or out of order."""
    if not events.n:
        return events
    good = (events.x < sensor.width) & (events.y < sensor.height)
    good[1:] &= events.t[1:] >= events.t[:-1]
    if not_before_us is not None:
        good[0] &= events.t[0] >= not_before_us
    return events.span(0, events.n if good.all() else int(good.argmin()))


def empty_events(n: int) -> Events:
    """Columns for a decoder to write this many events into."""
    return Events(np.empty(n, np.int64), np.empty(n, np.uint16), np.empty(n, np.uint16), np.empty(n, np.uint8))
