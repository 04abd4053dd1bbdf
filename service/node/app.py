"""Composition root: build, start, stop; the only file that knows everything."""

import os
import threading
import time
from collections.abc import Callable

from neurove_core.models.bundle import Bundle
from neurove_protocol import CameraInfo
from neurove_protocol.control import STATUS_SCHEMA, ChunkRequest, StreamStatus
from neurove_protocol.errors import NeuroVEError
from neurove_protocol.velocity import SCHEMA as VELOCITY_SCHEMA
from neurove_service import logs
from neurove_service.config import ServiceConfig
from neurove_service.lifecycle import notify
from neurove_service.models.active_file import Active, ActiveFile
from neurove_service.models.signatures import verifier
from neurove_service.models.slot import ModelSlot, Rules
from neurove_service.models.store import ModelStore
from neurove_service.node import memory
from neurove_service.node.handlers import Handlers
from neurove_service.node.health import stream_status
from neurove_service.streams.comparison import TrialLimits
from neurove_service.streams.lanes import RingSize
from neurove_service.streams.stream import Stream
from neurove_service.streams.worker import Inbox, Outlet, StreamWorker
from neurove_service.transport import EndpointError, Publisher, Tell, Transport, open_transport

log = logs.get(__name__)

_TICK_S = 0.1
_WATCHDOG_S = 1.0
_WEDGED_S = 10.0
_ASK_CAMERA_S = 1.0
_CHUNK_S = 10.0
_MOST_REFUSED = 1024
_ROUTER_PATIENCE_S = 365 * 86_400.0


def _rules(config: ServiceConfig) -> Rules:
    return Rules(
        probation_s=config.probation_s,
        prime_s=config.prime_s,
        shadow=TrialLimits(config.shadow_divergence),
        probation=TrialLimits(config.probation_divergence),
    )


class Service:
    """A node: serves every stream that it hears of.

    Args:
        config: checked settings.
        stop: set by whoever wants it to end.

    Raises:
        BadModel, UnknownModel: the configured model can not be loaded.
    """

    def __init__(self, config: ServiceConfig, stop: threading.Event) -> None:
        self._config, self._stop = config, stop
        self._keys = config.keys
        self._active_file = ActiveFile(config.state_folder)
        self._store = ModelStore(
            config.state_folder, config.models_dir, config.store_mib << 20, verifier(config.trusted_keys)
        )
        self._slot = ModelSlot(
            config.model,
            config.models_dir,
            _rules(config),
            on_changed=self._keep,
            pushed=self._store.files,
            kept=self._kept(),
        )
        self._workers: dict[str, StreamWorker] = {}
        self._spare = threading.Semaphore(max(1, (os.cpu_count() or 1) // 2))  # the rest is for those that answer
        self._changing = threading.Lock()  # of the dict; a worker's stream is the worker's alone
        self._refused: dict[str, float] = {}  # stream -> when it was last heard of
        self._handlers = Handlers(
            config.node,
            self._slot,
            self._statuses,
            lambda: len(self._refused),
            self._store,
            self._active_file,
            self._is_ready,
        )

    def run(self) -> None:
        """Serve until the stop event is set, then end everything in order.

        Raises:
            EndpointError: an endpoint is taken or wrong.
        """
        config = self._config
        try:
            opened = self._open()
        except EndpointError:
            if self._stop.is_set():  # told to end while it waited for a router
                return
            raise
        with opened as transport:
            self._declare(transport)
            model = self._slot.active.estimator.bundle
            endpoints = ", ".join((*config.listen, *config.connect))
            log.info("ready", node=config.node, endpoints=endpoints, model=model.name, trained=model.trained)
            notify("STATUS=serving")
            notify("READY=1")
            try:
                self._keep_house(transport)
            finally:
                notify("STOPPING=1")
                self._slot.close()
                self._end_workers(list(self._workers))
        log.info("stopped", node=config.node)

    def _open(self) -> Transport:
        config = self._config
        notify("STATUS=opening a Zenoh session")
        return open_transport(
            config.mode,
            listen=config.listen,
            connect=config.connect,
            config_file=config.zenoh_config,
            patience_s=_ROUTER_PATIENCE_S,
            stop=self._stop,
        )

    def _declare(self, transport: Transport) -> None:
        keys, node = self._keys, self._config.node
        # first what takes packets, then what says that the node is ready for them
        transport.subscribe(keys.camera(), self._route(transport, StreamWorker.put_camera))
        transport.subscribe(keys.events(), self._route(transport, StreamWorker.put_packet))
        transport.answer(keys.health(node), self._handlers.health)
        transport.answer(keys.models(node), self._handlers.models)
        for key, handle in (
            (keys.activate(node), self._handlers.activate),
            (keys.rollback(node), self._handlers.rollback),
            (keys.push(node), self._pushes(transport)),
        ):
            transport.answer_streaming(key, handle, after=memory.release_memory)
        transport.token(keys.alive(node))

    def _pushes(self, transport: Transport) -> Callable[[bytes, Tell], bytes]:
        """Answers pushes by pulling the bundle from whoever pushes it."""

        def pull(digest: str, request: ChunkRequest) -> bytes | None:
            answers = transport.ask(self._keys.chunks(digest), request.encode(), _CHUNK_S, bulk=True)
            return answers[0].payload if answers else None

        return lambda request, tell: self._handlers.push(request, tell, pull, self._stop)

    def _kept(self) -> tuple[str | None, str | None]:
        """Digests of the model that served last and of the one before, where they go before the configured one."""
        active = self._active_file.active
        if active is None:
            return None, None
        if active.configured != self._config.model:
            log.info("configured model is newer than the one that served last", model=self._config.model)
            return None, None
        try:
            self._store.signed(active.digest)
        except NeuroVEError as error:
            log.warning("model that served last is not taken", digest=active.digest, why=error.message)
            return None, None
        return active.digest, active.previous

    def _keep(self, model: Bundle) -> None:
        previous, highest = self._slot.previous, self._active_file.highest_release
        release = self._store.signed(model.digest).release_of(model.info)
        self._active_file.keep(
            Active(
                digest=model.digest,
                previous=previous.digest if previous else None,
                configured=self._config.model,
                highest_release=max(highest, release),
            )
        )

    def _route(
        self, transport: Transport, put: Callable[[StreamWorker, bytes, int], None]
    ) -> Callable[[str, bytes, int], None]:
        """Zenoh's thread: find or start the stream's worker and append to its queue, nothing else."""

        def on_sample(key: str, payload: bytes, received_ns: int) -> None:
            with self._changing:
                worker = self._worker_of(key, transport)
                if worker is not None:
                    put(worker, payload, received_ns)

        return on_sample

    def _worker_of(self, key: str, transport: Transport) -> StreamWorker | None:
        try:
            name = self._keys.stream_of(key)
        except NeuroVEError:
            name = key  # no name we could serve: counted with the refused ones
        worker = self._workers.get(name)
        if worker is not None or self._stop.is_set():
            return worker
        if name == key or len(self._workers) >= self._config.max_streams:
            self._refuse(name)
            return None
        stream = Stream(name, self._slot, ring=RingSize(self._config.ring_windows, self._config.ring_mib << 20))
        worker = StreamWorker(
            stream,
            lambda: self._outlet(name, transport),
            Inbox(self._config.queue_s, self._config.queue_mib << 20),
            self._config.limits,
            self._spare,
        )
        self._workers[name] = worker
        return worker

    def _refuse(self, name: str) -> None:
        known = name in self._refused
        if not known and len(self._refused) < _MOST_REFUSED:
            log.warning("stream refused", stream=name, serving=len(self._workers), cap=self._config.max_streams)
        if known or len(self._refused) < _MOST_REFUSED:
            self._refused[name] = time.monotonic()

    def _outlet(self, stream: str, transport: Transport) -> Outlet:
        publisher = transport.publisher(self._keys.velocity(stream), VELOCITY_SCHEMA, urgent=True)
        take_back = transport.token(self._keys.serves(self._config.node, stream))
        log.info("stream began", stream=stream)

        def ask_camera() -> CameraInfo | None:
            answers = transport.ask(self._keys.camera(stream), b"", _ASK_CAMERA_S)
            return CameraInfo.decode(answers[0].payload) if answers else None

        def close() -> None:
            take_back()
            publisher.close()

        return Outlet(ask_camera, publisher.put, close)

    def _statuses(self) -> list[StreamStatus]:
        with self._changing:
            streams = [worker.stream for worker in self._workers.values()]
        return [stream_status(self._config.node, stream) for stream in streams]

    def _keep_house(self, transport: Transport) -> None:
        """Status messages on change and once per period, eviction of silent streams, the watchdog."""
        publishers: dict[str, Publisher] = {}
        told: dict[str, str] = {}
        next_status = next_watchdog = time.monotonic()
        while not self._stop.wait(_TICK_S):
            now = time.monotonic()
            due = now >= next_status
            for status in self._statuses():
                if due or told.get(status.stream) != status.verdict:
                    self._tell(status, told, publishers, transport)
            if due:
                next_status = now + self._config.status_period_s
                self._evict(publishers, told)
            if now >= next_watchdog and self._alive():
                next_watchdog = now + _WATCHDOG_S
                notify("WATCHDOG=1")

    def _tell(
        self, status: StreamStatus, told: dict[str, str], publishers: dict[str, Publisher], transport: Transport
    ) -> None:
        name = status.stream
        if name not in publishers:
            publishers[name] = transport.publisher(self._keys.status(name), STATUS_SCHEMA)
        if name in told and told[name] != status.verdict:
            log.info("verdict", stream=name, before=told[name], now=status.verdict, why=status.why)
        told[name] = status.verdict
        publishers[name].put(status.encode())

    def _evict(self, publishers: dict[str, Publisher], told: dict[str, str]) -> None:
        idle_ns = self._config.idle_evict_s * 1e9
        now_ns = time.monotonic_ns()
        with self._changing:
            silent = [name for name, one in self._workers.items() if now_ns - one.stream.last_packet_ns > idle_ns]
            for name in [name for name, heard in self._refused.items() if (now_ns - heard * 1e9) > idle_ns]:
                del self._refused[name]
        self._end_workers(silent)
        for name in silent:
            log.info("stream forgotten", stream=name, idle_s=self._config.idle_evict_s)
            told.pop(name, None)
            if name in publishers:
                publishers.pop(name).close()

    def _end_workers(self, names: list[str]) -> None:
        with self._changing:
            ending = [self._workers.pop(name) for name in names]
        for worker in ending:
            worker.stop()
        for worker in ending:
            worker.join(timeout_s=1.0)

    def _is_ready(self) -> bool:
        """Whether the next packet gets its estimate: the model is warm before anything is declared."""
        return not self._stop.is_set() and self._alive()

    def _alive(self) -> bool:
        """Whether every worker's loop has turned lately: what the watchdog wants to know."""
        with self._changing:
            beats = [worker.beat_ns for worker in self._workers.values()]
        return all((time.monotonic_ns() - beat) / 1e9 < _WEDGED_S for beat in beats)
