"""StreamRegistry: the streams that a node serves, each with its worker; refused streams; eviction of idle streams."""

import os
import threading
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from neurove_protocol.control import StandbyStatus
from neurove_protocol.events import PacketLimits
from neurove_service import logs
from neurove_service.guard import Guard
from neurove_service.streams.duty import OpenDuty, alone
from neurove_service.streams.history import RingSize
from neurove_service.streams.model_source import ModelSource
from neurove_service.streams.stream import Stream
from neurove_service.streams.turns import Slots
from neurove_service.streams.worker import Inbox, Outlet, StreamWorker

log = logs.get(__name__)

MAX_REFUSED = 1024
"""Names of refused streams that are remembered."""

STALLED_LOOP_S = 10.0
"""A worker whose loop has not turned for this time is stuck."""

_JOIN_S = 1.0


class StreamSettings(NamedTuple):
    """Bounds of every stream of a node."""

    max_streams: int
    idle_evict_s: float
    queue_s: float
    queue_bytes: int
    ring: RingSize
    limits: PacketLimits
    node: str | None = None
    max_age_s: float = 1.0


class StreamRegistry:
    """Starts a worker for each stream at its first packet or CameraInfo; thread-safe.

    Args:
        models: gives streams their models.
        settings: bounds of every stream.
        open_outlet: opens the outlet of a stream, by its name; called on the thread of the worker.
        guard: counts internal errors.
        open_duty: opens the duty of a stream.
        takes: whether this node takes a stream, by its name; the packets of the others are ignored.
    """

    def __init__(
        self,
        models: ModelSource,
        settings: StreamSettings,
        open_outlet: Callable[[str], Outlet],
        guard: Guard | None = None,
        open_duty: OpenDuty = alone,
        takes: Callable[[str], bool] = lambda _: True,
    ) -> None:
        self._takes = takes
        self._models, self._settings, self._open_outlet, self._open_duty = models, settings, open_outlet, open_duty
        self._guard = guard or Guard()
        self._workers: dict[str, StreamWorker] = {}
        self._slots = Slots(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
        self._refused: dict[str, float] = {}  # stream -> time of its newest message
        self._lock = threading.Lock()  # of both dicts; only its worker changes a stream
        self._closed = False

    def put_packet(self, stream: str, payload: bytes, received_ns: int, sent_us: int | None = None) -> None:
        """Queue an event packet, on Zenoh's thread: this finds or starts a worker and appends, nothing else."""
        with self._lock:
            worker = self._worker_of(stream)
            if worker is not None:
                worker.put_packet(payload, received_ns, sent_us)

    def put_camera(self, stream: str, payload: bytes, received_ns: int, _sent_us: int | None = None) -> None:
        """Queue a CameraInfo, as put_packet."""
        with self._lock:
            worker = self._worker_of(stream)
            if worker is not None:
                worker.put_camera(payload, received_ns)

    def put_imu(self, stream: str, payload: bytes, received_ns: int, _sent_us: int | None = None) -> None:
        """Queue an IMU packet of a stream that is served; without events there is nothing to aid."""
        with self._lock:
            worker = self._workers.get(stream)
            if worker is not None:
                worker.put_imu(payload, received_ns)

    def refuse(self, name: str) -> None:
        """Count a stream whose name is not valid."""
        with self._lock:
            self._refuse(name)

    @property
    def refused(self) -> int:
        """Number of streams that were refused and are still sending."""
        return len(self._refused)

    def streams(self) -> list[Stream]:
        """The streams that are served now."""
        with self._lock:
            return [worker.stream for worker in self._workers.values()]

    def standby_of(self, name: str) -> StandbyStatus | None:
        """The part of this node in a stream that several nodes can answer."""
        with self._lock:
            worker = self._workers.get(name)
        return worker.duty.status() if worker is not None else None

    def evict_idle(self) -> list[str]:
        """End the workers of idle streams; return their names."""
        idle_ns = self._settings.idle_evict_s * 1e9
        now_ns = time.monotonic_ns()
        with self._lock:
            idle = [
                name
                for name, worker in self._workers.items()
                if now_ns - worker.stream.activity.newest_packet_ns > idle_ns
            ]
            for name in [name for name, heard in self._refused.items() if (now_ns - heard * 1e9) > idle_ns]:
                del self._refused[name]
        self._end(idle)
        for name in idle:
            log.info("stream evicted", stream=name, idle_s=self._settings.idle_evict_s)
        return idle

    def release(self) -> None:
        """End the workers that have retired, because other nodes answer their streams."""
        with self._lock:
            retired = [name for name, worker in self._workers.items() if worker.duty.retired]
        self._end(retired)

    def close(self) -> None:
        """End all workers and start no new ones."""
        with self._lock:
            self._closed = True
            names = list(self._workers)
        self._end(names)

    def alive(self) -> bool:
        """Whether the loop of every worker has turned recently."""
        return not self.stuck()

    def stuck(self) -> list[str]:
        """The streams whose worker is stuck."""
        now_ns = time.monotonic_ns()
        with self._lock:
            workers = list(self._workers.items())
        return [name for name, worker in workers if (now_ns - worker.beat_ns) / 1e9 >= STALLED_LOOP_S]

    def _worker_of(self, name: str) -> StreamWorker | None:
        worker = self._workers.get(name)
        if worker is not None or self._closed or not self._takes(name):
            return worker
        if len(self._workers) >= self._settings.max_streams:
            self._refuse(name)
            return None
        settings = self._settings
        worker = StreamWorker(
            Stream(
                name,
                self._models,
                ring=settings.ring,
                node=settings.node,
                max_age_s=settings.max_age_s,
                guard=self._guard,
            ),
            lambda: self._open_outlet(name),
            Inbox(settings.queue_s, settings.queue_bytes),
            settings.limits,
            self._slots,
            self._guard,
            lambda wake: self._open_duty(name, wake),
        )
        self._workers[name] = worker
        return worker

    def _refuse(self, name: str) -> None:
        known = name in self._refused
        if not known and len(self._refused) < MAX_REFUSED:
            serving, most = len(self._workers), self._settings.max_streams
            log.warning("stream refused", stream=name, serving=serving, max_streams=most)
        if known or len(self._refused) < MAX_REFUSED:
            self._refused[name] = time.monotonic()

    def _end(self, names: Sequence[str]) -> None:
        with self._lock:
            ending = [self._workers.pop(name) for name in names if name in self._workers]
        for worker in ending:
            worker.stop()
        deadline = time.monotonic() + _JOIN_S  # for all together
        for worker in ending:
            worker.join(timeout_s=max(0.0, deadline - time.monotonic()))
