"""History: the newest windows of one stream, and the lanes that were primed with them."""

from typing import NamedTuple

from neurove_protocol import CameraInfo, Sensor
from neurove_service.streams.lane import Lane, Pace, replay, windows_to_prime
from neurove_service.streams.ring import PackedWindow, Ring
from neurove_service.streams.roles import Serving

Optics = tuple[Sensor, CameraInfo | None]


class RingSize(NamedTuple):
    """Bounds of the windows that a stream keeps to prime another model."""

    windows: int = 64
    max_bytes: int = 16 << 20


class Primed(NamedTuple):
    """A lane that was primed outside the worker of its stream."""

    lane: Lane
    ring: Ring  # source of its windows; if the stream has another ring by now, it restarted in the meantime


class History:
    """The ring of one stream, and a lane that another thread primed with it.

    The worker of the stream uses it; any thread may call `offer`.

    Args:
        size: bounds of the ring.
    """

    def __init__(self, size: RingSize) -> None:
        self._size = size
        self.ring = Ring(*size)
        self._offered: Primed | None = None

    def clear(self) -> None:
        """Forget all windows."""
        self.ring = Ring(*self._size)

    def newest_for(self, serving: Serving) -> list[PackedWindow]:
        """The windows that a model is primed with, oldest first."""
        return self.ring.newest(windows_to_prime(serving.estimator))

    def primed(self, serving: Serving, optics: Optics) -> Lane:
        """A new lane of a model that has seen the newest windows."""
        return replay(zero_lane(serving, optics), self.newest_for(serving))

    def offer(self, lane: Primed | None) -> None:
        """Provide a primed lane for the time when its model starts to work on this stream."""
        self._offered = lane

    def take_offered(self, serving: Serving) -> Lane | None:
        """The offered lane, if it has this model and its windows come from the present ring."""
        offered = self._offered
        if offered is None or offered.lane.estimator is not serving.estimator or offered.ring is not self.ring:
            return None
        self._offered = None
        return offered.lane


def zero_lane(serving: Serving, optics: Optics) -> Lane:
    """A lane in the zero state."""
    return Lane(serving, serving.estimator.initial_state(*optics))


def prime(history: History, serving: Serving, optics: Optics, pace: Pace, before: Primed | None = None) -> Primed:
    """Prime a lane from another thread: with the newest windows, or `before` with the windows that arrived since.

    Args:
        history: of the stream.
        serving: a model with the duration and the grid of the windows.
        optics: sensor and camera of the stream.
        pace: see `replay`.
        before: result of an earlier call.
    """
    ring = history.ring
    if before is None or before.ring is not ring:
        entries = ring.newest(windows_to_prime(serving.estimator))
        return Primed(replay(zero_lane(serving, optics), entries, pace), ring)
    replay(before.lane, ring.after(before.lane.state.end_us), pace)
    return before
