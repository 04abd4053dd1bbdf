"""kill -9 of a service during a push or an activation, and the model that it serves after its restart."""

import contextlib
import signal
import threading
import time
from dataclasses import replace

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_core.models import bundle
from neurove_protocol.control import CHUNK_SCHEMA
from neurove_protocol.errors import NeuroVEError
from neurove_service.clients import ask
from neurove_service.clients.push_source import PushSource
from neurove_service.config import ClientConfig
from tests.live.conftest import START_S, free_endpoint, service

CONFIG = ModelConfig(
    canonical=CanonicalConfig(width=24, height=16),
    network=NetworkConfig(channels=(4, 4), features=128, hidden=128),
    settle_windows=4,
    low_activity_events=10,
)
"""Fast to run, with several chunks to transfer."""

CHUNK_S = 0.015
"""Added time of each chunk, so that a kill can come between chunks [s]."""


class Node:
    """A service that is killed and restarted, with one folder and one endpoint."""

    def __init__(self, folder):
        self.folder = folder
        self.endpoint = free_endpoint()
        self.config = ClientConfig(connect=(self.endpoint,))
        self.may_serve = set()  # digests after the last kill; empty: anything
        self.ready_s = 0.0
        (folder / "models").mkdir(parents=True, exist_ok=True)

    @contextlib.contextmanager
    def started(self, *more):
        """The running service, with `more` arguments, and its models when it is ready.

        It must serve a model that the last kill allows, and all its models must be complete.
        """
        began = time.monotonic()
        models_dir = str(self.folder / "models")
        with service(self.endpoint, "--models-dir", models_dir, *more) as (process, transport, _):
            self.ready_s = time.monotonic() - began
            (models,) = ask.models(transport, self.config)
            assert more or not self.may_serve or models.active.digest in self.may_serve, "a wrong model serves"
            assert models.unreadable == {}, models.unreadable
            assert ask.health(transport, self.config)[0].ok == models.active.trained
            yield process, transport, models

    def kill_in_a_change(self, seed, *, at_step=None, after_s=None):
        """Start the service, push and activate a new model, and kill -9 it at a step or after a time.

        Returns:
            digest of the new model, the last reported step, and digest of the model that served before.
        """
        path = self.folder / f"model{seed}.safetensors"
        bundle.save(replace(bundle.untrained(seed, CONFIG, f"model{seed}"), trained=True), path)  # for the health
        reported, reached = ["nothing"], threading.Event()

        def on_progress(progress):
            reported.append(progress.step)
            if progress.step == at_step:
                reached.set()

        def change(transport, source):
            with contextlib.suppress(NeuroVEError):  # the node is killed during the change
                ask.push(transport, self.config, source.request, "n1", on_progress)
                ask.activate(transport, self.config, source.digest, "n1", on_progress=on_progress)
                reported.append("acknowledged")
                self.may_serve = {source.digest}
                reached.set()

        with PushSource(path) as source, self.started() as (process, transport, before):
            transport.answer(self.config.keys.chunks(source.digest), slowly(source.chunk), CHUNK_SCHEMA)
            self.may_serve = {source.digest, before.active.digest}
            thread = threading.Thread(target=change, args=(transport, source))
            thread.start()
            reached.wait(after_s if at_step is None else START_S)
            process.end(signal.SIGKILL)
            thread.join(START_S)
            assert not thread.is_alive(), "the client waits for a node that was killed"
        return source.digest, reported[-1], before.active.digest

    def restarted(self):
        """The models after a new start."""
        with self.started() as (_, _, models):
            return models


def slowly(chunk):
    def answer(request):
        threading.Event().wait(CHUNK_S)
        return chunk(request)

    return answer
