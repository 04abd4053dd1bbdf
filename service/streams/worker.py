"""The queue and the thread of one stream: bytes in from Zenoh's thread, estimates out."""

import itertools
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from neurove_core.ingest.wire import read_packet
from neurove_protocol import CameraInfo
from neurove_protocol.camera import MAX_CAMERA_BYTES
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.events import PacketLimits
from neurove_protocol.velocity import TwistEstimate
from neurove_service import logs
from neurove_service.guard import Guard
from neurove_service.streams.cameras import Cameras
from neurove_service.streams.duty import Alone, Duty
from neurove_service.streams.intake import Arrival
from neurove_service.streams.overload import Overload, newest_whole_window
from neurove_service.streams.runs import MAX_RUN, SMALL_BYTES
from neurove_service.streams.stream import Stream
from neurove_service.streams.turns import Slots

log = logs.get(__name__)

_IDLE_BEAT_S = 0.5
_REOPEN_S = 0.5  # pause before the outlet is opened again after a failure
_REST_S = 0.01  # pause of the loop after an error in it
_RETRY_STANDBY_S = 0.002
_MAX_PAUSE_S = 0.02
_SOON_NS, _GATHER_S = 300_000, 0.001  # packets that follow this soon are gathered: a wake-up costs more than a packet
_MAX_TURN_NS = 50_000_000  # of a worker that leaves out windows: the other streams wait for it
_SAMPLE_BYTES = 256
_MAX_CAMERAS = 16  # CameraInfo messages that wait for the worker
_MAX_IMU = 1024  # IMU packets that wait for the worker: seconds of a usual driver
_MAX_IMU_TOTAL_BYTES = 4 << 20


class Sample(NamedTuple):
    """One message from the network."""

    payload: bytes
    received_ns: int
    is_camera: bool
    sent_us: int | None = None  # as in Arrival

    @property
    def size(self) -> int:
        """Memory of the message, with its overhead [bytes]."""
        return len(self.payload) + _SAMPLE_BYTES


class Inbox:
    """A queue between Zenoh's thread and a worker, bounded in age and bytes; it drops and counts the oldest packets.

    A CameraInfo has a place of its own: it is not dropped with the packets, and packets are not dropped for it.

    The age bound matters most. A worker that falls behind for a moment catches up in a fraction of it, because a window
    costs a tenth of its own duration. A worker that stays behind answers with data no older than this (decision 6).

    Args:
        max_age_s: a packet that is older than this is dropped when the next one arrives [s].
        max_bytes: maximum memory of all packets [bytes].
    """

    def __init__(self, max_age_s: float, max_bytes: int) -> None:
        self._samples: deque[Sample] = deque()
        self.max_age_s, self._max_age_ns, self._max_bytes = max_age_s, max_age_s * 1e9, max_bytes
        self._cameras: deque[tuple[int, Sample]] = deque()  # each with the number of packets that precede it
        self._imu: deque[Sample] = deque()
        self._imu_bytes = self._imu_dropped = 0
        self._bytes = self._dropped = 0
        self._woken = False
        self._changed = threading.Condition()

    def put_camera(self, sample: Sample) -> bool:
        """Append a CameraInfo; False if too many wait."""
        with self._changed:
            if len(self._cameras) >= _MAX_CAMERAS:
                return False
            self._cameras.append((self._dropped + len(self._samples), sample))
            self._changed.notify()
            return True

    def put(self, sample: Sample) -> None:
        """Append a packet; does not wait for the worker."""
        with self._changed:
            waited = not self._samples
            self._samples.append(sample)
            self._bytes += sample.size
            oldest_ns = sample.received_ns - self._max_age_ns
            while self._bytes > self._max_bytes or self._samples[0].received_ns < oldest_ns:
                self._bytes -= self._samples.popleft().size
                self._dropped += 1
                if not self._samples:
                    break
            if waited:
                self._changed.notify()

    def put_imu(self, sample: Sample) -> None:
        """Append an IMU packet; it wakes nobody, because it completes no window."""
        with self._changed:
            self._imu.append(sample)
            self._imu_bytes += sample.size
            while len(self._imu) > _MAX_IMU or self._imu_bytes > _MAX_IMU_TOTAL_BYTES:
                self._imu_bytes -= self._imu.popleft().size
                self._imu_dropped += 1

    def take_imu(self) -> tuple[deque[Sample], int]:
        """All IMU packets, oldest first, and how many were dropped since the last call."""
        with self._changed:
            dropped, self._imu_dropped = self._imu_dropped, 0
            samples, self._imu = self._imu, deque()
            self._imu_bytes = 0
            return samples, dropped

    def wake(self) -> None:
        """Let a waiting `take_all`, or else the next one, return at once."""
        with self._changed:
            self._woken = True
            self._changed.notify_all()

    def take_all(self, timeout_s: float) -> tuple[deque[Sample], int]:
        """All samples, oldest first, or none after the timeout; and how many were dropped since the last call."""
        with self._changed:
            if not self._samples and not self._cameras and not self._woken:
                self._changed.wait(timeout_s)
            self._woken = False
            dropped, self._dropped = self._dropped, 0
            samples, self._samples = self._samples, deque()
            for before, camera in reversed(self._cameras):
                samples.insert(max(0, before - dropped), camera)
            self._cameras.clear()
            self._bytes = 0
            return samples, dropped


class Outlet(NamedTuple):
    """What a worker needs from the network; opened and used on the worker's own thread."""

    ask_camera: Callable[[], CameraInfo | None]
    publish: Callable[[bytes], None]
    close: Callable[[], None]


class StreamWorker:
    """Runs one Stream on its own thread.

    Args:
        stream: only this thread changes its state.
        open_outlet: called first on the thread.
        inbox: the queue.
        limits: limits of packets.
        slots: limit how many workers of the node work at once.
        guard: counts internal errors.
        open_duty: given what wakes this worker.
    """

    def __init__(
        self,
        stream: Stream,
        open_outlet: Callable[[], Outlet],
        inbox: Inbox,
        limits: PacketLimits,
        slots: Slots | None = None,
        guard: Guard | None = None,
        open_duty: Callable[[Callable[[], None]], Duty] = lambda _: Alone(),
    ) -> None:
        self.stream, self.duty = stream, open_duty(inbox.wake)
        self._inbox, self.beat_ns = inbox, time.monotonic_ns()
        self._open_outlet, self._limits = open_outlet, limits
        self._slots, self._guard = slots or Slots(), guard or Guard()
        self._pause_until, self._taken_ns = 0.0, 0  # times: packets that arrive in a pause must not extend it
        self._pending: deque[Sample] = deque()  # taken out of the queue, not yet processed
        self._cameras = Cameras(stream, inbox.wake, self._guard)
        self._overload, self._stopping = Overload(inbox.max_age_s), threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"stream {stream.name}", daemon=True)
        self._thread.start()

    def put_packet(self, payload: bytes, received_ns: int, sent_us: int | None = None) -> None:
        """Queue an event packet."""
        self.stream.activity.arrived_ns = received_ns
        self._inbox.put(Sample(payload, received_ns, is_camera=False, sent_us=sent_us))

    def put_camera(self, payload: bytes, received_ns: int) -> None:
        """Queue a CameraInfo."""
        if len(payload) > MAX_CAMERA_BYTES or not self._inbox.put_camera(Sample(payload, received_ns, is_camera=True)):
            self._cameras.lose()

    def put_imu(self, payload: bytes, received_ns: int) -> None:
        """Queue an IMU packet."""
        self._inbox.put_imu(Sample(payload, received_ns, is_camera=False))

    def stop(self) -> None:
        """Ask the thread to end; queued samples are not processed."""
        self._stopping.set()
        self._cameras.stop()
        self._inbox.wake()

    def join(self, timeout_s: float) -> None:
        """Wait for the end of the thread."""
        self._thread.join(timeout_s)

    def _run(self) -> None:
        outlet = self._opened()
        if outlet is None:
            return
        with self._guard.at("camera query", stream=self.stream.name):
            self._cameras.receive(outlet.ask_camera)
        while not self._stopping.is_set():
            self.beat_ns = time.monotonic_ns()
            first = self._pending[0] if self._pending else None
            with self._guard.at("stream loop", stream=self.stream.name):
                self._turn(outlet)
                continue
            if first is not None and self._pending and self._pending[0] is first:
                self._pending.popleft()  # it would fail again
            self._stopping.wait(_REST_S)
        with self._guard.at("end of a stream", stream=self.stream.name):
            outlet.close()
        self.duty.close()

    def _opened(self) -> Outlet | None:
        """The outlet; after a failure it is opened again until the worker stops."""
        while not self._stopping.is_set():
            with self._guard.at("start of a stream", stream=self.stream.name):
                return self._open_outlet()
            self.beat_ns = time.monotonic_ns()
            self._stopping.wait(_REOPEN_S)
        return None

    def _turn(self, outlet: Outlet) -> None:
        """Process the oldest samples, or else a step of the standby model."""
        self._cameras.turn()
        _put(self.duty.turn(self.stream), outlet)
        if not self._pending:
            if time.monotonic_ns() - self._taken_ns < _SOON_NS:
                self._stopping.wait(_GATHER_S)
            pause_s = max(0.0, self._pause_until - time.monotonic())
            self._take(self.duty.wait_s(pause_s if self.stream.lanes.has_backlog else _IDLE_BEAT_S))
        if self._pending:
            with self._slots.serving.turn(last=self.duty.can_wait) as begun:
                if begun:
                    self._work_next(outlet)
        elif self.stream.lanes.has_backlog:
            self._pause_until = time.monotonic() + self._run_standby()

    def _take(self, timeout_s: float) -> None:
        samples, dropped = self._inbox.take_all(timeout_s)
        self._taken_ns = time.monotonic_ns()
        self._pending.extend(samples)
        if dropped:
            self.stream.overloaded(dropped)
        inertial, missing = self._inbox.take_imu()  # after the packets: samples up to their time have arrived
        self.stream.inertial.drop(missing)
        for one in inertial:
            self.stream.inertial.accept(one.payload, one.received_ns)

    def _work_next(self, outlet: Outlet) -> None:
        now_ns, answered = time.monotonic_ns(), -1
        if self._overload.must_shed(now_ns - self._pending[0].received_ns, now_ns):
            self._take(0)
            answered = self.stream.counters.estimates if self._shed() else -1
        self._work_some(now_ns, outlet)
        while (
            self._pending and self.stream.counters.estimates == answered and time.monotonic_ns() < now_ns + _MAX_TURN_NS
        ):
            self._work_some(now_ns, outlet)  # the rest of the window would be too old at the next turn

    def _work_some(self, now_ns: int, outlet: Outlet) -> None:
        """Process the oldest samples: a run of small packets, or one."""
        if len(self._pending) == 1 or not self._work_run(now_ns, outlet):
            self._work(self._pending.popleft(), now_ns, outlet)

    def _work_run(self, now_ns: int, outlet: Outlet) -> bool:
        """Process the small packets at the begin of the queue at once; whether there are any."""
        first = self._pending[0]
        if first.is_camera or len(first.payload) > SMALL_BYTES:
            return False
        alike = itertools.takewhile(
            lambda one: not one.is_camera and (one.sent_us is None) == (first.sent_us is None), self._pending
        )
        run = self.stream.collect([one.payload for one in itertools.islice(alike, MAX_RUN)], self._limits)
        if run is None:
            return False
        packets = [self._pending.popleft() for _ in run.marks]
        arrival = Arrival(packets[-1].received_ns, now_ns, packets[-1].sent_us)
        try:
            for estimate in self.stream.accept_run(run, arrival):
                self._publish(estimate, outlet)
        except NeuroVEError as error:  # such as no memory for the look-up table of the sensor
            for packet in packets:
                self._refused(packet, error)
        except Exception as error:  # noqa: BLE001  # as for a single packet
            self._guard.caught("packet", error, stream=self.stream.name, packets=len(packets))
            self.stream.failed(len(packets))
        return True

    def _shed(self) -> bool:
        """Leave out all windows before the newest one whose events have all arrived; False if there are none."""
        window = self.stream.lanes.open_window
        payloads = [None if one.is_camera else one.payload for one in self._pending]
        found = newest_whole_window(payloads, self._limits, window) if window is not None else None
        if found is None:
            return False
        left_out = [self._pending.popleft() for _ in range(found.packets)]
        self._pending.extendleft(reversed([sample for sample in left_out if sample.is_camera]))
        self.stream.shed(sum(not sample.is_camera for sample in left_out), found.start_us)
        return True

    def _run_standby(self) -> float:
        """Run one step of the standby model; return the pause after it [s], which leaves the processor to others."""
        if not self._slots.standby.acquire(blocking=False):
            return _RETRY_STANDBY_S
        began = time.monotonic()
        try:
            self.stream.lanes.run_standby()
        finally:
            self._slots.standby.release()
        return min(_MAX_PAUSE_S, time.monotonic() - began)  # as long as the step: half of the time

    def _work(self, sample: Sample, now_ns: int, outlet: Outlet) -> None:
        if sample.is_camera:
            self._cameras.receive(lambda: CameraInfo.decode(sample.payload))
            return
        try:
            arrival = Arrival(sample.received_ns, now_ns, sample.sent_us)
            packet = read_packet(sample.payload, self._limits)
            for estimate in self.stream.accept(packet, arrival):
                self._publish(estimate, outlet)
        except NeuroVEError as error:
            self._refused(sample, error)
        except Exception as error:  # noqa: BLE001  # an internal error on one packet must not end the stream
            self._guard.caught("packet", error, stream=self.stream.name)
            self.stream.failed()

    def _refused(self, sample: Sample, error: NeuroVEError) -> None:
        total = self.stream.refused(sample.received_ns, error.message)
        if total & (total - 1) == 0:  # log the 1st, 2nd, 4th, 8th, ...: packets are only counted
            log.warning("packet refused", stream=self.stream.name, why=error.message, total=total)

    def _publish(self, estimate: TwistEstimate, outlet: Outlet) -> None:
        done = _published_now(estimate)
        _put(self.duty.answer(done), outlet)
        self.stream.activity.published(done)


def _put(estimates: list[TwistEstimate], outlet: Outlet) -> None:
    for one in estimates:
        outlet.publish(_published_now(one).encode())


def _published_now(estimate: TwistEstimate) -> TwistEstimate:
    trace = estimate.trace.model_copy(update={"published_ns": time.monotonic_ns()})
    return estimate.model_copy(update={"trace": trace})
