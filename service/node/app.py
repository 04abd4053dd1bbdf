"""Composition root of the node: build, start, stop."""

import functools
import threading
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
from neurove_service.models.change import Rules
from neurove_service.models.signatures import verifier
from neurove_service.models.slot import ModelSlot
from neurove_service.models.store import ModelStore
from neurove_service.node import memory
from neurove_service.node.handlers import Handlers
from neurove_service.node.health import stream_status
from neurove_service.node.housekeeping import Housekeeping
from neurove_service.streams.comparison import TrialLimits
from neurove_service.streams.history import RingSize
from neurove_service.streams.registry import StreamRegistry, StreamSettings
from neurove_service.streams.worker import Outlet
from neurove_service.transport import EndpointError, OnTimedSample, Report, Transport, open_transport

log = logs.get(__name__)

_ASK_CAMERA_S = 1.0
_KNOWN_KEYS = 2048
_CHUNK_S = 10.0
_ROUTER_PATIENCE_S = 365 * 86_400.0


def _rules(config: ServiceConfig) -> Rules:
    return Rules(
        probation_s=config.probation_s,
        prime_s=config.prime_s,
        shadow=TrialLimits(config.shadow_divergence),
        probation=TrialLimits(config.probation_divergence),
    )


def _stream_settings(config: ServiceConfig) -> StreamSettings:
    return StreamSettings(
        max_streams=config.max_streams,
        idle_evict_s=config.idle_evict_s,
        queue_s=config.queue_s,
        queue_bytes=config.queue_mib << 20,
        ring=RingSize(config.ring_windows, config.ring_mib << 20),
        limits=config.limits,
        node=config.node,
        max_age_s=config.max_age_s,
    )


class Service:
    """A node: serves every stream whose packets it receives.

    Args:
        config: checked settings.
        stop: set it to end the service.

    Raises:
        BadModel, UnknownModel: the configured model cannot be loaded.
    """

    def __init__(self, config: ServiceConfig, stop: threading.Event) -> None:
        self._config, self._stop = config, stop
        self._keys = config.keys
        self._active_file = ActiveFile(config.state_folder)
        self._store = ModelStore(
            config.state_folder, config.models_dir, config.store_mib << 20, verifier(config.trusted_keys)
        )
        last = self._last_active()
        self._slot = ModelSlot(
            config.model,
            config.models_dir,
            _rules(config),
            on_changed=self._save_active,
            pushed=self._store.files,
            kept=(last.digest, last.previous) if last else (None, None),
            trained_only=bool(config.trusted_keys),
            trial=last.trial if last else None,
            on_trial=self._save_trial,
        )
        self._slot.resume()

    def run(self) -> None:
        """Serve until the stop event is set, then end everything in order.

        Raises:
            EndpointError: an endpoint is in use or wrong.
        """
        try:
            opened = self._open()
        except EndpointError:
            if self._stop.is_set():  # stopped while it waited for a router
                return
            raise
        with opened as transport:
            registry = StreamRegistry(
                self._slot, _stream_settings(self._config), lambda name: self._open_outlet(name, transport)
            )
            self._declare(transport, registry)
            self._log_ready()
            try:
                self._housekeeping(transport, registry).run(self._stop)
            finally:
                notify("STOPPING=1")
                self._slot.close()
                registry.close()
        log.info("stopped", node=self._config.node)

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

    def _declare(self, transport: Transport, registry: StreamRegistry) -> None:
        """Declare everything: first what receives packets, last the token that says that the node is ready."""
        keys, node = self._keys, self._config.node
        handlers = Handlers(
            node,
            self._slot,
            lambda: self._statuses(registry),
            lambda: registry.refused,
            self._store,
            self._active_file,
            lambda: not self._stop.is_set() and registry.alive(),
        )
        transport.subscribe_timed(keys.camera(), self._route(registry, registry.put_camera))
        transport.subscribe_timed(keys.events(), self._route(registry, registry.put_packet))
        transport.answer(keys.health(node), handlers.health)
        transport.answer(keys.models(node), handlers.models)
        for key, handle in (
            (keys.activate(node), handlers.activate),
            (keys.rollback(node), handlers.rollback),
            (keys.push(node), self._push_handler(handlers, transport)),
        ):
            transport.answer_streaming(key, handle, after=memory.release_memory)
        transport.token(keys.alive(node))

    def _route(self, registry: StreamRegistry, put: Callable[[str, bytes, int, int | None], None]) -> OnTimedSample:
        """A subscriber's callback: queue each message in the worker of its stream."""
        stream_of = functools.lru_cache(_KNOWN_KEYS)(self._keys.stream_of)

        def on_sample(key: str, payload: bytes, received_ns: int, sent_us: int | None) -> None:
            try:
                name = stream_of(key)
            except NeuroVEError:  # not a valid name
                registry.refuse(key)
                return
            put(name, payload, received_ns, sent_us)

        return on_sample

    def _push_handler(self, handlers: Handlers, transport: Transport) -> Callable[[bytes, Report], bytes]:
        """Answers pushes by pulling the bundle from the client that pushes it."""

        def pull(digest: str, request: ChunkRequest) -> bytes | None:
            answers = transport.ask(self._keys.chunks(digest), request.encode(), _CHUNK_S, bulk=True)
            return answers[0].payload if answers else None

        return lambda request, report: handlers.push(request, report, pull, self._stop)

    def _open_outlet(self, stream: str, transport: Transport) -> Outlet:
        """What the worker of a stream needs from the network."""
        publisher = transport.publisher(self._keys.velocity(stream), VELOCITY_SCHEMA, urgent=True)
        undeclare_token = transport.token(self._keys.serves(self._config.node, stream))
        log.info("stream started", stream=stream)

        def ask_camera() -> CameraInfo | None:
            answers = transport.ask(self._keys.camera(stream), b"", _ASK_CAMERA_S)
            return CameraInfo.decode(answers[0].payload) if answers else None

        def close() -> None:
            undeclare_token()
            publisher.close()

        return Outlet(ask_camera, publisher.put, close)

    def _housekeeping(self, transport: Transport, registry: StreamRegistry) -> Housekeeping:
        return Housekeeping(
            registry,
            lambda: self._statuses(registry),
            lambda stream: transport.publisher(self._keys.status(stream), STATUS_SCHEMA),
            self._config.status_period_s,
        )

    def _statuses(self, registry: StreamRegistry) -> list[StreamStatus]:
        return [stream_status(self._config.node, stream) for stream in registry.streams()]

    def _log_ready(self) -> None:
        config, model = self._config, self._slot.active.estimator.bundle
        endpoints = ", ".join((*config.listen, *config.connect))
        log.info("ready", node=config.node, endpoints=endpoints, model=model.name, trained=model.trained)
        notify("STATUS=serving")
        notify("READY=1")

    def _last_active(self) -> Active | None:
        """The last active model, if it takes precedence over the configured model."""
        active = self._active_file.active
        if active is None:
            return None
        if active.configured != self._config.model:
            log.info("configured model is newer than the last active one", model=self._config.model)
            return None
        try:
            for digest in (active.digest, active.trial):
                if digest is not None:
                    self._store.signed(digest)
        except NeuroVEError as error:
            log.warning("cannot restore the last active model", digest=digest, why=error.message)
            return None if digest == active.digest else active.model_copy(update={"trial": None})
        return active

    def _save_active(self, model: Bundle) -> None:
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

    def _save_trial(self, tried: Bundle | None, proven: Bundle) -> None:
        """Save a model whose probation waits for windows, next to the model before it; None: it waits no more."""
        before = self._active_file.active
        same = before is not None and before.digest == proven.digest
        self._active_file.keep(
            Active(
                digest=proven.digest,
                previous=before.previous if before is not None and same else None,
                configured=self._config.model,
                highest_release=self._active_file.highest_release,
                trial=tried.digest if tried is not None else None,
            )
        )
