"""Composition root of the node: build, start, stop."""

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from neurove_core.geometry.tables import TABLES
from neurove_core.models.bounds import Bounds
from neurove_core.models.bundle import Bundle
from neurove_protocol.control import STATUS_SCHEMA, ChunkRequest
from neurove_protocol.errors import NeuroVEError
from neurove_service import logs
from neurove_service.config import ServiceConfig
from neurove_service.guard import Guard
from neurove_service.lifecycle import notify
from neurove_service.models.active_file import Active, ActiveFile
from neurove_service.models.change import Rules
from neurove_service.models.library import Available
from neurove_service.models.signatures import verifier
from neurove_service.models.slot import ModelSlot
from neurove_service.models.store import ModelStore
from neurove_service.node import memory
from neurove_service.node.condition import Watch
from neurove_service.node.fellows import Fellows
from neurove_service.node.folders import check_folders
from neurove_service.node.followers import Followers
from neurove_service.node.handlers import Handlers
from neurove_service.node.housekeeping import Housekeeping
from neurove_service.node.namesakes import Namesakes
from neurove_service.node.outlets import open_outlet, route
from neurove_service.node.sharing import Moving, Sharing
from neurove_service.node.snapshot import Snapshot
from neurove_service.node.watchdog import Watchdog
from neurove_service.streams.comparison import TrialLimits
from neurove_service.streams.duty import alone
from neurove_service.streams.history import RingSize
from neurove_service.streams.registry import StreamRegistry, StreamSettings
from neurove_service.transport import EndpointError, Report, Transport, open_transport

if TYPE_CHECKING:
    from neurove_service.node.monitor import Monitor

log = logs.get(__name__)

_CHUNK_S = 10.0
_LEAVE_S = 0.1  # for each reply of the node that takes over a stream
_ROUTER_PATIENCE_S = 365 * 86_400.0


def _rules(config: ServiceConfig) -> Rules:
    return Rules(
        probation_s=config.probation_s,
        prime_s=config.prime_s,
        shadow=TrialLimits(config.shadow_divergence),
        probation=TrialLimits(config.probation_divergence),
        bounds=Bounds(config.uncertain_m_s, config.uncertain_rad_s),
        refine=config.refine == "auto",
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


def _monitor(config: ServiceConfig, guard: Guard) -> "Monitor | None":
    """The HTTP server for metrics and probes, if the settings ask for it; it starts before the model is loaded."""
    if config.metrics is None:
        return None
    from neurove_service.node.monitor import Monitor

    return Monitor(config.node, config.metrics, guard)


def _fellows(config: ServiceConfig, transport: Transport) -> Fellows | None:
    """The other nodes that answer the same streams, if the settings ask for a standby."""
    if config.standby == "off":
        return None
    return Fellows(transport, config.keys, config.node, reluctant=config.standby == "last")


def _sharing(config: ServiceConfig) -> Sharing:
    return Sharing(config.node, config.streams, config.copies, config.capacity)


def _registry(
    config: ServiceConfig,
    slot: ModelSlot,
    transport: Transport,
    guard: Guard,
    fellows: Fellows | None,
    takes: Callable[[str], bool],
) -> StreamRegistry:
    return StreamRegistry(
        slot,
        _stream_settings(config),
        lambda name: open_outlet(transport, config.keys, config.node, name),
        guard,
        fellows.open_duty if fellows else alone,
        takes,
    )


def _housekeeping(
    config: ServiceConfig, transport: Transport, registry: StreamRegistry, watch: Watch, guard: Guard
) -> Housekeeping:
    return Housekeeping(
        registry,
        watch.statuses,
        lambda stream: transport.publisher(config.keys.status(stream), STATUS_SCHEMA),
        config.status_period_s,
        guard,
    )


class Service:
    """A node: serves every stream whose packets it receives.

    Args:
        config: checked settings.
        stop: set it to end the service.

    Raises:
        ConfigError: a configured folder is no folder, or cannot be read.
        BadModel, UnknownModel: the configured model cannot be loaded.
        AddressError: the address for metrics cannot be used.
    """

    def __init__(self, config: ServiceConfig, stop: threading.Event) -> None:
        self._config, self._stop = config, stop
        check_folders(config)
        TABLES.max_bytes = config.tables_mib << 20
        self._guard = Guard()
        self._monitor, self._keys = _monitor(config, self._guard), config.keys
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
            guard=self._guard,
        )
        self._slot.resume()

    def available(self) -> Available:
        """The models that can be activated now."""
        return self._slot.available()

    def run(self) -> None:
        """Serve until the stop event is set, then end everything in order.

        Raises:
            EndpointError: an endpoint is in use or wrong.
        """
        try:
            self._run()
        finally:
            if self._monitor is not None:
                self._monitor.close()

    def _run(self) -> None:
        try:
            opened = self._open()
        except EndpointError:
            if self._stop.is_set():  # stopped while it waited for a router
                return
            raise
        with opened as transport:
            fellows, sharing = _fellows(self._config, transport), _sharing(self._config)
            followers = Followers(sharing.takes, fellows) if fellows else None
            takes = followers.takes if followers else sharing.takes
            registry = _registry(self._config, self._slot, transport, self._guard, fellows, takes)
            namesakes = Namesakes(transport, self._keys, self._config.node)
            namesakes.join(self._stop, allowed=self._config.allow_same_name)
            watch = Watch(
                self._config.node,
                registry,
                self._guard,
                self._config.expect_streams,
                lambda: namesakes.count,
                lambda: followers.left_out if followers else (),
            )
            if fellows and followers:
                fellows.join(self._stop)
                sharing.join(transport, self._keys)
                Moving(sharing, registry, fellows, followers, self._guard).start(self._stop)
            handlers = self._declare(transport, registry, watch)
            self._log_ready()
            housekeeping = _housekeeping(self._config, transport, registry, watch, self._guard)
            if self._monitor is not None:
                self._monitor.attach(handlers.report, registry.stuck, lambda: housekeeping.beat_s)
            Watchdog(lambda: housekeeping.beat_s, self._guard).start(self._stop)
            try:
                housekeeping.run(self._stop)
            finally:
                notify("STOPPING=1")
                if fellows:
                    fellows.drain(patience_s=_LEAVE_S)
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
            guard=self._guard,
        )

    def _declare(self, transport: Transport, registry: StreamRegistry, watch: Watch) -> Handlers:
        """Declare everything: first what receives packets, last the token that says that the node is ready."""
        keys, node = self._keys, self._config.node
        handlers = Handlers(
            node,
            self._slot,
            watch.statuses,
            watch.condition,
            self._store,
            self._active_file,
            lambda: not self._stop.is_set() and registry.alive(),
            self._config.labels,
        )
        transport.subscribe_timed(keys.camera(), route(keys, registry, registry.put_camera))
        transport.subscribe_timed(keys.imu(), route(keys, registry, registry.put_imu))
        transport.subscribe_timed(keys.events(), route(keys, registry, registry.put_packet))
        transport.answer(
            keys.health(node),
            Snapshot(handlers.health, lambda: (self._slot.last_change, len(registry.streams()), self._stop.is_set())),
        )
        transport.answer(keys.models(node), handlers.models)
        for key, handle in (
            (keys.activate(node), handlers.activate),
            (keys.rollback(node), handlers.rollback),
            (keys.push(node), self._push_handler(handlers, transport)),
        ):
            transport.answer_streaming(key, handle, after=memory.release_memory)
        transport.token(keys.alive(node))
        return handlers

    def _push_handler(self, handlers: Handlers, transport: Transport) -> Callable[[bytes, Report], bytes]:
        """Answers pushes by pulling the bundle from the client that pushes it."""

        def pull(digest: str, request: ChunkRequest) -> bytes | None:
            answers = transport.ask(self._keys.chunks(digest), request.encode(), _CHUNK_S, haste="bulk")
            return answers[0].payload if answers else None

        return lambda request, report: handlers.push(request, report, pull, self._stop)

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
        before, previous = self._active_file.active, None
        if before is not None:
            ways_back = {before.digest: before.previous, before.trial: before.digest}
            previous = ways_back.get(proven.digest)
        self._active_file.keep(
            Active(
                digest=proven.digest,
                previous=previous,
                configured=self._config.model,
                highest_release=self._active_file.highest_release,
                trial=tried.digest if tried is not None else None,
            )
        )
