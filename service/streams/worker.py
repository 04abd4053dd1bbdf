"""One stream's queue and thread: bytes in from Zenoh's thread, estimates out; the newest packets win."""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from neurove_core.ingest.wire import read_packet
from neurove_protocol import CameraInfo
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import PacketLimits
from neurove_protocol.velocity import TwistEstimate
from neurove_service import logs
from neurove_service.streams.stream import Arrival, Stream

log = logs.get(__name__)

_IDLE_BEAT_S = 0.5
_NO_SPARE_S = 0.002
_MOST_PAUSE_S = 0.02
_SAMPLE_BYTES = 256


class Sample(NamedTuple):
    """One message as it came from the network."""

    payload: bytes
    received_ns: int
    is_camera: bool

    @property
    def size(self) -> int:
        """Bytes that it takes, its own parts included."""
        return len(self.payload) + _SAMPLE_BYTES


class Inbox:
    """A queue between Zenoh's thread and a worker, bounded in age and bytes: full, it drops the oldest and counts it.

    The bound that matters is age: a worker that fell behind for a moment catches up in a fraction of it, for a window
    costs a tenth of its own duration; one that stays behind answers with data no older than this (decision 6).

    Args:
        max_age_s: a sample that waited for so long is dropped when the next one comes.
        max_bytes: of all samples.
    """

    def __init__(self, max_age_s: float, max_bytes: int) -> None:
        self._samples: deque[Sample] = deque()
        self._max_age_ns, self._max_bytes = max_age_s * 1e9, max_bytes
        self._bytes = self._dropped = 0
        self._changed = threading.Condition()

    def put(self, sample: Sample) -> None:
        """Append; never blocks for longer than an append takes."""
        with self._changed:
            self._samples.append(sample)
            self._bytes += sample.size
            oldest_ns = sample.received_ns - self._max_age_ns
            while self._bytes > self._max_bytes or self._samples[0].received_ns < oldest_ns:
                self._bytes -= self._samples.popleft().size
                self._dropped += 1
                if not self._samples:
                    break
            self._changed.notify()

    def wake(self) -> None:
        """Let a waiting take return."""
        with self._changed:
            self._changed.notify_all()

    def take(self, timeout_s: float) -> tuple[Sample | None, int]:
        """The oldest sample, or None after the time out; and how many were dropped since the last call."""
        with self._changed:
            if not self._samples:
                self._changed.wait(timeout_s)
            dropped, self._dropped = self._dropped, 0
            sample = self._samples.popleft() if self._samples else None
            self._bytes -= sample.size if sample else 0
            return sample, dropped


class Outlet(NamedTuple):
    """What a worker needs from the network: made and used on the worker's own thread."""

    ask_camera: Callable[[], CameraInfo | None]
    publish: Callable[[bytes], None]
    close: Callable[[], None]


class StreamWorker:
    """Runs one Stream on its own thread.

    Args:
        stream: the state it alone touches.
        open_outlet: called first on the thread.
        inbox: its queue.
        limits: caps on packets.
        spare: so many workers of the node at once may run a model beside the one that answers; without one, any.
    """

    def __init__(
        self,
        stream: Stream,
        open_outlet: Callable[[], Outlet],
        inbox: Inbox,
        limits: PacketLimits,
        spare: threading.Semaphore | None = None,
    ) -> None:
        self.stream = stream
        self.beat_ns = time.monotonic_ns()
        self._inbox = inbox
        self._open_outlet, self._limits = open_outlet, limits
        self._spare = spare or threading.Semaphore()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"stream {stream.name}", daemon=True)
        self._thread.start()

    def put_packet(self, payload: bytes, received_ns: int) -> None:
        """Queue an event packet."""
        self._inbox.put(Sample(payload, received_ns, is_camera=False))

    def put_camera(self, payload: bytes, received_ns: int) -> None:
        """Queue a CameraInfo."""
        self._inbox.put(Sample(payload, received_ns, is_camera=True))

    def stop(self) -> None:
        """Ask the thread to end; what is queued is not worked on any more."""
        self._stopping.set()
        self._inbox.wake()

    def join(self, timeout_s: float) -> None:
        """Wait for the thread's end."""
        self._thread.join(timeout_s)

    def _run(self) -> None:
        outlet = self._open_outlet()
        try:
            self._see_through(outlet.ask_camera)
            rests_until = 0.0  # a time, not a span: packets that come meanwhile must not begin the rest anew
            while not self._stopping.is_set():
                self.beat_ns = time.monotonic_ns()
                rest_s = max(0.0, rests_until - time.monotonic())
                sample, dropped = self._inbox.take(rest_s if self.stream.owes else _IDLE_BEAT_S)
                if dropped:
                    self.stream.overloaded(dropped)
                if sample is not None:
                    self._work(sample, outlet)
                elif self.stream.owes:
                    rests_until = time.monotonic() + self._attend()
        finally:
            outlet.close()

    def _attend(self) -> float:
        """Give a model beside the one that answers what time is left; how long to leave it to others then [s]."""
        if not self._spare.acquire(blocking=False):
            return _NO_SPARE_S
        began = time.monotonic()
        try:
            self.stream.attend()
        finally:
            self._spare.release()
        return min(_MOST_PAUSE_S, time.monotonic() - began)  # half of the time is others'

    def _work(self, sample: Sample, outlet: Outlet) -> None:
        if sample.is_camera:
            self._see_through(lambda: CameraInfo.decode(sample.payload))
            return
        try:
            arrival = Arrival(sample.received_ns, time.monotonic_ns())
            packet = read_packet(sample.payload, self._limits)
            for estimate in self.stream.accept(packet, arrival):
                self._publish(estimate, outlet)
        except NeuroVEError as error:
            total = self.stream.refused(sample.received_ns)
            if total & (total - 1) == 0:  # logged at 1, 2, 4, 8, ...: counted at packet rate
                log.warning("packet refused", stream=self.stream.name, why=error.message, total=total)
        except Exception:  # a fault on one packet must not end the stream
            self.stream.failed()
            log.exception("packet failed", stream=self.stream.name)

    def _publish(self, estimate: TwistEstimate, outlet: Outlet) -> None:
        trace = estimate.trace.model_copy(update={"published_ns": time.monotonic_ns()})
        stamped = estimate.model_copy(update={"trace": trace})
        outlet.publish(stamped.encode())
        self.stream.published(stamped)

    def _see_through(self, get: Callable[[], CameraInfo | None]) -> None:
        try:
            camera = get()
        except NeuroVEError as error:
            log.warning("camera info refused", stream=self.stream.name, why=error.message)
            return
        if camera is not None:
            self.stream.see_through(camera)
