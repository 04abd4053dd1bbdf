"""LiveSource: the interface of a camera or a network stream that is read as its events come."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

from neurove_core.io.errors import RecordingError
from neurove_core.io.faults import Faults
from neurove_protocol.camera import CameraInfo
from neurove_protocol.errors import EXIT_FAILURE
from neurove_protocol.events import Events, Sensor
from neurove_protocol.imu import Imu

WAIT_S: Final = 0.02
"""A source yields a batch at least this often; below the length of a window, so that a stationary scene has ticks."""


class LiveEnded(RecordingError):
    """A live source ended: the camera was unplugged, or the writer of a stream is gone."""

    code = "live_source_ended"
    exit_code = EXIT_FAILURE

    def __init__(self, name: str, why: str) -> None:
        super().__init__(f"{name}: {why}", value=name, why=why)


class NoCamera(RecordingError):
    """No live source can be opened: no camera, no permission, or no stream at this address."""

    code = "no_camera"
    exit_code = EXIT_FAILURE

    def __init__(self, source: str, why: str) -> None:
        super().__init__(f"{source}: {why}", value=source, why=why)


class Batch(NamedTuple):
    """What has arrived since the previous batch; possibly nothing."""

    events: Events  # valid and ordered by time, over all batches
    samples: Imu  # of the inertial unit, ordered by time, in SI units
    now_us: int | None = None  # sensor clock: every event before it has arrived; None if that is unknown
    lost: bool = False  # events before those of this batch were lost
    restarted: bool = False  # the clock began again with this batch


class LiveSource(Protocol):
    """Events of one camera as they come. It has one reader, and is read once."""

    @property
    def name(self) -> str:
        """Short name to display."""

    @property
    def sensor(self) -> Sensor:
        """The pixel array of the events."""

    @property
    def streams(self) -> tuple[str, ...]:
        """The kinds of data: events, and imu if the camera sends inertial samples."""

    @property
    def faults(self) -> Faults:
        """What was lost, discarded or could not be read so far."""

    def camera(self, stream: str) -> CameraInfo | None:
        """The camera parameters, or None if the source does not have them."""

    def batches(self) -> Iterator[Batch]:
        """What arrives, as soon as it does, and at least one batch in WAIT_S.

        Raises:
            LiveEnded: the source ended. All that arrived before was yielded.
        """

    def close(self) -> None:
        """Release the camera or the connection."""


@dataclass(frozen=True, slots=True)
class LiveFormat:
    """A kind of live sources, named by the scheme of a URL."""

    about: str  # for people: what to give and what it is, such as "dv://HOST:PORT (dv network stream)"
    scheme: str
    open: Callable[[str, Sensor | None], LiveSource]  # the URL, and a sensor for a source that does not say its size


class QuietClock:
    """The sensor's time while no event arrives, by the clock of this machine.

    The time advances by what has passed here since the newest event arrived, less the longest delay of the
    transmission.

    Args:
        delay_s: events arrive at most this much later than others [s].
        clock: monotonic clock [s].
    """

    def __init__(self, delay_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._delay_s, self._clock = delay_s, clock
        self._newest: tuple[int, float] | None = None  # sensor time [us], and when it arrived

    def arrived(self, t_us: int) -> None:
        """Events until this sensor time [us] have arrived now."""
        self._newest = t_us, self._clock()

    def stop(self) -> None:
        """Nothing is known until the next events, such as after a connection is lost."""
        self._newest = None

    def now_us(self) -> int | None:
        """Sensor time [us] before which every event has arrived, if it is later than the newest event."""
        if self._newest is None:
            return None
        t_us, at = self._newest
        later_us = int((self._clock() - at - self._delay_s) * 1e6)
        return t_us + later_us if later_us > 0 else None
