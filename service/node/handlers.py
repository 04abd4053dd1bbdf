"""Request bytes to reply bytes, one function per queryable; tested without a network.

A request that takes time also gets `report`, which sends each step as the bytes of a ProgressReply.
"""

import contextlib
import importlib.metadata
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType

from neurove_core.models import manifest
from neurove_core.models.bundle import Bundle
from neurove_protocol.control import (
    ActivateReply,
    ActivateRequest,
    HealthReply,
    HealthRequest,
    ModelInfo,
    ModelsReply,
    ModelsRequest,
    ProgressReply,
    PushReply,
    PushRequest,
    RollbackRequest,
    StreamStatus,
)
from neurove_protocol.errors import Downgrade, NeuroVEError, RolledBack
from neurove_service.models.active_file import ActiveFile
from neurove_service.models.progress import OnProgress, Progress
from neurove_service.models.pull import Pull
from neurove_service.models.signatures import Signed
from neurove_service.models.slot import ModelSlot
from neurove_service.models.store import ModelStore
from neurove_service.node.condition import Condition
from neurove_service.node.health import node_verdict
from neurove_service.streams.roles import Serving

VERSION = importlib.metadata.version("neurove")

_POLL_S = 0.02


class Handlers:
    """Answers the queries of a node.

    Args:
        node: its name.
        slot: its models.
        streams: status of every stream that is served now.
        condition: of the node as a whole.
        store: the models that were pushed to it.
        active_file: what it saves for a restart.
        ready: whether the next packet gets its estimate: the model is warm, and no worker is stuck.
        labels: of the node, for its health.
    """

    def __init__(
        self,
        node: str,
        slot: ModelSlot,
        streams: Callable[[], list[StreamStatus]],
        condition: Callable[[], Condition] = Condition,
        store: ModelStore | None = None,
        active_file: ActiveFile | None = None,
        ready: Callable[[], bool] = lambda: True,
        labels: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self._node, self._slot = node, slot
        self._streams, self._condition, self._ready = streams, condition, ready
        self._store, self._active_file = store or ModelStore(None), active_file or ActiveFile(None)
        self._began, self._labels = time.monotonic(), dict(labels)

    def health(self, request: bytes) -> bytes:
        """Health of this node and its streams."""
        HealthRequest.decode(request)
        return self.report().encode()

    def report(self) -> HealthReply:
        """Health of this node and its streams; any thread may ask."""
        streams = self._streams()
        condition = self._condition()
        ok, why = node_verdict(streams, (*self._slot.faults, *condition.reasons()))
        active = self._slot.active
        return HealthReply(
            node=self._node,
            ok=ok,
            why=why,
            uptime_s=time.monotonic() - self._began,
            version=VERSION,
            model=self._info(active.estimator.bundle.info),
            epoch=active.epoch,
            refused_streams=condition.refused_streams,
            internal_errors=dict(condition.internal_errors),
            dropped_log_lines=condition.dropped_log_lines,
            missing_streams=condition.missing_streams,
            namesakes=condition.namesakes,
            streams=tuple(streams),
            ready=self._ready(),
            change=self._slot.last_change,
            rollbacks=self._slot.rollbacks,
            labels=self._labels,
            form=active.estimator.form,
        )

    def models(self, request: bytes) -> bytes:
        """The models of this node."""
        ModelsRequest.decode(request)
        active, previous, available = self._slot.active, self._slot.previous, self._slot.available()
        serving = {active.estimator.bundle.digest, previous.digest if previous else ""}
        pushed = self._store.pushed()
        models = tuple(self._info(info) for info in available.models)
        reply = ModelsReply(
            node=self._node,
            active=self._info(active.estimator.bundle.info),
            previous=self._info(previous.info) if previous else None,
            epoch=active.epoch,
            available=models,
            unreadable=available.unreadable,
            staged=tuple(info for info in models if info.digest in pushed - serving),
            partial=self._store.partial(),
        )
        return reply.encode()

    def push(self, request: bytes, report: Callable[[bytes], None], pull: Pull, stop: threading.Event) -> bytes:
        """Pull a bundle, check it and store it; `activate` lets it serve."""
        wanted = PushRequest.decode(request)
        with self._progress(report) as on_progress:
            model, signed, fetched = self._store.fetch(wanted, pull, stop, on_progress, self._admit)
        info = model.info.model_copy(update={"signature": signed.state})
        return PushReply(node=self._node, model=info, fetched=fetched).encode()

    def activate(self, request: bytes, report: Callable[[bytes], None] = lambda _: None) -> bytes:
        """Change the model; the previous one serves until the new one is ready.

        It answers when the probation has ended, or when the probation waits for windows.

        Raises:
            RolledBack: the model did not pass its probation.
            Untrusted, Untrained, Downgrade, and the errors of ModelSlot.activate: nothing changed.
        """
        wanted = ActivateRequest.decode(request)
        with self._progress(report) as report_step:
            ended: list[Progress] = []

            def on_progress(progress: Progress) -> None:
                try:
                    report_step(progress)
                finally:
                    if progress.step in ("done", "rolled_back", "waiting"):
                        ended.append(progress)

            for info in self._slot.available().models:
                if info.name == wanted.model or info.digest.startswith(wanted.model):
                    self._admit(info, self._store.signed(info.digest))
            previous, serving = self._slot.activate(
                wanted.model,
                expect=wanted.expect,
                shadow_s=wanted.shadow_s,
                canary=frozenset(wanted.canary),
                force=wanted.force,
                on_progress=on_progress,
            )
            while not (ended or wanted.canary):
                if self._slot.closing.wait(_POLL_S):
                    break
            if ended and ended[0].step == "rolled_back":
                raise RolledBack(ended[0].text)
        return self._changed(previous, serving)

    def rollback(self, request: bytes, report: Callable[[bytes], None] = lambda _: None) -> bytes:
        """Activate the previous model again, whatever its release: it has served on this node."""
        wanted = RollbackRequest.decode(request)
        with self._progress(report) as on_progress:
            previous, serving = self._slot.rollback(expect=wanted.expect, on_progress=on_progress)
        return self._changed(previous, serving)

    def _changed(self, previous: Bundle, serving: Serving) -> bytes:
        reply = ActivateReply(
            node=self._node,
            active=self._info(serving.estimator.bundle.info),
            previous=self._info(previous.info),
            epoch=serving.epoch,
            changed=previous.digest != serving.estimator.bundle.digest,
        )
        return reply.encode()

    @contextlib.contextmanager
    def _progress(self, report: Callable[[bytes], None]) -> Iterator[OnProgress]:
        """Encode and report each step; the last one is `done`, `rolled_back` or `refused`."""
        last: list[str] = []

        def on_progress(progress: Progress) -> None:
            last.append(progress.step)
            report(ProgressReply(node=self._node, step=progress.step, text=progress.text).encode())

        try:
            yield on_progress
        except NeuroVEError as error:
            if not last or last[-1] not in ("refused", "rolled_back"):
                on_progress(Progress("refused", error.message))
            raise

    def _admit(self, info: ModelInfo, signed: Signed) -> None:
        """Refuse a model that this node must not use.

        A release below the highest that has served needs a trusted signature that allows the downgrade. The trained
        models of this installation are exempt: they are the way back without any bundle.

        Raises:
            Untrained, Downgrade: the model is refused.
        """
        self._slot.check_trained(info)
        if info.trained and self._slot.is_built_in(info.digest):
            return
        release, highest = signed.release_of(info), self._active_file.highest_release
        if not manifest.allowed(release, highest, signed.allow_downgrade):
            raise Downgrade(info.name, release, highest)

    def _info(self, info: ModelInfo) -> ModelInfo:
        try:
            state = self._store.signed(info.digest).state
        except (NeuroVEError, OSError):  # this node would refuse it now
            state = "untrusted"
        return info.model_copy(update={"signature": state})
